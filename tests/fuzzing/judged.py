"""One call of a program in a process of its own, and what must hold of it whatever the inputs are."""

import contextlib
import csv
import faulthandler
import hashlib
import importlib
import json
import multiprocessing
import os
import pkgutil
import resource
import shutil
import signal
import sys
import time
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import stcal
from stcal.cli.main import MESSAGE_CHARACTERS
from stcal.errors import NO_MEMORY
from stcal.io.files import RUN_ENTRIES
from tests.commands import PROGRAMS, Call
from tests.outcome import PROGRESS
from tests.shared import own_copy, without_rights

LONGEST_S = 60
"""Of processor time; three times as much by the clock, as others may have the processor."""
MOST_BYTES = 2 << 30
"""Of memory, beside what this process has; a program then says that there is not enough."""
LONGEST_PRINTED = 4 << 20
CODES = (0, 2, 3, 4)  # that a command ends with by itself
FAILED_CHECKS = 4  # of a run whose results are written, and not to be used
EARLIER = "of an earlier call\n"
IN, OUT = "in", "out"
_NO_POSE = "no pose accepted"
"""Said on standard output with exit code 3 by a command that has done its work."""
ENDS = {".html": b"</html>", ".pdf": b"%%EOF"}
FORK = multiprocessing.get_context("fork")
Failures = list[tuple[str, str]]
"""(kind, what) of what must not be."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a call ended: ``code`` is negative where a signal ended it; ``seconds`` by the clock."""

    code: int
    out: str
    err: str
    seconds: float = 0.0

    @property
    def lines(self) -> list[str]:
        """Of standard error, but for progress."""
        return [line for line in self.err.split("\n") if line and not PROGRESS.fullmatch(line)]

    @property
    def said(self) -> str:
        return "\n".join([self.out, *self.lines])


def lay_out(stock: Path, folder: Path, call: Call, earlier: bool) -> tuple[Path, Path]:
    """Copy the inputs of a call, and what an earlier call left where it writes; the two folders."""
    read, written = folder / IN, folder / OUT
    shutil.rmtree(folder, ignore_errors=True)
    for place, below in [*((p, read) for p in call.inputs), *((p, written) for p in call.folders)]:
        (below / place).parent.mkdir(parents=True, exist_ok=True)
        own_copy(stock / place, below / place, ignore=shutil.ignore_patterns("lock"))
    for below in (read, written):
        below.mkdir(parents=True, exist_ok=True)
    for name in call.outputs if earlier else ():
        (written / name).write_text(EARLIER)
    return read, written


def hashes(folder: Path) -> dict[str, str]:
    """Of every file and link below a folder, by its place."""
    found = {}
    for path in map(str, folder.rglob("*")):
        if os.path.islink(path):
            found[path] = f"link to {os.readlink(path)}"
        elif os.path.isfile(path):
            size = os.path.getsize(path)
            # With the effective rights: a plain user may not read what the superuser's process may.
            large = size > 1 << 26 or not os.access(path, os.R_OK, effective_ids=True)  # or a file with a large hole
            found[path] = str(size) if large else hashlib.blake2b(Path(path).read_bytes()).hexdigest()
    return found


class Program:
    """``perform`` in a process and session of its own, with limits of time and memory, its streams caught."""

    def __init__(self, perform: Callable[[], object], folder: Path):
        load()
        self.start = time.monotonic()
        pipes = [os.pipe() for _ in range(2)]
        self.process = FORK.Process(target=_perform, args=(perform, folder, [end for _, end in pipes]))
        self.process.start()
        for _, end in pipes:
            os.close(end)
        self._streams = [open(end, "rb") for end, _ in pipes]  # noqa: SIM115

    def ends_within(self, seconds: float) -> bool:
        """Waits for its end; ``Process.join`` takes the start of another program for it."""
        last = time.monotonic() + seconds
        while self.process.exitcode is None and time.monotonic() < last:
            time.sleep(0.01)
        return self.process.exitcode is not None

    def session(self) -> list[int]:
        """Processes that go on in its session."""
        found = []
        for place in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                state, _, _, session = place.read_text().rpartition(")")[2].split()[:4]
                if int(session) == self.process.pid and state != "Z":
                    found.append(int(place.parent.name))
        return found

    def outcome(self) -> Outcome:
        with ThreadPoolExecutor(2) as threads:
            texts = [threads.submit(stream.read) for stream in self._streams]
            if not self.ends_within(3 * LONGEST_S):
                os.kill(self.process.pid, signal.SIGXCPU)
            seconds = time.monotonic() - self.start
            # What it started may go on with its streams.
            if wait(texts, 10).not_done or not self.ends_within(0):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.join()
        for stream in self._streams:
            stream.close()
        return Outcome(self.process.exitcode, *(t.result().decode(errors="replace") for t in texts), seconds)


