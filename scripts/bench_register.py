"""Time of ``stcal register`` on many point pairs, by its parts, and their ratio to merely reading the file.

.venv/bin/python scripts/bench_register.py [--rows 100000] [--sigma 0.05] [--rounds 3]

Simulated pairs, some of them wrong by 2 to 50 mm, from a CSV file. Of each part the least time of some rounds in one
process (what others do on the machine only adds), beside the time of ``numpy.loadtxt`` for the same file in the same
rounds; then the command as a user starts it, its loading included, without files, with ``--out`` and with ``--report``
too. ``--paired`` starts it, BLAS left as it comes, alone and beside a process that keeps every core busy, in turn. Such
a process doubles the wall time at least; threads that wait for each other would show in the processor's.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scripts.runner import options_of
from stcal.io.files import json_text
from stcal.parallel import ONE_THREAD
from stcal.register import register
from stcal.register.file import RegistrationFile
from stcal.register.page import registration_report
from stcal.register.pairs import read_pairs
from stcal.register.workspace import findings
from tests.support.point_pairs import make_scene

SHARES = (0.0, 0.2, 0.45)
HEADER = "ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm"
PARTS = ("numpy.loadtxt", "reading", "registration", "field and cubes", "tables", "JSON", "page")
PROGRAM = [sys.executable, "-P", "-c", "from stcal.cli.entry import main; main()"]
BUSY = "import numpy as np\na = np.ones((700, 700))\nwhile True: a @ a"


def write_pairs(path: Path, rows: int, share: float, sigma_mm: float) -> int:
    """Write point pairs; how many of them are wrong."""
    scene = make_scene(np.random.default_rng(0), rows, share, sigma_mm=sigma_mm)
    values = np.hstack([scene.xyz_a, scene.xyz_b])
    np.savetxt(path, values, delimiter=",", header=HEADER, comments="", fmt="%.6f")
    return int((~scene.clean).sum())


def parts_once(path: Path) -> tuple[dict[str, float], int]:
    """Seconds of each part, and how many rows were called wrong."""
    took: dict[str, float] = {}

    def timed(name: str, work: Callable):
        start = time.perf_counter()
        result = work()
        took[name] = time.perf_counter() - start
        return result

    timed("numpy.loadtxt", lambda: np.loadtxt(path, delimiter=",", skiprows=1))
    pairs = timed("reading", lambda: read_pairs(path))
    found = timed("registration", lambda: register(pairs.xyz_a, pairs.xyz_b, lines=pairs.lines))
    every = timed("field and cubes", lambda: findings(pairs, found))
    timed("tables", registration_report(every).text)
    timed("JSON", lambda: json_text(RegistrationFile.model_validate(every)))
    timed("page", registration_report(every).page)
    return took, len(found.outliers)


def least(rounds: list[dict[str, float]]) -> dict[str, float]:
    """Of each part."""
    return {name: min(each[name] for each in rounds) for name in rounds[0]}


def command_seconds(words: list, environment: dict[str, str] | None = None) -> tuple[float, float]:
    """Wall and processor seconds of the command."""
    start, before = time.perf_counter(), os.times()
    done = subprocess.run([*PROGRAM, "register", *map(str, words)], capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(f"error: {done.stderr}")
    wall, after = time.perf_counter() - start, os.times()
    user, system = after.children_user - before.children_user, after.children_system - before.children_system
    return wall, user + system


def commands(path: Path, folder: Path) -> dict[str, float]:
    """Seconds of the command with more and more files."""
    out, page = ["--overwrite", "--out", folder / "out.json"], ["--report", folder / "out.html"]
    ways = {"command": [], "command, --out": out, "command, --out --report": [*out, *page]}
    return {name: command_seconds([path, *words])[0] for name, words in ways.items()}


def paired(path: Path, rounds: int) -> None:
    """Alone and beside a busy process in turn, threads of BLAS as they come."""
    free = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    for _ in range(rounds):
        alone = command_seconds([path], free)
        busy = subprocess.Popen([sys.executable, "-c", BUSY], env=free)
        try:
            time.sleep(0.5)
            beside = command_seconds([path], free)  # before the busy one is waited for, and counts as a child
        finally:
            busy.kill()
            busy.wait()
        words = [f"{wall:.2f} s (processor {used:.2f} s)" for wall, used in (alone, beside)]
        print(f"  alone {words[0]}, beside a busy process {words[1]}", flush=True)


def main() -> None:
    given = options_of(__doc__, rows=100_000, sigma=0.05, rounds=3, paired=False)
    with tempfile.TemporaryDirectory() as name:
        folder, columns = Path(name), []
        for share in SHARES:
            path = folder / f"{100 * share:.0f}.csv"
            wrong = write_pairs(path, given.rows, share, given.sigma)
            if given.paired:
                print(f"{given.rows} point pairs, {100 * share:.0f} % wrong")
                paired(path, given.rounds)
                continue
            rounds = [parts_once(path) for _ in range(given.rounds)]
            whole = least([commands(path, folder) for _ in range(given.rounds)])
            columns.append((least([took for took, _ in rounds]) | whole, wrong, rounds[0][1]))
    if columns:
        print_table(given.rows, columns)


def print_table(rows: int, columns: list[tuple[dict[str, float], int, int]]) -> None:
    """Seconds, and times the reading by numpy."""
    print(f"{rows} point pairs, s, and times reading the file by numpy.loadtxt")
    print(f"{'wrong':<26}" + "".join(f"{100 * share:8.0f} %        " for share in SHARES).rstrip())
    for name in columns[0][0]:
        cells = "".join(f"{took[name]:8.2f} {took[name] / took['numpy.loadtxt']:6.1f}×  " for took, *_ in columns)
        print(f"{name:<26}{cells}".rstrip())
    print("called wrong of wrong     " + "".join(f"{found:7d} of {wrong:5d} " for _, wrong, found in columns).rstrip())


if __name__ == "__main__":
    main()
