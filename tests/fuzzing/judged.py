"""One call of a program on spoiled inputs, in this process, and what must hold of it whatever the inputs are; and the
rule for written files: each is read again, and its check sees another number in it."""

import contextlib
import csv
import hashlib
import json
import math
import os
import re
import shutil
import signal
import sys
import time
import traceback
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import pairwise
from pathlib import Path

from stcal.cli.main import MESSAGE_CHARACTERS
from stcal.errors import ConvergenceError
from stcal.io import files as writing
from stcal.io.files import RUN_ENTRIES
from tests.commands import PROGRAMS, Call
from tests.outcome import PROGRESS
from tests.shared import own_copy, without_rights

LONGEST_S = 60.0
"""Of processor time; three times as much by the clock, as others may have the processor."""
MOST_BYTES = 2 << 30
LONGEST_PRINTED = 4 << 20
CODES = (0, 2, 3, 4)  # that a command ends with by itself
FAILED_CHECKS = 4  # of a run whose results are written, and not to be used
EARLIER = "of an earlier call\n"
IN, OUT = "in", "out"
_NO_POSE = "no pose accepted"
"""Said on standard output with exit code 3 by a command that has done its work."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a call ended: ``code`` None where it raised; ``trace`` of what it raised."""

    code: int | None
    out: str
    err: str
    seconds: float
    peak_bytes: int = 0
    trace: str = ""

    @property
    def said(self) -> str:
        return "\n".join([self.out, *lines_of(self.err)])


class TooLong(BaseException):
    """The call has had its time."""


def lines_of(err: str) -> list[str]:
    return [line for line in err.split("\n") if line and not PROGRESS.fullmatch(line)]


def lay_out(stock: Path, folder: Path, call: Call, earlier: bool) -> tuple[Path, Path]:
    """Copy the inputs of a call, and what an earlier call left where it writes; the two folders."""
    read, written = folder / IN, folder / OUT
    shutil.rmtree(folder, ignore_errors=True)
    for place, below in [*((p, read) for p in call.inputs), *((p, written) for p in call.folders)]:
        _copy(stock / place, below / place)
    for below in (read, written):
        below.mkdir(parents=True, exist_ok=True)
    for name in call.outputs if earlier else ():
        (written / name).write_text(EARLIER)
    return read, written


