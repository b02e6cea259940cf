"""Camera files of keys and values: YAML, JSON, XML, INI, and lines of many programs, by one table of their keys.

A program is read by what its keys are called: :data:`ROLES` has the names in use, and :data:`TABLES` those that mean
something else in one program. What is left goes through :func:`stcal.io.cameras.keys.require_known`.
"""

import json
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stcal.errors import InputError, InputNote
from stcal.io.cameras.foreign import SQUARE, ForeignLens, of_kalibr, of_opencv, of_parts, one_of
from stcal.io.cameras.keys import is_neutral, leaves, plain, require_known
from stcal.io.cameras.model import (
    COLMAP_PIXEL_ORIGIN,
    EQUIDISTANT,
    MAX_SIDE_PX,
    CameraModel,
    camera_from_opencv,
    camera_model,
)
from stcal.io.plain_yaml import load_documents

ROLES: Mapping[str, str] = {
    name: role
    for role, names in {
        "matrix": "cameramatrix k m mtx cammtx cammatrix kmatrix intrinsicmatrix intrinsicsmatrix "
        "cameraintrinsicmatrix",
        "distortion": "distortioncoefficients d distcoeffs distcoeff distcoefs distortioncoeffs distortioncoefs coeffs "
        "distortion dist distortionvector",
        "lens": "intrinsics",
        "f": "f focal focallength",
        "fx": "fx flx focalx gamma1",
        "fy": "fy fly focaly gamma2",
        "cx": "cx ppx u0",
        "cy": "cy ppy v0",
        "skew": "skew",
        "xi": "xi",
        "width": "imagewidth width w imgwidth imwidth",
        "height": "imageheight height h imgheight imheight",
        "size": "imagesize resolution cameraresolution imgsize s",
        "camera model": "cameramodel modeltype projectionmodel projectiontype cameratype type",
        "model": "distortionmodel model lensmodel distortiontype",
        "fisheye": "fisheyemodel fisheye isfisheye usefisheye",
        **{k: k for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")},
    }.items()
    for name in names.split()
}
"""What a key holds, by its name in small letters and digits."""
CONTAINERS = re.compile(
    r"(camera|cam|camerainfo|cameraparameters|cameramatrix|distortion|intrinsics?|projectionparameters|calibration"
    r"|d|distortioncoefficients|distortioncoeffs|distcoeffs|distortionparameters|mirrorparameters|intrinsicparameters|image|opencvstorage|value0)\d*$"
)
"""Keys that hold others and add nothing to their meaning."""
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PERSPECTIVE = {
    *("plumbbob", "rationalpolynomial", "radtan", "radialtangential", "brown", "brownconrady", "opencv", "fullopencv"),
    *("distortionbrownconrady", "thinprism", "tilted"),
}
"""Values of a model that mean OpenCV's perspective lens."""
UNDISTORTED = frozenset(["none", "", "pinhole", "simplepinhole", "perspective", "distortionnone", "null", "false"])
"""Values of a model that say nothing of distortion."""
FISHEYE = frozenset([*map(plain, EQUIDISTANT), "kannalabrandt8", "kannalabrandt4", "kb4", "opencvfisheye"])
FISHEYE_ALSO = frozenset(["distortionkannalabrandt4", "fisheyeopencv", "pinholeequi", "equi"])
UNIFIED = frozenset(["omni", "omnidir", "omnidirectional", "mei", "unified"])
INVERSE = frozenset(["inversebrownconrady", "distortioninversebrownconrady", "modifiedbrownconrady"])
"""Models of which zeros alone are read: their polynomials are other ones than OpenCV's."""
OTHER_WAY = "its coefficients are those of another formula, and under another name they make a wrong camera"
NUMBERED = re.compile(r"(.*?)[ _]?(\d+|left|right|l|r)$|(left|right|cam\d+)[ _.](.*)$", re.IGNORECASE)
"""A key with the number or the side of its camera, behind or in front."""
TAB = 4
"""Spaces in place of a tab, which YAML does not allow."""
NEAR = 0.25
"""Share of the image's size within which the principal point is from the middle of the image."""


@dataclass(frozen=True, slots=True)
class Table:
    """The keys of one program, where they mean something else than in :data:`ROLES`.

    ``needs`` : keys that tell the program; ``roles`` : its keys; ``model`` : its lens, where no key says it;
    ``origin`` : coordinate of the first pixel's centre; ``relative`` : True if lengths are in units of the longer side,
    from the middle of the image; ``harmless`` : further keys, as in :func:`stcal.io.cameras.keys.require_known`.
    """

    called: str
    needs: frozenset[str]
    roles: Mapping[str, str] = field(default_factory=dict)
    model: str = ""
    origin: float = 0.0
    relative: bool = False
    harmless: tuple[str, ...] = ()


TABLES = (
    Table(
        "camodocal's KANNALA_BRANDT",
        frozenset(["mu", "mv"]),
        {"mu": "fx", "mv": "fy", "k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4"},
        model="equidistant",
    ),
    Table(
        "Nerfstudio",
        frozenset(["flx"]),
        origin=COLMAP_PIXEL_ORIGIN,
        harmless=("cameraanglex", "cameraangley", "plyfilepath", "orientationoverride", "aabbscale", "scale", "offset"),
    ),
    Table(
        "stella_vslam",
        frozenset(["cols", "rows", "fx"]),
        {"cols": "width", "rows": "height"},
        harmless=("setup", "colororder", "focalxbaseline", "depththreshold", "keyframe*", "mapping*", "feature*"),
    ),
    Table(
        "Meshroom",
        frozenset(["intrinsicid"]),
        harmless=(
            *("initial*", "px*", "sensor*", "locked", "pixelratio*", "distortioninit*", "distortionlocked"),
            *("scalelocked", "offsetlocked", "intrinsicid"),
        ),
    ),
    Table("OpenSfM", frozenset(["projectiontype"]), {"focal": "f"}, relative=True, harmless=("focalprior*",)),
    Table("a file", frozenset()),
)
SLAM_SETTINGS = ("camerabf", "cameranew*", "camerargb", "thdepth", "depthmapfactor", "cameraimagescale", "rgbd*")
"""Settings of ORB-SLAM: its images are resized after reading, and its intrinsics are of the images as they are."""
NEUTRAL = {"binningx": (0, 1), "binningy": (0, 1), "binning": (0, 1)}
"""Keys of ROS that are harmless with these values alone: the image is not the one that the intrinsics are for."""


def values_of(text: str) -> dict:
    """Return the keys and values of a text in JSON, XML, INI, Bouguet's ``.m``, or YAML.

    Raises
    ------
    ValueError, yaml.YAMLError, ElementTree.ParseError
        The text is none of these, or holds several documents that differ.
    """
    if text.lstrip().startswith("<"):
        return _xml_values(ElementTree.fromstring(text))
    if text.lstrip().startswith("{"):
        try:
            values = json.loads(text, strict=False, object_pairs_hook=_once)
        except json.JSONDecodeError:  # YAML has braces, too
            values = load_documents(text)[0]
    elif sections := _ini_values(text):
        return sections
    else:
        documents = [each for each in load_documents(text.replace("\t", " " * TAB)) if each is not None]
        if not documents:
            raise ValueError("no keys")
        values, *more = documents
        if any(_without_header(each) != _without_header(values) for each in more):
            raise ValueError(f"{len(documents)} documents that differ; leave one in")
    if not isinstance(values, dict):
        raise ValueError("no keys")
    return _with_data(values)


def _once(pairs: list) -> dict:
    """Return an object of JSON; refuse a repeated key, of which readers take the last one without a word."""
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)[:40]} twice")
    return made


