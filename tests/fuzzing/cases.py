"""Cases by their names: ``c12`` a spoiled input, ``b12`` one of a short call, ``o7`` an option, ``k3`` a program that
is ended or has no room left, ``s4`` files that a run keeps, ``d6`` closed streams, ``v5`` a valid call, or a mistake.
Seed and name make a case: a function (stock, folder, rng, number) lays it out and judges it.
"""

import contextlib
import os
import re
import resource
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from stcal.io.files import RUN_MARKER
from stcal.sfm.runs.transaction import verify
from tests.commands import CALLS, PLACES, Call, options_of
from tests.fuzzing.judged import OUT, Failures, Outcome, Program, called, failures, hashes, lay_out, started
from tests.fuzzing.mistakes import MISTAKES, told
from tests.fuzzing.mutations import BYTES, KEPT, MARKED, NOT_PERMITTED, REFUSED, Rng, pick, spoil
from tests.fuzzing.writers import unchecked, watched
from tests.shared import own_copy

UNREAD = {"report.html", "detections.csv", "overlays", "compare.json", "no-colmap", "cache"}
"""Of a run's folder: read by people alone, or by the next run alone."""
BRIEF_S = 1.0
"""Processor time of a call up to which it is made with any mutation where time counts; else with one of ``REFUSED``."""
OPTION_SHARE = 0.06  # of cases that change no file but an option
VALUES = (
    *("nan", "inf", "-1", "0", "1e308", "1e-308", "1e150", "1e-150", "-1e308", "abc"),
    *("", "\x1b[31m", "é", "1,5", "9" * 30, "x" * 3000),
)
LONGEST_CALL_S = 6.0
"""Of cases with kept files and closed streams."""
KEPT_IN = ("run", "detected")
"""Folders of the stock that commands keep for the next one."""
COMPARED = {".json", ".csv", ".urdf", ".xacro", ".yaml", ".yml", ".bin", ".gltf", ".glb"}
REMADE_BY = ("sfm run", "sfm detect")
"""Commands that make what they keep anew; others leave what was spoiled as it is."""
TOLD = ("not as the run left it", "are not compared")
NOT_KEPT = {"lock", "holder.txt"}
GONE = {name: REFUSED[name] for name in ("missing", "a folder", "emptied")}
WHEN = re.compile(rb'"(created|seconds|duration_s|made)[^,}]*')
ENDED = {signal.SIGKILL: -9, signal.SIGINT: 130, signal.SIGTERM: 143}
"""Exit codes."""
ENDS_WITHIN_S, ORPHAN_S = 2.0, 10.0
"""Until a program ends after a signal, and until all that it started does; that may still load libraries."""
STARTING_S = 0.3
"""Until then Python itself may be loading, and no program answers a signal yet."""
ROOM = {
    "full disk": (resource.RLIMIT_FSIZE, 100, 300_000),
    "file limit falls": (resource.RLIMIT_FSIZE, 100, 300_000),
    "little memory": (resource.RLIMIT_AS, 700 << 20, 1500 << 20),
}
"""What is limited, and the range of the limit, bytes."""
AT_ONCE = ("full disk", "little memory")
Judgement = tuple[Call, str, Outcome, Failures]
"""The call, what was done, how it ended, and what must not be."""


@dataclass(frozen=True, slots=True)
class Judged:
    """``said`` : which command, and what was done; ``failures`` : (kind, what)."""

    name: str
    said: str
    failures: tuple[tuple[str, str], ...]
    code: int | None
    command: str


def perform(stock: Path, folder: Path, seed: int, name: str) -> Judged:
    """Judge the case of this name in a folder that is emptied for it."""
    letter, number = (name[0], int(name[1:])) if name[1:].isdigit() else ("", name)
    try:
        for _ in range(2):  # one that ends late is tried again: other cases run beside it
            call, said, outcome, found = KINDS[letter](stock, folder, rng_of(seed, name), number)
            if letter != "k" or "hang" not in dict(found):
                break
        return Judged(name, f"{call.command}: {said}", tuple(found), outcome.code, call.command)
    except Exception:
        return Judged(name, "", (("study", traceback.format_exc()[-1500:]),), None, "")


def rng_of(seed: int, name: str) -> Rng:
    return np.random.default_rng([seed, *name.encode()])


