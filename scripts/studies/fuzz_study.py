"""Whether every file that comes in is judged, and every file that goes out is whole.

.venv/bin/python scripts/studies/fuzz_study.py [--count 1000] [--seed 1] [--kills 20] [--only CASE]

All commands of both programs, found in the tree: one without a call in `tests/commands.py` ends the study. Six parts:
inputs spoiled by their bytes, place or structure (`c0`, `c1`, …), every option with every value that is none for it
(`o0`, …), realistic mistakes (by name; "silent wrong" where nothing is said), programs ended by signals, and with a
full disk (`ulimit -f`) or little memory, from the beginning or at random moments (`k0`, `k1`, …), what runs keep
swapped, aged and changed (`s0`, …), and closed standard streams (`d0`, …). The seed and the case's name repeat a
case: `--seed 1 --only c17`. Simulated data; a small run is made first. Exits with 1 where anything failed.
"""

import os
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from stcal.parallel import ONE_THREAD

os.environ.update(dict.fromkeys(ONE_THREAD, "1"))

from scripts.runner import script
from tests.commands import CALLS, COMMANDS
from tests.fuzzing.cases import Judged, option_cases
from tests.fuzzing.mistakes import MISTAKES
from tests.fuzzing.pool import run_all
from tests.fuzzing.stock import make_stock

ALLOWED = ("no program could tell",)
SHOWN = 600
"""Characters of a failure."""


def names_of(arguments) -> list[str]:
    """Cases: each call on good data, mistakes, every option with every odd value, and those that are drawn."""
    if arguments.only:
        return [arguments.only]
    valid = [f"v{i}" for i in range(len(CALLS))]
    options = [f"o{i}" for i in range(len(option_cases()))]
    counts = {"k": arguments.kills, "s": arguments.kept, "d": arguments.closed, "c": arguments.count}
    drawn = [f"{letter}{i}" for letter, count in counts.items() for i in range(count)]
    return [*valid, *MISTAKES, *options, *drawn]


def show(found: Judged, seed: int) -> None:
    """Each failure of a case."""
    for kind, what in found.failures:
        print(f"{kind} | {found.said} | --seed {seed} --only {found.name!r}\n    {what[-SHOWN:]}", flush=True)


def summary(found: list[Judged], seed: int) -> str:
    """Counts by kind with the cases, and by command, as Markdown."""
    kinds: dict[str, list[str]] = {}
    for each in found:
        for kind in sorted({kind for kind, _ in each.failures}):
            kinds.setdefault(kind, []).append(each.name)
    lines = [f"seed {seed}: {len(found)} cases", "", "| failure | cases | names |", "|---|---|---|"]
    lines += [f"| {kind} | {len(names)} | {', '.join(names[:12])} |" for kind, names in sorted(kinds.items())]
    codes = Counter((each.command, each.code) for each in found)
    lines += ["", "| command | exit 0 | 2 | 3 | other |", "|---|---|---|---|---|"]
    for command in COMMANDS:
        own = {code: n for (name, code), n in codes.items() if name == command}
        known = [own.pop(code, 0) for code in (0, 2, 3)]
        lines.append(f"| {command} | {' | '.join(map(str, known))} | {sum(own.values())} |")
    return "\n".join(lines)


COUNTS = {"count": 1000, "kills": 20, "kept": 60, "closed": 20}


@script(**COUNTS, seed=1, only="", workers=os.cpu_count() or 1)
def main(arguments) -> None:
    missing = set(COMMANDS) - {call.command for call in CALLS}
    if missing:
        sys.exit(f"no call in tests/commands.py of {', '.join(sorted(missing))}; add one")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # what it laid out is taken away
    start = time.monotonic()
    found: list[Judged] = []
    with tempfile.TemporaryDirectory(prefix="stcal-stock-") as folder:
        stock = make_stock(Path(folder) / "stock")
        for each in run_all(stock, arguments.seed, names_of(arguments), arguments.workers):
            found.append(each)
            show(each, arguments.seed)
    print(f"\n{summary(found, arguments.seed)}\n\n{time.monotonic() - start:.0f} s")
    sys.exit(any(kind not in ALLOWED for each in found for kind, _ in each.failures))
