"""Keys of camera files: a reader takes those of its format, and one rule holds for all others. A key is known to be
harmless, or named; one that may change the projection is refused."""

import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np

from stcal.errors import InputError, InputNote, held, named

_HARMLESS = """
cameraid cameraindex cameraname cameraserial camname camoverlaps comment createdat createdby data description
fileversion flags fps frameid generatedon hostname id imagename imagetopic label localtransform make name nframes notes
nrofframes nrofimages p pattern patternsize projectionmatrix r ratehz rectificationmatrix ret rms rostopic sensortype
serial serialnumber source squaresize stamp t target tbs tcamimu tcncnm1 time timeshiftcamimu timestamp topic units
version
"""
HARMLESS = frozenset(_HARMLESS.split())
"""Keys, in small letters and digits alone, that say nothing of how a ray becomes a pixel of the photograph. ``R`` and
``P`` of ROS are for images that are rectified afterwards."""
_BEGINNINGS = """
acc avg bodyt board calib date estimate extrinsic fixaspect fixprincipal frames gridpoints gyr header imagepoints imu
mean num objectpoints perview projectionmatrix rect rectificationmatrix reproj rvec stereo tbc tcam timu totalavg tvec
zeroprincipal zerotangent
"""
HARMLESS_BEGINNINGS = tuple(_BEGINNINGS.split())
"""Beginnings of such keys: of poses, observations and settings of other programs."""
HARMLESS_ENDS = ("stddev", "std", "error", "errors", "sigma", "uncertainty", "covariance", "rms", "topic")
"""Ends of such keys: uncertainties."""
SUSPECT = re.compile(
    r"([kd]|xi|alpha|alphac|beta|gamma[12]?|skew|shear|tau[xy]?|[kpsb]\d\d?|t\d|sk[xy]|mu|mv|mx|my|f|fx|fy|cx|cy|u0|v0|ppx|ppy)"
)
"""Names of parameters of lenses, of which a reader takes those of its format."""
SUSPECT_PART = re.compile(
    r"model|distort|fisheye|omni|mirror|radial|tangent|prism|tilt|rational|coef|projecti|intrinsic|focal|principal"
    r"|stretch|crop|binning|roi|scal|flip|zoom|resiz|affin|poly|cameratype|lens(type|param)|cameramatrix|undist"
)
"""Parts of names of keys that may change the projection."""
DISTORTION = re.compile(r"dist(?!anc)|coef|^kc")
"""Parts of names of lists of distortion coefficients, also of keys that begin harmlessly, as ``calib_dist`` does."""
COUNTS = (4, 5, 8, 12, 14)  # numbers of OpenCV's distortion coefficients
MOST_COEFFICIENT = 100.0  # largest distortion coefficient; lists with larger values are pixels or times
UNIT_WITHIN = 1e-3  # largest deviation of a quaternion's length from 1
SHOWN = 6  # largest number of keys that a message names
_passed_over: ContextVar[list[str] | None] = ContextVar("_passed_over", default=None)
_file: ContextVar[str] = ContextVar("_file", default="")
"""The camera file that is read, as messages name it."""


@contextmanager
def reading(file: str) -> Iterator[None]:
    """Let errors and notes name the camera file that is read in the context."""
    with held(_file, file), named(file):
        yield


def note(text: str) -> None:
    """Warn of something in the camera file that is read."""
    warnings.warn(f"{_file.get()}: {text}", InputNote, stacklevel=3)


@contextmanager
def collecting_passed_over() -> Iterator[list[str]]:
    """Collect what is in a camera file and not in the camera that is read: other cameras, and keys with numbers."""
    collected: list[str] = []
    with held(_passed_over, collected):
        yield collected


def pass_over(parts: Collection[str], what: str = "") -> None:
    """Add parts of a camera file to what is passed over, the first ``SHOWN`` by name; ``what`` : what they are."""
    collected = _passed_over.get()
    if collected is not None and parts:
        collected.append(f"{what}{_first(list(parts))}")


