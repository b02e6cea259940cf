"""Reading of camera files of any kind, recognised by the content; and saving, where each file is read again."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import COLMAP_MODELS, MAX_SIDE_PX, Camera, parameter_names
from stcal.io.cameras import forms, matlab, metashape
from stcal.io.cameras.camera_model import CORRELATION, SIGMA, SQUARE_WITHIN, CameraModel, model_of
from stcal.io.cameras.foreign_lenses import ForeignLens, numbered, of_colmap, of_database, one_of
from stcal.io.cameras.forms import SUFFIXES, WRITERS, CameraForm, name_to_write, written
from stcal.io.cameras.keyed import READ, from_ini, from_keys, is_ini, values_of
from stcal.io.cameras.keys import reading
from stcal.io.cameras.photograph import is_photograph
from stcal.io.covariance import Rows, require_covariance
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_written, save, text_of

SQLITE = b"SQLite format 3\0"
"""First bytes of an SQLite database."""
COLMAP_LINE = re.compile(r"\A(?:[ \t]*(?:#[^\r\n]*)?[\r\n])*[ \t]*[^\s{<]+[ \t]+[A-Z][A-Z0-9_]+(?:[ \t]+\S+){3}")
"""First line of COLMAP's ``cameras.txt`` : a number, a model, and at least three numbers."""

_chosen: ContextVar[str] = ContextVar("_chosen", default="")
"""Name of the camera that is read of a file of several, where the reader is given none."""


@contextmanager
def camera_chosen(name: str) -> Iterator[None]:
    """Read the camera of this name from files of several; for a command's option, which applies to all it reads."""
    token = _chosen.set(name)
    try:
        yield
    finally:
        _chosen.reset(token)


def read_camera(path: str | Path, name: str = "") -> CameraModel:
    """Read a camera file of any kind (``data_layout.md``), recognised by its content; ``name`` : chooses of several."""
    lens = read_lens(path, name)
    if isinstance(lens, CameraModel):
        return lens
    raise unsupported(lens, path)


def unsupported(lens: ForeignLens, path: str | Path) -> InputError:
    """Return the error of a lens whose model is not supported."""
    return InputError(
        "E-CAMERA-MODEL",
        f"camera file {path}: {lens.called} is none of {', '.join(COLMAP_MODELS)}; fit one of them to it with "
        "`stcal camera convert`",
    )


def camera_model(camera: str | Path | Camera | CameraModel) -> CameraModel:
    """Return a camera as a file states it; it may be given as a file, or as either class."""
    if isinstance(camera, str | Path):
        return read_camera(camera)
    return model_of(camera) if isinstance(camera, Camera) else camera


@require_arguments
def load_camera(path: str | Path, name: str = "", size: tuple[int, int] | None = None) -> Camera:
    """Load a camera from a file of any supported kind, which is recognised by the content, with any covariance.

    Parameters
    ----------
    path : str or Path
        File of COLMAP, OpenCV, ROS, Kalibr, EuRoC, MATLAB, Bouguet, Metashape, mrcal or camodocal
        (``data_layout.md``).
    name : str
        Name of the camera in a file of several, such as ``cam1``.
    size : (int, int), optional
        Width and height of the images, px, for a file that does not state them.

    Raises InputError: no such file, a malformed one, one of several cameras or an unsupported lens, or no size.
    """
    return sized_camera(read_camera(path, name), path, size)


def sized_camera(model: CameraModel | ForeignLens, path: str | Path, size: tuple[int, int] | None) -> Camera:
    """Return the camera of a file; ``size`` is taken where the file states none."""
    width, height = size or (0, 0)
    if not (model.width or width) or not (model.height or height):
        raise InputError(
            "E-CAMERA-SIZE", f"camera file {path}: states no image size; give it (--size), width and height in px"
        )
    if isinstance(model, ForeignLens):
        raise unsupported(model, path)
    return model.calibrated(width, height)


def _stated_covariance(text: str, names: list[str]) -> np.ndarray | None:
    """Return the covariance (q, q) in the comments of :func:`write_cameras_txt`; None if there are none."""
    stated = {
        key: [line.split()[2:] for line in text.splitlines() if line.startswith(key)] for key in (SIGMA, CORRELATION)
    }
    if not any(stated.values()):
        return None
    count = len(names)
    try:
        if list(map(len, stated[SIGMA])) != [count] or list(map(len, stated[CORRELATION])) != [count] * count:
            raise InputError("E-CAMERA-COVARIANCE", f"a line of {count} σ and {count}×{count} correlations needed")
        sigma, correlation = np.array(stated[SIGMA][0], float), np.array(stated[CORRELATION], float)
        for name, sigma_of_name, with_itself in zip(names, sigma, np.diagonal(correlation), strict=True):
            # the covariance hides such errors
            if not 0 < sigma_of_name <= MAX_SIDE_PX or not abs(with_itself - 1) <= SQUARE_WITHIN:
                raise InputError(
                    "E-CAMERA-COVARIANCE",
                    f"σ of {name} is {sigma_of_name:g}, its correlation with itself {with_itself:g}; a positive number "
                    f"up to {MAX_SIDE_PX}, and 1 needed",
                )
        covariance = correlation * np.outer(sigma, sigma)
        require_covariance(covariance, count, Rows(tuple(names)), definite=True)
    except (InputError, ValueError) as error:
        raise InputError(
            "E-CAMERA-COVARIANCE",
            f"SIGMA and CORRELATION state no covariance of its parameters: {error}; write it again, or remove these "
            "comments",
        ) from error
    return covariance


