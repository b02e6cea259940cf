"""Poses and views of several cameras on one mount, and the file that lists the cameras."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, require_fields
from stcal.geometry.rigid import Poses
from stcal.handeye.data.pairs import HandEyePoses, Setup
from stcal.handeye.data.views import Views, pairs_of_views
from stcal.io.cameras.model import CameraPrior
from stcal.io.design import Name
from stcal.io.toml import Strict, load_toml


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RigCamera(Brief):
    """Observations of one camera of a rig.

    Parameters
    ----------
    name : str
        Name of the camera.
    views : Views
        v views, with the camera's intrinsics.
    rows : (v,) int array
        Pose of the robot at which each view was taken; no pose twice.
    images : tuple of str
        Name of each view.
    prior : CameraPrior, optional
        Prior of the intrinsics; None if they are exact.
    """

    name: str
    views: Views
    rows: np.ndarray
    images: tuple[str, ...]
    prior: CameraPrior | None = None

    def __post_init__(self):
        require_fields(self, "camera of a rig")
        freeze(self, "rows", (len(self.views),), "rows", int)
        if len(self.images) != len(self.views):
            raise InputError(
                "E-NAMES-COUNT", f"camera {self.name}: {len(self.images)} names of {len(self.views)} views; one each"
            )
        if len(set(self.rows.tolist())) < len(self.rows):
            raise InputError(
                "E-RIG-INSTANT", f"camera {self.name}: two images of one pose of the robot; take one of them out"
            )

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index) -> "RigCamera":
        """Returns the views selected by a mask or list."""
        rows = np.arange(len(self))[index]
        images = tuple(self.images[i] for i in rows)
        return replace(self, views=self.views[rows], rows=self.rows[rows], images=images)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RigPoses(Brief):
    """Cameras on one flange, or in one base, that saw one board from the poses of one robot.

    Parameters
    ----------
    base_from_flange : Poses
        m poses, mm, as the robot states them. All images from one pose share the error of that pose.
    cameras : tuple of RigCamera
        c cameras, each with a name of its own.
    names : tuple of str
        Name of each pose of the robot; ``pose 1`` … where no names are given.
    where : str
        Source of the poses.

    Raises
    ------
    InputError
        No camera, two cameras of one name, or a row that no pose has.
    """

    base_from_flange: Poses
    cameras: tuple[RigCamera, ...]
    names: tuple[str, ...] = ()
    where: str = "rig"

    def __post_init__(self):
        require_fields(self, "rig")
        m = len(self.base_from_flange)
        names = tuple(self.names) or tuple(f"pose {i}" for i in range(1, m + 1))
        object.__setattr__(self, "names", names)
        if len(names) != m:
            raise InputError(
                "E-NAMES-COUNT", f"{self.where}: {len(names)} names of {m} poses of the robot; one each needed"
            )
        called = [camera.name for camera in self.cameras]
        if not called or len(set(called)) < len(called):
            raise InputError(
                "E-RIG-CAMERAS", f"{self.where}: cameras {', '.join(called) or '–'}; one or more, each of its own name"
            )
        for camera in self.cameras:
            if len(camera) and not (camera.rows.min() >= 0 and camera.rows.max() < m):
                raise InputError(
                    "E-RIG-ROW",
                    f"{self.where}: camera {camera.name}: a row that does not exist among the {m} poses; correct it",
                )

    def __len__(self) -> int:
        return len(self.base_from_flange)

    def only(self, rows: np.ndarray) -> "RigPoses":
        """Returns the rig with only the images from these poses of the robot, (k,) int. All poses keep their
        numbers."""
        cameras = tuple(camera[np.isin(camera.rows, rows)] for camera in self.cameras)
        return replace(self, cameras=cameras)

    def pairs(self, i: int) -> HandEyePoses:
        """Returns the pose pairs of one camera, with the board's pose from each view by itself."""
        camera = self.cameras[i]
        where = f"{self.where}: camera {camera.name}"
        return pairs_of_views(self.base_from_flange[camera.rows], camera.views, camera.images, where)


WHAT = "rig file"
FileName = Annotated[str, Field(min_length=1, strict=True)]


class _CameraFile(Strict):
    name: Name
    images: FileName
    camera: FileName
    camera_name: str = ""
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
    ``times`` : times of its images, where their names are not times; ``camera_name`` : name of the intrinsics in a file
    of several cameras."""

    name: str
    images: Path
    camera: Path
    poses: Path
    times: Path | None = None
    camera_name: str = ""


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

    Raises InputError: not TOML, not of the required form, two cameras of one name, or a camera without poses of the
    robot.
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
                "E-RIG-CAMERAS",
                f"{WHAT} {path}: camera {number} is called {entry.name!r} like another camera; give each its own name",
            )
        files = (folder / name for name in (entry.images, entry.camera, poses))
        times = folder / entry.times if entry.times else None
        cameras.append(RigCameraFiles(entry.name, *files, times=times, camera_name=entry.camera_name))
    return RigFiles(path, content.setup, folder / content.board, tuple(cameras))
