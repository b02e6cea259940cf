"""The cameras of a file of keys and values: one, several in a list or a mapping, or pairs of numbered keys."""

import re
import warnings

import numpy as np

from stcal.errors import InputNote
from stcal.io.cameras.keys import CONTAINERS, numbers_of, pass_over, plain, role_of

NUMBERED = re.compile(r"(.+?)[ _]?(\d+|left|right|l|r)$|(left|right|cam\d+)[ _.](.*)$", re.IGNORECASE)
"""A key with the number or the side of its camera, behind or in front."""
NEAR = 0.25
"""Share of the image's size within which the principal point is from the middle of the image."""


def _holds_lens(values: object) -> bool:
    if not isinstance(values, dict):
        return False
    if sum(map(_holds_lens, values.values())) > 1:  # several cameras
        return False
    found = {path[-1].split(".")[-1]: value for path, value in shallow(values)}
    roles = {role_of(key) for key, value in found.items() if not is_fundamental(plain(key), value)}
    return bool({"matrix", "lens", "fx", "f"} & roles) or "mu" in found or {"px", "u0"} <= found.keys()


def is_fundamental(name: str, value: object) -> bool:
    """Return True for F of a stereo calibration: a matrix, and no focal length."""
    return name == "f" and numbers_of(value).size == 9


def shallow(values: dict):
    """Yield the leaves of a camera's own keys, and of containers among them."""
    for key, value in values.items():
        if isinstance(value, dict) and CONTAINERS.match(plain(key)):
            yield from (((key, *path), inner) for path, inner in shallow(value))
        elif not isinstance(value, dict):
            yield (key,), value


def cameras_of(values: dict) -> dict[str, dict]:
    """Return the cameras of a file by name, each with the keys that all share; a single one may have no name.

    Raises ValueError: a lens of Meshroom, or of Basalt, is not read, or lacks a number.
    """
    if isinstance(values.get("value0"), dict):  # of cereal, which Basalt writes with
        return cameras_of(values["value0"])
    frames = values.get("frames")
    if isinstance(frames, list) and any(_holds_lens(frame) for frame in frames):
        shared = {key: value for key, value in values.items() if key != "frames"}
        kept = [{k: v for k, v in f.items() if role_of(k)} for f in frames if isinstance(f, dict)]
        pass_over(["frames"])
        if all(each == kept[0] for each in kept):
            return {"": shared | kept[0]}
        names = [str(frame.get("file_path", i)) for i, frame in enumerate(frames) if isinstance(frame, dict)]
        return {name: shared | own for name, own in zip(names, kept, strict=True)}
    if isinstance(values.get("intrinsics"), list) and any(isinstance(each, dict) for each in values["intrinsics"]):
        stated = [each for each in values["intrinsics"] if isinstance(each, dict)]
        if all("key" in each and isinstance(each.get("value"), dict) for each in stated):
            return {str(each["key"]): _of_openmvg(each["value"]) for each in stated}
        if all(isinstance(each.get("intrinsics"), dict) for each in stated):
            return _of_basalt(stated, values.get("resolution", []))
        own = [_of_meshroom(each) for each in stated]
        return {str(each.get("intrinsicId", i)): each for i, each in enumerate(own)}
    if numbered := _numbered(values):
        return numbered
    inner = {str(key): value for key, value in values.items() if _holds_lens(value)}
    own = {key: value for key, value in values.items() if str(key) not in inner}
    containers = [key for key in inner if CONTAINERS.match(plain(key)) and not plain(key)[-1:].isdigit()]
    if _holds_lens(own) or (len(inner) == 1 and containers and "camera_model" not in inner[containers[0]]):
        return {"": values}
    if inner:
        return {name: own | value for name, value in inner.items()}
    shared = {key: value for key, value in values.items() if role_of(key) in ("width", "height", "size")}
    for value in values.values():  # a list or a mapping of cameras, one level down
        if isinstance(value, list):
            pairs = [each for each in value if isinstance(each, list) and len(each) == 2 and _holds_lens(each[1])]
            if pairs and len(pairs) == len(value):
                return {str(name): shared | camera for name, camera in pairs}
        if isinstance(value, list) and any(_holds_lens(each) for each in value):
            named = {
                str(next((each[k] for k in ("name", "id", "camera_name", "type") if k in each), i)): shared | each
                for i, each in enumerate(value)
                if isinstance(each, dict)
            }
            return named if len(named) == len(value) else {str(i): shared | each for i, each in enumerate(value)}
        if isinstance(value, dict) and (inner := cameras_of(value)):
            return inner
    return {}


