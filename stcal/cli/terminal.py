"""What commands say: results, in characters that a terminal prints and does not obey; progress of long work, on
standard error; and the files they write, one of them to standard output where it is asked for there."""

import json
import os
import re
import sys
import time
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from stcal.io import files

if TYPE_CHECKING:
    from rich.progress import TaskID

LINE_EVERY_S = 5.0
LEFT_FROM_S = 2.0
"""Shortest remaining time that a stage shows, s."""
STANDARD_OUTPUT = Path("-")
"""Name that stands for standard output in place of a JSON file."""
_taker: ContextVar[TextIO | None] = ContextVar("_taker", default=None)
"""Standard output while a file goes there."""

_quiet: ContextVar[bool] = ContextVar("_quiet", default=False)
_verbose: ContextVar[bool] = ContextVar("_verbose", default=False)
RED, YELLOW, GREEN = 31, 33, 32
"""Colour codes of ECMA-48."""
COLOURS = {
    "failed": RED,
    "do not use": RED,
    "suspicious": YELLOW,
    "use with care": YELLOW,
    "warning": YELLOW,
    "passed": GREEN,
    "good": GREEN,
}
"""Colour of each verdict's word."""
VERDICTS = re.compile(
    r"(?m)(?P<before>^ *|^(?:verdict|split-half check): |(?<=checks: )\d+ |(?<=, )\d+ )"
    rf"(?P<word>{'|'.join(COLOURS)})(?=[:;,]| *$)"
)
"""Where such a word is one: before what it judges, after `verdict`, and in the counts of checks."""


@contextmanager
def manner(quiet: bool, verbose: bool) -> Iterator[None]:
    """What a command says meanwhile: nothing but warnings and errors, or more than usual."""
    tokens = _quiet.set(quiet), _verbose.set(verbose)
    try:
        yield
    finally:
        _quiet.reset(tokens[0])
        _verbose.reset(tokens[1])


def verbose() -> bool:
    """Whether more than usual is to be said."""
    return _verbose.get()


class StageProgress:
    """A callable (stage, done, total): a bar on a terminal, plain lines otherwise, with the time left; nothing where
    the command is quiet. Use as a context manager."""

    def __init__(self):
        self.bar = None
        self.tasks: dict[str, TaskID] = {}
        self.last = 0.0
        self.began: dict[str, float] = {}
        if sys.stderr.isatty() and not _quiet.get():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
            from rich.progress import TimeRemainingColumn as TimeLeftColumn

            columns = (TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self.bar = Progress(*columns, TextColumn("left"), TimeLeftColumn(), console=Console(stderr=True))

    def __enter__(self) -> "StageProgress":
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, *_) -> None:
        if self.bar:
            self.bar.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if _quiet.get():
            return
        if self.bar:
            if stage not in self.tasks:
                self.tasks[stage] = self.bar.add_task(stage, total=total)
            self.bar.update(self.tasks[stage], completed=done, total=total)
            return
        now = time.monotonic()
        began = self.began.setdefault(stage, now)
        if done == total or (done and (now - self.last > LINE_EVERY_S or _verbose.get())):
            self.last = now
            more = time_left(now - began, done, total)
            if _verbose.get() and done == total:
                more = f" in {now - began:.1f} s"
            print(f"{stage}: {done} of {total}{more}", file=sys.stderr, flush=True)


def time_left(taken_s: float, done: int, total: int) -> str:
    """Remaining time in words, extrapolated from the items that are done; empty below ``LEFT_FROM_S``."""
    left = taken_s / done * (total - done) if done else 0.0
    if left < LEFT_FROM_S:
        return ""
    return f", about {left:.0f} s left" if left < 100 else f", about {left / 60:.0f} min left"


def printable(text: str) -> str:
    """Text without what a terminal would obey: a space stands for white space other than a line's end, a question mark
    for each character that is not printed."""
    return "".join(c if c.isprintable() or c == "\n" else _instead(c) for c in text)


def _instead(character: str) -> str:
    if unicodedata.category(character) == "Zs":
        return character
    return " " if character.isspace() else "?"


def say(*values: object, sep: str = " ", end: str = "\n") -> None:
    """Print, unless the command is quiet; names that come from files may hold any characters."""
    if not _quiet.get():
        print(_coloured(printable(sep.join(map(str, values)))), end=end)


def _coloured(text: str) -> str:
    """Colour the words of verdicts if standard output is a terminal and `NO_COLOR` (no-color.org) is not set."""
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return VERDICTS.sub(lambda found: f"{found['before']}\x1b[{COLOURS[found['word']]}m{found['word']}\x1b[0m", text)


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
        taker.write(_escaped(files.json_text(content), taker.encoding or "ascii"))
        taker.flush()
        return
    files.save(path, content if isinstance(content, str | bytes) else files.json_text(content))
    say(f"{said}: {path}")


def _escaped(text: str, encoding: str) -> str:
    """JSON whose strings have ``\\u....`` in place of what a terminal would obey, or what the encoding has not."""
    whole = encoding.lower().replace("-", "") == "utf8"
    return re.sub(r"[^ -~\n]", lambda c: c[0] if whole and c[0].isprintable() else json.dumps(c[0])[1:-1], text)


def print_each(said: str, lines: Iterable[object]) -> None:
    """Each on a line of its own, after the word."""
    for line in lines:
        if _quiet.get() and said.startswith("warning"):
            sys.stderr.write(f"{printable(f'{said}: {line}')}\n")
        say(f"{said}: {line}")
