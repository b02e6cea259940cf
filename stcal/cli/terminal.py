"""What commands say: results, in characters that a terminal prints and does not obey; progress of long work, on
standard error; and the files they write, one of them to standard output where it is asked for there."""

import json
import re
import sys
import time
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from stcal.io import saving

if TYPE_CHECKING:
    from rich.progress import TaskID

LINE_EVERY_S = 5.0
STANDARD_OUTPUT = Path("-")
"""In place of a JSON file's name."""
_taker: ContextVar[TextIO | None] = ContextVar("_taker", default=None)
"""Standard output while a file goes there."""


class StageProgress:
    """A callable (stage, done, total): a bar on a terminal, plain lines otherwise; use as a context manager."""

    def __init__(self):
        self.bar = None
        self.tasks: dict[str, TaskID] = {}
        self.last = 0.0
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self.bar = Progress(*columns, console=Console(stderr=True))

    def __enter__(self) -> "StageProgress":
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, *_) -> None:
        if self.bar:
            self.bar.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if self.bar:
            if stage not in self.tasks:
                self.tasks[stage] = self.bar.add_task(stage, total=total)
            self.bar.update(self.tasks[stage], completed=done, total=total)
            return
        now = time.monotonic()
        if done == total or (done and now - self.last > LINE_EVERY_S):
            self.last = now
            print(f"{stage}: {done} of {total}", file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """Text without what a terminal would obey: a space stands for white space other than a line's end, a question mark
    for each character that is not printed."""
    return "".join(c if c.isprintable() or c == "\n" else _instead(c) for c in text)


def _instead(character: str) -> str:
    if unicodedata.category(character) == "Zs":
        return character
    return " " if character.isspace() else "?"


def say(*values: object, sep: str = " ", end: str = "\n") -> None:
    """Print; names that come from files may hold any characters."""
    print(printable(sep.join(map(str, values))), end=end)


@contextmanager
def said_apart() -> Iterator[None]:
    """Keep standard output for the file that goes there; all that is said goes to standard error meanwhile."""
    token = _taker.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _taker.reset(token)


def write(path: Path, content, said: str = "written") -> None:
    """Save text, bytes, or a dict or result file as JSON, and say so; or give JSON to standard output, ``-``."""
    if path == STANDARD_OUTPUT and (taker := _taker.get()) is not None:
        taker.write(_escaped(saving.json_text(content), taker.encoding or "ascii"))
        taker.flush()
        return
    saving.save(path, content if isinstance(content, str | bytes) else saving.json_text(content))
    say(f"{said}: {path}")


def _escaped(text: str, encoding: str) -> str:
    """JSON whose strings have ``\\u....`` in place of what a terminal would obey, or what the encoding has not."""
    whole = encoding.lower().replace("-", "") == "utf8"
    return re.sub(r"[^ -~\n]", lambda c: c[0] if whole and c[0].isprintable() else json.dumps(c[0])[1:-1], text)


def print_each(said: str, lines: Iterable[object]) -> None:
    """Each on a line of its own, after the word."""
    for line in lines:
        say(f"{said}: {line}")
