"""What a run keeps, swapped, aged or changed, and programs whose standard streams are closed: the answer is the same.

A kept file that is not what it says is refused, or made anew; a call that ends with 0 answers as on good data.
"""

import os
import re
import shutil
import time
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from stcal.io.files import RUN_MARKER
from tests.commands import CALLS, Call
from tests.fuzzing.cases import Judged
from tests.fuzzing.judged import OUT, Outcome, failures, hashes, in_process, lay_out
from tests.fuzzing.kills import outcome_of, start_program
from tests.fuzzing.mutations import a_folder, emptied, flipped, missing, pick, truncated

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
