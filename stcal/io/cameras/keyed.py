"""Camera files of keys and values: OpenCV, ROS, Kalibr, EuRoC, camodocal, and MATLAB's JSON.

:data:`FORMATS` has a row for each. A reader takes the keys of its format; all others go through
:func:`stcal.io.cameras.keys.require_known`.
"""

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping

import numpy as np

from stcal.errors import InputError
from stcal.io.cameras.camera_model import EQUIDISTANT, CameraModel, camera_from_opencv, camera_model
from stcal.io.cameras.foreign_lenses import SQUARE, ForeignLens, of_kalibr, of_opencv, of_parts, one_of
from stcal.io.cameras.keys import Keys, is_neutral, note, numbers_of, plain, require_known
from stcal.io.cameras.matlab import MARKS, from_structure
from stcal.io.toml import load_documents

TAB = 4  # spaces in place of a tab, which YAML does not allow


def values_of(text: str) -> dict:
    """Return the keys and values of JSON, XML or YAML; ValueError, YAMLError or ParseError if it is none of them."""
    if text.lstrip().startswith("<"):
        return _xml_values(ElementTree.fromstring(text))
    try:
        documents = [json.loads(text, strict=False, object_pairs_hook=_once)]
    except json.JSONDecodeError:
        documents = [each for each in load_documents(text.replace("\t", " " * TAB)) if each is not None]
    if not documents or not isinstance(values := _with_data(documents[0]), dict):
        raise ValueError("no keys")
    if any(_without_header(each) != _without_header(documents[0]) for each in documents[1:]):
        raise ValueError(f"{len(documents)} documents that differ; leave one in")
    return values


def _once(pairs: list) -> dict:
    keys = [key for key, _ in pairs]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ValueError(f"the key {twice[0][:40]} twice")
    return dict(pairs)


def _without_header(document: object) -> object:
    return {k: v for k, v in document.items() if k != "header"} if isinstance(document, dict) else document


def _with_data(values):
    """Return values with the content of matrices in place of their rows, columns and type, and with keys as texts."""
    if not isinstance(values, dict):
        return values
    if "data" in values and values.keys() & {"rows", "cols"}:
        return values["data"]
    return {str(key): _with_data(value) for key, value in values.items()}


def _xml_values(root: ElementTree.Element) -> dict:
    values: dict = {}
    for node in root:
        if node.tag in values:
            raise ValueError(f"the key {node.tag[:40]} twice")
        if (data := node.find("data")) is not None:
            values[node.tag] = [float(word) for word in (data.text or "").split()]
        else:
            values[node.tag] = _xml_values(node) if len(node) else (node.text or "").strip().strip('"')
    return values


def is_ini(text: str) -> bool:
    """Return True if a text begins with a section, below comments, and has a camera matrix."""
    return bool(re.match(r"(?:[ \t]*(?:[#;][^\r\n]*)?[\r\n])*[ \t]*\[[^\d\]]", text)) and "camera matrix" in text


def ini_cameras(text: str) -> dict[str, dict]:
    """Return the cameras of ROS's INI by name: every section with a matrix, each with the keys of ``[image]``."""
    sections: dict[str, dict] = {}
    section, numbers = {}, []
    for line in (line.split("#")[0].strip() for line in text.splitlines()):
        if match := re.fullmatch(r"\[(.+)\]", line):
            section = sections.setdefault(match[1], {})
        elif re.match(r"[^\W\d]", line):
            numbers = section.setdefault(f"{line}_matrix" if line in ("projection", "rectification") else line, [])
        elif line and line[0] != ";":
            numbers += [float(word) for word in line.split()]
    shared = {key: value for key, (value, *_) in sections.pop("image", {}).items()}
    return {name: shared | section for name, section in sections.items() if "camera matrix" in section}


READ = "COLMAP, OpenCV, ROS, Kalibr, EuRoC, MATLAB, Bouguet, Metashape, mrcal and camodocal"
"""Programs whose camera files are read."""
MATRIX = ("camera_matrix", "K", "M", "mtx")
COEFFICIENTS = ("distortion_coefficients", "D", "dist_coeffs", "dist_coeff", "distortion_coeffs", "dist", "distortion")
"""Names of OpenCV's matrix and coefficients."""
SIDED = re.compile(r"(.+?)_?([1-9]|left|right|l|r)$", re.IGNORECASE)
"""A key that ends in the number or the side of its camera."""
UNDISTORTED = ("", "none", "null", "false", "pinhole", "rectified", "perspective")
"""Words for a lens model, in small letters alone, that say no more than that the projection is perspective."""
LENSES = {
    **dict.fromkeys(("plumbbob", "rationalpolynomial", "radtan", "radialtangential", "brownconrady"), "perspective"),
    **dict.fromkeys(("opencv", "thinprism", "tilted"), "perspective"),
    **dict.fromkeys((*map(plain, EQUIDISTANT), "equi", "kannalabrandt4", "kannalabrandt8"), "equidistant"),
    **dict.fromkeys(("omni", "omnidir", "omnidirectional", "mei", "unified"), "unified"),
}
"""Kinds of lenses by the words for them."""
INVERSE = ("inversebrownconrady", "modifiedbrownconrady")
"""Models that are read only if their coefficients are zero: their polynomials are not OpenCV's."""
MOST_TANGENTIAL = 0.02
"""Largest tangential coefficient of real lenses: 0.02 is a sensor tilted by 2° behind the lens."""
NEAR = 0.25
"""Share of the image's size within which the principal point is from the middle of the image."""
Lens = CameraModel | ForeignLens


