"""Reading of camera files of any kind, which is recognised by the content."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import COLMAP_MODELS, MAX_SIDE_PX, Camera, parameter_names
from stcal.io.cameras import forms, matlab, metashape
from stcal.io.cameras.foreign import ForeignLens, numbered, of_colmap, of_database, one_of
from stcal.io.cameras.keyed import from_keys
from stcal.io.cameras.model import CORRELATION, SIGMA, SQUARE_WITHIN, CameraModel, model_of
from stcal.io.cameras.photograph import is_photograph
from stcal.io.cameras.texts import values_of, values_of_archive
from stcal.io.covariance import Rows, require_covariance
from stcal.io.files import SETTINGS_BYTES, read_bytes, text_of

SQLITE = b"SQLite format 3\0"
"""First bytes of an SQLite database."""
ARCHIVE, PICKLE = b"PK\x03\x04", (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")
"""First bytes of NumPy's archives, and of Python's pickles."""


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
    """Read a camera file of any supported kind, which is recognised by the content.

    ``path`` : COLMAP, OpenCV, ROS, ROS-Industrial, Kalibr, mrcal or Metashape (``data_layout.md``); ``name`` : name of
    the camera in a file of several.

    Raises InputError: the file is missing or malformed, holds more than one camera, or a lens of an unsupported model.
    """
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
    """Load a camera from a file of any supported kind, which is recognised by the content.

    Parameters
    ----------
    path : str or Path
        File of COLMAP, OpenCV, ROS, Kalibr, mrcal, Metashape, MATLAB and others (``data_layout.md``).
    name : str
        Name of the camera in a file of several, such as ``cam1``.
    size : (int, int), optional
        Width and height of the images, px, for a file that does not state them.

    Returns
    -------
    Camera
        With its covariance if the file states one.

    Raises
    ------
    InputError
        The file is missing or malformed, holds more than one camera, a lens of an unsupported model, or no size.
    """
    return sized_camera(read_camera(path, name), path, size)


def sized_camera(model: CameraModel | ForeignLens, path: str | Path, size: tuple[int, int] | None) -> Camera:
    """Return the camera of a file; ``size`` is taken where the file states none.

    Raises InputError: no size is known.
    """
    width, height = size or (0, 0)
    if not (model.width or width) or not (model.height or height):
        raise InputError(
            "E-CAMERA-SIZE", f"camera file {path}: states no image size; give it (--size), width and height in px"
        )
    if isinstance(model, ForeignLens):
        raise unsupported(model, path)
    return model.calibrated(width, height)


def read_lens(path: str | Path, name: str = "") -> CameraModel | ForeignLens:
    """Read the lens of a camera file, also of an unsupported model; arguments and errors as :func:`read_camera`."""
    path, name = Path(path), name or _chosen.get()
    try:
        database = path.is_file() and _starts_with(path, SQLITE)
        content = b"" if database else read_bytes(path, SETTINGS_BYTES)
    except OSError as error:
        raise InputError(
            "E-CAMERA-UNREADABLE", f"camera file {path}: {error.strerror or error}; give a readable file"
        ) from error
    except ValueError as error:  # a NUL in the name
        raise _no_text(path) from error
    if database:
        return of_database(path, name)
    if matlab.is_mat(content):
        return matlab.from_mat(content, name, str(path))
    if forms.is_colmap_binary(content):
        return forms.from_colmap_binary(content, name, str(path))
    try:
        if content.startswith(ARCHIVE):
            return from_keys(values_of_archive(content), name, str(path))
        return _of_text(text_of(content), name, path)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        if content.startswith(PICKLE):
            raise InputError(
                "E-CAMERA-UNREADABLE",
                f"camera file {path}: a pickle, which is not opened since it may contain a program; write its arrays "
                "with numpy.savez, or as JSON",
            ) from error
        raise _no_text(path) from error
    except (KeyError, ElementTree.ParseError, yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError(
            "E-CAMERA-UNREADABLE",
            f"camera file {path}: neither COLMAP's cameras.txt nor OpenCV's YAML or XML ({reason}); check its form",
        ) from error


PHOTONVISION = '"cameraIntrinsics"'
"""Key of PhotonVision, which names mrcal's lens models, too."""
ANEW = "calibrate with OpenCV's model, as `stcal-sfm calibrate-camera` does"
UNREAD = (
    (
        r"capturingreality\.com|^#name,.*\bpx,py\b",
        "of RealityCapture, relative to an image whose size it does not state; export the registration as COLMAP, and "
        "give its cameras.txt",
    ),
    (r"\A# Bundle file", "of Bundler, without the images' size and middle; export as COLMAP, and give its cameras.txt"),
    (r"\A# Image list", "COLMAP's images.txt, which has poses; give the cameras.txt beside it"),
    (r"\ACalibration results\s+=", "Kalibr's report, with fewer decimals; give the camchain.yaml beside it"),
    (r"\AF \S+\s+Px \S+|\AfileName imageWidth imageHeight", "of Pix4D; export as COLMAP, and give its cameras.txt"),
    (r"ParGroup: Camera|^Kappa\b", f"of HALCON, in metres and by other formulas; {ANEW}"),
    (
        r"polynomial coefficients for the DIRECT|SCARAMUZZA",
        f"of OCamCalib (SCARAMUZZA), a lens by polynomials of its own; {ANEW}",
    ),
    ("<ExportAPERO", f"of MicMac, whose distortion leads from the image to the ray; {ANEW}"),
    ("<BlocksExchange", "of ContextCapture; export as COLMAP, and give its cameras.txt"),
    (r'VICON_RADIAL|qtm-version=|KC1="', f"of a system of motion capture, with formulas of its own; {ANEW}"),
    ('"CalibrationInformation"', "of Azure Kinect, in shares of a side; write what its SDK says for your images' size"),
)
"""Patterns that tell files of programs whose cameras are not read, and why and what to do."""