def _copy(source: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        own_copy(source, to, ignore=shutil.ignore_patterns("lock"))
    else:
        shutil.copyfile(source, to)


def hashes(folder: Path) -> dict[str, str]:
    """Of every file and link below a folder, by its place."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(root, name)
            if os.path.islink(path):
                found[path] = f"link to {os.readlink(path)}"
            elif os.path.isfile(path):
                found[path] = _hash(path)
    return found


def _hash(path: str) -> str:
    size = os.path.getsize(path)
    # With the effective rights: a plain user may not read what the superuser's process may.
    if size > 1 << 26 or not os.access(path, os.R_OK, effective_ids=True):  # or a file with a large hole
        return str(size)
    with open(path, "rb") as stream:
        return hashlib.blake2b(stream.read()).hexdigest()


def in_process(call: Call, program: str, folder: Path, more: tuple[str, ...] = (), plain: bool = False) -> Outcome:
    """Call a program here, its working directory ``folder``; standard streams are caught as files."""
    words = [*call.arguments(folder / IN, folder / OUT), *more]
    words = words[1:] if program == "stcal-sfm" else words
    before = os.getcwd()
    trace, code = "", None
    with _caught_streams() as streams, _own_settings(), without_rights(plain):
        sys.argv = [program, *words]
        os.chdir(folder)
        held = _forget_peak()
        start = time.monotonic()
        try:
            signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
            signal.setitimer(signal.ITIMER_REAL, 3 * LONGEST_S)
            PROGRAMS[program][1]()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        except TooLong:
            trace = "too long\n" + traceback.format_exc()
        except BaseException:
            trace = traceback.format_exc()
        finally:
            for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
                signal.setitimer(timer, 0)
            seconds = time.monotonic() - start
            os.chdir(before)
    return Outcome(code, *streams, seconds, max(_bytes("VmHWM:") - held, 0), trace)


@contextlib.contextmanager
def _caught_streams() -> Iterator[list[str]]:
    """What is written to standard output and error meanwhile, by libraries in C too; filled in at the end."""
    texts: list[str] = []
    kept, own = [os.dup(1), os.dup(2)], (sys.stdout, sys.stderr)
    files = [open(os.memfd_create(name), "r+b") for name in ("out", "err")]  # noqa: SIM115
    for number, file in enumerate(files, 1):
        os.dup2(file.fileno(), number)
    sys.stdout, sys.stderr = (
        TextIOWrapper(os.fdopen(os.dup(n), "wb", 0), encoding="utf-8", write_through=True) for n in (1, 2)
    )
    try:
        yield texts
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.close()
        sys.stdout, sys.stderr = own
        for number, (file, old) in enumerate(zip(files, kept, strict=True), 1):
            os.dup2(old, number)
            os.close(old)
            file.seek(0)
            texts.append(file.read(LONGEST_PRINTED + 1).decode(errors="replace"))
            file.close()


@contextlib.contextmanager
def _own_settings() -> Iterator[None]:
    """Signals, arguments and warnings as a new process has them, and afterwards as they were."""
    argv, numbers = sys.argv, (signal.SIGINT, signal.SIGTERM, signal.SIGALRM, signal.SIGPROF)
    handlers = [signal.getsignal(number) for number in numbers]
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, _end)
    try:
        with warnings.catch_warnings():
            warnings.resetwarnings()
            warnings.simplefilter("always")
            for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
                warnings.simplefilter("ignore", kind)
            yield
    finally:
        sys.argv = argv
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)


def _end(*_) -> None:
    raise TooLong


def _forget_peak() -> int:
    """Let the peak of memory begin at what is used now, which earlier tests may hold; returns that, bytes."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _bytes("VmRSS:")


def _bytes(what: str) -> int:
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(what):
                return int(line.split()[1]) * 1024
    return 0


def failures(
    call: Call, folder: Path, outcome: Outcome, before: dict[str, str], refused: bool
) -> list[tuple[str, str]]:
    """(kind, what) of everything that must not be; ``before`` : hashes of the folder before the call; ``refused`` : the
    inputs are such that the command must not end with 0."""
    found = list(_ending(outcome, refused))
    if outcome.peak_bytes > MOST_BYTES or "not enough memory" in outcome.err:
        found.append(("memory", f"{outcome.peak_bytes / 2**20:.0f} MB; {outcome.err[-100:]}"))
    after = hashes(folder)
    read = str(folder / IN) + os.sep
    own = ("/cache/", "/holder.txt")  # what a run keeps for itself, with its lock and who holds it
    changed = [
        p for p, old in before.items() if p.startswith(read) and not any(o in p for o in own) and after.get(p) != old
    ]
    if changed:
        found.append(("input changed", ", ".join(sorted(changed)[:3])))
    if outcome.code is not None:
        found += _printed(outcome)
        found += _left(call, folder / OUT, outcome.code, before, after)
    return found


def _ending(outcome: Outcome, refused: bool) -> Iterator[tuple[str, str]]:
    if outcome.trace.startswith("too long"):
        yield "hang", f"over {LONGEST_S:g} s\n{outcome.trace}"
    elif outcome.trace:
        yield "traceback", outcome.trace
    elif outcome.code not in CODES:
        yield "exit code", f"{outcome.code}, one of {CODES} needed"
    elif refused and outcome.code == 0:
        yield "exit code", "0, an error needed"
    if "Traceback (most recent call last)" in outcome.out + outcome.err:
        yield "traceback", outcome.err


def _printed(outcome: Outcome) -> Iterator[tuple[str, str]]:
    lines = lines_of(outcome.err)
    if outcome.code == 0 and (noise := [line for line in lines if not line.startswith("warning: ")]):
        yield "noise", noise[0][:300]
    done = outcome.code == 3 and not lines and _NO_POSE in outcome.out
    if outcome.code and not done and (len(lines) != 1 or not lines[0].startswith("error: ")):
        yield "not one line", f"{len(lines)}: " + " | ".join(line[:150] for line in lines[:4])
    if any(len(line) > MESSAGE_CHARACTERS for line in lines):
        yield "message too long", f"{max(map(len, lines))} characters: {max(lines, key=len)[:200]}"
    for name, text in (("standard output", outcome.out), ("standard error", outcome.err)):
        bad = next((c for c in text if not c.isprintable() and c not in "\n\t"), None)
        if bad:
            yield "not printable", f"{bad!r} on {name}: {text[max(0, text.index(bad) - 60) : text.index(bad) + 20]!r}"
        if len(text) > LONGEST_PRINTED:
            yield "message too long", f"over {LONGEST_PRINTED >> 20} MB on {name}"


def _left(call: Call, written: Path, code: int, before: dict, after: dict) -> Iterator[tuple[str, str]]:
    """Of what lies where the command writes."""
    for path in after:
        if path.endswith(".partial") and path not in before:
            yield "broken result", f"{path} is left behind"
    for name in call.outputs:
        path = written / name
        earlier = before.get(str(path))
        if earlier is not None and str(path) not in after:
            yield "earlier result lost", f"{name} is gone, exit code {code}"
        elif str(path) in after and after[str(path)] != earlier:
            if reason := broken(path):
                yield "broken result", f"{name}: {reason}, exit code {code}"
        elif code == 0:
            yield "broken result", f"{name} was not written, exit code 0"
    for place in call.folders if code not in (0, FAILED_CHECKS) else ():
        for path, old in before.items():
            own = any(Path(path).is_relative_to(written / place / entry) for entry in RUN_ENTRIES)
            if own and after.get(path) != old:
                yield "earlier run lost", f"{path} of the earlier run, exit code {code}"


BINARY = (".mat", ".bin")


def broken(path: Path) -> str:
    """Why a result file is none; empty where it is one."""
    try:
        if path.suffix == ".pdf":
            whole = path.read_bytes().rstrip().endswith(b"%%EOF")
            return "" if whole else "cut off"
        if path.suffix in BINARY:
            return "" if path.stat().st_size else "empty"
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".json":
            json.loads(text, parse_constant=_no_number)
        elif path.suffix == ".csv":
            rows = list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))
            if not rows or len({len(row) for row in rows}) > 1:
                return "rows of several lengths, or none"
        elif path.suffix in (".svg", ".urdf"):
            ElementTree.fromstring(text)
        elif path.suffix == ".html" and not text.rstrip().endswith("</html>"):
            return "no end"
    except (OSError, ValueError, ElementTree.ParseError) as error:
        return str(error)
    return "" if text else "empty"


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


