"""Dictionaries of tags, by their names in ``cv2.aruco``."""

import re
from collections.abc import Sequence
from functools import cache

import cv2

from stcal.errors import InputError

OF_OPENCV = ("tag36h11", "tag36h10", "tag25h9", "tag16h5")
"""Families of AprilTag that OpenCV detects."""
_APRILTAG = re.compile(r"(?:april)?[_ -]?t(?:ag)?[_ -]?(standard|circle|custom)?[_ -]?(\d{2}h\d{1,2})", re.I)


@cache
def known_dictionary(name: str) -> str:
    """Return the full name of a dictionary of ``cv2.aruco``; ``name`` may lack ``DICT_``, and be in any case.

    Families of AprilTag have their own names, too: ``tag36h11``, ``t36h11``.

    Raises
    ------
    ValueError
        The name is unknown; the message lists similar names. Or OpenCV lacks the family.
    """
    family = _APRILTAG.fullmatch(name.strip())
    if family is not None:
        if family[1] is not None or f"DICT_APRILTAG_{family[2].lower()}" not in dir(cv2.aruco):
            raise ValueError(
                f"OpenCV does not detect this family of AprilTag; print tags of {', '.join(OF_OPENCV)} for the target"
            )
        name = f"APRILTAG_{family[2]}"
    plain = name.strip().upper()
    plain = plain if plain.startswith("DICT_") else f"DICT_{plain}"
    dictionaries = {key.upper(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    if plain not in dictionaries:
        alike = sorted(k for k in dictionaries if k[5:9] == plain[5:9]) or sorted(dictionaries)
        raise ValueError(f"unknown dictionary; one of {', '.join(alike)} needed")
    return dictionaries[plain]


def dictionary_of(name: str):
    """Return the dictionary of ``cv2.aruco`` with this name, full or as of :func:`known_dictionary`.

    Raises
    ------
    InputError
        The name is unknown.
    """
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


def known_tags(tags: Sequence[tuple[str, int]], where: str) -> tuple[tuple[str, int], ...]:
    """Return tags with the full names of their dictionaries; ``where`` : what holds them, for messages.

    Raises
    ------
    InputError
        A dictionary is unknown or lacks the id, or a tag occurs twice.
    """
    known: list[tuple[str, int]] = []
    for name, tag in tags:
        try:
            full = known_dictionary(name)
        except ValueError as error:
            raise InputError("E-TAG-DICTIONARY", f"{where}: tag {tag}: dictionary {name!r}: {error}") from None
        if tag != int(tag) or not 0 <= tag < count_of(full):
            raise InputError(
                "E-TAG-ID-RANGE", f"{where}: tag {tag}: {full} has 0 … {count_of(full) - 1}; correct id or dictionary"
            )
        known.append((full, int(tag)))
    if twice := [tag for k, tag in enumerate(known) if tag in known[:k]]:
        raise InputError(
            "E-TAG-REPEATED", f"{where}: tag {twice[0][1]} of {twice[0][0]} occurs twice; tags must differ"
        )
    return tuple(known)
