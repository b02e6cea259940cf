"""Cameras of other programs: readers of mrcal and COLMAP's ``cameras.bin``; and writers of all forms.

Pixel origins: the centre of the first pixel is at (0, 0) in OpenCV, ROS, Kalibr and mrcal, at (0.5, 0.5) in COLMAP and
Metashape; Metashape's principal point is relative to the middle of the image.
"""

import ast
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import Camera, parameter_names
from stcal.io.cameras import foreign_lenses as foreign
from stcal.io.cameras import metashape
from stcal.io.cameras.camera_model import CameraModel, cameras_txt
from stcal.io.cameras.keys import pass_over, require_known
from stcal.io.cameras.matlab import mat

CameraForm = Literal[
    "colmap", "colmap-bin", "opencv", "ros", "kalibr", "mrcal", "metashape", "metashape-cameras", "matlab"
]
"""Forms in which cameras are written."""
SUFFIXES = {
    ".txt": "colmap",
    ".bin": "colmap-bin",
    ".yaml": "opencv",
    ".yml": "opencv",
    ".cameramodel": "mrcal",
    ".xml": "metashape",
    ".mat": "matlab",
}
"""The form of a file by its suffix."""
MRCAL = {f"LENSMODEL_{name}": count for name, count in (("PINHOLE", 0), *((f"OPENCV{n}", n) for n in (4, 5, 8, 12)))}
"""Numbers of coefficients of those models of mrcal that are OpenCV's."""
MRCAL_HARMLESS = ("extrinsics", "icamintrinsics", "optimizationinputs", "rtcamref", "rtrefcam")
"""Keys of ``.cameramodel`` that say where a camera is, and from what it was calibrated."""
LEAST_CAMERA_BYTES = 48
"""Bytes of a camera of ``cameras.bin`` with three parameters."""
SIGMA_FORMS = ("colmap", "metashape-cameras")
"""The forms that have a place for σ and correlations."""


@dataclass(frozen=True, slots=True)
class Written:
    """The ``content`` of a file, and ``lost`` : properties of the camera that the file has no place for."""

    content: str | bytes
    lost: tuple[str, ...]


def is_mrcal(text: str) -> bool:
    """Return True if a text has the keys of a ``.cameramodel``; PhotonVision names mrcal's lens models, too."""
    return "lensmodel" in text and "imagersize" in text


