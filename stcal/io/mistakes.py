"""The first mistake that a pydantic model found in a file, in words."""

from pydantic import ValidationError
from pydantic_core import PydanticCustomError

LONGEST = 80
"""Characters of a value that are shown."""
WITHOUT_VALUE = "without value"
"""Type of a mistake whose message says enough: of a matrix the first numbers tell nothing."""


def mistake(reason: object) -> PydanticCustomError:
    """To be raised by a validator; ``reason`` stands in the message as it is, without the value."""
    return PydanticCustomError(WITHOUT_VALUE, "{reason}", {"reason": str(reason)})


def first_mistake(error: ValidationError, missing: str = "key missing; add it") -> str:
    """``place: reason``, and how many more there are; ``missing`` : what is said of a key that is not there."""
    first = error.errors()[0]
    place = ".".join(str(part + 1 if isinstance(part, int) else part) for part in first["loc"])
    place = " ".join(place.split())  # a quoted TOML key may hold a line break
    if first["type"] == "extra_forbidden":
        reason = "unknown key; remove it or correct its spelling"
    elif first["type"] == "missing":
        reason = missing
    elif first["type"] == WITHOUT_VALUE:
        reason = first["msg"]
    elif first["type"] == "string_pattern_mismatch":
        reason = f"{first['input'][:LONGEST]!r}: spaces, colons, commas, slashes and line breaks are not allowed"
    else:
        shown = " ".join(repr(first["input"]).split())
        shown = shown if len(shown) <= LONGEST else shown[: LONGEST - 1] + "…"
        reason = f"{shown}: {first['msg'][0].lower()}{first['msg'][1:]}"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return f"{place}: {reason}{more}" if place else reason + more