def _perform(perform: Callable[[], object], folder: Path, streams: list[int]) -> None:
    """Runs in the new process."""
    os.setsid()
    os.chdir(folder)
    for number, stream in enumerate(streams, 1):
        os.dup2(stream, number)
    sys.stdout, sys.stderr = (open(n, "w", 1, "utf-8", closefd=False) for n in (1, 2))  # noqa: SIM115
    held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_DATA, (held + MOST_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S + 5))
    faulthandler.enable()
    faulthandler.register(signal.SIGXCPU, chain=True)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    warnings.resetwarnings()
    warnings.simplefilter("always")
    for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", kind)
    perform()


@cache
def load() -> None:
    """Imports all of the package, so that the process of a call need not."""
    for module in pkgutil.walk_packages(stcal.__path__, "stcal."):
        if not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError):
                importlib.import_module(module.name)


def called(
    call: Call,
    folder: Path,
    program: str = "stcal",
    more: tuple[str, ...] = (),
    plain: bool = False,
    around: Callable[[], AbstractContextManager] = nullcontext,
) -> Outcome:
    """Call a program whose libraries are loaded; ``plain`` : without the superuser's rights."""
    words = [*call.arguments(folder / IN, folder / OUT), *more]

    def perform() -> None:
        sys.argv = [program, *(words[1:] if program == "stcal-sfm" else words)]
        with without_rights(plain), around():
            PROGRAMS[program][1]()

    return Program(perform, folder).outcome()


def started(call: Call, folder: Path, limits: Sequence[tuple[int, int]] = (), closed: Sequence[int] = ()) -> Program:
    """Start a program from its beginning. ``limits`` : resources and how much of each; ``closed`` : streams."""
    words = ["-P", "-c", "from stcal.cli.entry import main; main()", *call.arguments(folder / IN, folder / OUT)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2]), "PYTHONWARNINGS": ""}

    def perform() -> None:
        for what, most in limits:
            resource.setrlimit(what, (most, most))
        for number in closed:
            os.close(number)
        os.execve(sys.executable, [sys.executable, *words], environment)

    return Program(perform, folder)


def failures(call: Call, folder: Path, outcome: Outcome, before: dict[str, str], refused: bool = False) -> Failures:
    """Everything that must not be; ``before`` : hashes of the folder before the call; ``refused`` : the inputs are such
    that the command must not end with 0."""
    after = hashes(folder)
    changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    # A run keeps its cache, and who holds its lock, where it is read.
    inputs = sorted(p for p in changed & before.keys() if f"/{IN}/" in p and "/cache/" not in p and "holder" not in p)
    found = [("input changed", ", ".join(inputs[:3]))] if inputs else []
    if outcome.code == -signal.SIGXCPU:
        return [*found, ("hang", f"over {LONGEST_S:g} s\n{outcome.err[:500]}")]
    if "Traceback (most recent call last)" in outcome.said:
        return [*found, ("traceback", outcome.err)]
    if NO_MEMORY in outcome.err:
        found.append(("memory", outcome.err[-100:]))
    if outcome.code not in CODES or (refused and outcome.code == 0):
        found.append(("exit code", f"{outcome.code}, {'an error' if refused else f'one of {CODES}'} needed"))
    written = folder / OUT
    for name in call.outputs:
        path = str(written / name)
        if path in before and path not in after:
            found.append(("earlier result lost", f"{name} is gone, exit code {outcome.code}"))
        elif outcome.code == 0 and path not in changed:
            found.append(("broken result", f"{name} was not written, exit code 0"))
    for path in map(Path, sorted(changed & after.keys())):
        if f"/{OUT}/" in str(path) and ".stcal" not in path.parts and (reason := broken(path)):
            found.append(("left behind" if path.suffix == ".partial" else "broken result", f"{path}: {reason}"))
    if outcome.code not in (0, FAILED_CHECKS):
        runs = [written / place / entry for place in call.folders for entry in RUN_ENTRIES]
        lost = sorted(p for p in changed & before.keys() if any(Path(p).is_relative_to(run) for run in runs))
        found += [("earlier run lost", f"{path}, exit code {outcome.code}") for path in lost]
    return [*found, *_printed(outcome)]


def _printed(outcome: Outcome) -> Iterator[tuple[str, str]]:
    lines = outcome.lines
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


def broken(path: Path) -> str:
    """Why a result file is none; empty where it is one."""
    data = b"" if path.is_dir() else path.read_bytes()
    try:
        if path.suffix == ".json":
            json.loads(data, parse_constant=_no_number)
        elif path.suffix == ".csv":
            rows = csv.reader(line for line in data.decode().splitlines() if not line.startswith("#"))
            if len({len(row) for row in rows}) != 1:
                return "rows of several lengths, or none"
        elif path.suffix in (".svg", ".urdf"):
            ElementTree.fromstring(data)
        elif path.suffix in ENDS and not data.rstrip().endswith(ENDS[path.suffix]):
            return "no end"
    except (ValueError, ElementTree.ParseError) as error:
        return str(error)
    return "" if data and path.suffix != ".partial" else "empty or left behind"


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is not JSON")