def from_mrcal(text: str, _: str) -> CameraModel | foreign.ForeignLens:
    """Return the camera of a ``.cameramodel`` whose lens model is OpenCV's, CAHVOR, or splined."""
    try:
        values = ast.literal_eval(text.strip())
        lens, numbers = values["lensmodel"], [float(v) for v in values["intrinsics"]]
        width, height = (float(v) for v in values["imagersize"])
    except (SyntaxError, ValueError, TypeError, KeyError, RecursionError, MemoryError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError("E-CAMERA-UNREADABLE", f"not mrcal's form ({reason}); write it anew with mrcal") from error
    region = _region(values.get("valid_intrinsics_region"))
    taken = ("lensmodel", "intrinsics", "imagersize", "valid_intrinsics_region")
    require_known({key: value for key, value in values.items() if key not in taken}, MRCAL_HARMLESS)
    if str(lens).startswith("LENSMODEL_SPLINED"):
        made = foreign.of_splines(lens, numbers, width, height)
    elif lens == "LENSMODEL_CAHVOR":
        made = foreign.of_cahvor(numbers, width, height)
    elif lens in MRCAL and len(numbers) == 4 + MRCAL[lens]:
        made = foreign.of_opencv(numbers[:4], np.array(numbers[4:]), width, height)
    else:
        raise InputError(
            "E-CAMERA-MODEL",
            f"{lens} with {len(numbers)} intrinsics; {', '.join(MRCAL)}, CAHVOR and splined "
            "ones are read: mrcal-convert-lensmodel makes one of another",
        )
    if isinstance(made, foreign.ForeignLens):
        return replace(made, region=region)
    pass_over([] if region is None else ["valid_intrinsics_region"])
    return made


def _region(stated: object) -> np.ndarray | None:
    """Return mrcal's polygon (n, 2), px, in which the intrinsics are valid; None if the file states none."""
    try:
        region = None if stated is None else np.array(stated, float)
    except (TypeError, ValueError):
        region = np.full(1, np.nan)  # refused below
    if region is not None and not region.size:
        return None
    if region is not None and (region.ndim != 2 or region.shape[-1] != 2 or not np.isfinite(region).all()):
        raise InputError("E-CAMERA-CONTENT", "valid_intrinsics_region is no list of pixels; remove it")
    return region


def is_colmap_binary(content: bytes) -> bool:
    """Return True if a file begins with a number of cameras that it is long enough for; a text states a huge one."""
    if len(content) < 8:
        return False
    (count,) = struct.unpack_from("<Q", content, 0)
    return count <= (len(content) - 8) // LEAST_CAMERA_BYTES


def from_colmap_binary(content: bytes, choice: str) -> CameraModel | foreign.ForeignLens:
    """Return the camera of ``cameras.bin``, or the one of number ``choice``."""
    try:
        (count,) = struct.unpack_from("<Q", content, 0)
        at, cameras = 8, {}
        for _ in range(min(count, len(content) // 24)):
            number, kind, width, height = struct.unpack_from("<IiQQ", content, at)
            model = foreign.NUMBERS[kind]
            _, length = foreign.COLMAP_FOREIGN.get(model) or (0, len(parameter_names(model)))
            cameras[str(number)] = model, width, height, struct.unpack_from(f"<{length}d", content, at + 24)
            at += 24 + 8 * length
    except (struct.error, KeyError) as error:
        raise InputError("E-CAMERA-UNREADABLE", "neither text nor a cameras.bin of known models; check it") from error
    if at != len(content) or not cameras:
        raise InputError("E-CAMERA-UNREADABLE", "neither text nor COLMAP's cameras.bin; check it")
    model, width, height, params = cameras[foreign.one_of(list(cameras), foreign.numbered(cameras, choice))]
    return foreign.of_colmap(model, width, height, params)


def name_to_write(name: str) -> str:
    """Return a name that every form can hold, of the name that chose a camera: ``Cam_B_35mm`` of ``Cam B (35mm)``,
    ``cam1`` of 1, ``cam0`` of none."""
    word = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    if not word:
        return "cam0"
    return word if word[0].isalpha() else f"cam{word}"


def written(camera: Camera, form: str, name: str) -> Written:
    """Return the file of a camera in one of :data:`WRITERS`, with its name where the form has a place for it; refuse a
    lens that the form cannot hold, and a name that is no word."""
    if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise InputError(
            "E-CAMERA-NAME", f"camera name {name}: letters, digits and _ needed, a letter first, such as cam0"
        )
    lost = []
    if camera.covariance is not None and form not in SIGMA_FORMS:
        lost.append("σ and correlations of the parameters")
    if camera.covariance is not None and form == "metashape-cameras":
        lost += metashape.without_sigma(camera)
    return Written(WRITERS[form](camera, name), tuple(lost))


def _colmap_binary(camera: Camera, _: str) -> bytes:
    params = camera.colmap_params()
    number = next(number for number, name in foreign.NUMBERS.items() if name == camera.colmap_model)
    head = struct.pack("<QIiQQ", 1, 1, number, camera.width, camera.height)
    return head + struct.pack(f"<{len(params)}d", *params)


def _fisheye_four(camera: Camera, form: str) -> list[float]:
    """Return k1 … k4 of an equidistant camera; refuse one with further coefficients."""
    others = [*camera.distortion[2:4], *camera.distortion[8:]]
    if any(others):
        raise foreign.refused(camera, form, "p1, p2 and prisms")
    return [float(camera.distortion[i]) for i in (0, 1, 4, 5)]


def _coefficients(camera: Camera) -> list[float]:
    """Return the first 5 or 8 coefficients of a perspective camera, as few as represent the lens."""
    count = 8 if camera.distortion[5:8].any() else 5
    return [float(k) for k in camera.distortion[:count]]


def _matrix(camera: Camera) -> list[float]:
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.centre.tolist()
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _opencv(camera: Camera, _: str) -> str:
    values = _fisheye_four(camera, "opencv") if camera.fisheye else _coefficients(camera)
    node = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: {}\n"
    kind = "distortion_model: equidistant\n" if camera.fisheye else ""
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        f"camera_matrix: {node.format(3, 3, _matrix(camera))}{kind}"
        f"distortion_coefficients: {node.format(1, len(values), values)}"
    )


def _ros(camera: Camera, name: str) -> str:
    values = _fisheye_four(camera, "ros") if camera.fisheye else _coefficients(camera)
    kind = "equidistant" if camera.fisheye else "rational_polynomial" if len(values) == 8 else "plumb_bob"
    k = _matrix(camera)
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    eye = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]

    def node(rows: int, data: list[float]) -> str:
        return f"\n  rows: {rows}\n  cols: {len(data) // rows}\n  data: {data}\n"

    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: {name}\n"
        f"camera_matrix:{node(3, k)}distortion_model: {kind}\ndistortion_coefficients:{node(1, values)}"
        f"rectification_matrix:{node(3, eye)}projection_matrix:{node(3, p)}"
    )


def _kalibr(camera: Camera, name: str) -> str:
    if camera.fisheye:
        kind, values = "equidistant", _fisheye_four(camera, "kalibr")
    else:
        kind, values = "radtan", [float(k) for k in camera.distortion[:4]]
        if camera.distortion[4:].any():
            raise foreign.refused(camera, "kalibr", "more than k1, k2, p1, p2")
    lens = [*camera.focal.tolist(), *camera.centre.tolist()]
    return (
        f"{name}:\n  camera_model: pinhole\n  intrinsics: {lens}\n  distortion_model: {kind}\n"
        f"  distortion_coeffs: {values}\n  resolution: [{camera.width}, {camera.height}]\n"
    )


def _mrcal(camera: Camera, _: str) -> str:
    if camera.fisheye:
        raise foreign.refused(camera, "mrcal", "the equidistant projection")
    values = _coefficients(camera) if camera.distortion.any() else []
    values = values[:4] if len(values) == 5 and not values[4] else values
    lens = next(name for name, count in MRCAL.items() if count == len(values))
    numbers = [*camera.focal.tolist(), *camera.centre.tolist(), *values]
    return (
        f"{{\n    'lensmodel': '{lens}',\n    'intrinsics': {numbers},\n    'extrinsics': [0, 0, 0, 0, 0, 0],\n"
        f"    'imagersize': [{camera.width}, {camera.height}]\n}}\n"
    )


WRITERS: Mapping[str, Callable[[Camera, str], str | bytes]] = {
    "colmap": lambda camera, _: cameras_txt(camera),
    "colmap-bin": _colmap_binary,
    "opencv": _opencv,
    "ros": _ros,
    "kalibr": _kalibr,
    "mrcal": _mrcal,
    "metashape": lambda camera, _: metashape.calibration(camera),
    "metashape-cameras": metashape.cameras,
    "matlab": mat,
}
"""Writers by form: each returns the file of a camera and its name."""
