"""Programs that are ended, or whose disk or memory is full, at a random moment, and what they leave behind; what a run
keeps, swapped, aged or changed, and programs whose standard streams are closed: the answer is the same.

A kept file that is not what it says is refused, or made anew; a call that ends with 0 answers as on good data.
"""

import contextlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from stcal.io.files import RUN_MARKER
from stcal.sfm.runs.transaction import verify
from tests.commands import CALLS, Call
from tests.fuzzing.cases import Judged
from tests.fuzzing.judged import (
    CODES,
    IN,
    LONGEST_S,
    OUT,
    Outcome,
    broken,
    failures,
    hashes,
    in_process,
    lay_out,
    lines_of,
)
from tests.fuzzing.mutations import a_folder, emptied, flipped, missing, pick, truncated

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


STREAM_KEPT, STREAM_CLOSED = 20_000_000, 30_000_000
"""Keep the random numbers of these cases from those of others."""
LONGEST_CALL_S = 6.0
KEPT_IN = ("run", "detected")
"""Folders of the stock that commands keep for the next one."""
COMPARED = {".json", ".csv", ".urdf", ".xacro", ".yaml", ".yml", ".bin"}
REMADE_BY = ("sfm run", "sfm detect")
"""Commands that make what they keep anew; others leave what was spoiled as it is."""
TOLD = ("not as the run left it", "are not compared")
NOT_KEPT = {"lock", "holder.txt"}
DAYS_S = 86_400.0
WHEN = re.compile(rb'"(created|seconds|duration_s|made)[^,}]*')


def of_kept(stock: Path, folder: Path, seed: int, number: int) -> Judged:
    """Case ``number`` of this seed: one or two kept files spoiled, and a call that reads them."""
    rng = np.random.default_rng([seed, STREAM_KEPT + number])
    calls = [call for call in CALLS if _reads_kept(call) and call.seconds <= LONGEST_CALL_S and not call.code]
    call = pick(rng, calls)
    clean = _clean(stock, folder, call)
    read, written = _laid_out(stock, folder, call)
    files = [path for below in (read, written) for place in KEPT_IN for path in _kept(below / place)]
    laid_out = hashes(folder)
    said = [_spoil(files, rng) for _ in range(1 + int(rng.integers(2)))]
    before = hashes(folder)
    spoiled = {os.path.relpath(path, folder / OUT) for path in laid_out if before.get(path) != laid_out[path]}
    outcome = in_process(call, "stcal", folder)
    found = [each for each in failures(call, folder, outcome, before, refused=False) if each[0] != "noise"]
    if outcome.code == 0:
        answered = _answers(call, folder)
        given = set() if call.command in REMADE_BY else spoiled
        changed = sorted(name for name in clean if name not in given and answered.get(name, clean[name]) != clean[name])
        said_so = _all_said(call, folder, outcome)
        told = call.command not in REMADE_BY and any(words in said_so for words in TOLD)
        found += [("silent wrong", f"{name} is another one: {outcome.said[-300:]}") for name in changed[:1] if not told]
    return Judged.of(f"s{number}", f"{call.command}: {'; '.join(said)}", found, outcome, call)


def _laid_out(stock: Path, folder: Path, call: Call) -> tuple[Path, Path]:
    """As :func:`lay_out`; a single file of a run has the run's marker beside it."""
    read, written = lay_out(stock, folder, call, earlier=False)
    for place in KEPT_IN:
        marker = read / place / RUN_MARKER
        if (read / place).is_dir() and not marker.exists():
            marker.parent.mkdir(exist_ok=True)
            shutil.copyfile(stock / place / RUN_MARKER, marker)
    return read, written


def _all_said(call: Call, folder: Path, outcome: Outcome) -> str:
    written = (folder / OUT / name for name in call.outputs if name.endswith(".json"))
    return "\n".join([outcome.said, *(path.read_text(encoding="utf-8") for path in written)])


def _reads_kept(call: Call) -> bool:
    return any(re.search(rf"[@~]{place}( |/|$)", call.words) for place in KEPT_IN)