def from_keys(values: dict, choice: str) -> Lens:
    """Return a camera of keys and values; ``choice`` : its name or number if there are several."""
    for cameras_of, read in FORMATS:
        if cameras := cameras_of(values):
            names = list(cameras)
            return read(Keys(dict(cameras["" if names == [""] else one_of(names, choice)])))
    remedy = "convert it there, or write camera_matrix and distortion_coefficients as OpenCV has them"
    raise InputError("E-CAMERA-CONTENT", f"no camera of {READ}; {remedy}")


def from_ini(text: str, choice: str) -> Lens:
    """Return a camera of ROS's INI; errors as :func:`from_keys`."""
    cameras = ini_cameras(text)
    return of_matrix(Keys(cameras[one_of(list(cameras), choice)]))


def of_matrix(keys: Keys) -> Lens:
    """Return the camera of OpenCV's and ROS's keys: a matrix, coefficients, and a lens by name or by omnidir's xi."""
    matrix, given = keys.numbers(*MATRIX), keys.numbers(*COEFFICIENTS)
    xi, (width, height, listed) = keys.number("xi", 0.0), keys.size()
    said = {name: keys.take(name, *others) for name, others in SAYS_LENS.items() if keys.has(name, *others)}
    _require_whole_image(keys, width, height)
    if numbers_of(keys.left.get("F")).size == 9:  # the fundamental matrix of a pair
        del keys.left["F"]
    require_known(keys.left, undistorted=given is None)
    given = np.zeros(0) if given is None else given
    kind = _kind(said, xi, given)
    lens, skew = _lens_of(matrix)
    if kind == "perspective" and not said and given.size == 4:
        _say_no_model(given)
    return _camera(lens, given, kind, (width, height, listed), skew, xi)


def _camera(lens: list[float], given: np.ndarray, kind: str, size: tuple, skew: float = 0.0, xi: float = 0.0) -> Lens:
    width, height, listed = size
    last = 4 if kind == "equidistant" else 5
    given = given[:last] if last < len(given) < 8 and not given[last:].any() else given  # zeros beyond the model's
    if kind == "equidistant" and len(given) not in (0, 4):
        fault = f"{len(given)} coefficients, but by its model, or fisheye_model, the lens is equidistant"
        raise InputError("E-CAMERA-COEFFICIENTS", f"{fault}; k1 to k4 needed")
    if listed:
        _require_order(lens, width, height)
    if kind == "unified" or (kind == "equidistant" and not abs(skew) <= SQUARE * abs(lens[0])):
        return of_parts(lens, skew, given, kind, width, height, xi)
    if kind == "equidistant":
        return camera_from_opencv(lens, given, True, width, height)
    return of_opencv(lens, given, width, height, skew)


SAYS_LENS = {
    "camera_model": ("projection_model", "projection_type", "camera_type", "model_type", "type"),
    "distortion_model": ("model", "lens_model", "distortion_type"),
    "fisheye_model": ("fisheye", "is_fisheye", "use_fisheye"),
}
"""Keys that say which lens it is, with their other names."""


def _kind(said: Mapping[str, object], xi: float, given: np.ndarray) -> str:
    """Return the kind of lens: perspective, equidistant, or unified; refuse others, and keys that disagree."""
    kinds = {"xi": "unified"} if xi else {}
    for name, value in said.items():
        word = plain("" if value is None else value)
        if name == "fisheye_model":
            kinds[name] = "perspective" if is_neutral(value) else "equidistant"
        elif word in LENSES:
            kinds[name] = LENSES[word]
        elif word not in UNDISTORTED and not (word in INVERSE and not given.any()):
            why = "its coefficients are those of another formula; " if word in INVERSE else ""
            fault = f"{name} {' '.join(str(value).split())[:60]!r} is not supported"
            raise InputError("E-CAMERA-MODEL", f"{fault}; {why}calibrate anew with plumb_bob or equidistant")
    both = set(kinds.values()) - ({"perspective"} if "unified" in kinds.values() else set())
    if len(both) > 1:
        words = ", ".join(f"{name} says {kind}" for name, kind in kinds.items())
        raise InputError("E-CAMERA-MODEL", f"{words}; correct one of them")
    if "unified" in both and not xi:
        raise InputError("E-CAMERA-CONTENT", "a unified lens without xi; add it")
    return both.pop() if both else "perspective"


