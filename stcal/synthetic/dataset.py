"""Data sets of rendered images in a folder, with their truth."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from stcal.boards.board_file import save_board
from stcal.boards.target_file import save_target
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.cameras.read import save_camera
from stcal.io.files import save, unwritable
from stcal.io.json import ByFace, ByGroup, ByImage, ByLabel, Pair, Part, Points, Pose, ResultFile, Vector3
from stcal.labels import BOARD, Label
from stcal.parallel import run_parallel
from stcal.synthetic.body_scene import BodyScene, render_body
from stcal.synthetic.render import RenderOptions, check_lens, encode, render
from stcal.synthetic.scene import Scene, image_circles

FIRST_IMAGE = 1000


class TrueCircle(Part):
    centre_px: Pair
    tilt_deg: float | None = None
    must_find: bool


class TrueImage(Part):
    camera_from_target: Pose | None = Field(None, description="frame of the camera")
    circles: dict[ByLabel, TrueCircle] = Field(
        description="`centre_px` image of the circle's centre (not of the ellipse's), px; `tilt_deg` angle between its "
        "normal and the line of sight; `must_find` whether detection is expected to. Dots are numbered row by row "
        "here: `board:0` …"
    )


class TrueGroup(Part):
    board_circles_target: Points = Field(description="dots as really placed, row-major, target frame, mm")
    images: dict[ByImage, TrueImage] = Field(description="`group/file` → what it shows")


class TrueLens(Part):
    f_number: float = Field(description="focal length / diameter of the aperture")
    focal_mm: float = Field(description="focal length")
    focus_mm: float = Field(description="depth of the plane of focus from the camera's centre")


class TrueOptics(Part):
    lens: TrueLens | None = Field(None, description="a thin lens; without it everything is in focus")
    rim_mm: float | None = Field(
        None,
        description="depth of the faces' circles behind a rim, negative where they are raised; `circles` are those of "
        "the face's surface all the same. The board's dots have those of its design",
    )


class TruthFile(ResultFile):
    """Truth of a scene: mm, target frame, pixels from the centre of the top-left one. A ``faces.json`` is valid too."""

    format: Literal["stcal truth 1", "stcal faces 1"] = Field(
        default="stcal truth 1", description="the file's form and its version; may be left out"
    )
    unit: Literal["mm"] = Field(description="of all lengths")
    reference_face: str = Field(description="face id")
    target_from_face: dict[ByFace, Pose] = Field(description="three-point frame of each face")
    circles: dict[ByLabel, Vector3] = Field(description="`face:circle` → centre, target frame, mm")
    groups: dict[ByGroup, TrueGroup] | None = Field(None, description="by folder of `images`")
    camera_from_target: dict[ByImage, Pose] | None = Field(
        default=None, description="of the photographs of a body that is held, by file below `images`"
    )
    optics: TrueOptics | None = Field(default=None, description="of simulated sets with a thin lens or rims")

    def poses(self) -> dict[str, Pose]:
        """Returns camera_from_target of the images, by name below ``images``."""
        of_groups = (group.images for group in (self.groups or {}).values())
        stated = {name: image.camera_from_target for images in of_groups for name, image in images.items()}
        return {name: pose for name, pose in stated.items() if pose is not None} | (self.camera_from_target or {})

    @classmethod
    def of(
        cls, scene: Scene | BodyScene, image_format: str = "jpg", options: RenderOptions | None = None
    ) -> "TruthFile":
        """Returns the truth of a scene, with images named by :func:`image_name`."""
        given: dict[str, Any] = {}
        if isinstance(scene, BodyScene):
            circles, poses = scene.circles_target(), enumerate(scene.camera_from_target)
            given["camera_from_target"] = {image_name("", i, image_format): pose.matrix() for i, pose in poses}
        else:
            circles = {str(label): xyz for label, xyz in scene.circles_target.items()}
            given["groups"] = {name: _true_group(scene, name, image_format) for name in scene.groups}
            optics: dict[str, Any] = {"lens": TrueLens(**asdict(options.lens))} if options and options.lens else {}
            optics |= {"rim_mm": options.rim_mm} if options and options.rim_mm else {}
            given |= {"optics": TrueOptics(**optics)} if optics else {}
        return cls(
            unit="mm",
            reference_face=scene.target.faces[0].id,
            target_from_face={face: pose.matrix() for face, pose in scene.target_from_face.items()},
            circles=circles,
            **given,
        )


def image_name(group: str, image: int, image_format: str = "jpg") -> str:
    """Returns the name of an image inside ``images``: ``12/IMG_1000.jpg``, ``IMG_1000.jpg`` without a group."""
    return f"{group}/IMG_{FIRST_IMAGE + image}.{image_format}".removeprefix("/")


def _true_group(scene: Scene, name: str, image_format: str) -> TrueGroup:
    group, images = scene.groups[name], {}
    number: dict[Label, str] = {label: f"{BOARD}:{i}" for i, label in enumerate(scene.board.labels())}
    for i, pose in enumerate(group.camera_from_target):
        shown = image_circles(scene, name, i)
        tilts_deg = np.degrees(shown.tilt_rad).tolist()
        rows = zip(shown.labels, shown.centre_px.round(5), tilts_deg, shown.must_find, strict=True)
        circles = {
            number.get(label, label): TrueCircle(centre_px=centre, tilt_deg=round(tilt, 2), must_find=bool(must_find))
            for label, centre, tilt, must_find in rows
        }
        image = TrueImage(camera_from_target=pose.matrix(), circles=circles)
        images[image_name(name, i, image_format)] = image
    return TrueGroup(board_circles_target=group.board_circles_target, images=images)


@require_arguments
def render_all(
    scene: Scene, options: RenderOptions | None = None, workers: int | None = None
) -> dict[str, list[np.ndarray]]:
    """Returns all photographs of a scene, uint8 or uint16 by group, as :func:`stcal.sfm.run` takes them.

    Parameters
    ----------
    scene : Target, board, camera and views.
    options : Appearance of the photographs; the defaults if None.
    workers : Number of processes that render; one per core by default.

    Raises InputError: the lens does not fit the scene.
    """
    options = options or RenderOptions()
    check_lens(scene, options.lens)
    views = scene.views()
    rendered = dict(run_parallel(render, [(scene, *view, options) for view in views], workers))
    return {name: [rendered[k] for k, (group, _) in enumerate(views) if group == name] for name in scene.groups}


@contextmanager
def new_dataset(folder: Path) -> Iterator[None]:
    """Refuses a folder that is not empty or not writable; if the block fails, the folder is left as it was."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("E-OUTPUT-EXISTS", f"data set folder {folder}: exists and is not empty; give another")
    existed = folder.exists()
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
        yield
    except BaseException as error:
        for child in list(folder.iterdir()) if folder.is_dir() else ():
            shutil.rmtree(child) if child.is_dir() else child.unlink()
        if not existed and folder.is_dir():
            folder.rmdir()
        if isinstance(error, OSError):
            raise unwritable(folder, error) from error
        raise