def _kept(folder: Path) -> list[Path]:
    """Files that a run keeps; those of its cache, which are many, as often as all others."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in NOT_KEPT]
    cached = [path for path in files if "cache" in path.parts]
    return files + cached[:: max(1, len(cached) // max(1, len(files) - len(cached)))]


@cache
def _clean(stock: Path, folder: Path, call: Call) -> dict[str, str]:
    """Digests of the answers on good data, of those that two calls make alike."""
    found = []
    for _ in range(2):
        _laid_out(stock, folder, call)
        in_process(call, "stcal", folder)
        found.append(_answers(call, folder))
    return {name: digest for name, digest in found[0].items() if found[1].get(name) == digest}


def _answers(call: Call, folder: Path) -> dict[str, str]:
    names = [word[1:] for word in call.split() if word[0] in ">+~"]
    entries = [folder / OUT / name for name in names]
    files = [path for entry in entries for path in (entry.rglob("*") if entry.is_dir() else [entry]) if path.is_file()]
    wanted = [path for path in files if path.suffix in COMPARED and not {"cache", "overlays"} & set(path.parts)]
    return {str(path.relative_to(folder / OUT)): str(hash(WHEN.sub(b"", path.read_bytes()))) for path in wanted}


def _spoil(files: list[Path], rng: np.random.Generator) -> str:
    left = [each for each in files if each.is_file()]
    if not left:
        return "nothing is left"
    path = pick(rng, left)
    return f"{path.parent.name}/{path.name[:20]}: {pick(rng, SPOILED)(path, files, rng)}"


def _others(path: Path, files: list[Path]) -> list[Path]:
    """Files of the same kind, such as detections of other images."""
    kind = path.name.partition("-")[0] if "-" in path.name else ""
    return [each for each in files if each != path and each.suffix == path.suffix and each.name.startswith(kind)]


def _another(swap: bool):
    """Puts another file of the same kind in its place, and this one in that one's."""

    def change(path: Path, files: list[Path], rng: np.random.Generator) -> str:
        others = [each for each in _others(path, files) if each.is_file()]
        if not others:
            return flipped(path, rng) if swap else missing(path, rng)
        other, own = pick(rng, others), path.read_bytes()
        shutil.copyfile(other, path)
        if swap:
            other.write_bytes(own)
        return f"{'swapped with' if swap else 'a copy of'} {other.name[:20]}"

    return change


def _aged(path: Path, _, rng: np.random.Generator) -> str:
    days = float(rng.uniform(-4000, 4000))
    os.utime(path, (time.time() - days * DAYS_S,) * 2)
    return f"{days:.0f} days old"


def _edited(path: Path, _, rng: np.random.Generator) -> str:
    """Values of an array changed by little, so that the file is still a valid one."""
    if path.suffix != ".npz":
        return flipped(path, rng)
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error):  # an earlier change spoiled it
        return flipped(path, rng)
    names = [name for name, values in arrays.items() if values.dtype.kind == "f" and values.size]
    if not names:
        return flipped(path, rng)
    name = pick(rng, names)
    arrays[name] = arrays[name] * (1 + 1e-3 * rng.standard_normal(arrays[name].shape))
    np.savez(path, **arrays)
    return f"{name} edited"


def _plainly(mutation: Callable[[Path, np.random.Generator], str]):
    return lambda path, _, rng: mutation(path, rng)


SPOILED = (
    *(_another(False), _another(True), _another(True), _aged, _edited, _edited),
    *map(_plainly, (missing, a_folder, truncated, flipped, emptied)),
)


def closed(stock: Path, folder: Path, seed: int, number: int) -> Judged:
    """Case ``number`` of this seed: a program some of whose standard streams are closed."""
    rng = np.random.default_rng([seed, STREAM_CLOSED + number])
    call = pick(rng, [call for call in CALLS if call.seconds <= LONGEST_CALL_S])
    numbers = [n for n in range(3) if rng.random() < 0.6] or [int(rng.integers(3))]
    lay_out(stock, folder, call, earlier=True)
    before = hashes(folder)
    start = time.monotonic()
    outcome = outcome_of(start_program(call, folder, [], numbers), start)
    found = [
        each for each in failures(call, folder, _heard(outcome, numbers), before, refused=False) if each[0] != "memory"
    ]
    if outcome.code != call.code:
        found.append(("exit code", f"{outcome.code}, {call.code} needed: {outcome.err[-300:]}"))
    said = f"{call.command}: {', '.join(['stdin', 'stdout', 'stderr'][n] for n in numbers)} closed"
    return Judged.of(f"d{number}", said, found, outcome, call)


def _heard(outcome: Outcome, numbers: list[int]) -> Outcome:
    """The outcome as far as it could be heard: where standard error is closed, no line is expected there."""
    if outcome.code and 2 in numbers:
        return Outcome(outcome.code, outcome.out, outcome.err or "error: unheard\n", outcome.seconds)
    return outcome
