"""A scene as a folder: photographs, camera, designs and truth."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.io.camera import write_cameras_txt
from stcal.io.design import board_toml, target_toml
from stcal.labels import BOARD, Label
from stcal.parallel import run_parallel
from stcal.synthetic.observe import image_circles
from stcal.synthetic.render import RenderOptions, encode, render
from stcal.synthetic.scene import Scene

FIRST_IMAGE = 1000
IMAGE_FORMATS = ("jpg", "png")


def write_dataset(
    folder: str | Path,
    scene: Scene,
    render_options: RenderOptions | None = None,
    image_format: str = "jpg",
    jpeg_quality: int = 95,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write ``images/<group>/IMG_1000.jpg`` …, ``cameras.txt``, ``target.toml``, ``board.toml``, ``truth.json``.

    Parameters
    ----------
    folder : path
        Made if missing; must be empty.
    image_format : {"jpg", "png"}
    jpeg_quality : int
    workers : int, optional
        Processes that render; default one per core.
    progress : callable, optional
        Called with the number of images done, and that of all.

    Returns
    -------
    list of Path
        The images, in order.

    Raises
    ------
    InputError
        The folder is not empty or cannot be written, or the image format does not fit.
    """
    folder, options = Path(folder), render_options or RenderOptions()
    if image_format not in IMAGE_FORMATS:
        raise InputError(f"data set: image format {image_format}, one of {', '.join(IMAGE_FORMATS)} needed")
    if image_format == "jpg" and options.bit_depth != 8:
        raise InputError(f"data set: JPEG holds 8 bits, not {options.bit_depth}; choose png")
    if not 1 <= jpeg_quality <= 100:
        raise InputError(f"data set: JPEG quality {jpeg_quality}, 1 to 100 needed")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"data set folder {folder}: exists and is not empty; give a new or an empty folder")
    try:
        for group in scene.groups:
            (folder / "images" / group).mkdir(parents=True, exist_ok=True)
        write_cameras_txt(folder / "cameras.txt", scene.camera)
        (folder / "target.toml").write_text(target_toml(scene.target), encoding="utf-8")
        (folder / "board.toml").write_text(board_toml(scene.board), encoding="utf-8")
        (folder / "truth.json").write_text(json.dumps(truth(scene, image_format)) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"data set folder {folder}: {error.strerror or error}; give a writable folder") from error
    jobs = {
        image_name(group, i, image_format): (scene, group, i, options, jpeg_quality)
        for group, g in scene.groups.items()
        for i in range(len(g.camera_from_target))
    }
    paths = {name: folder / "images" / name for name in jobs}
    written = run_parallel(_write_image, [(path, *jobs[name]) for name, path in paths.items()], workers)
    for done, _ in enumerate(written, 1):
        if progress:
            progress(done, len(jobs))
    return list(paths.values())


def image_name(group: str, image: int, image_format: str = "jpg") -> str:
    """Name of an image inside ``images``: ``12/IMG_1000.jpg``."""
    return f"{group}/IMG_{FIRST_IMAGE + image}.{image_format}"


def truth(scene: Scene, image_format: str = "jpg") -> dict:
    """The content of ``truth.json``: mm, target frame, pixels from the centre of the top-left pixel.

    Board dots are numbered row by row here, ``board:0`` ….
    """
    return {
        "unit": "mm",
        "reference_face": scene.reference_face,
        "target_from_face": {face: pose.matrix().tolist() for face, pose in scene.target_from_face.items()},
        "circles": {label: xyz.tolist() for label, xyz in scene.circles_target.items()},
        "groups": {
            name: {
                "board_circles_target": g.board_circles_target.tolist(),
                "images": {
                    image_name(name, i, image_format): {
                        "camera_from_target": pose.matrix().tolist(),
                        "circles": _image_truth(scene, name, i),
                    }
                    for i, pose in enumerate(g.camera_from_target)
                },
            }
            for name, g in scene.groups.items()
        },
    }


def _image_truth(scene: Scene, group: str, image: int) -> dict:
    seen = image_circles(scene, group, image)
    number: dict[Label, str] = {label: f"{BOARD}:{i}" for i, label in enumerate(scene.board.labels())}
    return {
        number.get(label, label): {
            "centre_px": [round(float(x), 5) for x in centre],
            "tilt_deg": round(float(np.degrees(tilt)), 2),
            "must_find": bool(must),
        }
        for label, centre, tilt, must in zip(seen.labels, seen.centre_px, seen.tilt_rad, seen.must_find, strict=True)
    }


def _write_image(path: Path, scene: Scene, group: str, image: int, options: RenderOptions, jpeg_quality: int) -> None:
    data = encode(render(scene, group, image, options), path.suffix, jpeg_quality)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(f"image {path}: {error.strerror or error}; free space or choose another folder") from error
