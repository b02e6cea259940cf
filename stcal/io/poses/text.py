"""Numbers, names and comments in the form that controllers accept."""

import re


def fixed(value: float, digits: int) -> str:
    """Return a number with a fixed number of digits, and no minus before zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text


def joined(values, digits: int, between: str = ",") -> str:
    """Return numbers with a fixed number of digits, joined by ``between``."""
    return between.join(fixed(v, digits) for v in values)


def ascii_text(text: str) -> str:
    """Return the text for a comment, with ``?`` for characters outside ASCII."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)


def without_comments(text: str) -> str:
    """Return the lines that are no comments of a controller."""
    return "\n".join(line for line in text.splitlines() if not line.lstrip().startswith((";", "!", "#", "'")))


def program_name(stem: str) -> str:
    """Return a valid name of a controller's module from a file's name.

    It has at most 24 letters, digits and ``_``, and begins with a letter.
    """
    word = re.sub(r"\W", "_", stem, flags=re.ASCII)[:24]
    return word if re.match(r"[A-Za-z]", word) else f"stcal_{word}"[:24].rstrip("_")