def _first(names: list[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(name[:40] for name in names[:SHOWN]) + more


def plain(key: object) -> str:
    """Return a key in small letters and digits alone: programs differ in capitals, dots and underscores."""
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def may_be_coefficients(value: object) -> bool:
    """Return True for a list of as many numbers as distortion has, unless they are whole, or a quaternion."""
    numbers = numbers_of(value)
    if isinstance(value, str) or numbers.size not in COUNTS or not np.abs(numbers).max() < MOST_COEFFICIENT:
        return False
    return bool((numbers % 1).any()) and abs(float(np.linalg.norm(numbers)) - 1) > UNIT_WITHIN


def numbers_of(value: object) -> np.ndarray:
    """Return the numbers of a list or of a text of them, flat; empty if it is neither."""
    try:
        return _flat(value)
    except (TypeError, ValueError):
        return np.zeros(0)


def _flat(value: Any) -> np.ndarray:
    return np.asarray(value.replace(",", " ").split() if isinstance(value, str) else value, float).ravel()


def is_neutral(value: object) -> bool:
    """Return True for a value that says nothing: 0, a list of zeros, false, an empty text, or none."""
    if isinstance(value, Mapping | list | tuple):
        return all(map(is_neutral, value.values() if isinstance(value, Mapping) else value))
    if isinstance(value, str):
        words = [word for word in value.lower().split() if word not in ("none", "null", "false", "no")]
        return len(numbers_of(words)) == len(words) and not numbers_of(words).any()
    return value is None or not value


def leaves(values: Mapping, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    """Yield the path and the value of every key that holds no further keys."""
    for key, value in values.items():
        inner = (*path, str(key))
        if isinstance(value, Mapping) and value:
            yield from leaves(value, inner)
        else:
            yield inner, value


def require_known(unread: Mapping, harmless: Collection[str] = (), undistorted: bool = False) -> None:
    """Report the keys that a reader did not use: harmless ones are ignored silently, others with an
    :class:`InputNote`; one that may change the projection is refused unless its value is 0 or empty. ``harmless`` :
    further harmless keys of the format, as :func:`plain` writes them, or beginnings of them that end in ``*``;
    ``undistorted`` : True if no distortion was found, so that an unknown list of coefficients may be it."""
    beginnings = (*HARMLESS_BEGINNINGS, *(word[:-1] for word in harmless if word.endswith("*")))
    unknown = []
    pass_over([".".join(keys) for keys, value in leaves(unread) if _says_numbers(value)])
    for keys, value in leaves(unread):
        path = [part for key in keys for part in key.split(".")]
        names = [*map(plain, path), plain("".join(path))]
        if not (HARMLESS | set(harmless)).isdisjoint(names):
            continue
        of_a_lens = bool(SUSPECT.fullmatch(plain(path[-1])))
        coefficients = may_be_coefficients(value)
        uncertainty = plain(path[-1]).endswith(HARMLESS_ENDS)
        of_a_lens |= coefficients and not uncertainty and bool(DISTORTION.search(plain(path[-1])))
        if not of_a_lens and (uncertainty or any(n.startswith(beginnings) for n in names)):
            continue
        if not (of_a_lens or (undistorted and coefficients)) and not any(map(SUSPECT_PART.search, names)):
            unknown.append(".".join(path))
        elif not is_neutral(value):
            taken = "call it distortion_coefficients if it is OpenCV's k1, k2, p1, p2, k3 …; " if coefficients else ""
            text = " ".join(str(value).split())
            shown = text if len(text) <= 40 else f"{text[:40]} …"
            fault = f"{'.'.join(path)[:80]} = {shown} may change the projection and is not supported"
            remedy = f"{taken}remove it if the lens is right without it, or calibrate without it"
            raise InputError("E-CAMERA-KEY", f"{fault}; {remedy}")
    if unknown:
        note(f"not known, and passed over: {_first(unknown)}")


def _says_numbers(value: object) -> bool:
    """Return True for numbers, such as poses and σ, but not for zeros and identity matrices."""
    numbers = numbers_of(value)
    is_identity = numbers.size == 9 and (numbers == np.eye(3).ravel()).all()
    is_nested = isinstance(value, list) and any(isinstance(each, dict | list) for each in value)
    return not isinstance(value, str | bool) and bool(numbers.any() if numbers.size else is_nested) and not is_identity


@dataclass(frozen=True, slots=True, eq=False)
class Keys:
    """The keys of one camera. What a reader takes is removed from ``left``."""

    left: dict[str, object]

    def has(self, *names: str) -> bool:
        """Return True if a key of these names is left."""
        return not {plain(key) for key in self.left}.isdisjoint(map(plain, names))

    def take(self, *names: str) -> object:
        """Return the value of the key that has one of these names; None if there is none."""
        wanted = [*map(plain, names)]
        keys = [key for key, value in self.left.items() if plain(key) in wanted and not isinstance(value, Mapping)]
        found = {key: self.left.pop(key) for key in keys}
        if len({repr(value) for value in found.values()}) > 1:
            raise InputError("E-CAMERA-REPEATED", f"{' and '.join(found)} mean the same and differ; leave one in")
        return next(iter(found.values()), None)

    def numbers(self, *names: str) -> np.ndarray | None:
        """Return the numbers of a key, flat; None if there is no such key; ValueError if a word is no number."""
        if not self.has(*names):
            return None
        value = self.take(*names)
        if isinstance(value, bool):
            raise InputError("E-CAMERA-CONTENT", f"{names[0]} is {value}; numbers needed")
        return _flat(value)

    def number(self, name: str, default: float | None = None) -> float:
        """Return one number; ``default`` where there is no such key."""
        numbers = self.numbers(name)
        if numbers is None and default is None:
            raise InputError("E-CAMERA-CONTENT", f"no {name}; add it")
        if numbers is not None and numbers.size != 1:
            raise InputError("E-CAMERA-COEFFICIENTS", f"{name} of {numbers.size} numbers; 1 needed")
        return float(default if numbers is None else numbers[0])

    def size(self) -> tuple[float, float, bool]:
        """Return width and height, px, 0 if the file states none; and whether they are from a list of both."""
        stated = [self.take(f"image_{side}", side) for side in ("width", "height")]
        if any(isinstance(side, bool) for side in stated):
            raise InputError("E-CAMERA-SIZE", f"image_width and image_height are {stated}; numbers of pixels needed")
        width, height = (float(side or 0) for side in stated)  # type: ignore[arg-type]
        both = self.numbers("image_size", "resolution", "camera_resolution", "img_size")
        if both is None or not both.any():
            return width, height, False
        if both.size != 2:
            raise InputError("E-CAMERA-SIZE", f"size of {both.size} numbers; width and height needed")
        if width and height and (width, height) != tuple(both):
            fault = f"size {both[0]:g}×{both[1]:g} px, but image_width and image_height {width:g}×{height:g} px"
            raise InputError("E-CAMERA-SIZE", f"{fault}; correct one of them")
        return float(both[0]), float(both[1]), True
