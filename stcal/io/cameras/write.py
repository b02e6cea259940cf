"""Camera files that are saved, each of which is read again."""

from pathlib import Path
from typing import cast

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.cameras.forms import SUFFIXES, WRITERS, CameraForm, name_to_write, written
from stcal.io.cameras.read import read_camera
from stcal.io.files import require_written, save

WRITTEN_PX = 1e-6
"""Largest difference of a projected point, px. Forms with few decimals, such as OpenCV's, round by 1e-8 px."""
ACROSS = 9
"""Number of points across the image, and down it, by which cameras are compared."""


@require_arguments
def save_camera(path: str | Path, camera: Camera, form: CameraForm | None = None, name: str = "") -> tuple[str, ...]:
    """Save a camera to a file of this or another program, and require that it is read as the same camera.

    Parameters
    ----------
    path : str or Path
        File to write.
    camera : Camera
        Camera to save, with its covariance if it has one.
    form : str, optional
        ``colmap``, ``opencv``, ``ros``, ``kalibr``, ``mrcal``, ``metashape`` …; if None, that of the suffix: ``.txt``
        colmap, ``.yaml`` opencv, ``.cameramodel`` mrcal, ``.xml`` metashape, ``.mat`` matlab.
    name : str
        Name of the camera, for forms that have a place for it.

    Returns
    -------
    tuple of str
        What the form has no place for, such as σ; nothing for ``colmap``.

    Raises
    ------
    InputError
        No form of this suffix, a form that cannot hold the lens, or a file that cannot be written.
    """
    converted = written(camera, form_of(path, form), name_to_write(name))
    save(Path(path), converted.content)
    require_camera_written(path, camera)
    return converted.lost


def form_of(path: str | Path, form: str | None) -> CameraForm:
    """Return the form of a camera file to write: ``form``, or that of the suffix if it is None."""
    suffix = Path(path).suffix.lower()
    kind = SUFFIXES.get(suffix) if form is None else form
    if kind not in WRITERS:
        unknown = f"form {form} unknown" if form else f"no form of suffix {suffix or 'none'}"
        raise InputError(
            "E-OPTION-FORM",
            f"{path}: {unknown}; give the form (--form), one of {', '.join(WRITERS)}, or one of the suffixes "
            f"{', '.join(SUFFIXES)}",
        )
    return cast(CameraForm, kind)


def require_camera_written(path: str | Path, camera: Camera) -> None:
    """Read a written camera file again, and require that it projects points all over the image to the same pixels."""
    size = np.array([camera.width, camera.height])
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, ACROSS)]), axis=-1) * size
    rays = camera.normalised_from_pixel(grid)
    rays = rays[np.isfinite(rays).all(axis=-1)]

    def again() -> np.ndarray:
        return read_camera(path).sized(*size).pixel_from_normalised(rays)

    require_written(path, again, camera.pixel_from_normalised(rays), WRITTEN_PX, "px")
