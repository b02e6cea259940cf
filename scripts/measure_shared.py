"""The figures of the README on the rendered data sets beside the repository: errors, labels found, the control.

.venv/bin/python scripts/measure_shared.py [../shared/data/stereo_target]
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from stcal.sfm import RunOptions, run
from stcal.sfm.compare import compare, comparison_table

NEAR_PX = 1.5


def main() -> None:
    default = Path(__file__).resolve().parents[2] / "shared" / "data" / "stereo_target"
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    for name in ("clean", "clutter"):
        folder = root / name
        if not folder.is_dir():
            sys.exit(f"error: {folder} is missing; give the folder that holds clean/ and clutter/")
        for title, options in (
            ("corrected, joint adjustment", RunOptions()),
            ("corrected, chained (--solve chain)", RunOptions(solve="chain")),
            ("uncorrected control (--no-eccentricity)", RunOptions(eccentricity=False)),
        ):
            with tempfile.TemporaryDirectory() as scratch:
                out = Path(scratch) / "run"
                result = run(folder / "images", folder / "cameras.txt", out, options=options)
                rms = json.loads((out / "report.json").read_text())["summary"]["residual_rms_px"]
                print(f"\n{name}, {title}: residual RMS {rms:.4f} px")
                print(comparison_table(compare(out, folder / "truth.json")))
                if options == RunOptions():
                    print_labels(result, json.loads((folder / "truth.json").read_text()))


def print_labels(result, truth: dict) -> None:
    """Wrong labels, and visible circles found; the plain board's numbers are known up to half a turn."""
    wrong = found = visible = 0
    columns = result.board_design.columns
    for group, known in truth["groups"].items():
        count = len(known["board_circles_target"])
        rows = [o for o in result.observations() if o.group == group]
        best = min(
            (_count(rows, known["images"], turn, columns) for turn in (np.arange(count), np.arange(count)[::-1])),
        )
        wrong, found, visible = wrong + best[0], found - best[1], visible + best[2]
    mapped = sum(len(s.model.images) for s in result.solutions)
    print(
        f"images registered: {mapped} of {len(result.labelled)}; wrong labels: {wrong}; "
        f"visible circles found: {found} of {visible} ({100 * found / visible:.1f} %)"
    )


def _count(observations, images: dict, numbering, columns: int) -> tuple[int, int, int]:
    wrong = found = visible = 0
    for image in observations:
        circles = images[image.name]["circles"]
        visible += sum(c["must_find"] for c in circles.values())
        for label, centre in zip(image.labels, image.centre_px, strict=True):
            if label.startswith("board:"):
                row, column = (int(v) for v in label.split(":")[1:])
                label = f"board:{numbering[row * columns + column]}"
            right = label in circles and np.linalg.norm(centre - circles[label]["centre_px"]) < NEAR_PX
            wrong += not right
            found += right and circles[label]["must_find"]
    return wrong, -found, visible


if __name__ == "__main__":
    main()