def _without_header(document: object) -> object:
    return {k: v for k, v in document.items() if k != "header"} if isinstance(document, dict) else document


def _with_data(values):
    """Return values with the content of OpenCV's and ROS's matrices in place of their rows, columns and type."""
    if isinstance(values, dict):
        if "data" in values and values.keys() & {"rows", "cols"}:
            return values["data"]
        return {key: _with_data(value) for key, value in values.items()}
    return values


def _xml_values(root: ElementTree.Element) -> dict:
    values: dict = {}
    for node in root:
        data = node.find("data")
        if data is not None:
            value = [float(word) for word in (data.text or "").split()]
        elif len(node):
            value = _xml_values(node)
        else:
            value = (node.text or "").strip().strip('"')
        if node.tag in values:
            raise ValueError(f"the key {node.tag[:40]} twice")
        values[node.tag] = value
    return values


def _ini_values(text: str) -> dict:
    """Return sections, keys and numbers of ROS's ``.ini``: each key in a line of its own, then lines of numbers."""
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith(";")]
    if not lines or not re.fullmatch(r"\[[A-Za-z_][\w /.-]*\]", lines[0]):
        return {}
    values: dict = {}
    section = numbers = None
    for line in lines:
        if match := re.fullmatch(r"\[(.+)\]", line):
            section = values.setdefault(match[1], {})
        elif section is not None:
            key, equals, rest = (word.strip() for word in line.partition("="))
            words = rest.split() if equals else line.split()
            if key in ("projection", "rectification"):  # the words elsewhere name a lens
                key = f"{key}_matrix"
            if equals or not _are_numbers(words):
                numbers = section.setdefault(key, [])
            if equals and not _are_numbers(words):
                section[key] = rest
            elif numbers is not None and _are_numbers(words):
                numbers += [float(word) for word in words]
    for section in values.values():
        for key, value in section.items():
            if isinstance(value, list) and len(value) == 1:
                section[key] = value[0]
    return values


