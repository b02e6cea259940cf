"""A target made by itself, rehearsed: init, design, simulate, run, compare, as one calls them.

.venv/bin/python scripts/studies/own_target.py [--out FOLDER]

The board is that of ``init``; ``design`` makes a target for a cube of 130 mm around it, a data set of 4 groups of 5
images of 9 megapixels is rendered from afar as ``design`` was told, calibrated, and compared with the truth.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from scripts.runner import options_of

GROUPS = "front-right,front-left,front-top,right-back"
DISTANCE, WIDTH, IMAGES = "900", "3672", "5"
OWN = ("--target", "own/target.toml", "--board", "own/board.toml")
WORKERS = ("--workers", "1")


def main() -> None:
    """Every command, and what of its answer matters."""
    out = options_of(__doc__, out=Path).out
    with tempfile.TemporaryDirectory() as temporary:
        folder = out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=out is None)
        rehearse(folder)


def rehearse(folder: Path) -> None:
    """In that folder."""
    call(folder, "init", "start")
    (folder / "own").mkdir()
    shutil.copy(folder / "start" / "board.toml", folder / "own")
    made = call(
        folder, *("design", "own", "--size", "130,130,130", "--distance-mm", DISTANCE, "--width", WIDTH),
        *("--images", IMAGES),
    )  # fmt: skip
    show(made[:4])
    call(
        folder, *("simulate", "data", *OWN, "--groups", GROUPS, "--distance", DISTANCE, "--width", WIDTH),
        *("--images", IMAGES, *WORKERS),
    )  # fmt: skip
    run = call(folder, "run", "data/images", "--camera", "data/cameras.txt", *OWN, "--out", "run", *WORKERS)
    table = next(number for number, line in enumerate(run) if line.startswith("Face "))
    end = run.index("", table)
    show(run[table:end])
    show(call(folder, "compare", "run", "data/truth.json")[:-1])


def call(folder: Path, *words: str) -> list[str]:
    """Lines that a command of stcal-sfm prints.

    Raises
    ------
    SystemExit
        It does not end well.
    """
    print(f"$ stcal-sfm {' '.join(words)}", flush=True)
    done = subprocess.run([sys.executable, "-m", "stcal", "sfm", *words], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return done.stdout.splitlines()


def show(lines: list[str]) -> None:
    """As they are."""
    print("\n".join(lines), flush=True)


if __name__ == "__main__":
    main()