BASALT = {
    "ds": ("xi", "alpha", "fx", "fy", "cx", "cy"),
    "eucm": ("alpha", "beta", "fx", "fy", "cx", "cy"),
    "ucm": ("alpha", 1.0, "fx", "fy", "cx", "cy"),
}
"""Basalt's lenses with parameters of their own, in the order of Kalibr; a unified lens is an EUCM of β = 1."""


def _of_basalt(stated: list[dict], sizes: object) -> dict[str, dict]:
    """Return the cameras of Basalt's ``intrinsics``, whose sizes stand in a list of their own."""
    cameras = {}
    for i, each in enumerate(stated):
        kind, own = str(each.get("camera_type", "")), each["intrinsics"]
        size = {"resolution": sizes[i]} if isinstance(sizes, list) and i < len(sizes) else {}
        if kind in BASALT:
            lens = [float(own[name]) if isinstance(name, str) else name for name in BASALT[kind]]
            others = {key: value for key, value in own.items() if key not in BASALT[kind]}
            model = {"camera_model": "eucm" if kind == "ucm" else kind, "distortion_model": "none"}
            cameras[str(i)] = model | {"intrinsics": lens} | others | size
        else:
            cameras[str(i)] = {"camera_model": kind.removesuffix("8"), **own, **size}
    return cameras


OPENMVG = {
    "disto_k1": ("opencv", "k1"),
    "disto_k3": ("opencv", "k1 k2 k3"),
    "disto_t2": ("opencv", "k1 k2 k3 p1 p2"),
    "fisheye": ("fisheye", "k1 k2 k3 k4"),
}
"""Keys of OpenMVG's coefficients: the model, and their order (openMVG, ``cameras/Camera_Pinhole_Brown.hpp``)."""


def _of_openmvg(stated: dict) -> dict:
    """Return an entry of OpenMVG's ``intrinsics``, whose lengths are px from the centre of the first pixel.

    Raises ValueError: the lens is another one, or the number of coefficients is wrong.
    """
    data = dict(stated.get("ptr_wrapper", {}).get("data", {}))
    data |= data.pop("value0", {})
    kinds = [key for key in OPENMVG if key in data]
    names = OPENMVG[kinds[0]][1].split() if kinds else []
    given = [float(each) for each in data.pop(kinds[0])] if kinds else []
    if len(kinds) > 1 or len(given) != len(names) or "focal_length" not in data:
        raise ValueError(f"lens {stated.get('polymorphic_name', '')!r} of OpenMVG; {', '.join(OPENMVG)} are read")
    return data | dict(zip(names, given, strict=True)) | {"model": OPENMVG[kinds[0]][0] if kinds else "pinhole"}


MESHROOM = {
    "pinhole": ("pinhole", ""),
    "none": ("pinhole", ""),
    "radial1": ("opencv", "k1"),
    "radialk1": ("opencv", "k1"),
    "radial3": ("opencv", "k1 k2 k3"),
    "radialk3": ("opencv", "k1 k2 k3"),
    "brown": ("opencv", "k1 k2 k3 p1 p2"),
    "fisheye4": ("fisheye", "k1 k2 k3 k4"),
}
"""Meshroom's lenses: the model, and its parameters in their order (AliceVision, ``camera/Distortion*.hpp``)."""