def _of_text(text: str, name: str, path: Path) -> CameraModel | ForeignLens:
    for pattern, why in UNREAD:
        if re.search(pattern, text, re.MULTILINE):
            raise InputError("E-CAMERA-MODEL", f"camera file {path}: {why}")
    if text.lstrip().startswith("<"):
        root = ElementTree.fromstring(text)
        if root.tag == "calibration":
            return metashape.from_calibration(root, str(path))
        if root.tag in metashape.ROOTS:
            return metashape.from_cameras(root, name, str(path))
        return from_keys(values_of(text), name, str(path))
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if rows and rows[0][0].startswith("{") and "lensmodel" in text and PHOTONVISION not in text:
        return forms.from_mrcal(text, str(path))
    if rows and len(rows[0]) >= 5 and re.fullmatch(r"[A-Z][A-Z0-9_]+", rows[0][1]):
        lens = _from_colmap(rows, name, path)
        if isinstance(lens, ForeignLens):
            return lens
        return replace(lens, covariance=_stated_covariance(text, parameter_names(lens.colmap_model), path))
    if matlab.is_zhang(rows):
        return matlab.from_zhang(rows, str(path))
    if matlab.is_script(text):
        return matlab.from_script(text, str(path))
    values = values_of(text)
    if matlab.STRUCTURE in values or "MappingCoefficients" in values:
        return matlab.from_structure(values, str(path))
    return from_keys(values, name, str(path))


def _no_text(path: Path) -> InputError:
    if is_photograph(path):
        return InputError(
            "E-CAMERA-UNREADABLE",
            f"camera file {path}: a photograph; `stcal camera convert {path.name} cameras.txt` makes a start for "
            "--refine-camera from its EXIF",
        )
    return InputError(
        "E-CAMERA-UNREADABLE", f"camera file {path}: not a text file; give cameras.txt, or OpenCV's YAML or XML"
    )


def _stated_covariance(text: str, names: list[str], path: Path) -> np.ndarray | None:
    """Return the covariance (q, q) in the comments of :func:`write_cameras_txt`; None if there are none."""
    stated = {
        key: [line.split()[2:] for line in text.splitlines() if line.startswith(key)] for key in (SIGMA, CORRELATION)
    }
    if not any(stated.values()):
        return None
    count = len(names)
    try:
        if len(stated[SIGMA]) != 1 or [len(row) for row in stated[CORRELATION]] != [count] * count:
            raise InputError("E-CAMERA-COVARIANCE", f"a line of {count} σ and {count}×{count} correlations needed")
        sigma, correlation = np.array(stated[SIGMA][0], float), np.array(stated[CORRELATION], float)
        if len(sigma) != count:
            raise InputError("E-CAMERA-COVARIANCE", f"{len(sigma)} σ, {count} needed")
        _require_sigmas(sigma, correlation, names)
        covariance = correlation * np.outer(sigma, sigma)
        require_covariance(covariance, count, Rows(tuple(names)), definite=True)
    except (InputError, ValueError) as error:
        raise InputError(
            "E-CAMERA-COVARIANCE",
            f"camera file {path}: SIGMA and CORRELATION state no covariance of its parameters: {error}; write it "
            "again, or remove these comments",
        ) from error
    return covariance


def _require_sigmas(sigma: np.ndarray, correlation: np.ndarray, names: list[str]) -> None:
    """Refuse invalid σ, and correlations of a parameter with itself other than 1: the covariance hides such errors."""
    for name, sigma_of_name, self_correlation in zip(names, sigma, np.diagonal(correlation), strict=True):
        if not 0 < sigma_of_name <= MAX_SIDE_PX:
            raise InputError(
                "E-CAMERA-COVARIANCE", f"σ of {name} is {sigma_of_name:g}, a positive number up to {MAX_SIDE_PX} needed"
            )
        if not abs(self_correlation - 1) <= SQUARE_WITHIN:
            raise InputError(
                "E-CAMERA-COVARIANCE", f"correlation of {name} with itself is {self_correlation:g}, 1 needed"
            )


def _starts_with(path: Path, head: bytes) -> bool:
    with open(path, "rb") as stream:
        return stream.read(len(head)) == head


def _from_colmap(rows: list[list[str]], name: str, path: Path) -> CameraModel | ForeignLens:
    cameras = {row[0]: row[1:] for row in rows}
    if len(cameras) < len(rows):
        raise InputError("E-CAMERA-REPEATED", f"camera file {path}: two cameras of one number; correct it")
    model, *values = cameras[one_of(list(cameras), numbered(cameras, name), str(path))]
    try:
        width, height, *params = (float(value) for value in values)
    except ValueError as error:
        raise InputError(
            "E-CAMERA-CONTENT", f"camera file {path}: {' '.join(str(error).split())[:150]}; numbers needed"
        ) from error
    return of_colmap(model, width, height, params, str(path))
