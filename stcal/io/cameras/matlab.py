"""Cameras of MATLAB: structures of its Computer Vision Toolbox, and files of Bouguet's toolbox.

In MATLAB's toolbox the centre of the first pixel is at (1, 1); in Bouguet's it is at (0, 0), as in OpenCV.
"""

import contextlib
import io
import re
import subprocess
import sys
import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.io import loadmat, savemat
from scipy.io.matlab import MatReadWarning, MatWriteWarning

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.cameras.foreign import ForeignLens, of_skewed, one_of
from stcal.io.cameras.keys import require_known
from stcal.io.cameras.model import CameraModel

HEADS = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")
PIXEL_ORIGIN = 1.0
STRUCTURE = "RadialDistortion"
"""Name of a field of every structure that ``toStruct`` makes of a camera."""
BOUGUET = ("fc", "cc", "kc")
BOUGUET_SIGMAS = 3.0
"""Factor from σ to Bouguet's ``…_error`` (vision.caltech.edu/bouguetj/calib_doc, "Description of the calibration
parameters")."""
TAKEN = {
    *("K", "IntrinsicMatrix", "FocalLength", "PrincipalPoint", "Skew", "ImageSize", "RadialDistortion"),
    *("TangentialDistortion", "MappingCoefficients"),
}
HARMLESS = (
    *("worldpoints", "worldunits", "estimateskew", "estimatetangentialdistortion", "reproject*", "rotation*"),
    *("translation*", "patternextrinsics*", "detectedkeypoints", "numradial*", "numpatterns", "version", "intrinsics"),
    *("reprojectedpoints", "reprojectionerrors", "meanreprojectionerror", "cameraparameters", "fixedparams"),
)
"""Fields of MATLAB's camera that are not of the lens, or repeat it."""
BOUGUET_TAKEN = {*BOUGUET, *(f"{key}_error" for key in BOUGUET), "alpha_c", "alpha_c_error", "nx", "ny"}
BOUGUET_HARMLESS = (
    *("kk", "invkk", "omc*", "tc*", "rc*", "h*", "x*", "y*", "ex*", "dx*", "dy*", "wint*", "nsqu*", "est*", "ima*"),
    *("ind*", "active*", "center*", "solution*", "param*", "err*", "check*", "init*", "quick*", "dont*", "max*"),
    *("two*", "thresh*", "recompute*", "format*", "type*", "first*", "last*", "smallcalib*", "n", "nima", "cond*"),
    *("desactivated*", "save*", "string*", "sol*", "jj*", "pp*", "aspect*", "title*", "manual*", "rosette*", "fp*"),
)
"""Variables of Bouguet's toolbox: its settings, points and poses; ``KK`` repeats the intrinsics."""
TRIAL = """
import sys
sys.path = [folder for folder in sys.path if folder]  # not the user's folder, in which any name may be a module's
import io
from scipy.io import loadmat
loadmat(io.BytesIO(sys.stdin.buffer.read()))
"""
"""Program that reads a file and is lost with it."""
HEAD_BYTES = 116
"""Length of the text at the beginning of a file; scipy writes the time into it."""


def is_mat(content: bytes) -> bool:
    """Return True if a file begins as a MATLAB file."""
    return content.startswith(HEADS)


def from_mat(content: bytes, choice: str, source: str) -> CameraModel | ForeignLens:
    """Return a camera of a ``.mat`` file; ``choice`` : name of the variable if there are several cameras.

    Raises InputError: the file is of version 7.3 (HDF5), has objects in place of structures, no camera, or several and
    no choice.
    """
    if content.startswith(HEADS[1]):
        raise InputError("E-CAMERA-UNREADABLE", f"camera file {source}: of MATLAB 7.3 (HDF5); save it with '-v7'")
    try:
        _require_survived(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MatReadWarning)
            values = loadmat(io.BytesIO(content), simplify_cells=True)
    except Exception as error:  # damaged files fail in many ways, also with unbound names
        reason = " ".join(str(error).split())[:150]
        raise InputError(
            "E-CAMERA-UNREADABLE", f"camera file {source}: not readable as a .mat file ({reason}); save it again"
        ) from error
    if all(name in values for name in BOUGUET):
        return _from_bouguet(values, source)
    structures = dict(_structures({key: value for key, value in values.items() if not key.startswith("__")}, ""))
    if not structures:
        raise InputError(
            "E-CAMERA-CONTENT",
            f"camera file {source}: no structure of a camera; save toStruct(cameraParams), since only MATLAB can read "
            "its objects",
        )
    return from_structure(structures[one_of(list(structures), choice, source)], source)


