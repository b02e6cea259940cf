"""Reader of RIG.toml, which says which files belong to which camera of a rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from stcal.errors import InputError
from stcal.handeye.data.loop import Setup
from stcal.io.design import Name
from stcal.io.toml import Strict, load_toml

WHAT = "rig file"
FileName = Annotated[str, Field(min_length=1, strict=True)]


class _CameraFile(Strict):
    name: Name
    images: FileName
    camera: FileName
    poses: FileName | None = None
    times: FileName | None = None


class _RigFile(Strict):
    setup: Setup
    board: FileName
    poses: FileName | None = None
    camera: list[_CameraFile] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class RigCameraFiles:
    """``name`` of a camera; ``images`` : folder; ``camera`` : intrinsics; ``poses`` : the robot's poses at its images;
    ``times`` : times of its images, where their names are not times."""

    name: str
    images: Path
    camera: Path
    poses: Path
    times: Path | None = None


@dataclass(frozen=True, slots=True)
class RigFiles:
    """``file`` : the rig file; ``setup``; ``board``; ``cameras`` in their order."""

    file: Path
    setup: Setup
    board: Path
    cameras: tuple[RigCameraFiles, ...]

    def read(self) -> list[tuple[str, Path]]:
        """Returns every file and folder that is read, with what each is."""
        files = [(WHAT, self.file), ("board", self.board)]
        for camera in self.cameras:
            keys = ("images", "camera", "poses", *(("times",) if camera.times else ()))
            files += [(f"{camera.name}: {key}", getattr(camera, key)) for key in keys]
        return list(dict(reversed([(path, (what, path)) for what, path in files])).values())


def read_rig_file(path: Path) -> RigFiles:
    """Read a rig file. All paths in it are relative to its folder.

    Raises
    ------
    InputError
        Not TOML, not of the required form, two cameras of one name, or a camera without poses of the robot.
    """
    content = load_toml(path, _RigFile, WHAT, "give a file with setup, board, poses and a [[camera]] for each camera")
    folder, cameras = path.parent, []
    for number, entry in enumerate(content.camera, 1):
        poses = entry.poses or content.poses
        if poses is None:
            raise InputError(
                "E-RIG-POSES",
                f"{WHAT} {path}: camera {entry.name}: no poses of the robot; add `poses`, here or for all",
            )
        if entry.name in [previous.name for previous in cameras]:
            raise InputError(
                "E-RIG-CAMERAS", f"{WHAT} {path}: camera {number} is called {entry.name!r} as another is; one name each"
            )
        files = (folder / name for name in (entry.images, entry.camera, poses))
        cameras.append(RigCameraFiles(entry.name, *files, times=folder / entry.times if entry.times else None))
    return RigFiles(path, content.setup, folder / content.board, tuple(cameras))