def _are_numbers(words: list[str]) -> bool:
    try:
        return [float(word) for word in words] != []
    except ValueError:
        return False


def from_keys(values: dict, choice: str, source: str) -> CameraModel | ForeignLens:
    """Return a camera of keys and values; ``choice`` : its name or number if there are several.

    Raises
    ------
    InputError
        There is no camera, several and no choice, an unsupported lens, a key that may change the projection, or a value
        is impossible.
    """
    cameras = _cameras(values)
    if not cameras:
        raise InputError(
            "E-CAMERA-CONTENT",
            f"camera file {source}: no camera_matrix, K, intrinsics or fx; write it with cv2.FileStorage or as ROS "
            "camera_info",
        )
    names = list(cameras)
    chosen = cameras[names[0] if names == [""] else one_of(names, choice, source)]
    return _Reading.of(chosen, source).lens()


def _role_of(path: tuple[str, ...], table: Table) -> str | None:
    """Return what a key holds; containers around it add nothing, ORB-SLAM's ``Camera.`` neither."""
    parts = [part for key in path for part in key.split(".")]
    while len(parts) > 1 and CONTAINERS.match(plain(parts[0])):
        parts = parts[1:]
    name = plain(parts[0]) if len(parts) == 1 else ""
    return table.roles.get(name) or (ROLES.get(name) if name not in table.needs or name in ROLES else None)


def _holds_lens(values: object) -> bool:
    if not isinstance(values, dict):
        return False
    names = {plain(key.split(".")[-1]) for path, _ in _shallow(values) for key in path[-1:]}
    roles = {ROLES.get(name) for name in names}
    return bool({"matrix", "lens", "fx", "f"} & roles) or "mu" in names


def _shallow(values: dict):
    """Yield the leaves of a camera's own keys, and of containers among them."""
    for key, value in values.items():
        if isinstance(value, dict) and CONTAINERS.match(plain(key)):
            yield from (((key, *path), inner) for path, inner in _shallow(value))
        elif not isinstance(value, dict):
            yield (key,), value