TO_LOOK_AT = {".html", ".pdf", ".svg", ".png", ".jpg"}
"""Suffixes of pages, drawings and scenes, from which no number is taken."""
OF_A_RUN = {
    *("report.json", "labels.csv", "detections.csv", "colmap", "inputs"),
    *("overlays", ".stcal", "detections", "truth.json"),
}
"""Files of a run that later commands of the same program read; COLMAP's are read again by the stage that writes them,
and the faces are in ``faces.json``."""
OPTIONS_OF_FIGURES = ("--json", "--report", "--plot")
ELSEWHERE = {"sfm demo", "sfm draw", "sfm export-model", "sfm export-database"}
"""Commands that call others, that draw, and that write COLMAP's models and databases, which are compared by their own
code (E-EXPORT-READ-BACK, E-OUTPUT-READ-BACK)."""
NUMBER = re.compile(rb"(?<![\w.])-?\d+\.\d+(?:e[-+]?\d+)?(?![\w.])")


@contextmanager
def watched() -> Iterator[tuple[set[str], list[str]]]:
    """Collects meanwhile the names of files that are checked, and of those whose check does not see a change."""
    names: set[str] = set()
    seen: dict[str, bool] = {}
    blind: list[str] = []
    measure = writing._difference

    def difference(path, read, reported) -> float:
        found, content = measure(path, read, reported), Path(path).read_bytes()
        names.add(Path(path).name)
        changed = NUMBER.sub(_another, content)
        if changed != content:
            Path(path).write_bytes(changed)
            try:
                noticed = not measure(path, read, reported) <= max(1e-4, 100 * found)
            except ConvergenceError:
                noticed = True
            finally:
                Path(path).write_bytes(content)
            seen[Path(path).name] = seen.get(Path(path).name, False) or noticed
        return found

    writing._difference = difference
    try:
        yield names, blind
    finally:
        writing._difference = measure
        blind += [name for name, noticed in seen.items() if not noticed]


def _another(number: re.Match[bytes]) -> bytes:
    """Returns the text of a number that differs by a thousandth."""
    return repr(float(number[0]) * 1.001 if math.isfinite(float(number[0])) else 0.0).encode()


def unchecked(call: Call, folder: Path, names: set[str], before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Returns the files below ``folder`` that a call wrote and nobody read again."""
    if call.command in ELSEWHERE or call.code:
        return []
    words = call.split()
    figures = {word[1:] for option, word in pairwise(words) if option in OPTIONS_OF_FIGURES}
    changed = [Path(path).relative_to(folder) for path in after if after[path] != before.get(path)]
    return [
        str(path)
        for path in changed
        if path.name not in names | figures and path.suffix not in TO_LOOK_AT and not OF_A_RUN & set(path.parts)
    ]
