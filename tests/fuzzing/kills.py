"""Programs that are ended, or whose disk or memory is full, at a random moment: what they leave behind."""

import contextlib
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.sfm.runs.transaction import verify
from tests.commands import CALLS, Call
from tests.fuzzing.cases import Judged
from tests.fuzzing.judged import CODES, IN, LONGEST_S, OUT, Outcome, broken, failures, hashes, lay_out, lines_of
from tests.fuzzing.mutations import pick

ENDED = {signal.SIGKILL: (-9, 2.0), signal.SIGINT: (130, 2.0), signal.SIGTERM: (143, 2.0)}
"""Exit code, and within which time, s."""
STARTING_S = 0.3
"""Until then Python itself may be loading, and no program answers a signal yet."""
LOADED_S = 1.0
"""Time that Python and the libraries take before any work."""
LARGEST_FILE = (100, 300_000)
MEMORY = (500 << 20, 900 << 20)
STREAM = 10_000_000
"""Keeps the random numbers of kills from those of cases."""
_SEEN_BELOW = ("not one line", "broken result", "earlier run lost")
"""Of an ended program: its line is judged where it ends, and new results that are complete are as good as the earlier
ones."""
PROGRAM = (sys.executable, "-P", "-c", "from stcal.cli.entry import main; main()")


def killed(stock: Path, folder: Path, seed: int, number: int) -> Judged:
    """Case ``number`` of this seed. One that ends late is tried again: other cases run beside it."""
    judged = _killed(stock, folder, seed, number)
    return _killed(stock, folder, seed, number) if "hang" in dict(judged.failures) else judged


def _killed(stock: Path, folder: Path, seed: int, number: int) -> Judged:
    rng = np.random.default_rng([seed, STREAM + number])
    calls = [call for call in CALLS if re.search(r"(^| )[>+~]", call.words) and call.seconds < 20 and not call.code]
    call = pick(rng, calls)
    two = replace(call, words=call.words.replace("--workers 1", "--workers 2"))
    lay_out(stock, folder, call, earlier=True)
    before = hashes(folder)
    kind = pick(rng, [*ENDED, "full disk", "little memory", "file limit falls"])
    if isinstance(kind, signal.Signals):
        moment = float(rng.uniform(0, LOADED_S + 1.5 * call.seconds))
        said = f"{kind.name} after {moment:.2f} s"
        outcome, found = _ended(two, folder, kind, moment)
    else:
        limit = int(np.exp(rng.uniform(*np.log(MEMORY if kind == "little memory" else LARGEST_FILE))))
        said, found = f"{kind}, {limit} bytes", []
        if kind in ("full disk", "little memory"):
            what = resource.RLIMIT_FSIZE if kind == "full disk" else resource.RLIMIT_AS
            start = time.monotonic()
            outcome = outcome_of(start_program(call, folder, [(what, limit)]), start)
        else:
            moment = float(rng.uniform(0, LOADED_S + 1.5 * call.seconds))
            said += f" after {moment:.2f} s"
            outcome = _short_of_room(two, folder, limit, moment)
    after = [f for f in failures(call, folder, outcome, before, refused=False) if f[0] not in ("exit code", "noise")]
    found += [] if kind in ENDED else [("exit code", str(outcome.code))] * (outcome.code not in CODES)
    found += [f for f in after if f[0] != "memory" and not (kind in ENDED and f[0] in _SEEN_BELOW)]
    found += _whole(folder / OUT, kind is signal.SIGKILL)
    # A run's folder holds the earlier results or the new ones, by its own hashes.
    found += [("earlier result lost", note) for place in call.folders for note in verify(folder / OUT / place).notes()]
    return Judged.of(f"k{number}", f"{call.command}: {said}", found, outcome, call)


def start_program(
    call: Call, folder: Path, limits: Sequence[tuple[int, int]] = (), closed: Sequence[int] = ()
) -> subprocess.Popen:
    """Start a program for a call. ``limits`` : resources and how much of each; ``closed`` : numbers of its streams."""

    def limited() -> None:
        for what, most in limits:
            resource.setrlimit(what, (most, most))
        for number in closed:
            os.close(number)

    words = [*PROGRAM, *call.arguments(folder / IN, folder / OUT)]
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"PYTHONPATH": root, "PYTHONWARNINGS": ""}
    return subprocess.Popen(
        words, stdout=-1, stderr=-1, cwd=folder, start_new_session=True, preexec_fn=limited, env=environment
    )


def outcome_of(process: subprocess.Popen, start: float) -> Outcome:
    try:
        out, err = process.communicate(timeout=3 * LONGEST_S)
        trace = ""
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        trace = "too long"
    seconds = time.monotonic() - start
    return Outcome(process.returncode, *(t.decode(errors="replace") for t in (out, err)), seconds, trace=trace)


def _short_of_room(call: Call, folder: Path, limit: int, moment: float) -> Outcome:
    """The outcome of a call whose files may not grow beyond ``limit`` from a moment on."""
    process, start = start_program(call, folder), time.monotonic()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(moment)
    for each in [*_of_session(process.pid), *([process.pid] if process.returncode is None else [])]:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(each, resource.RLIMIT_FSIZE, (limit, limit))
    return outcome_of(process, start)


def _ended(call: Call, folder: Path, number: signal.Signals, moment: float) -> tuple[Outcome, list[tuple[str, str]]]:
    process, found = start_program(call, folder), []
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(moment)
    done = process.returncode is not None
    start = time.monotonic()
    process.send_signal(number)
    outcome = outcome_of(process, start)
    code, within = ENDED[number]
    if done or outcome.code in CODES or (moment < STARTING_S and outcome.code == -number):
        return outcome, found
    if outcome.code != code:
        found.append(("exit code", f"{outcome.code}, {code} needed: {outcome.err[-300:]}"))
    if outcome.seconds > within:
        found.append(("hang", f"ended {outcome.seconds:.1f} s after {number.name}"))
    lines = lines_of(outcome.err)
    if number is not signal.SIGKILL and (len(lines) != 1 or not lines[0].startswith(("interrupted", "terminated"))):
        found.append(("not one line", f"{len(lines)}: " + " | ".join(line[:150] for line in lines[:4])))
    time.sleep(0.5)
    if left := _of_session(process.pid):
        found.append(("orphan", f"{len(left)} processes go on"))
    return outcome, found


def _of_session(leader: int) -> list[int]:
    """Processes of the session that the program was started in."""
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, session = place.read_text().rpartition(")")[2].split()[:4]
            if int(session) == leader and state != "Z":
                found.append(int(place.parent.name))
    return found


def _whole(written: Path, by_force: bool) -> list[tuple[str, str]]:
    """Every result that stands under its name is complete; what is left of a killed write has another name."""
    found = []
    for path in sorted(written.rglob("*")):
        inside = {".stcal"} & set(path.relative_to(written).parts)
        if path.is_file() and not inside and not path.name.endswith(".partial") and path.read_bytes() != b"":
            reason = broken(path) if path.suffix in (".json", ".csv", ".html", ".svg", ".urdf") else ""
            if reason and path.read_text(errors="replace") != "of an earlier call\n":
                found.append(("broken result", f"{path.relative_to(written)}: {reason}"))
        elif path.is_file() and not inside and not by_force and path.name.endswith(".partial"):
            found.append(("broken result", f"{path.relative_to(written)} is left behind"))
    return found
