"""Photographs of other renderers against their truth: errors of faces, joint χ² of all circles, verdict.

    .venv/bin/python scripts/studies/optics_study.py [SET …]

For each set of `../shared/data/stereo_target`, JPEG and PNG where both exist, a run with the default options.
Columns: largest error of a face's place (µm), what it is on average by the stated covariances of the faces, and the
share of draws from these in which it is as large as here; largest error of a rotation (mdeg); largest normalised error
√(eᵀC⁻¹e/6) of a face; χ² of all circles of the faces with their joint covariance, after the best rigid motion, per
degree of freedom; largest correction for defocus, px; wrong labels; verdict, and the checks that did not pass.
"""

import json
import tempfile
from pathlib import Path

import numpy as np

from scripts.runner import DATA, script
from stcal.geometry.normal_equations import free_motions
from stcal.geometry.rigid import align_rigid
from stcal.report.text import text_table
from stcal.sfm import run
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.report.compare import compare

SETS = ("exact", "sample", "clean", "clutter", "white_block", "focus", "uneven", "rim")
DRAWS = 20_000
FREE = 1e6
"""Variance of the rigid motion, in mm² about each axis: the truth's frame is another one."""


def joint_chi2(circles: TargetCircles, truth: dict) -> float:
    """χ² of all circles against the truth, per degree of freedom."""
    true = np.array([truth["circles"][str(label)] for label in circles.labels])
    error = (circles.xyz - align_rigid(circles.xyz, true) @ true).ravel()
    motions = free_motions(circles.xyz, scale=False)
    whole = circles.covariance + FREE * np.diag(circles.covariance).mean() * motions @ motions.T
    return float(error @ np.linalg.solve(whole, error)) / (error.size - 6)


def worst_of_draws(face_covariance: dict[str, np.ndarray]) -> np.ndarray:
    """Largest error of a face's place, µm, in random draws from the stated covariances of the faces."""
    rng = np.random.default_rng(0)
    covariances = [c[3:, 3:] for c in face_covariance.values()]
    errors = [rng.multivariate_normal(np.zeros(3), c, DRAWS, check_valid="ignore") for c in covariances]
    return 1e3 * np.linalg.norm(errors, axis=2).max(0)


def row_of(name: str, images: Path, scratch: Path) -> list[str]:
    """One row of the table."""
    folder, truth_file = images.parent, scratch / "truth.json"
    designs = (path if (path := folder / f"{design}.toml").exists() else None for design in ("target", "board"))
    result = run(images, folder / "cameras.txt", scratch / "run", *designs)
    text = (folder / "truth.json").read_text(encoding="utf-8")
    truth_file.write_text(text.replace(".jpg", ".png") if images.name.endswith("png") else text, encoding="utf-8")
    compared = compare(scratch / "run", truth_file)
    by_chance = worst_of_draws(result.target.face_covariance)
    bad = ", ".join(check.key for check in result.checks if check.verdict != "passed")
    return [
        name,
        f"{compared.worst.translation_um:.1f}",
        f"{by_chance.mean():.1f}",
        f"{100 * (by_chance >= compared.worst.translation_um).mean():.0f}",
        f"{compared.worst.rotation_mdeg:.1f}",
        f"{max(face.normalised_error or 0.0 for face in compared.faces.values()):.2f}",
        f"{joint_chi2(result.circles(), json.loads(text)):.2f}",
        f"{max((row['shift_px'] for row in result.report['focus']), default=0.0):.4f}",
        str(compared.labels.wrong) if compared.labels else "–",
        f"{result.judgement.verdict}{': ' if bad else ''}{bad}",
    ]


@script({"sets": list(SETS)})
def main(args) -> None:
    heads = "<set", "faces µm", "expected", "chance %", "mdeg", "worst σ", "χ²/dof", "defocus px", "wrong", "<verdict"
    rows = [list(heads)]
    for name in args.sets:
        for images in sorted((DATA / "stereo_target" / name).glob("images*")):
            with tempfile.TemporaryDirectory() as scratch:
                rows.append(row_of(f"{name}{' PNG' * images.name.endswith('png')}", images, Path(scratch)))
    print("\n".join(text_table(rows)))
