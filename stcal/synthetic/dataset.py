"""Data set of a simulated scene: a folder with photographs, camera, designs and truth."""

import json
from collections.abc import Callable
from pathlib import Path

from stcal.errors import InputError
from stcal.io.cameras.model import write_cameras_txt
from stcal.io.design import board_toml, target_toml
from stcal.parallel import run_parallel
from stcal.synthetic.render import RenderOptions, encode, render
from stcal.synthetic.scene import Scene
from stcal.synthetic.truth import TruthFile, image_name

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
    """Writes ``images/<group>/IMG_1000.jpg`` …, ``cameras.txt``, ``target.toml``, ``board.toml``, ``truth.json``.

    Parameters
    ----------
    folder : path
        Folder of the data set. It is created if missing, and must be empty.
    image_format : {"jpg", "png"}
    jpeg_quality : int
    workers : int, optional
        Number of processes that render; one per core by default.
    progress : callable, optional
        Called with the number of images done, and the number of all images.

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
        raise InputError(
            "E-OPTION-FORM", f"data set: image format {image_format}, one of {', '.join(IMAGE_FORMATS)} needed"
        )
    if image_format == "jpg" and options.bit_depth != 8:
        raise InputError("E-OPTION-FORM", f"data set: JPEG holds 8 bits, not {options.bit_depth}; choose png")
    if not 1 <= jpeg_quality <= 100:
        raise InputError("E-OPTION-RANGE", f"data set: JPEG quality {jpeg_quality}, 1 to 100 needed")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "E-OUTPUT-EXISTS", f"data set folder {folder}: exists and is not empty; give a new or an empty folder"
        )
    try:
        truth = json.dumps(TruthFile.of(scene, image_format).content())
        for group in scene.groups:
            (folder / "images" / group).mkdir(parents=True, exist_ok=True)
        write_cameras_txt(folder / "cameras.txt", scene.camera)
        (folder / "target.toml").write_text(target_toml(scene.target), encoding="utf-8")
        (folder / "board.toml").write_text(board_toml(scene.board), encoding="utf-8")
        (folder / "truth.json").write_text(truth + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(
            "E-OUTPUT-UNWRITABLE", f"data set folder {folder}: {error.strerror or error}; give a writable folder"
        ) from error
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


def _write_image(path: Path, scene: Scene, group: str, image: int, options: RenderOptions, jpeg_quality: int) -> None:
    data = encode(render(scene, group, image, options), path.suffix, jpeg_quality)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(
            "E-OUTPUT-UNWRITABLE", f"image {path}: {error.strerror or error}; free space or choose another folder"
        ) from error