def _from_colmap(text: str, name: str) -> CameraModel | ForeignLens:
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    cameras = {row[0]: row[1:] for row in rows}
    if len(cameras) < len(rows):
        raise InputError("E-CAMERA-REPEATED", "two cameras of one number; correct it")
    model, *values = cameras[one_of(list(cameras), numbered(cameras, name))]
    try:
        width, height, *params = (float(value) for value in values)
    except ValueError as error:
        raise InputError("E-CAMERA-CONTENT", f"{' '.join(str(error).split())[:150]}; numbers needed") from error
    lens = of_colmap(model, width, height, params)
    if isinstance(lens, ForeignLens):
        return lens
    return replace(lens, covariance=_stated_covariance(text, parameter_names(lens.colmap_model)))


def read_lens(path: str | Path, name: str = "") -> CameraModel | ForeignLens:
    """Read the lens of a camera file, also of an unsupported model; arguments and errors as :func:`read_camera`."""
    path = Path(path)
    with reading(f"camera file {path}"):
        lens = _read(path, name or _chosen.get())
    return replace(lens, source=str(path)) if isinstance(lens, CameraModel) else lens


def _read(path: Path, name: str) -> CameraModel | ForeignLens:
    try:
        if path.is_file():
            with open(path, "rb") as stream:
                is_database = stream.read(len(SQLITE)) == SQLITE
            if is_database:
                return of_database(path, name)
        content = read_bytes(path, SETTINGS_BYTES)
        for recognised, read in BINARY_FORMATS:
            if recognised(content):
                return read(content, name)
        text = text_of(content)
        return next(read for recognised, read in TEXT_FORMATS if recognised(text))(text, name)
    except OSError as error:
        raise InputError("E-CAMERA-UNREADABLE", f"{error.strerror or error}; give a readable file") from error
    except UnicodeDecodeError as error:
        reason = f"neither text nor a binary file of COLMAP or MATLAB; give a camera file of {READ}"
        if is_photograph(path):
            convert = f"`stcal camera convert {path.name} cameras.txt`"
            reason = f"a photograph; {convert} makes a start for --refine-camera from its EXIF"
        raise InputError("E-CAMERA-UNREADABLE", reason) from error
    except (KeyError, ElementTree.ParseError, yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError(
            "E-CAMERA-UNREADABLE", f"no camera of {READ} ({reason}); check its form, or convert it"
        ) from error


BINARY_FORMATS = (
    (lambda content: content.startswith(matlab.HEADS), matlab.from_mat),
    (forms.is_colmap_binary, forms.from_colmap_binary),
)
"""For each binary format a test of the content and a reader, which is given the content and a name."""
TEXT_FORMATS: tuple[tuple[Callable[[str], bool], Callable[[str, str], CameraModel | ForeignLens]], ...] = (
    (lambda text: COLMAP_LINE.search(text) is not None, _from_colmap),
    (metashape.is_metashape, metashape.from_metashape),
    (forms.is_mrcal, forms.from_mrcal),
    (matlab.is_script, matlab.from_script),
    (is_ini, from_ini),
    (lambda text: True, lambda text, name: from_keys(values_of(text), name)),
)
"""For each text format the same; what no other test recognises has keys and values."""


WRITTEN_PX = 1e-6
"""Largest difference of a projected point, px. Forms with few decimals, such as OpenCV's, round by 1e-8 px."""
ACROSS = 9
"""Number of points across the image, and down it, by which cameras are compared."""


@require_arguments
def save_camera(path: str | Path, camera: Camera, form: CameraForm | None = None, name: str = "") -> tuple[str, ...]:
    """Save a camera in a form of this or another program, and return what it has no place for, such as σ.

    Parameters
    ----------
    path : str or Path
        File to write; it is required to be read as the same camera.
    camera : Camera
        Camera to save, with its covariance if it has one.
    form : str, optional
        ``colmap``, ``opencv``, ``ros``, ``kalibr``, ``mrcal``, ``metashape`` …; if None, that of the suffix: ``.txt``
        colmap, ``.yaml`` opencv, ``.cameramodel`` mrcal, ``.xml`` metashape, ``.mat`` matlab.
    name : str
        Name of the camera, for forms that have a place for it.

    Raises InputError: no form of this suffix, a form that cannot hold the lens, or a file that cannot be written.
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