def run_all(stock: Path, seed: int, names: Sequence[str], workers: int) -> Iterator[Judged]:
    """Judge all cases; programs that hang or break are in processes of their own."""
    with (
        tempfile.TemporaryDirectory(prefix="stcal-fuzz-", ignore_cleanup_errors=True) as folder,
        ProcessPoolExecutor(workers, get_context("spawn")) as pool,
    ):
        yield from pool.map(partial(_in_own_folder, stock, Path(folder), seed), names)


def _in_own_folder(stock: Path, folder: Path, seed: int, name: str) -> Judged:
    return perform(stock, folder / str(os.getpid()), seed, name)


def _exit_code(call: Call, outcome: Outcome) -> Failures:
    as_wanted = outcome.code == call.code
    return [] if as_wanted else [("exit code", f"{outcome.code}, {call.code} needed: {outcome.err[-300:]}")]


def _without(found: Failures, *kinds: str) -> Failures:
    return [each for each in found if each[0] not in kinds]


def valid(stock: Path, folder: Path, _, number: int) -> Judgement:
    """A call of the table on good data: its exit code, and all that holds of any call."""
    call, record = CALLS[number], folder.with_suffix(".json")
    lay_out(stock, folder, call, earlier=True)
    before = hashes(folder)
    outcome = called(call, folder, around=partial(watched, record))
    found = failures(call, folder, outcome, before) + _exit_code(call, outcome)
    return call, "on good data", outcome, found + unchecked(call, folder / OUT, record, before, hashes(folder / OUT))


def mistaken(stock: Path, folder: Path, _, name: str) -> Judgement:
    """A realistic mistake beside the same call on good data."""
    mistake = MISTAKES[name]
    good = _on_good_data(stock, folder, mistake.call)
    read, _ = lay_out(stock, folder, mistake.call, earlier=False)
    mistake.edit(read)
    before = hashes(folder)
    outcome = called(mistake.call, folder)
    found = failures(mistake.call, folder, outcome, before)
    read_rightly = (outcome.code, outcome.said) == (good.code, good.said)
    if mistake.untold and not told(mistake, outcome, good):
        found.append(("no program could tell", mistake.untold))
    elif not read_rightly and not told(mistake, outcome, good):
        found.append(("silent wrong", outcome.said[-400:]))
    elif mistake.untold and not read_rightly:
        found.append(("told", f"is told, though none could: {outcome.said[-200:]}"))
    return mistake.call, name, outcome, found


@cache
def _on_good_data(stock: Path, folder: Path, call: Call) -> Outcome:
    lay_out(stock, folder, call, earlier=False)
    return called(call, folder)


def options() -> list[tuple[str, str, str]]:
    """(command, option, value): every option that takes a number or a word, with everything that is none for it."""
    commands = dict.fromkeys(call.command for call in CALLS)
    return [(c, name, value) for c in commands for name in options_of(c) for value in VALUES]


def with_option(stock: Path, folder: Path, _, number: int) -> Judgement:
    """The command's shortest call."""
    command, name, value = options()[number]
    call = min((c for c in CALLS if c.command == command), key=lambda c: (c.code, c.seconds))
    lay_out(stock, folder, call, earlier=False)
    before = hashes(folder)
    outcome = called(call, folder, more=(f"{name}={value}",))
    return call, f"{name}={value[:20]!r}", outcome, failures(call, folder, outcome, before)


def spoiled(stock: Path, folder: Path, rng: Rng, number: int, brief: bool = False) -> Judgement:
    """One of the inputs spoiled, or an option; ``brief`` : without calls that take long."""
    call = spoiled_call(rng, brief)
    program = pick(rng, ["stcal", PLACES[call.command]])
    read, written = lay_out(stock, folder, call, earlier=rng.random() < 0.5)
    slow = brief and call.seconds > BRIEF_S
    named = [read / place for place in call.inputs]
    files = [path for path in sorted(read.rglob("*")) if path.is_file() and not UNREAD & set(path.parts)]
    files += sorted(written.glob("*/.stcal/cache/*.npz"))  # what an earlier run keeps for this one
    if slow:  # what a command that takes long says before its work
        files = [path for path in files if path in named or path.name in ("run.json", "faces.json")]
    more, done, refused = (), "", False
    if files and (slow or rng.random() > OPTION_SHARE):
        camera = read / "data/cameras.txt"
        if camera.exists() and rng.random() < 0.7:  # in another of its forms; the name stays
            own_copy(pick(rng, sorted((stock / "cameras").iterdir())), camera)
        kind = pick(rng, sorted({_kind(path) for path in files}))  # photographs are many
        path = pick(rng, [path for path in files if _kind(path) == kind])
        done, said = spoil(path, rng, *([REFUSED] if slow else []))
        said = f"{path.relative_to(folder)}: {said}"
        # Of a folder that is read a file may be skipped.
        refused = done in REFUSED and done != MARKED and path in named and call.code == 0
    else:
        names, value = options_of(call.command), pick(rng, VALUES)
        more = (f"{pick(rng, names)}={value}" if names else value,)
        said = f"{more[0][:50]!r} more"
    before = hashes(folder)
    outcome = called(call, folder, program, more, plain=done == NOT_PERMITTED)
    found = failures(call, folder, outcome, before, refused)
    return call, f"{' '.join([program, *call.inputs])}: {said}", outcome, found