def _require_whole_image(keys: Keys, width: float, height: float) -> None:
    stated = {key: keys.take(key) for key in ("binning_x", "binning_y")}
    if isinstance(keys.left.get("roi"), Mapping):
        stated |= {f"roi.{key}": value for key, value in keys.left.pop("roi").items()}  # type: ignore[attr-defined]
    whole = {"binning_x": 1, "binning_y": 1, "roi.width": width, "roi.height": height}
    for key, value in stated.items():
        if not is_neutral(value) and value != whole.get(key):
            fault = f"{key} = {value}, so that K is for a larger image of which yours is a part"
            remedy = "set it to 0 if your images have the file's full size, else calibrate at their size"
            raise InputError("E-CAMERA-KEY", f"{fault}; {remedy}")


def _lens_of(matrix: np.ndarray | None) -> tuple[list[float], float]:
    if matrix is None or matrix.size != 9:
        count = 0 if matrix is None else matrix.size
        raise InputError("E-CAMERA-COEFFICIENTS", f"camera_matrix of {count} numbers; 3×3 needed")
    matrix = matrix.reshape(3, 3)
    if not matrix.any():
        fault = "camera_matrix is all zero, as published by a driver for an uncalibrated camera"
        remedy = "calibrate it with `stcal-sfm calibrate-camera`, or load its calibration into the driver"
        raise InputError("E-CAMERA-UNCALIBRATED", f"{fault}; {remedy}")
    if (matrix[[1, 2, 2, 2], [0, 0, 1, 2]] != [0, 0, 0, 1]).any():
        turned = (matrix.T[[1, 2, 2, 2], [0, 0, 1, 2]] == [0, 0, 0, 1]).all()
        order = "it is transposed: write it row by row" if turned else "write it row by row, with 0 0 1 last"
        raise InputError("E-CAMERA-MATRIX", f"camera_matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; {order}")
    if np.isnan(matrix[0, 1]):
        raise InputError("E-CAMERA-SKEW", "skew nan; a finite number needed")
    return [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], float(matrix[0, 1])


def _say_no_model(given: np.ndarray) -> None:
    """Name four coefficients without a model, as OpenCV's fisheye has; refuse those that must be a fisheye's."""
    model = "distortion_model: equidistant"
    if np.abs(given[2:]).max() > MOST_TANGENTIAL:
        large = f"the tangential ones {given[2]:g} and {given[3]:g} are larger than {MOST_TANGENTIAL:g}"
        remedy = f"add {model} if the lens is OpenCV's fisheye, else distortion_model: plumb_bob"
        fault = f"4 coefficients D without a lens model: for a perspective lens, {large}"
        raise InputError("E-CAMERA-MODEL", f"{fault}; {remedy}")
    if given.any():
        note(f"4 coefficients without a model, taken as k1, k2, p1, p2; of OpenCV's fisheye, add {model}")


def _require_order(lens: list[float], width: float, height: float) -> None:
    size = np.array([width, height])
    near = [(np.abs(np.array(lens[2:]) - each / 2) < NEAR * each).all() for each in (size, size[::-1])]
    if not near[0] and near[1]:
        place = f"({lens[2]:g}, {lens[3]:g}) px is near the middle of the sides exchanged"
        fault = f"size {width:g}×{height:g} px, but the principal point {place}"
        raise InputError("E-CAMERA-SIZE", f"{fault}; width first needed")


def _of_kalibr(keys: Keys) -> Lens:
    numbers, given = keys.numbers("intrinsics"), keys.numbers("distortion_coeffs", "distortion_coefficients")
    lens = plain(keys.take("camera_model", "type") or "pinhole")
    word = plain(keys.take("distortion_model") or "none")
    size = keys.size()
    require_known(keys.left, undistorted=given is None)
    kind = LENSES.get(word, word)
    distortion = "radtan" if kind == "perspective" else kind
    if lens not in ("pinhole", "omni", "eucm", "ds") or distortion not in ("radtan", "equidistant", "fov", "none"):
        known = "pinhole, omni, eucm, ds with radtan, equidistant, fov or none are read"
        raise InputError("E-CAMERA-MODEL", f"{lens[:40]} with {distortion[:40]}; {known}")
    assert numbers is not None  # by which the format is recognised
    given = np.zeros(0) if given is None else given
    if lens != "pinhole" or distortion == "fov":
        return of_kalibr(lens, distortion, numbers, given, size[:2])
    if numbers.size != 4:
        raise InputError("E-CAMERA-COEFFICIENTS", f"intrinsics of {numbers.size} numbers; 4 needed")
    if distortion == "none" and given.any():
        raise InputError("E-CAMERA-MODEL", "distortion_coeffs without a distortion model; add distortion_model")
    return _camera(numbers.tolist(), np.zeros(0) if distortion == "none" else given, kind, size)