@require_arguments
def write_dataset(
    folder: str | Path,
    scene: Scene | BodyScene,
    render_options: RenderOptions | None = None,
    image_format: Literal["jpg", "png"] = "jpg",
    jpeg_quality: int = 95,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Writes ``images/<group>/IMG_1000.jpg`` …, ``cameras.txt``, ``target.toml``, ``board.toml``, ``truth.json``.

    Returns the paths of the images, in order. A body has neither groups nor a board.

    Parameters
    ----------
    folder : Folder of the data set, new or empty.
    scene : Target, board, camera and views; or a body with its photographs.
    render_options : Appearance of the photographs; the defaults if None. That of a body is in its own options.
    image_format, jpeg_quality : {"jpg", "png"}, int
    workers, progress : Number of processes, one per core by default; called with (done, total).

    Raises InputError: the folder is not empty or cannot be written, or the image format or the lens does not fit.
    """
    folder, options = Path(folder), render_options or RenderOptions()
    if isinstance(scene, BodyScene) and render_options is not None:
        raise InputError("E-OPTION-CONFLICT", "data set: rendering of a body; give BodyOptions to make_body_scene")
    if image_format == "jpg" and options.bit_depth != 8:
        raise InputError("E-OPTION-FORM", f"data set: JPEG holds 8 bits, not {options.bit_depth}; choose png")
    if not 1 <= jpeg_quality <= 100:
        raise InputError("E-OPTION-RANGE", f"data set: JPEG quality {jpeg_quality}, 1 to 100 needed")
    with new_dataset(folder):
        truth = TruthFile.of(scene, image_format, options)
        make: Callable[..., np.ndarray]
        jobs: dict[str, tuple]  # arguments of ``make`` by name of the image
        if isinstance(scene, BodyScene):
            make, drawings = render_body, scene.drawings()
            jobs = {name: (scene, i, drawings) for i, name in enumerate(truth.camera_from_target or ())}
        else:
            check_lens(scene, options.lens)
            save_board(folder / "board.toml", scene.board)
            make, jobs = render, {image_name(*view, image_format): (scene, *view, options) for view in scene.views()}
        save_camera(folder / "cameras.txt", scene.camera)
        save_target(folder / "target.toml", scene.target)
        save(folder / "truth.json", json.dumps(truth.content()) + "\n")
        paths = [folder / "images" / name for name in jobs]
        calls = [(make, path, own, jpeg_quality) for path, own in zip(paths, jobs.values(), strict=True)]
        for done, _ in enumerate(run_parallel(_write_image, calls, workers), 1):
            if progress:
                progress(done, len(calls))
    return paths


def _write_image(make: Callable[..., np.ndarray], path: Path, arguments: tuple, jpeg_quality: int) -> None:
    save(path, encode(make(*arguments), path.suffix, jpeg_quality))
