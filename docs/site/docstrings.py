"""Docstrings of this package for Sphinx: numpydoc's sections become lists, whatever an entry says after its colon."""

import re
from collections.abc import Iterator

RULE = re.compile(r"-{3,}\s*")
ENTRY = re.compile(r"(\*{0,2}[A-Za-z_][\w.]*(?:, \*{0,2}[A-Za-z_][\w.]*)*)(?: : (.*))?$")
CROSS = re.compile(r":(?:func|class|meth|data|mod|attr):`~?\.?([^`]+)`")


def setup(app) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True}


def process(_app, _what, _name, _object, _options, lines: list[str]) -> None:
    """Replace a docstring's lines, as autodoc asks for it."""
    lines[:] = as_lists(lines)


def as_lists(lines: list[str]) -> list[str]:
    """The lines with each section as a heading and a list; code stays, cross references become names."""
    found: list[str] = []
    for title, body in sections(lines):
        if title:
            found += ["", f".. rubric:: {title}", ""]
            found += entries(body) if title != "Notes" and title != "Examples" else body
        else:
            found += body
    return [literal(CROSS.sub(r"``\1``", line)) for line in found] + [""]


def literal(line: str) -> str:
    """Without what docutils would take for a substitution, or for a list where a name's initial begins a line."""
    parts = re.split(r"(``.*?``)", line)
    line = "".join(part if k % 2 else part.replace("|", "\\|") for k, part in enumerate(parts))
    return re.sub(r"^(\s*)([A-Z])\. ", r"\1\\\2. ", line)


def sections(lines: list[str]) -> Iterator[tuple[str, list[str]]]:
    """(title, lines) of each; the first has no title."""
    title, body = "", []
    for k, line in enumerate(lines):
        if k + 1 < len(lines) and RULE.fullmatch(lines[k + 1]) and re.fullmatch(r"\w[\w ]*", line):
            yield title, body
            title, body = line.strip(), []
        elif not (RULE.fullmatch(line) and k and re.fullmatch(r"\w[\w ]*", lines[k - 1])):
            body.append(line)
    yield title, body


def entries(body: list[str]) -> list[str]:
    """One item for each entry at the margin; what stands below it, or after its colon, is its text."""
    found: list[str] = []
    for line in body:
        entry = ENTRY.match(line)
        if entry and not line.startswith(" "):
            found += ["", f"- **{escaped(entry[1])}**" + (f" : {entry[2]}" if entry[2] else ""), ""]
        elif line.startswith(" ") or not line.strip():
            found.append("  " + line.strip() if line.strip() else "")
        else:  # of a section that is plain text, or of a line that goes on
            found.append(("  " if found else "") + line)
    return found


def escaped(names: str) -> str:
    """Without what would begin a link or emphasis."""
    return re.sub(r"([*_`])", r"\\\1", names)
