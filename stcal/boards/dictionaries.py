"""Dictionaries of tags, by their names in ``cv2.aruco``; families of AprilTag that OpenCV lacks, by their own."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from types import MappingProxyType

import cv2
import numpy as np

from stcal.errors import InputError

OF_OPENCV = ("tag36h11", "tag36h10", "tag25h9", "tag16h5")  # families of AprilTag that OpenCV detects


@dataclass(frozen=True, slots=True)
class Family:
    """A family of AprilTag 3 that ``pupil_apriltags`` detects. Corners are those of the white ring."""

    tags: int  # their number
    cells: int  # across the white ring; further cells lie outside
    most_wrong: int  # misread cells that are put right; with more of them, other squares would pass for tags


FAMILIES = MappingProxyType({"tagStandard41h12": Family(2115, 5, 2), "tagCircle21h7": Family(38, 5, 0)})
TOO_LARGE = ("tagStandard52h13", "tagCircle49h12", "tagCustom48h12")
"""Families of 42 000 to 66 000 tags: a detector needs a table of 1 to 2 GB in each process."""
EXTRA = "pip install 'stereo-target-calibration[apriltag]'"
_APRILTAG = re.compile(r"(?:april)?[_ -]?(?:t(?:ag)?)?[_ -]?(standard|circle|custom)?[_ -]?(\d{2}h\d{1,2})", re.I)


@cache
def known_dictionary(name: str) -> str:
    """Return the full name of a dictionary of ``cv2.aruco``; ``name`` may lack ``DICT_``, and be in any case. Families
    of AprilTag have their own names, too: ``tag36h11``, ``t36h11``. Raises ValueError."""
    family = _APRILTAG.fullmatch(name.strip())
    if family is not None and f"DICT_APRILTAG_{family[2].lower()}" in dir(cv2.aruco) and family[1] is None:
        name = f"APRILTAG_{family[2]}"
    elif family is not None:
        return _of_apriltag(f"tag{(family[1] or '').capitalize()}{family[2].lower()}")
    plain = f"DICT_{name.strip().upper().removeprefix('DICT_')}"
    dictionaries = {key.upper(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    if plain not in dictionaries:
        size = re.search(r"\d+ ?[X×] ?\d+|\d\dH\d+", plain)
        word = size[0].replace(" ", "").replace("×", "X") if size else plain[5:9]
        alike = sorted(own for key, own in dictionaries.items() if word in key) or sorted(dictionaries.values())
        raise ValueError(f"unknown dictionary; one of {', '.join(alike)} needed")
    return dictionaries[plain]


def dictionary_of(name: str):
    """Return the dictionary of ``cv2.aruco`` with this name, full or as of :func:`known_dictionary`."""
    if not hasattr(cv2.aruco, name):
        try:
            name = known_dictionary(name)
        except ValueError as error:
            raise InputError("E-TAG-DICTIONARY", f"dictionary {name!r}: {error}") from None
    if name in FAMILIES:
        found = f"dictionary {name}: its tags are found in images, not drawn here"
        raise InputError("E-TAG-DICTIONARY", f"{found}; draw them with AprilTag's own program")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _of_apriltag(name: str) -> str:
    instead = f"print tags of {', '.join(OF_OPENCV)}"
    unread = "OpenCV does not detect this family of AprilTag"
    if name in TOO_LARGE:
        large = "a family of 42 000 tags and more, whose table takes over a gigabyte in each process"
        raise ValueError(f"{large}; {instead} or of {', '.join(FAMILIES)} for the target")
    if name not in FAMILIES:
        raise ValueError(f"{unread}; {instead} for the target")
    if find_spec("pupil_apriltags") is None:
        raise ValueError(f"{unread}, which is read after `{EXTRA}`; or {instead} for the target")
    return name


def is_of_apriltag(name: str) -> bool:
    """Return True for the names of families that OpenCV lacks, whose corners are those of AprilTag's own pictures."""
    try:
        return known_dictionary(name) in FAMILIES
    except ValueError:
        return False


def of_opencv(name: str) -> str:
    """Return the full name of a dictionary, as :func:`known_dictionary`, for boards that only OpenCV finds."""
    full = known_dictionary(name)
    if full in FAMILIES:
        only = "tags that OpenCV does not detect, which only a layout of tags may have"
        raise ValueError(f"{only}; one of {', '.join(OF_OPENCV)} needed")
    return full


@cache
def count_of(name: str) -> int:
    """Return the number of tags in a dictionary."""
    return FAMILIES[name].tags if name in FAMILIES else len(dictionary_of(name).bytesList)


def cells_of(name: str, border_bits: int = 1) -> int:
    """Return the number of cells between a tag's corners, with ``border_bits`` cells of border on either side."""
    return FAMILIES[name].cells if name in FAMILIES else dictionary_of(name).markerSize + 2 * border_bits


@cache
def _detector(family: str):
    from pupil_apriltags import Detector

    class Kept(Detector):
        """Left to the end of the process: the package's own way frees the family twice, which may end in an abort."""

        def __del__(self):
            pass

    return Kept(families=family, nthreads=1, quad_decimate=1.0)


def find_family(grey: np.ndarray, family: str) -> list[tuple[int, np.ndarray]]:
    """Return the ids and rough corners (4, 2), px, of the tags of a family of :data:`FAMILIES` in an 8-bit image."""
    # AprilTag's corners begin bottom left and turn the other way; the middle of its first pixel is (0.5, 0.5).
    found = _detector(family).detect(np.ascontiguousarray(grey))
    sure = [tag for tag in found if tag.hamming <= FAMILIES[family].most_wrong]
    return [(int(tag.tag_id), np.array(tag.corners, float)[::-1] - 0.5) for tag in sure]


def known_tags(tags: Sequence[tuple[str, int]], where: str) -> tuple[tuple[str, int], ...]:
    """Return tags with the full names of their dictionaries; ``where`` : what holds them, for messages."""
    known: list[tuple[str, int]] = []
    for name, tag in tags:
        try:
            full = known_dictionary(name)
        except ValueError as error:
            raise InputError("E-TAG-DICTIONARY", f"{where}: tag {tag}: dictionary {name!r}: {error}") from None
        if tag != int(tag) or not 0 <= tag < count_of(full):
            raise InputError("E-TAG-ID-RANGE", f"{where}: tag {tag}: {full} has 0 … {count_of(full) - 1}; correct it")
        known.append((full, int(tag)))
    if twice := [tag for k, tag in enumerate(known) if tag in known[:k]]:
        repeated = f"{where}: tag {twice[0][1]} of {twice[0][0]} occurs twice; tags must differ"
        raise InputError("E-TAG-REPEATED", repeated)
    return tuple(known)
