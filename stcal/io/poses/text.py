"""Numbers, names and comments as controllers take them."""

import re


def fixed(value: float, digits: int) -> str:
    """Fixed digits, and no minus before zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text


def joined(values, digits: int, between: str = ",") -> str:
    """Numbers of fixed digits in a row."""
    return between.join(fixed(v, digits) for v in values)


def ascii_text(text: str) -> str:
    """What a comment can hold: other characters are ``?``."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)


def without_comments(text: str) -> str:
    """Lines that do not begin as comments of a controller do."""
    return "\n".join(line for line in text.splitlines() if not line.lstrip().startswith((";", "!", "#", "'")))


def program_name(stem: str) -> str:
    """The file's name as far as a controller takes it for that of a module: letters, digits and ``_``, 24 at most, not
    begun by a digit."""
    word = re.sub(r"\W", "_", stem, flags=re.ASCII)[:24]
    return word if re.match(r"[A-Za-z]", word) else f"stcal_{word}"[:24].rstrip("_")