def _of_meshroom(stated: dict) -> dict:
    """Return an entry of ``intrinsics`` with lengths in px: Meshroom's are in mm, its centre is an offset or absolute.

    Raises ValueError: the lens is another one, or a number is missing.
    """
    kind = plain(stated.get("distortionType", stated.get("type", "")))
    kind = plain(stated.get("type", "")) if kind == "none" and "distortionType" in stated else kind
    if kind not in MESHROOM:
        raise ValueError(f"lens {kind[:40]!r} of Meshroom; {', '.join(MESHROOM)} are read")
    model, names = MESHROOM[kind]
    size = np.array([float(stated["width"]), float(stated["height"])])
    if "pxFocalLength" in stated:
        focal = np.broadcast_to(numbers_of(stated["pxFocalLength"]), 2)
    else:
        focal = np.full(2, float(stated["focalLength"]) / float(stated["sensorWidth"]) * size[0])
        focal = focal * [1, float(stated.get("pixelRatio", 1))]
    point = numbers_of(stated["principalPoint"])
    if (np.abs(point) < NEAR * size).all():
        point = point + size / 2
    elif not (np.abs(point - size / 2) < NEAR * size).all():
        raise ValueError(f"principalPoint {point.tolist()} is neither in nor relative to the middle of the image")
    given = numbers_of(stated.get("distortionParams", []))
    names_given = names.split()
    if len(given) != len(names_given) and given.any():
        raise ValueError(f"{len(given)} distortionParams of {kind}; {len(names_given)} needed")
    taken = ("type", "distortionType", "focalLength", "pxFocalLength", "principalPoint", "distortionParams")
    others = {key: value for key, value in stated.items() if key not in taken}
    lens = {"fx": focal[0], "fy": focal[1], "cx": point[0], "cy": point[1], "model": model}
    return others | lens | (dict(zip(names_given, given.tolist(), strict=True)) if given.any() else {})


def _numbered(values: dict) -> dict[str, dict]:
    """Return the cameras of keys that are numbered, as ``M1``, ``D1``, ``K_00``, ``camera_matrix_left``."""
    split = {}
    for key in values:
        if slam := re.fullmatch(r"Camera(\d)\.(.+)", str(key)):
            split[key] = (f"Camera.{slam[2]}", slam[1])
        elif match := NUMBERED.match(str(key)):
            split[key] = (match[1], match[2]) if match[2] else (match[4], match[3])
    wanted = "matrix" if any(_is_matrix(values[key], base, "matrix") for key, (base, _) in split.items()) else "p"
    sides = [side for key, (base, side) in split.items() if _is_matrix(values[key], base, wanted)]
    rectified = wanted == "p" and bool(sides)
    sides = sides or list(dict.fromkeys(side for base, side in split.values() if base == "Camera.fx"))
    if not sides:
        return {}
    shared = {key: value for key, value in values.items() if key not in split or split[key][1] not in sides}
    whole = shared
    if wanted == "matrix" and _holds_lens(shared):  # ORB-SLAM's rectified camera beside LEFT.K and RIGHT.K
        shared = {key: value for key, value in shared.items() if not str(key).startswith("Camera.")}
    cameras = {
        side: shared | {base: values[key] for key, (base, own) in split.items() if own == side} for side in sides
    }
    if rectified:  # KITTI's odometry: the left 3×3 of P is K of the rectified images
        for camera in cameras.values():
            if "P" in camera:
                camera["K"] = np.reshape(numbers_of(camera.pop("P")), (3, 4))[:, :3].ravel().tolist()
        warnings.warn("the camera is that of P, which is for rectified images", InputNote, stacklevel=2)
    return cameras | ({"Camera": whole} if whole is not shared else {})


def _is_matrix(value: object, base: str, role: str) -> bool:
    if role == "p":
        return plain(base) == "p" and numbers_of(value).size == 12
    return role_of(base) == role and numbers_of(value).size == 9