def _require_survived(content: bytes) -> None:
    """Raise ValueError if reading the file ends the process: SciPy follows a damaged type of data into foreign memory.

    Another interpreter reads it first.
    """
    trial = subprocess.run([sys.executable, "-c", TRIAL], input=content, capture_output=True)
    if trial.returncode < 0:
        raise ValueError("damaged")


def from_structure(values: Mapping, source: str) -> CameraModel | ForeignLens:
    """Return the camera of ``toStruct(cameraParameters)`` or ``toStruct(cameraIntrinsics)``, as a structure or as JSON.

    Raises InputError: the lens is a fisheye lens, or a field is missing.
    """
    unread = {key: _plain_value(value) for key, value in values.items() if key not in TAKEN}
    require_known(unread, source, HARMLESS)
    if "MappingCoefficients" in values:
        raise InputError(
            "E-CAMERA-MODEL", f"camera file {source}: MATLAB's fisheye model is not supported; calibrate with another"
        )
    matrix = _numbers(values, "K", source)
    if matrix is None:
        turned = _numbers(values, "IntrinsicMatrix", source)  # with the principal point in its last row
        matrix = None if turned is None else turned.reshape(3, 3).T
    if matrix is not None:
        (fx, skew, cx), (_, fy, cy) = matrix.reshape(3, 3)[:2]
    else:
        focal, centre = (_numbers(values, key, source, 2) for key in ("FocalLength", "PrincipalPoint"))
        if focal is None or centre is None:
            raise InputError(
                "E-CAMERA-CONTENT",
                f"camera file {source}: no K, IntrinsicMatrix or FocalLength; save toStruct(cameraParams)",
            )
        (fx, fy), (cx, cy), skews = focal, centre, _numbers(values, "Skew", source, 1)
        skew = 0.0 if skews is None else skews[0]
    size = _numbers(values, "ImageSize", source)
    height, width = (0.0, 0.0) if size is None or not size.size else size[:2]
    radial = _numbers(values, STRUCTURE, source)
    tangential = _numbers(values, "TangentialDistortion", source, 2)
    k = [0.0, 0.0] if radial is None else [*radial, 0.0, 0.0][: max(len(radial), 2)]
    p = [0.0, 0.0] if tangential is None else tangential
    lens = [fx, fy, cx - PIXEL_ORIGIN, cy - PIXEL_ORIGIN]
    return of_skewed(lens, float(skew), np.array([*k[:2], *p, *k[2:]], float), float(width), float(height), source)


def _plain_value(value: object) -> object:
    """Return an array as a list, so that an empty one or one of zeros is seen as such."""
    return np.asarray(value).ravel().tolist() if isinstance(value, np.ndarray) else value


def _structures(values: Mapping, where: str):
    """Yield name and structure of every camera, at any depth."""
    if STRUCTURE in values or "MappingCoefficients" in values:
        yield where or "camera", values
        return
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _structures(value, f"{where}.{key}" if where else str(key))


def _numbers(values: Mapping, key: str, source: str, count: int = 0) -> np.ndarray | None:
    if values.get(key) is None:
        return None
    try:
        numbers = np.asarray(values[key], float)
    except (TypeError, ValueError) as error:
        raise InputError(
            "E-CAMERA-CONTENT", f"camera file {source}: {key} is no list of numbers; save it again"
        ) from error
    if (count and numbers.size != count) or (key in ("K", "IntrinsicMatrix") and numbers.size != 9):
        raise InputError(
            "E-CAMERA-COEFFICIENTS", f"camera file {source}: {key} of {numbers.size} numbers; {count or 9} needed"
        )
    return numbers.ravel() if key not in ("K", "IntrinsicMatrix") else numbers


def _known(values: Mapping, key: str, source: str, count: int) -> np.ndarray:
    numbers = _numbers(values, key, source, count)
    if numbers is None:
        raise InputError("E-CAMERA-CONTENT", f"camera file {source}: {key} is empty; {count} numbers needed")
    return numbers


def _from_bouguet(values: Mapping, source: str) -> CameraModel | ForeignLens:
    own = {key: value for key, value in values.items() if not key.startswith("__")}
    unread = {key: _plain_value(value) for key, value in own.items() if key not in BOUGUET_TAKEN}
    require_known(unread, source, BOUGUET_HARMLESS)
    focal, centre, k = (_known(values, key, source, n) for key, n in zip(BOUGUET, (2, 2, 5), strict=True))
    width, height = (float(np.asarray(values.get(key, 0)).sum()) for key in ("nx", "ny"))
    skew = float(np.asarray(values.get("alpha_c", 0.0)).sum()) * focal[0]
    lens = of_skewed([*focal, *centre], skew, k, width, height, source)
    if isinstance(lens, ForeignLens) or lens.colmap_model != "OPENCV":
        return lens
    if not all(f"{key}_error" in values for key in BOUGUET):
        return lens
    errors = [_known(values, f"{key}_error", source, n) for key, n in zip(BOUGUET, (2, 2, 5), strict=True)]
    sigma = np.concatenate(errors)[:8] / BOUGUET_SIGMAS
    return replace(lens, covariance=np.diag(sigma**2)) if (sigma > 0).all() and np.isfinite(sigma).all() else lens


