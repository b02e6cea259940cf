"""Processes that judge one case after another; one that hangs or breaks is replaced, and the case says so."""

import multiprocessing
import os
import resource
import tempfile
import threading
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache
from pathlib import Path

from stcal.parallel import ONE_THREAD
from tests.commands import CALLS, Call
from tests.fuzzing.cases import Judged, judged, judged_option
from tests.fuzzing.judged import LONGEST_S, OUT, Outcome, failures, hashes, in_process, lay_out, unchecked, watched
from tests.fuzzing.kills import closed, killed, of_kept
from tests.fuzzing.mistakes import MISTAKES, told

LONGEST_WAIT_S = 4 * LONGEST_S + 20
MOST_MEMORY = 8 << 30
"""Of a process, so that the machine lives."""


def perform(stock: Path, folder: Path, seed: int, name: str) -> Judged:
    """The case of this name: ``c12`` a spoiled input, ``k3`` a kill, ``s4`` kept files, ``d6`` closed streams, ``o7``
    an option, ``v5`` a valid call, else a mistake."""
    if not name[1:].isdigit():
        return mistaken(stock, folder, name)
    if name[0] in "vo":
        return {"v": went_through, "o": judged_option}[name[0]](stock, folder, int(name[1:]))
    return {"c": judged, "k": killed, "s": of_kept, "d": closed}[name[0]](stock, folder, seed, int(name[1:]))


def went_through(stock: Path, folder: Path, number: int) -> Judged:
    """A call of the table on good data: its exit code, and all that holds of any call."""
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
    return Judged.of(f"v{number}", f"{call.command} on good data", found, outcome, call)


def mistaken(stock: Path, folder: Path, name: str) -> Judged:
    """A realistic mistake beside the same call on good data."""
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
    return Judged.of(name, f"{mistake.call.command}: {name}", found, outcome, mistake.call)


@cache
def _on_good_data(stock: Path, folder: Path, call: Call) -> Outcome:
    lay_out(stock, folder, call, earlier=False)
    return in_process(call, "stcal", folder)


def run_all(stock: Path, seed: int, names: Sequence[str], workers: int) -> Iterator[Judged]:
    """Judge all cases."""
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    own = threading.local()
    with tempfile.TemporaryDirectory(prefix="stcal-fuzz-", ignore_cleanup_errors=True) as folder:

        def judge(name: str) -> Judged:
            """Judges a case in the process of this thread, which is replaced where it breaks or gives no answer."""
            if getattr(own, "pool", None) is None:
                own.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _limit_memory)
            place, processes = Path(folder, str(threading.get_ident())), own.pool._processes
            try:
                return own.pool.submit(perform, stock, place, seed, name).result(LONGEST_WAIT_S)
            except BrokenExecutor:
                own.pool, fault = None, ("crash", f"exit codes {[each.exitcode for each in processes.values()]}")
            except TimeoutError:
                for process in processes.values():
                    process.kill()
                own.pool, fault = None, ("hang", f"no answer for {LONGEST_WAIT_S:g} s")
            except Exception:
                fault = "study", traceback.format_exc()[-1500:]
            return Judged(name, "", (fault,), None, 0, "")

        with ThreadPoolExecutor(workers) as threads:
            try:
                yield from threads.map(judge, names)
            finally:
                threads.shutdown(cancel_futures=True)


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, resource.RLIM_INFINITY))