CAMODOCAL = {
    "pinhole": ("perspective", "fx fy cx cy", "k1 k2 p1 p2"),
    "pinholefull": ("perspective", "fx fy cx cy", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "mei": ("unified", "gamma1 gamma2 u0 v0", "k1 k2 p1 p2"),
    "kannalabrandt": ("equidistant", "mu mv u0 v0", "k2 k3 k4 k5"),
}
"""Lenses of camodocal: the kind of each, and the keys of its intrinsics and of its coefficients."""


def _of_camodocal(keys: Keys) -> Lens:
    named = keys.take("model_type", "type")
    if plain(named) not in CAMODOCAL:
        raise InputError("E-CAMERA-MODEL", f"model_type {str(named)[:40]!r}; PINHOLE, MEI, KANNALA_BRANDT are read")
    kind, lens_keys, names = CAMODOCAL[plain(named)]
    if kind == "equidistant":
        keys.take("fisheye")  # a setting of VINS
    for part in ("projection_parameters", "distortion_parameters", "mirror_parameters"):
        stated = keys.left.pop(part, {})
        if not isinstance(stated, Mapping) or not keys.left.keys().isdisjoint(stated):
            raise InputError("E-CAMERA-CONTENT", f"{part} is no list of new keys; correct it")
        keys.left.update(stated)
    lens = [keys.number(name) for name in lens_keys.split()]
    given = np.array([keys.number(name, 0.0) for name in names.split()])
    xi, size = keys.number("xi") if kind == "unified" else 0.0, keys.size()
    require_known(keys.left)
    return _camera(lens, given, kind, size, xi=xi)


def _of_industrial(keys: Keys) -> CameraModel:
    """Return the camera of ROS-Industrial; its lens may have distortion, though the form has none."""
    own = Keys(dict(keys.left.pop("intrinsics")))  # type: ignore[call-overload]
    lens = [own.number(name) for name in ("fx", "fy", "cx", "cy")]
    width, height, _ = keys.size()
    require_known(keys.left | own.left, undistorted=True)
    return camera_model(np.array(lens), "OPENCV", width or None, height or None)


def _matrix_cameras(values: dict) -> dict[str, dict]:
    """Return the camera of a matrix, or those of a pair, by the ends of their keys, such as ``M1`` and ``D1``."""
    names = [*map(plain, MATRIX)]
    if any(plain(key) in names and not isinstance(value, Mapping) for key, value in values.items()):
        return {"": values}
    split = {key: match.groups() for key in values if (match := SIDED.match(key))}
    sides = [side for key, (base, side) in split.items() if plain(base) in names and numbers_of(values[key]).size == 9]
    shared = {key: value for key, value in values.items() if key not in split or split[key][1] not in sides}
    return {side: shared | {base: values[key] for key, (base, own) in split.items() if own == side} for side in sides}


def _has_intrinsics(values: object) -> bool:
    return isinstance(values, Mapping) and isinstance(values.get("intrinsics"), list) and "cameras" not in values


def _kalibr_cameras(values: dict) -> dict[str, dict]:
    if _has_intrinsics(values):
        return {"": values}
    shared = {key: value for key, value in values.items() if not _has_intrinsics(value)}
    return {key: shared | value for key, value in values.items() if _has_intrinsics(value)}


def _industrial_camera(values: dict) -> dict[str, dict]:
    intrinsics = values.get("intrinsics")
    return {"": values} if isinstance(intrinsics, Mapping) and "fx" in intrinsics else {}


FORMATS: tuple[tuple[Callable[[dict], dict[str, dict]], Callable[[Keys], Lens]], ...] = (
    (lambda values: {} if values.keys().isdisjoint(MARKS) else {"": values}, lambda keys: from_structure(keys.left)),
    (lambda values: {"": values} if "model_type" in values else {}, _of_camodocal),
    (_kalibr_cameras, _of_kalibr),
    (_industrial_camera, _of_industrial),
    (_matrix_cameras, of_matrix),
)
"""For each format a function that finds its cameras by name, a single one without a name, and the reader of one."""