def _cameras(values: dict) -> dict[str, dict]:
    """Return the cameras of a file by name, each with the keys that all share; a single one may have no name."""
    frames = values.get("frames")
    if isinstance(frames, list) and any(_holds_lens(frame) for frame in frames):
        shared = {key: value for key, value in values.items() if key != "frames"}
        kept = [{k: v for k, v in f.items() if plain(k) in ROLES} for f in frames if isinstance(f, dict)]
        if all(each == kept[0] for each in kept):
            return {"": shared | kept[0]}
        names = [str(frame.get("file_path", i)) for i, frame in enumerate(frames) if isinstance(frame, dict)]
        return {name: shared | own for name, own in zip(names, kept, strict=True)}
    if isinstance(values.get("intrinsics"), list) and any(isinstance(each, dict) for each in values["intrinsics"]):
        own = [_of_meshroom(each) for each in values["intrinsics"] if isinstance(each, dict)]
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
    for value in values.values():  # a list or a mapping of cameras, one level down
        if isinstance(value, list) and any(_holds_lens(each) for each in value):
            named = {
                str(next((each[k] for k in ("name", "id", "camera_name") if k in each), i)): each
                for i, each in enumerate(value)
                if isinstance(each, dict)
            }
            return named if len(named) == len(value) else {str(i): each for i, each in enumerate(value)}
        if isinstance(value, dict) and any(_holds_lens(each) for each in value.values()):
            return _cameras(value)
    return {}


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

    Raises
    ------
    ValueError
        The lens is another one, or a number is missing.
    """
    kind = plain(stated.get("distortionType", stated.get("type", "")))
    kind = plain(stated.get("type", "")) if kind == "none" and "distortionType" in stated else kind
    if kind not in MESHROOM:
        raise ValueError(f"lens {kind[:40]!r} of Meshroom; {', '.join(MESHROOM)} are read")
    model, names = MESHROOM[kind]
    size = np.array([float(stated["width"]), float(stated["height"])])
    if "pxFocalLength" in stated:
        focal = np.broadcast_to(_numbers(stated["pxFocalLength"]), 2)
    else:
        focal = np.full(2, float(stated["focalLength"]) / float(stated["sensorWidth"]) * size[0])
        focal = focal * [1, float(stated.get("pixelRatio", 1))]
    point = _numbers(stated["principalPoint"])
    if (np.abs(point) < NEAR * size).all():
        point = point + size / 2
    elif not (np.abs(point - size / 2) < NEAR * size).all():
        raise ValueError(f"principalPoint {point.tolist()} is neither in nor relative to the middle of the image")
    given = _numbers(stated.get("distortionParams", []))
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
        match = NUMBERED.match(str(key))
        if match:
            split[key] = (match[1], match[2]) if match[2] else (match[4], match[3])
        elif slam := re.fullmatch(r"(Camera)(\d)\.(.+)", str(key)):
            split[key] = (f"Camera.{slam[3]}", slam[2])
    wanted = "matrix" if any(_is_matrix(values[key], base, "matrix") for key, (base, _) in split.items()) else "p"
    sides = [side for key, (base, side) in split.items() if _is_matrix(values[key], base, wanted)]
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
    if wanted == "p":  # KITTI's odometry: the left 3×3 of P is K of the rectified images
        for camera in cameras.values():
            if "P" in camera:
                camera["K"] = np.reshape(_numbers(camera.pop("P")), (3, 4))[:, :3].ravel().tolist()
        warnings.warn("the camera is that of P, which is for rectified images", InputNote, stacklevel=2)
    return cameras | ({"Camera": whole} if whole is not shared else {})


def _is_matrix(value: object, base: str, role: str) -> bool:
    if role == "p":
        return plain(base) == "p" and _numbers(value).size == 12
    return ROLES.get(plain(base)) == role and _numbers(value).size == 9


def _numbers(value: object) -> np.ndarray:
    """Return the numbers of a list or of a text of them, flat; empty if it is neither."""
    try:
        return np.asarray(value.replace(",", " ").split() if isinstance(value, str) else value, float).ravel()
    except (TypeError, ValueError):
        return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class _Reading:
    """``known`` : values by role, each with the ``keys`` it was read from; ``table`` : their program."""

    known: Mapping[str, object]
    keys: Mapping[str, str]
    table: Table
    source: str
    industrial: bool

    @classmethod
    def of(cls, values: dict, source: str) -> "_Reading":
        names = {plain(path[-1].split(".")[-1]) for path, _ in _shallow(values)}
        table = next(each for each in TABLES if each.needs <= names)
        known, keys, unread = {}, {}, {}
        for path, value in leaves(values):
            role, key = _role_of(path, table), ".".join(path)
            if role is None:
                unread[key] = value
            elif role in known and known[role] != value:
                raise InputError(
                    "E-CAMERA-REPEATED",
                    f"camera file {source}: {keys[role]} and {key} differ and mean the same; leave one in",
                )
            else:
                known[role], keys[role] = value, key
        for key in list(unread):
            allowed, of_roi = NEUTRAL.get(plain(key.split(".")[-1])), plain(key).startswith("roi")
            if (allowed and unread[key] in allowed) or (of_roi and _full_image(key, unread, known)):
                del unread[key]
            elif allowed or of_roi:
                raise InputError(
                    "E-CAMERA-KEY",
                    f"camera file {source}: {key} = {unread[key]}, so that images are a part of the one that K is for; "
                    "set it to 0 if your images have the file's full size, else calibrate at their size",
                )
        require_known(unread, source, (*table.harmless, *SLAM_SETTINGS))
        industrial = {"fx", "cx"} & known.keys() != set() and keys.get("fx", keys.get("cx", "")).startswith(
            "intrinsics"
        )
        return cls(known, keys, table, source, industrial)

    def fault(self, code: str, text: str) -> InputError:
        return InputError(code, f"camera file {self.source}: {text}")

    def number(self, role: str) -> float:
        """Return one number; 0 if the file has none."""
        value = self.known.get(role)
        if isinstance(value, bool):
            raise self.fault("E-CAMERA-CONTENT", f"{self.keys[role]} is {value}; a number needed")
        if value is None:
            return 0.0
        numbers = np.asarray(value, float).ravel()
        if numbers.size != 1:
            raise self.fault("E-CAMERA-COEFFICIENTS", f"{self.keys[role]} of {numbers.size} numbers; 1 needed")
        return float(numbers[0])

    def size(self) -> tuple[float, float]:
        """Return width and height, px; 0 if the file states none."""
        stated = [self.known.get(side) for side in ("width", "height")]
        if any(isinstance(side, bool) for side in stated):
            raise self.fault("E-CAMERA-SIZE", f"image_width and image_height are {stated}; numbers of pixels needed")
        width, height = (float(side or 0) for side in stated)  # type: ignore[arg-type]
        if (both := self.known.get("size")) is None or is_neutral(both):
            return width, height
        numbers = np.asarray(both.replace("x", " ").split() if isinstance(both, str) else both, float).ravel()
        if numbers.size != 2:
            raise self.fault("E-CAMERA-SIZE", f"{self.keys['size']} of {numbers.size} numbers; width and height needed")
        if width and height and (width, height) != tuple(numbers):
            raise self.fault(
                "E-CAMERA-SIZE",
                f"{self.keys['size']} {numbers[0]:g}×{numbers[1]:g} px, but {self.keys['width']} and "
                f"{self.keys['height']} {width:g}×{height:g} px; correct one of them",
            )
        return float(numbers[0]), float(numbers[1])

    def require_order(self, flat: list[float]) -> None:
        """Refuse a list of height and width, by the principal point, which is near the middle."""
        if "size" not in self.known:
            return
        size = np.array(self.size())
        near = [(np.abs(np.array(flat[2:]) - each / 2) < NEAR * each).all() for each in (size, size[::-1])]
        if not near[0] and near[1]:
            raise self.fault(
                "E-CAMERA-SIZE",
                f"{self.keys['size']} {size[0]:g}×{size[1]:g} px, but the principal point ({flat[2]:g}, {flat[3]:g}) "
                "px is near the middle of the sides exchanged; width first needed",
            )

    def intrinsics(self) -> tuple[list[float], float]:
        """Return fx, fy, cx, cy and the skew, px."""
        if "matrix" in self.known:
            return self._of_matrix()
        if "f" in self.known and "fx" not in self.known:
            fx = fy = self.number("f")
        else:
            fx = self.number("fx")
            fy = self.number("fy") if "fy" in self.known or self.table.called != "Nerfstudio" else fx
        wanted = ["cx", "cy"] if "f" in self.known and "fx" not in self.known else ["fx", "fy", "cx", "cy"]
        missing = [] if self.table.relative else [role for role in wanted if role not in self.known]
        if self.table.called == "Nerfstudio":
            missing = [role for role in missing if role != "fy"]
        if missing:
            raise self.fault("E-CAMERA-CONTENT", f"intrinsics without {', '.join(missing)}; fx, fy, cx, cy needed")
        cx, cy = self.number("cx") - self.table.origin, self.number("cy") - self.table.origin
        if self.table.relative:
            sides = self.size()
            if not all(0 < side <= MAX_SIDE_PX for side in sides):
                raise self.fault("E-CAMERA-SIZE", f"size {sides[0]:g}×{sides[1]:g} px; width and height needed")
            unit, (x, y) = max(sides), ((side - 1) / 2 for side in sides)
            return [unit * fx, unit * fy, unit * cx + x, unit * cy + y], 0.0
        return [fx, fy, cx, cy], self.number("skew")

    def _of_matrix(self) -> tuple[list[float], float]:
        value = self.known["matrix"]
        matrix = np.asarray(value.replace(",", " ").split() if isinstance(value, str) else value, float)
        if matrix.size != 9:
            raise self.fault("E-CAMERA-COEFFICIENTS", f"camera_matrix of {matrix.size} numbers; 3×3 needed")
        matrix = matrix.reshape(3, 3)
        if not matrix.any():
            raise self.fault(
                "E-CAMERA-UNCALIBRATED",
                f"{self.keys['matrix']} is all zero, which a driver publishes for a camera without calibration; "
                "calibrate it with `stcal-sfm calibrate-camera`, or load its calibration into the driver",
            )
        if (matrix[[1, 2, 2, 2], [0, 0, 1, 2]] != [0, 0, 0, 1]).any():
            turned = (matrix.T[[1, 2, 2, 2], [0, 0, 1, 2]] == [0, 0, 0, 1]).all()
            raise self.fault(
                "E-CAMERA-MATRIX",
                "camera_matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; "
                + ("it is transposed: write it row by row" if turned else "write it row by row, with 0 0 1 last"),
            )
        if not np.isfinite(matrix).all() and np.isfinite(matrix[[0, 1], [0, 1]]).all() and np.isnan(matrix[0, 1]):
            raise self.fault("E-CAMERA-SKEW", f"skew {matrix[0, 1]:g}; a finite number needed")
        stated = {"fx": (0, 0), "f": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2), "skew": (0, 1)}
        for role, place in stated.items():
            if role in self.known and self.number(role) != matrix[place]:
                raise self.fault(
                    "E-CAMERA-REPEATED",
                    f"{self.keys['matrix']} has {matrix[place]:g} for {role}, but {self.keys[role]} is "
                    f"{self.number(role):g}; leave one in",
                )
        return [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], float(matrix[0, 1])

    def model(self) -> str:
        """Return the kind of lens: perspective, equidistant, unified, or Kalibr's own.

        Raises
        ------
        InputError
            It is another one, or two keys contradict each other.
        """
        said = {role: self.known[role] for role in ("camera model", "model") if role in self.known}
        kinds = {}
        for role, value in said.items():
            word = plain("" if value is None else value)
            if word in UNDISTORTED or (role == "camera model" and word in PERSPECTIVE and "model" in said):
                continue
            kind = next(
                (
                    kind
                    for kind, words in (
                        ("perspective", PERSPECTIVE | {"simpleradial", "radial"}),
                        ("equidistant", FISHEYE | FISHEYE_ALSO),
                        ("unified", UNIFIED),
                        ("fov", {"fov"}),
                        ("eucm", {"eucm"}),
                        ("ds", {"ds"}),
                    )
                    if word in words
                ),
                None,
            )
            if kind is None and word in INVERSE and not self.coefficients("perspective").any():
                kind = "perspective"
            if kind is None:
                why = OTHER_WAY if word in INVERSE else "calibrate with plumb_bob or equidistant, or convert it there"
                raise self.fault(
                    "E-CAMERA-MODEL",
                    f"{self.keys[role]} {' '.join(str(value).split())[:60]!r} is not supported; {why}"
                    + ("; calibrate anew" if word in INVERSE else ""),
                )
            kinds[self.keys[role]] = kind
        if "fisheye" in self.known:
            yes = not is_neutral(self.known["fisheye"])
            kinds[self.keys["fisheye"]] = "equidistant" if yes else "perspective"
        if "xi" in self.known and self.number("xi") and "unified" not in kinds.values():
            kinds[self.keys["xi"]] = "unified"
        if self.table.model:
            kinds[self.table.called] = self.table.model
        both = set(kinds.values())
        if {"unified", "perspective"} == both or {"eucm", "perspective"} == both or {"ds", "perspective"} == both:
            both -= {"perspective"}  # distortion after the projection
        if len(both) > 1:
            words = ", ".join(f"{key} says {kind}" for key, kind in kinds.items())
            raise self.fault("E-CAMERA-MODEL", f"{words}; correct one of them")
        return both.pop() if both else "perspective"

    def coefficients(self, kind: str) -> np.ndarray:
        """Return the distortion coefficients in OpenCV's order; zeros beyond those of the model are left out."""
        single = [role for role in RADIAL_TANGENTIAL if role in self.known]
        if "distortion" in self.known:
            value = self.known["distortion"]
            given = np.asarray(value.replace(",", " ").split() if isinstance(value, str) else value, float).ravel()
            extra = [role for role in single if not is_neutral(self.known[role])]
            if extra:
                raise self.fault(
                    "E-CAMERA-REPEATED",
                    f"{self.keys['distortion']} and {self.keys[extra[0]]} both state distortion; leave one in",
                )
            last = 4 if kind == "equidistant" else 5
            given = given[:last] if last < len(given) < 8 and not given[last:].any() else given
            if kind == "equidistant" and len(given) not in (0, 4):
                why = next((self.keys[r] for r in ("fisheye", "model", "camera model") if r in self.known), "a key")
                raise self.fault(
                    "E-CAMERA-COEFFICIENTS",
                    f"{len(given)} coefficients in {self.keys['distortion']}, but by {why} the lens is equidistant; k1 "
                    "to k4 needed",
                )
            return given
        if not single:
            return np.zeros(0)
        if kind == "equidistant":
            tangential = [role for role in ("p1", "p2", "k5", "k6") if self.number(role)]
            if tangential:
                raise self.fault(
                    "E-CAMERA-COEFFICIENTS",
                    f"{self.keys[tangential[0]]} of a fisheye lens (equidistant); k1 to k4 are possible",
                )
            return np.array([self.number(role) for role in ("k1", "k2", "k3", "k4")])
        if self.number("k4") and not {"k5", "k6"} <= self.known.keys():
            raise self.fault(
                "E-CAMERA-COEFFICIENTS",
                f"k4 = {self.number('k4'):g} of a perspective lens without k5 and k6: OpenCV's stands below the "
                "fraction, others' is of r⁸; calibrate without it",
            )
        given = np.array([self.number(role) for role in RADIAL_TANGENTIAL])
        return given if given[5:].any() else given[:5]

    def lens(self) -> CameraModel | ForeignLens:
        """Return the camera."""
        if "lens" in self.known:
            return self._of_kalibr()
        kind = self.model()
        flat, skew = self.intrinsics()
        given, (width, height) = self.coefficients(kind), self.size()
        self.require_order(flat)
        if kind not in ("perspective", "equidistant", "unified"):
            raise self.fault("E-CAMERA-MODEL", f"{kind!r} needs the intrinsics as one list, as Kalibr writes them")
        if kind == "perspective" and self.industrial and "distortion" not in self.known and not given.size:
            # The lens may have distortion, though the form has none.
            numbers = np.concatenate([flat, np.zeros(8)])
            return camera_model(numbers, "OPENCV", width or None, height or None, Path(self.source))
        if kind == "unified":
            return self._unified(flat, skew, given, width, height)
        if not abs(skew) <= SQUARE * abs(flat[0]):
            return of_parts(flat, skew, given, kind, width, height, self.source)
        if kind == "equidistant":
            return camera_from_opencv(flat, given, True, width, height, self.source)
        return of_opencv(flat, given, width, height, self.source)

    def _unified(self, flat, skew: float, given: np.ndarray, width: float, height: float) -> ForeignLens:
        if "xi" not in self.known:
            raise self.fault("E-CAMERA-CONTENT", "a unified lens without xi; add it")
        values = {"xi": self.number("xi")}
        return of_parts(flat, skew, given, "unified", width, height, self.source, values["xi"])

    def _of_kalibr(self) -> CameraModel | ForeignLens:
        numbers = _numbers(self.known["lens"])
        for role in ("matrix", "f", "fx", "fy", "cx", "cy", "skew", "xi", "fisheye"):
            if role in self.known and not is_neutral(self.known[role]):
                raise self.fault(
                    "E-CAMERA-REPEATED",
                    f"{self.keys['lens']} is a list of all intrinsics, and {self.keys[role]} stands beside it; leave "
                    "one in",
                )
        lens = plain(self.known.get("camera model", "pinhole") or "pinhole")
        word = plain(self.known.get("model", "none") or "none")
        radtan = word in PERSPECTIVE
        distortion = "radtan" if radtan else "equidistant" if word in FISHEYE | FISHEYE_ALSO else word
        if lens not in ("pinhole", "omni", "eucm", "ds") or distortion not in ("radtan", "equidistant", "fov", "none"):
            raise self.fault(
                "E-CAMERA-MODEL",
                f"{lens} with {distortion}; pinhole, omni, eucm, ds with radtan, equidistant, fov or none are read",
            )
        width, height = self.size()
        given = self.coefficients("equidistant" if distortion == "equidistant" else "perspective")
        if lens != "pinhole" or distortion == "fov":
            values = {"intrinsics": numbers, "distortion_coeffs": given, "resolution": (width, height)}
            return of_kalibr(lens, distortion, values, self.source)
        if numbers.size != 4:
            raise self.fault("E-CAMERA-COEFFICIENTS", f"{self.keys['lens']} of {numbers.size} numbers; 4 needed")
        if distortion == "none" and given.any():
            raise self.fault(
                "E-CAMERA-MODEL", f"{self.keys['distortion']} without a distortion model; add distortion_model"
            )
        self.require_order(numbers.tolist())
        coefficients = given if distortion != "none" else np.zeros(0)
        return camera_from_opencv(
            numbers.tolist(), coefficients, distortion == "equidistant", width, height, self.source
        )


def _full_image(key: str, unread: dict, known: dict) -> bool:
    """Return True if a key of ROS's region of interest says that it is the whole image."""
    last = plain(key.split(".")[-1])
    if last in ("width", "height"):
        return is_neutral(unread[key]) or unread[key] == known.get(last)
    return last in ("dorectify", "xoffset", "yoffset") and is_neutral(unread[key])
