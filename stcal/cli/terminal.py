"""Output of the commands: printed results, the progress of long work, and files.

Results have only characters that a terminal prints and does not execute. Progress goes to standard error. One JSON file
may go to standard output.
"""

import json
import os
import re
import signal
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from stcal.errors import InputError, held
from stcal.io import files

if TYPE_CHECKING:
    from rich.progress import TaskID

LINE_EVERY_S = 2.0  # longest silence of a command at work, s
LEFT_FROM_S = 2.0  # shortest remaining time that a stage shows, s
STANDARD_OUTPUT = Path("-")  # name that means standard output instead of a JSON file
_taker: ContextVar[TextIO | None] = ContextVar("_taker", default=None)
"""Standard output while a file goes there."""
_quiet: ContextVar[bool] = ContextVar("_quiet", default=False)
_verbose: ContextVar[bool] = ContextVar("_verbose", default=False)
_beating: ContextVar["_Beat | None"] = ContextVar("_beating", default=None)


@contextmanager
def manner(quiet: bool, verbose: bool) -> Iterator[None]:
    """Sets the verbosity within the context: warnings and errors only, or more than usual."""
    beat = _Beat()
    if not quiet:
        beat.start()
    try:
        with held(_quiet, quiet), held(_verbose, verbose), held(_beating, beat):
            yield
    finally:
        beat.over.set()


def wait_for_others() -> None:
    """Notes that the command waits for others from now on: its silence is no work."""
    if beat := _beating.get():
        beat.over.set()


def verbose() -> bool:
    return _verbose.get()


class _Beat(threading.Thread):
    """Says what a command is at, and for how long, before ``LINE_EVERY_S`` pass in silence."""

    def __init__(self):
        super().__init__(daemon=True)
        self.over, self.stream, self.said = threading.Event(), sys.stderr, True
        self.stage, self.began = "working", time.perf_counter()

    def at(self, stage: str) -> None:
        if stage != self.stage:
            self.stage, self.began = stage, time.perf_counter()

    def run(self) -> None:
        if os.name == "posix":  # signals are for the main thread, which makes them wait while COLMAP's bindings load
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        while not self.over.wait(LINE_EVERY_S / 2):
            if not self.said:
                with suppress(ValueError, OSError):  # nobody reads the stream any more
                    print(f"{self.stage}: {time.perf_counter() - self.began:.0f} s", file=self.stream, flush=True)
            self.said = not self.said


class StageProgress:
    """Progress of a command's stages, called with (stage, done, total): a bar on a terminal, else lines, or quiet."""

    def __init__(self):
        self.bar, self.beat = None, _beating.get() or _Beat()
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
            self.beat.over.set()  # the bar has a clock
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
        self.beat.at(stage if done < total else "working")
        if done == total or (done and (now - self.last > LINE_EVERY_S or _verbose.get())):
            self.last = now
            suffix = time_left(now - began, done, total)
            if _verbose.get() and done == total:
                suffix = f" in {now - began:.1f} s"
            print(f"{stage}: {done} of {total}{suffix}", file=sys.stderr, flush=True)
            self.beat.said = True


def time_left(taken_s: float, done: int, total: int) -> str:
    """Returns the remaining time in words, extrapolated from the finished items; empty below ``LEFT_FROM_S``."""
    remaining_s = taken_s / done * (total - done) if done else 0.0
    if remaining_s < LEFT_FROM_S:
        return ""
    return f", about {remaining_s:.0f} s left" if remaining_s < 100 else f", about {remaining_s / 60:.0f} min left"


def printable(text: str) -> str:
    """Returns the text with white space as a space, and other unprintable characters as question marks."""

    def shown(c: str) -> str:
        return c if c.isprintable() or c == "\n" or unicodedata.category(c) == "Zs" else " " if c.isspace() else "?"

    return "".join(map(shown, text))


def say(*values: object, sep: str = " ", end: str = "\n") -> None:
    """Prints the values, unless the command is quiet. Names from files may contain any characters."""
    if _quiet.get():
        return
    print(printable(sep.join(map(str, values))) + end, end="")  # at once: threads may say something too


@contextmanager
def said_apart() -> Iterator[None]:
    """Reserves standard output for a file. All other output goes to standard error within the context."""
    with held(_taker, sys.stdout), redirect_stdout(sys.stderr):
        yield


@contextmanager
def printed_last() -> Iterator[None]:
    """Holds back what is printed while files are written: ``head`` ends a command as soon as it has its lines."""
    held = StringIO()
    try:
        with redirect_stdout(held):
            yield
    finally:
        sys.stdout.write(held.getvalue())


def write(path: Path, content, said: str = "written") -> None:
    """Saves text, bytes, or a dict or result file as JSON, and prints the path; ``-`` is standard output."""
    if path == STANDARD_OUTPUT and _taker.get() is not None:
        write_out(files.json_text(content))
        return
    files.save(path, content if isinstance(content, str | bytes) else files.json_text(content))
    if not isinstance(content, str | bytes | dict):
        from stcal.io.json import require_result_written

        require_result_written(path, content)
    say(f"{said}: {path}")


def write_out(text: str) -> None:
    """Writes JSON to standard output, which is reserved for it, with ``\\u....`` for characters that a terminal would
    execute, or that its encoding lacks."""
    taker = _taker.get() or sys.stdout
    if getattr(taker, "name", "") == os.devnull:  # see ``entry.py``
        raise InputError("E-OUTPUT-UNWRITABLE", "--json -: standard output is closed; give the name of a file")
    is_utf8 = (taker.encoding or "ascii").lower().replace("-", "") == "utf8"

    def escaped(c: re.Match) -> str:
        return c[0] if is_utf8 and c[0].isprintable() else json.dumps(c[0])[1:-1]

    taker.write(re.sub(r"[^ -~\n]", escaped, text))
    taker.flush()


def write_if(path: Path | None, content: Callable[[], object], said: str = "written") -> None:
    """Writes the result of ``content`` if a path is given; otherwise ``content`` is not called."""
    if path:
        write(path, content(), said)


def warn(line: object) -> None:
    """Writes a warning to standard error, also if the command is quiet."""
    sys.stderr.write(f"{printable(f'warning: {line}')}\n")


def warn_if_quiet(verdict: str) -> None:
    """Writes the sentence of a verdict that is not good to standard error if the command is quiet, which hid it."""
    if _quiet.get():
        warn(verdict)


def print_each(said: str, lines: Iterable[object]) -> None:
    """Prints each item on a line of its own, after the word ``said``; a warning also if the command is quiet."""
    for line in lines:
        if said.startswith("warning"):
            warn_if_quiet(f"{said}: {line}".removeprefix("warning: "))
        say(f"{said}: {line}")