def spoiled_call(rng: Rng, brief: bool) -> Call:
    """Calls that take long are fewer; each command has its share."""
    calls = [call for call in CALLS if not (brief and call.seconds > BRIEF_S and not call.inputs)]
    same = np.array([sum(call.command == other.command for other in calls) for call in calls])
    share = 1 / (same * (0.3 + np.array([call.seconds for call in calls])))
    return calls[int(rng.choice(len(calls), p=share / share.sum()))]


def _kind(path: Path) -> tuple[bool, str]:
    return path.parent.name in ("12", "14"), path.suffix


def killed(stock: Path, folder: Path, rng: Rng, number: int) -> Judgement:
    """A program that is ended, or whose disk or memory is full, from the beginning or from a moment on."""
    calls = [call for call in CALLS if re.search(r"(^| )[>+~]", call.words) and call.seconds < 20 and not call.code]
    call, kind = pick(rng, calls), pick(rng, [*ENDED, *ROOM])
    two = replace(call, words=call.words.replace("--workers 1", "--workers 2"))
    moment = 0.0 if kind in AT_ONCE else float(rng.uniform(STARTING_S, _seconds(stock, folder, two)))
    lay_out(stock, folder, call, earlier=True)
    before = hashes(folder)
    said, found, but = f"{getattr(kind, 'name', kind)} after {moment:.2f} s", [], ["noise", "memory"]
    if kind in ENDED:
        outcome, found = _ended(started(two, folder), kind, moment)
        # New results that are complete are as good as the earlier ones.
        but += ["exit code", "not one line", "earlier run lost", *(["left behind"] if kind == signal.SIGKILL else [])]
    else:
        what, *range_bytes = ROOM[kind]
        limit = int(np.exp(rng.uniform(*np.log(range_bytes))))
        said = f"{said}, {limit} bytes"
        program = started(two, folder, [(what, limit)] if kind in AT_ONCE else [])
        if kind not in AT_ONCE and not program.ends_within(moment):
            for each in program.session():
                with contextlib.suppress(ProcessLookupError):
                    resource.prlimit(each, what, (limit, limit))
        outcome = program.outcome()
    found += _without(failures(call, folder, outcome, before), *but)
    # A run's folder holds the earlier results or the new ones, by its own hashes.
    found += [("earlier result lost", note) for place in call.folders for note in verify(folder / OUT / place).notes()]
    return call, said, outcome, found


@cache
def _seconds(stock: Path, folder: Path, call: Call) -> float:
    """From the beginning of a program to its end, by the clock; more where others run beside it."""
    lay_out(stock, folder, call, earlier=False)
    return started(call, folder).outcome().seconds


def _ended(program: Program, number: signal.Signals, moment: float) -> tuple[Outcome, Failures]:
    done, start = program.ends_within(moment), time.monotonic()
    if not done:
        os.kill(program.process.pid, number)
        program.ends_within(10)
    seconds = time.monotonic() - start
    while (left := program.session()) and time.monotonic() < start + seconds + ORPHAN_S:
        time.sleep(0.1)
    outcome, code, found = program.outcome(), ENDED[number], []
    if done or (outcome.code == 0 and seconds < ENDS_WITHIN_S):
        return outcome, found
    if outcome.code != code:
        found.append(("exit code", f"{outcome.code}, {code} needed: {outcome.err[-300:]}"))
    if seconds > ENDS_WITHIN_S:
        found.append(("hang", f"ended {seconds:.1f} s after {number.name}"))
    if number != signal.SIGKILL and not re.fullmatch("(interrupted|terminated).*", "\n".join(outcome.lines)):
        found.append(("not one line", " | ".join(line[:150] for line in outcome.lines[:4])))
    if left:
        found.append(("orphan", f"{len(left)} processes go on"))
    return outcome, found


