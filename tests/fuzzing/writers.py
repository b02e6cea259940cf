"""The rule for written files, watched during a call: each is read again, and its check sees another number in it."""

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from stcal.errors import ConvergenceError
from stcal.io import files
from tests.commands import Call

TO_LOOK_AT = {".html", ".pdf", ".svg", ".png", ".jpg", ".gltf", ".glb"}
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
def watched(record: Path) -> Iterator[None]:
    """Writes which files were checked meanwhile, and whether their check sees a change; null where there is none."""
    seen: dict[str, bool | None] = {}
    measure = files._difference

    def difference(path, read, reported) -> float:
        found, content = measure(path, read, reported), Path(path).read_bytes()
        seen.setdefault(Path(path).name, None)
        changed = NUMBER.sub(_another, content)
        if changed != content:
            Path(path).write_bytes(changed)
            try:
                noticed = not measure(path, read, reported) <= max(1e-4, 100 * found)
            except ConvergenceError:
                noticed = True
            finally:
                Path(path).write_bytes(content)
            seen[Path(path).name] = seen[Path(path).name] or noticed
        return found

    files._difference = difference
    try:
        yield
    finally:
        files._difference = measure
        record.write_text(json.dumps(seen))


def _another(number: re.Match[bytes]) -> bytes:
    """Returns the text of a number that differs by a thousandth."""
    return repr(float(number[0]) * 1.001 if math.isfinite(float(number[0])) else 0.0).encode()


def unchecked(
    call: Call, folder: Path, record: Path, before: dict[str, str], after: dict[str, str]
) -> list[tuple[str, str]]:
    """Returns the files below ``folder`` that a call wrote and nobody read again, and those whose check is blind."""
    seen = json.loads(record.read_text())
    blind = [("check is blind", name) for name, noticed in seen.items() if noticed is False]
    if call.command in ELSEWHERE or call.code:
        return blind
    figures = {word[1:] for option, word in pairwise(call.split()) if option in OPTIONS_OF_FIGURES}
    changed = [Path(path).relative_to(folder) for path in after if after[path] != before.get(path)]
    return blind + [
        ("not read again", str(path))
        for path in changed
        if path.name not in seen.keys() | figures and path.suffix not in TO_LOOK_AT and not OF_A_RUN & set(path.parts)
    ]
