"""Processes that judge one case after another; one that hangs or breaks is replaced, and the case says so."""

import multiprocessing
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection, wait
from pathlib import Path

from stcal.parallel import ONE_THREAD
from tests.commands import Call
from tests.fuzzing.cases import Judged, judged, judged_option
from tests.fuzzing.judged import LONGEST_S, OUT, Outcome, failures, hashes, in_process, lay_out
from tests.fuzzing.writers import unchecked, watched

LONGEST_WAIT_S = 4 * LONGEST_S + 20
MOST_MEMORY = 8 << 30
"""Of a process, so that the machine lives."""


def perform(stock: Path, folder: Path, seed: int, name: str) -> Judged:
    """The case of this name: ``c12`` a spoiled input, ``k3`` a kill, ``s4`` kept files, ``d6`` closed streams, ``o7``
    an option, ``v5`` a valid call, else a mistake."""
    from tests.fuzzing.kept import closed, of_kept
    from tests.fuzzing.kills import killed

    for letter, judge in (("s", of_kept), ("d", closed)):
        if name[0] == letter and name[1:].isdigit():
            return judge(stock, folder, seed, int(name[1:]))
    if name[0] == "c" and name[1:].isdigit():
        return judged(stock, folder, seed, int(name[1:]))
    if name[0] == "k" and name[1:].isdigit():
        return killed(stock, folder, seed, int(name[1:]))
    if name[0] == "o" and name[1:].isdigit():
        return judged_option(stock, folder, int(name[1:]))
    if name[0] == "v" and name[1:].isdigit():
        return went_through(stock, folder, int(name[1:]))
    return mistaken(stock, folder, name)


def went_through(stock: Path, folder: Path, number: int) -> Judged:
    """A call of the table on good data: its exit code, and all that holds of any call."""
    from tests.commands import CALLS

    call = CALLS[number]
    lay_out(stock, folder, call, earlier=True)
    before = hashes(folder)
    with watched() as (checked, blind):
        outcome = in_process(call, "stcal", folder)
    found = failures(call, folder, outcome, before, refused=False)
    found += [("not read again", name) for name in unchecked(call, folder / OUT, checked, before, hashes(folder / OUT))]
    found += [("check is blind", name) for name in blind]
    if outcome.code != call.code:
        found.append(("exit code", f"{outcome.code}, {call.code} needed: {outcome.err[-300:]}"))
    return Judged(
        f"v{number}", f"{call.command} on good data", tuple(found), outcome.code, outcome.seconds, call.command
    )


def mistaken(stock: Path, folder: Path, name: str) -> Judged:
    """A realistic mistake beside the same call on good data."""
    from tests.fuzzing.mistakes import MISTAKES, told

    mistake = MISTAKES[name]
    valid = _on_good_data(stock, folder, mistake.call)
    read, _ = lay_out(stock, folder, mistake.call, earlier=False)
    mistake.edit(read)
    before = hashes(folder)
    outcome = in_process(mistake.call, "stcal", folder)
    found = failures(mistake.call, folder, outcome, before, refused=False)
    read_rightly = (outcome.code, outcome.said) == (valid.code, valid.said)
    if mistake.untold and not told(mistake, outcome, valid):
        found.append(("no program could tell", mistake.untold))
    elif not read_rightly and not told(mistake, outcome, valid):
        found.append(("silent wrong", outcome.said[-400:]))
    elif mistake.untold and not read_rightly:
        found.append(("told", f"is told, though none could: {outcome.said[-200:]}"))
    return Judged(
        name, f"{mistake.call.command}: {name}", tuple(found), outcome.code, outcome.seconds, mistake.call.command
    )


@cache
def _on_good_data(stock: Path, folder: Path, call: Call) -> Outcome:
    lay_out(stock, folder, call, earlier=False)
    return in_process(call, "stcal", folder)


@dataclass(slots=True)
class _Worker:
    process: multiprocessing.process.BaseProcess
    ours: Connection
    name: str = ""
    since: float = 0.0


def run_all(stock: Path, seed: int, names: Sequence[str], workers: int) -> Iterator[Judged]:
    """Judge all cases, in any order."""
    waiting = list(reversed(names))
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    folder = Path(tempfile.mkdtemp(prefix="stcal-fuzz-"))
    context = multiprocessing.get_context("spawn")
    at_work: list[_Worker] = []
    started = 0
    try:
        while waiting or at_work:
            while waiting and len(at_work) < workers:
                ours, theirs = context.Pipe()
                arguments = (theirs, stock, folder / str(started), seed)
                process = context.Process(target=_work, args=arguments, daemon=False)
                process.start()
                theirs.close()
                started += 1
                at_work.append(_give(_Worker(process, ours), waiting))
            wait([worker.ours for worker in at_work], timeout=5)
            for worker in list(at_work):
                found = _answer(worker)
                if found is None:
                    continue
                yield found
                if worker.process.is_alive() and waiting:
                    _give(worker, waiting)
                else:
                    _stop(worker)
                    at_work.remove(worker)
    finally:
        for worker in at_work:
            worker.process.kill()
            worker.process.join()
        shutil.rmtree(folder, ignore_errors=True)


def _give(worker: _Worker, waiting: list[str]) -> _Worker:
    worker.name, worker.since = waiting.pop(), time.monotonic()
    worker.ours.send(worker.name)
    return worker


def _answer(worker: _Worker) -> Judged | None:
    """What a worker found, or what became of it; None while it works."""
    try:
        if worker.ours.poll():
            return worker.ours.recv()
    except (EOFError, OSError):
        worker.process.join()
        return Judged(worker.name, "", (("crash", f"exit code {worker.process.exitcode}"),), None, 0, "")
    if time.monotonic() - worker.since > LONGEST_WAIT_S:
        worker.process.kill()
        worker.process.join()
        return Judged(worker.name, "", (("hang", f"no answer for {LONGEST_WAIT_S:g} s"),), None, LONGEST_WAIT_S, "")
    return None


def _stop(worker: _Worker) -> None:
    if worker.process.is_alive():
        worker.ours.send("")
    worker.process.join()
    worker.ours.close()


def _work(theirs: Connection, stock: Path, folder: Path, seed: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, resource.RLIM_INFINITY))
    while name := theirs.recv():
        try:
            theirs.send(perform(stock, folder, seed, name))
        except Exception as error:
            import traceback

            theirs.send(Judged(name, repr(error), (("study", traceback.format_exc()[-1500:]),), None, 0, ""))
