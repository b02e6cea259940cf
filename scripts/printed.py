"""Figures of the documents beside what the scripts print that they come from.

.venv/bin/python scripts/printed.py [NAME …]

A table of figures in README.md or docs/ has a comment directly above it, ``<!-- printed by: COMMAND -->``; COMMAND is a
script with its arguments. ``docs/printed/NAME.txt`` holds what it printed, after a line with the command and the commit
that it ran at; a document may show some of the rows. With names the commands of these are run and stored anew; without,
the documents are compared with what is stored, and what differs is printed. ``tests/test_documents.py`` does the same,
and runs the quick ones.
"""

import re
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from scripts.runner import ROOT

PRINTED = ROOT / "docs" / "printed"
_PAGES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md"))
DOCUMENTS = ("README.md", *(page for page in _PAGES if not page.startswith("docs/reference/")))
"""All but docs/reference, which holds formats and options."""
MARK = re.compile(r"<!-- printed by: (.+?) -->")
FIRST = re.compile(r"# (.+), at commit ([0-9a-f]{7,40})(, .+)?")
FIGURE = re.compile(r"[-+±]?\d+(?:\.\d+)?")
DECIMAL = re.compile(r"\d\.\d")
TEMPORARY = re.compile(re.escape(tempfile.gettempdir()) + r"/[^/\s]+")
"""A folder made for one run; … where it was printed."""
LEAST_DECIMALS = 5
"""In a block without a language, so that it is one of figures; examples of commands have fewer."""
LEAST_CELLS = 4
"""Cells of a table that begin with a number."""


@dataclass(frozen=True, slots=True)
class Block:
    """A table or block of figures.

    ``document``, ``line`` : where it begins, from 1; ``rows`` : its lines as cells or words; ``command`` : that printed
    it, None without a comment.
    """

    document: str
    line: int
    rows: tuple[tuple[str, ...], ...]
    command: str | None

    @property
    def name(self) -> str:
        """What names it in lists: the document and the words of its first row."""
        return f"{self.document}: {' '.join(' '.join(self.rows[0]).split())}"[:80].strip()


def cells_of(line: str) -> tuple[str, ...]:
    """Cells of a table's row, or words."""
    if line.lstrip().startswith("|"):
        return tuple(cell.strip() for cell in line.strip().strip("|").split("|"))
    return tuple(line.split())


def is_rule(line: str) -> bool:
    """Between a table's head and its rows."""
    return bool(re.fullmatch(r"\|(?:\s*:?-+:?\s*\|)+", line.strip()))


def blocks(document: str, text: str) -> list[Block]:
    """The tables and blocks of figures of a document."""
    lines, found, i = text.splitlines(), [], 0
    while i < len(lines):
        fenced = lines[i].startswith("```")
        if not fenced and not lines[i].startswith("|"):
            i += 1
            continue
        begin, end = i, i + 1
        while end < len(lines) and (not lines[end].startswith("```") if fenced else lines[end].startswith("|")):
            end += 1
        body = lines[begin + 1 : end] if fenced else lines[begin:end]
        rows = tuple(cells_of(line) for line in body if line.strip() and not is_rule(line))
        mark = MARK.fullmatch(lines[begin - 1].strip()) if begin else None
        if mark or _is_of_figures(lines[begin], body, rows):
            found.append(Block(document, begin + 1, rows, mark and mark[1]))
        i = end + fenced
    return found


def _is_of_figures(first: str, body: list[str], rows: tuple[tuple[str, ...], ...]) -> bool:
    if first.startswith("|"):
        numbers = [cell for row in rows[1:] for cell in row[1:] if re.match(r"[-+±]?\d", cell)]
        return len(numbers) >= LEAST_CELLS
    return first.strip() == "```" and len(DECIMAL.findall("\n".join(body))) >= LEAST_DECIMALS


def of_documents() -> list[Block]:
    """Of all documents."""
    texts = ((name, (ROOT / name).read_text(encoding="utf-8")) for name in DOCUMENTS)
    return [block for name, text in texts for block in blocks(name, text)]


def name_of(command: str) -> str:
    """Of the file that holds what a command printed: the script's, and its arguments."""
    script, *arguments = shlex.split(command)
    return "_".join([Path(script).stem, *(re.sub(r"[^\w.]+", "", Path(each).name) for each in arguments)])


def stored(command: str) -> tuple[str, list[str]]:
    """The first line of the file, and what was printed.

    Raises
    ------
    ValueError
        The first line is not that of this command.
    """
    first, *lines = (PRINTED / f"{name_of(command)}.txt").read_text(encoding="utf-8").splitlines()
    found = FIRST.fullmatch(first)
    if not found or found[1] != command:
        raise ValueError(f"{name_of(command)}.txt begins with {first!r}; '# {command}, at commit …' needed")
    return first, lines


def first_missing(block: Block, lines: list[str]) -> str | None:
    """Returns the first row that what was printed does not have after the rows above it, cell by cell; None if it has
    all of them in this order. A document may leave out rows."""
    printed = (cells_of(line) for line in lines)
    return next((" | ".join(row) for row in block.rows if row not in printed), None)


def differing_figures(before: list[str], after: list[str], digits: float = 1.0) -> list[str]:
    """Lines of two runs whose words differ, or whose numbers by more than ``digits`` of the last digit shown."""
    if len(before) != len(after):
        return [f"{len(before)} and {len(after)} lines"]
    return [f"{a!r}: {b!r}" for a, b in zip(before, after, strict=True) if not _alike(a, b, digits)]


def _alike(one: str, two: str, digits: float) -> bool:
    if FIGURE.sub("#", one).split() != FIGURE.sub("#", two).split():
        return False
    for a, b in zip(FIGURE.findall(one), FIGURE.findall(two), strict=True):
        step = 10.0 ** -len(a.partition(".")[2])
        if abs(float(a.lstrip("±")) - float(b.lstrip("±"))) > digits * step * (1 + 1e-9):
            return False
    return True


def run(command: str) -> list[str]:
    """What the command prints now."""
    script, *arguments = shlex.split(command)
    words = [*([sys.executable] if script.endswith(".py") else []), str(ROOT / script), *arguments]
    printed = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return TEMPORARY.sub("…", printed).splitlines()


def main() -> None:
    commands = {name_of(block.command): block.command for block in of_documents() if block.command}
    for name in sys.argv[1:]:
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT)
        lines = [f"# {commands[name]}, at commit {commit.stdout.strip()}", *run(commands[name])]
        (PRINTED / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for block in of_documents():
        if block.command:
            missing = first_missing(block, stored(block.command)[1])
            print(f"{block.document}:{block.line}: {'as stored' if missing is None else f'not stored: {missing}'}")
        else:
            print(f"{block.document}:{block.line}: no command: {block.name}")


if __name__ == "__main__":
    main()
