"""Cameras of MATLAB: structures of its Computer Vision Toolbox, and files of Bouguet's toolbox.

In MATLAB's toolbox the centre of the first pixel is at (1, 1); in Bouguet's it is at (0, 0), as in OpenCV.
"""

import contextlib
import io
import math
import re
import struct
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.foreign_lenses import ForeignLens, of_opencv, one_of, refused
from stcal.io.cameras.keys import require_known

HEADS = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")
PIXEL_ORIGIN = 1.0
STRUCTURE = "RadialDistortion"
MARKS = (STRUCTURE, "MappingCoefficients")
"""Fields that tell a structure that ``toStruct`` makes of a camera, of a fisheye the second."""
BOUGUET = {"fc": 2, "cc": 2, "kc": 5}
"""Variables of Bouguet's toolbox that hold the lens, and their numbers of values."""
BOUGUET_SIGMAS = 3.0
"""Factor from σ to Bouguet's ``…_error`` (vision.caltech.edu/bouguetj/calib_doc, "Description of …")."""
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
COMPRESSED, MATRIX, OF_NUMBERS = 15, 14, (1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18)
"""Types of the elements of a ``.mat`` file (MATLAB's "MAT-File Format", table 1-1)."""
WITH_ARRAYS = (1, 2, 3, 16, 17)
SPARSE = 5
"""Classes of arrays that hold further arrays: cells, structures, objects, functions (table 1-3); and of sparse ones."""
FLAGS, INT32, DIMENSION_BYTES = [6, 8], 5, 128
"""Type and size of the first element of an array, its flags; type of the second, its size, and the longest of NumPy."""
MOST_BYTES = 1 << 26  # largest size of a variable when its compression is undone
HEAD_BYTES = 116  # length of the text at the beginning of a file; scipy writes the time into it


def from_mat(content: bytes, choice: str) -> CameraModel | ForeignLens:
    """Return a camera of a ``.mat`` file; ``choice`` : name of the variable if there are several cameras."""
    from scipy.io import loadmat  # slow to load, and needed for these files alone
    from scipy.io.matlab import MatReadWarning

    if content.startswith(HEADS[1]):
        raise InputError("E-CAMERA-UNREADABLE", "of MATLAB 7.3 (HDF5); save it with '-v7'")
    try:
        _require_elements(content[128:], "<" if content[126:128] == b"IM" else ">")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MatReadWarning)
            values = loadmat(io.BytesIO(content), simplify_cells=True)
    except Exception as error:  # damaged files fail in many ways, also with unbound names
        reason = " ".join(str(error).split())[:150]
        raise InputError("E-CAMERA-UNREADABLE", f"not readable as a .mat file ({reason}); save it again") from error
    if all(name in values for name in BOUGUET):
        return _from_bouguet(values)
    structures = dict(_structures({key: value for key, value in values.items() if not key.startswith("__")}, ""))
    if not structures:
        fault = "no structure of a camera"
        raise InputError("E-CAMERA-CONTENT", f"{fault}; save toStruct(cameraParams), not MATLAB's object")
    return from_structure(structures[one_of(list(structures), choice)])


