"""The figures of docs/accuracy on the rendered data sets beside the repository: errors, labels found, the control, and
the cross-check with the native COLMAP where that is installed.

.venv/bin/python scripts/studies/measure_shared.py [../shared/data/stereo_target]
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

from scripts.runner import DATA, script
from stcal.sfm import RunOptions, run
from stcal.sfm.interop.crosscheck import comparison_text, crosscheck
from stcal.sfm.report.compare import compare, comparison_table
from stcal.sfm.runs.saved import load_run


@script({"root": DATA / "stereo_target"})
def main(given) -> None:
    for name in ("clean", "clutter"):
        folder = given.root / name
        if not folder.is_dir():
            sys.exit(f"error: {folder} is missing; give the folder that holds clean/ and clutter/")
        for title, options in (
            ("corrected, joint adjustment", RunOptions()),
            ("corrected, chained (--solve chain)", RunOptions(solve="chain")),
            ("uncorrected control (--no-eccentricity)", RunOptions(eccentricity=False)),
        ):
            with tempfile.TemporaryDirectory() as scratch:
                out = Path(scratch) / "run"
                run(folder / "images", folder / "cameras.txt", out, options=options)
                summary = json.loads((out / "report.json").read_text())["summary"]
                registered = f"{summary['images_mapped']} of {summary['images']} images registered"
                print(f"\n{name}, {title}: {registered}, residual RMS {summary['residual_rms_px']:.4f} px")
                print(comparison_table(compare(out, folder / "truth.json")))
                if options == RunOptions() and shutil.which("colmap"):
                    print(f"\n{name}, cross-check with the native COLMAP:")
                    print(comparison_text(crosscheck(load_run(out))))