def of_kept(stock: Path, folder: Path, rng: Rng, number: int) -> Judgement:
    """One or two files that a run keeps swapped, aged or changed, and a call that reads them: it is refused, or makes
    them anew, or its answer is as on good data."""
    reads = [call for call in CALLS if re.search(rf"[@~]({'|'.join(KEPT_IN)})( |/|$)", call.words)]
    call = pick(rng, [call for call in reads if call.seconds <= LONGEST_CALL_S and not call.code])
    clean = _answers_on_good_data(stock, folder, call)
    read, written = _laid_out(stock, folder, call)
    below = [path for side in (read, written) for place in KEPT_IN for path in sorted((side / place).rglob("*"))]
    files = [path for path in below if path.is_file() and path.name not in NOT_KEPT]
    cached = [path for path in files if "cache" in path.parts]
    kinds = [kind for kind in ([path for path in files if path not in cached], cached) if kind]
    laid_out, said = hashes(folder), []
    for _ in range(1 + int(rng.integers(2))):
        path = pick(rng, [path for path in pick(rng, kinds) if path.is_file()])
        said.append(f"{path.parent.name}/{path.name[:20]}: {spoil(path, rng, KEPT, KEPT, BYTES, GONE)[1]}")
    before = hashes(folder)
    outcome = called(call, folder)
    found = _without(failures(call, folder, outcome, before), "noise")
    if outcome.code == 0:
        given = {os.path.relpath(path, folder / OUT) for path in laid_out if before.get(path) != laid_out[path]}
        names = clean if call.command in REMADE_BY else clean.keys() - given
        answers = _answers(call, folder)
        changed = sorted(name for name in names if answers.get(name, clean[name]) != clean[name])
        results = [folder / OUT / name for name in call.outputs if name.endswith(".json")]
        texts = [outcome.said, *(path.read_text(encoding="utf-8") for path in results)]
        told_so = call.command not in REMADE_BY and any(words in text for words in TOLD for text in texts)
        if changed and not told_so:
            found.append(("silent wrong", f"{changed[0]} is another one: {outcome.said[-300:]}"))
    return call, "; ".join(said), outcome, found


def _laid_out(stock: Path, folder: Path, call: Call) -> tuple[Path, Path]:
    """As :func:`lay_out`; a single file of a run has the run's marker beside it."""
    markers = [f"@{place}/{RUN_MARKER}" for place in KEPT_IN if f"@{place}/" in call.words]
    return lay_out(stock, folder, replace(call, words=" ".join([call.words, *markers])), earlier=False)


@cache
def _answers_on_good_data(stock: Path, folder: Path, call: Call) -> dict[str, str]:
    """Digests of the answers that two calls make alike."""
    found = []
    for _ in range(2):
        _laid_out(stock, folder, call)
        called(call, folder)
        found.append(_answers(call, folder))
    return dict(found[0].items() & found[1].items())


def _answers(call: Call, folder: Path) -> dict[str, str]:
    entries = [folder / OUT / word[1:] for word in call.split() if word[0] in ">+~"]
    files = [path for entry in entries for path in (entry, *entry.rglob("*")) if path.is_file()]
    wanted = [path for path in files if path.suffix in COMPARED and not {"cache", "overlays"} & set(path.parts)]
    return {str(path.relative_to(folder / OUT)): str(hash(WHEN.sub(b"", path.read_bytes()))) for path in wanted}


def closed(stock: Path, folder: Path, rng: Rng, number: int) -> Judgement:
    """A program some of whose standard streams are closed."""
    call = pick(rng, [call for call in CALLS if call.seconds <= LONGEST_CALL_S])
    numbers = [n for n in range(3) if rng.random() < 0.6] or [int(rng.integers(3))]
    lay_out(stock, folder, call, earlier=True)
    before = hashes(folder)
    outcome = started(call, folder, closed=numbers).outcome()
    # Where standard error is closed, no line is expected there.
    heard = replace(outcome, err=outcome.err or "error: unheard\n") if outcome.code and 2 in numbers else outcome
    found = failures(call, folder, heard, before)
    names = ", ".join(["stdin", "stdout", "stderr"][n] for n in numbers)
    return call, f"{names} closed", outcome, found + _exit_code(call, outcome)


KINDS = {
    "c": spoiled,
    "b": partial(spoiled, brief=True),
    "o": with_option,
    "k": killed,
    "s": of_kept,
    "d": closed,
    "v": valid,
    "": mistaken,
}
