"""Dictionaries of tags, by their names in ``cv2.aruco`` or as families of AprilTag."""

import re
from collections.abc import Sequence
from functools import cache

import cv2

from stcal.errors import InputError

OF_OPENCV = ("tag36h11", "tag36h10", "tag25h9", "tag16h5")  # families of AprilTag that OpenCV detects
_APRILTAG = re.compile(r"(?:april)?[_ -]?(?:t(?:ag)?)?[_ -]?(standard|circle|custom)?[_ -]?(\d{2}h\d{1,2})", re.I)


@cache
def known_dictionary(name: str) -> str:
    """Return the full name of a dictionary of ``cv2.aruco``; ``name`` may lack ``DICT_``, and be in any case. Families
    of AprilTag have their own names, too: ``tag36h11``, ``t36h11``. Raises ValueError."""
    family = _APRILTAG.fullmatch(name.strip())
    if family is not None and f"DICT_APRILTAG_{family[2].lower()}" in dir(cv2.aruco) and family[1] is None:
        name = f"APRILTAG_{family[2]}"
    elif family is not None:
        unread = "OpenCV does not detect this family of AprilTag"
        raise ValueError(f"{unread}; print tags of {', '.join(OF_OPENCV)} for the target")
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
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@cache
def count_of(name: str) -> int:
    """Return the number of tags in a dictionary."""
    return len(dictionary_of(name).bytesList)


def cells_of(name: str, border_bits: int = 1) -> int:
    """Return the number of cells between a tag's corners, with ``border_bits`` cells of border on either side."""
    return dictionary_of(name).markerSize + 2 * border_bits


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