def is_script(text: str) -> bool:
    """Return True if a text assigns Bouguet's ``fc`` and ``cc`` as his ``Calib_Results.m`` does."""
    return all(re.search(rf"(?m)^\s*{key}\s*=\s*\[", text) for key in BOUGUET[:2])


def from_script(text: str, source: str) -> CameraModel | ForeignLens:
    """Return the camera of Bouguet's ``Calib_Results.m``; errors as :func:`from_mat`."""
    lines = "\n".join(line.split("%")[0] for line in text.splitlines())
    values: dict[str, object] = {}
    for name, listed, single in re.findall(r"(?m)^\s*(\w+)\s*=\s*(?:\[([^\]]*)\]|([^;\[\n]+))\s*;?", lines):
        words = re.split(r"[\s,;]+", (listed or single).strip())
        with contextlib.suppress(ValueError):  # settings in words
            numbers = np.array(words, float) if words != [""] else np.zeros(0)
            if name in values and not np.array_equal(np.asarray(values[name]), numbers):
                raise InputError("E-CAMERA-REPEATED", f"camera file {source}: {name} twice; leave one in")
            values[name] = numbers
    if BOUGUET[2] not in values:
        raise InputError("E-CAMERA-CONTENT", f"camera file {source}: no kc; 5 numbers needed")
    return _from_bouguet(values, source)


def mat(camera: Camera, name: str) -> bytes:
    """Return a ``.mat`` file with a structure of the fields of ``cameraIntrinsics`` and ``toStruct(cameraParams)``."""
    k = camera.distortion
    if camera.fisheye or k[5:].any():
        raise InputError(
            "E-CAMERA-FORM",
            f"matlab has no place for {'the equidistant projection' if camera.fisheye else 'more than k1, k2, k3'} of "
            f"{camera.colmap_model}; write --form colmap",
        )
    (fx, fy), (cx, cy) = camera.focal, camera.centre + PIXEL_ORIGIN
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    radial = [k[0], k[1], k[4]] if k[4] else [k[0], k[1]]
    fields = {
        "FocalLength": [fx, fy],
        "PrincipalPoint": [cx, cy],
        "ImageSize": [float(camera.height), float(camera.width)],
        "RadialDistortion": radial,
        "TangentialDistortion": [k[2], k[3]],
        "Skew": 0.0,
        "K": matrix,
        "IntrinsicMatrix": matrix.T,
    }
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("error", MatWriteWarning)
        savemat(stream, {name: fields}, oned_as="row")
    content = stream.getvalue()
    return HEADS[0] + b", written by stcal".ljust(HEAD_BYTES - len(HEADS[0])) + content[HEAD_BYTES:]


def is_zhang(rows: list[list[str]]) -> bool:
    """Return True if the rows are a file of Zhang's calibration: five words, two, then rows of three, and no keys."""
    counts = [len(row) for row in rows]
    return counts[:2] == [5, 2] and set(counts[2:]) <= {3} and not any(":" in word for word in rows[0] + rows[1])


def from_zhang(rows: list[list[str]], source: str) -> CameraModel | ForeignLens:
    """Return the camera of α, c, β, u0, v0, then k1, k2; poses are ignored (Zhang 2000; the file of his page).

    Raises InputError: a word is no number.
    """
    try:
        (fx, skew, fy, cx, cy), (k1, k2) = ([float(word) for word in row] for row in rows[:2])
    except ValueError as error:
        raise InputError(
            "E-CAMERA-CONTENT", f"camera file {source}: {' '.join(str(error).split())[:150]}; numbers needed"
        ) from error
    return of_skewed([fx, fy, cx, cy], skew, np.array([k1, k2, 0.0, 0.0]), 0.0, 0.0, source)


def zhang(camera: Camera, _: str) -> str:
    """Return the text of Zhang's five numbers, and k1, k2."""
    if camera.fisheye or camera.distortion[2:].any():
        lost = "the equidistant projection" if camera.fisheye else "more than k1, k2"
        raise InputError(
            "E-CAMERA-FORM", f"zhang has no place for {lost} of {camera.colmap_model}; write --form colmap"
        )
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.centre.tolist()
    k1, k2 = camera.distortion[:2].tolist()
    return f"{fx!r} 0 {fy!r} {cx!r} {cy!r}\n\n{k1!r} {k2!r}\n"