def _require_elements(data: bytes, order: str, arrays: bool = True) -> int:
    """Return the number of elements in a row, each of a known type and whole: SciPy would read foreign memory."""
    at = count = 0
    while at < len(data):
        count += 1
        kind, size = struct.unpack_from(f"{order}II", data, at)
        at += 8
        if kind >> 16:  # up to 4 bytes in the tag itself
            kind, size, at = kind & 0xFFFF, kind >> 16, at - 4
        inner = data[at : at + size]
        if len(inner) < size or not (kind in OF_NUMBERS or (arrays and kind in (COMPRESSED, MATRIX))):
            raise ValueError("damaged")
        at += size
        if kind == COMPRESSED:
            decompressed = zlib.decompressobj()
            _require_elements(decompressed.decompress(inner, MOST_BYTES), order)
            if decompressed.unconsumed_tail:
                raise ValueError(f"a variable of more than {MOST_BYTES} bytes")
        else:
            at = -(-at // 8) * 8
        if kind == MATRIX and size:
            _require_array(inner, order)
    return count


def _require_array(data: bytes, order: str) -> None:
    *head, flags, _, dims_kind, dims_bytes = struct.unpack_from(f"{order}6I", data)
    array_class, is_complex = flags & 0xFF, flags >> 11 & 1
    parts = _require_elements(data, order, array_class in WITH_ARRAYS)
    needed = (6 if array_class == SPARSE else 4) + is_complex
    dims = struct.unpack_from(f"{order}{min(dims_bytes, DIMENSION_BYTES) // 4}I", data, 24)
    if (
        head != FLAGS
        or dims_kind != INT32
        or (array_class != SPARSE and math.prod(dims) > len(data))
        or (array_class not in WITH_ARRAYS and parts != needed)
    ):
        raise ValueError("damaged")


def from_structure(values: Mapping) -> CameraModel | ForeignLens:
    """Return the camera of ``toStruct`` of cameraParameters or cameraIntrinsics, as a structure or as JSON."""
    unread = {key: _plain_value(value) for key, value in values.items() if key not in TAKEN}
    require_known(unread, HARMLESS)
    if "MappingCoefficients" in values:
        raise InputError("E-CAMERA-MODEL", "MATLAB's fisheye model is not supported; calibrate with another")
    if (matrix := _numbers(values, "K", 9)) is not None:
        fx, skew, cx, _, fy, cy, *_ = matrix
    elif (turned := _numbers(values, "IntrinsicMatrix", 9)) is not None:  # with the principal point in its last row
        fx, _, _, skew, fy, _, cx, cy, _ = turned
    else:
        focal, centre = (_numbers(values, key, 2) for key in ("FocalLength", "PrincipalPoint"))
        if focal is None or centre is None:
            raise InputError("E-CAMERA-CONTENT", "no K, IntrinsicMatrix or FocalLength; save toStruct(cameraParams)")
        (fx, fy), (cx, cy), skews = focal, centre, _numbers(values, "Skew", 1)
        skew = 0.0 if skews is None else skews[0]
    size = _numbers(values, "ImageSize")
    height, width = (0.0, 0.0) if size is None or not size.size else size[:2]
    radial = _numbers(values, STRUCTURE)
    tangential = _numbers(values, "TangentialDistortion", 2)
    k = [0.0, 0.0] if radial is None else [*radial, 0.0, 0.0][: max(len(radial), 2)]
    p = [0.0, 0.0] if tangential is None else tangential
    lens = [fx, fy, cx - PIXEL_ORIGIN, cy - PIXEL_ORIGIN]
    return of_opencv(lens, np.array([*k[:2], *p, *k[2:]], float), float(width), float(height), float(skew))


def _plain_value(value: object) -> object:
    """Return an array as a list, so that an empty one or one of zeros is seen as such."""
    return np.asarray(value).ravel().tolist() if isinstance(value, np.ndarray) else value


def _structures(values: Mapping, where: str):
    if not values.keys().isdisjoint(MARKS):
        yield where or "camera", values
        return
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _structures(value, f"{where}.{key}" if where else str(key))


def _numbers(values: Mapping, key: str, count: int = 0, needed: bool = False) -> Any:
    if values.get(key) is None:
        if needed:
            raise InputError("E-CAMERA-CONTENT", f"{key} is empty; {count} numbers needed")
        return None
    try:
        numbers = np.asarray(values[key], float)
    except (TypeError, ValueError) as error:
        raise InputError("E-CAMERA-CONTENT", f"{key} is no list of numbers; save it again") from error
    if count and numbers.size != count:
        raise InputError("E-CAMERA-COEFFICIENTS", f"{key} of {numbers.size} numbers; {count} needed")
    return numbers.ravel()


def _from_bouguet(values: Mapping) -> CameraModel | ForeignLens:
    others = {key: value for key, value in values.items() if key not in BOUGUET_TAKEN and not key.startswith("__")}
    require_known({key: _plain_value(value) for key, value in others.items()}, BOUGUET_HARMLESS)
    focal, centre, k = (_numbers(values, key, count, True) for key, count in BOUGUET.items())
    width, height = (float(np.asarray(values.get(key, 0)).sum()) for key in ("nx", "ny"))
    skew = float(np.asarray(values.get("alpha_c", 0.0)).sum()) * focal[0]
    lens = of_opencv([*focal, *centre], k, width, height, skew)
    stated = all(f"{key}_error" in values for key in BOUGUET)
    if isinstance(lens, ForeignLens) or lens.colmap_model != "OPENCV" or not stated:
        return lens
    errors = [_numbers(values, f"{key}_error", count, True) for key, count in BOUGUET.items()]
    sigma = np.concatenate(errors)[:8] / BOUGUET_SIGMAS
    return replace(lens, covariance=np.diag(sigma**2)) if (sigma > 0).all() and np.isfinite(sigma).all() else lens


def is_script(text: str) -> bool:
    """Return True if a text assigns Bouguet's ``fc`` and ``cc`` as his ``Calib_Results.m`` does."""
    return all(re.search(rf"(?m)^\s*{key}\s*=\s*\[", text) for key in ("fc", "cc"))


def from_script(text: str, _: str) -> CameraModel | ForeignLens:
    """Return the camera of Bouguet's ``Calib_Results.m``; errors as :func:`from_mat`."""
    lines = "\n".join(line.split("%")[0] for line in text.splitlines())
    values: dict[str, object] = {}
    for name, listed, single in re.findall(r"(?m)^\s*(\w+)\s*=\s*(?:\[([^\]]*)\]|([^;\[\n]+))\s*;?", lines):
        words = re.split(r"[\s,;]+", (listed or single).strip())
        with contextlib.suppress(ValueError):  # settings in words
            numbers = np.array(words, float) if words != [""] else np.zeros(0)
            if name in values and not np.array_equal(np.asarray(values[name]), numbers):
                raise InputError("E-CAMERA-REPEATED", f"{name} twice; leave one in")
            values[name] = numbers
    if "kc" not in values:
        raise InputError("E-CAMERA-CONTENT", "no kc; 5 numbers needed")
    return _from_bouguet(values)


def mat(camera: Camera, name: str) -> bytes:
    """Return a ``.mat`` file with a structure of the fields of ``cameraIntrinsics`` and ``toStruct(cameraParams)``."""
    k = camera.distortion
    if camera.fisheye or k[5:].any():
        raise refused(camera, "matlab", "the equidistant projection" if camera.fisheye else "more than k1, k2, k3")
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
    from scipy.io import savemat
    from scipy.io.matlab import MatWriteWarning

    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("error", MatWriteWarning)
        savemat(stream, {name: fields}, oned_as="row")
    content = stream.getvalue()
    return HEADS[0] + b", written by stcal".ljust(HEAD_BYTES - len(HEADS[0])) + content[HEAD_BYTES:]
