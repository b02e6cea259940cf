"""The rule for written files, watched during a call: each is read again, and its check sees another number in it."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from stcal.errors import ConvergenceError
from stcal.io import files
from tests.commands import Call

TO_LOOK_AT = {".html", ".pdf", ".svg", ".png", ".jpg"}
"""Suffixes of pages, drawings and scenes, from which no number is taken."""
OF_A_RUN = {
    *("report.json", "labels.csv", "detections.csv", "colmap", "inputs"),
    *("overlays", ".stcal", "detections", "truth.json"),
}
"""Files of a run that later commands of the same program read; COLMAP's are read again by the stage that writes them,
and the faces are in ``faces.json``."""
OPTIONS_OF_FIGURES = ("--json", "--report", "--plot")
ELSEWHERE = {"sfm demo", "sfm draw", "sfm export-model", "sfm export-database"}
"""Commands that call others, that draw, and that write COLMAP's models and databases, which are compared by their own
code (E-EXPORT-READ-BACK, E-OUTPUT-READ-BACK)."""
NUMBER = re.compile(rb"(?<![\w.])-?\d+\.\d+(?:e[-+]?\d+)?(?![\w.])")


@contextmanager
def watched() -> Iterator[tuple[set[str], list[str]]]:
    """Collects meanwhile the names of files that are checked, and of those whose check does not see a change."""
    names: set[str] = set()
    seen: dict[str, bool] = {}
    blind: list[str] = []
    measure = files._difference

    def difference(path, read, reported) -> float:
        found, content = measure(path, read, reported), Path(path).read_bytes()
        names.add(Path(path).name)
        changed = NUMBER.sub(_another, content)
        if changed != content:
            Path(path).write_bytes(changed)
            try:
                noticed = not measure(path, read, reported) <= max(1e-4, 100 * found)
            except ConvergenceError:
                noticed = True
            finally:
                Path(path).write_bytes(content)
            seen[Path(path).name] = seen.get(Path(path).name, False) or noticed
        return found

    files._difference = difference
    try:
        yield names, blind
    finally:
        files._difference = measure
        blind += [name for name, noticed in seen.items() if not noticed]


def _another(number: re.Match[bytes]) -> bytes:
    """Returns the text of a number that differs by a thousandth."""
    return repr(float(number[0]) * 1.001 if math.isfinite(float(number[0])) else 0.0).encode()


def unchecked(call: Call, folder: Path, names: set[str], before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Returns the files below ``folder`` that a call wrote and nobody read again."""
    if call.command in ELSEWHERE or call.code:
        return []
    words = call.split()
    figures = {word[1:] for option, word in pairwise(words) if option in OPTIONS_OF_FIGURES}
    changed = [Path(path).relative_to(folder) for path in after if after[path] != before.get(path)]
    return [
        str(path)
        for path in changed
        if path.name not in names | figures and path.suffix not in TO_LOOK_AT and not OF_A_RUN & set(path.parts)
    ]
