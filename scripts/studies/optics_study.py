"""Photographs of other renderers against their truth: errors of faces, joint χ² of all circles, verdict.

    .venv/bin/python scripts/studies/optics_study.py [SET …] [--data FOLDER] [--runs FOLDER] [--rim]

For each set of `../shared/data/stereo_target`, JPEG and PNG where both exist, `stcal-sfm run` with its default options.
Columns: largest error of a face's place (µm), what it is on average by the stated covariances of the faces, and the
share of draws from these in which it is as large as here; largest error of a rotation (mdeg); largest normalised error
√(eᵀC⁻¹e/6) of a face; χ² of all circles of the faces with their joint covariance, after the best rigid motion, per
degree of freedom; largest correction for defocus, px; wrong labels; verdict, and the checks that did not pass.
`--rim` : runs that estimate rims, and their height.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from scripts.runner import DATA, script
from stcal.geometry.normal_equations import free_motions
from stcal.report.text import text_table

SETS = ("exact", "sample", "clean", "clutter", "white_block", "focus", "uneven", "rim")
COMMAND = [sys.executable, "-m", "stcal", "sfm"]
DRAWS = 20_000
FREE = 1e6
"""Variance of the rigid motion, in mm² about each axis: the truth's frame is another one."""


def joint_chi2(faces: dict, truth: dict) -> tuple[float, int]:
    """χ² of all circles against the truth, and its degrees of freedom."""
    labels = faces["circles_joint_covariance_mm2"]["labels"]
    n = 3 * len(labels)
    covariance = np.zeros((n, n))
    covariance[np.triu_indices(n)] = faces["circles_joint_covariance_mm2"]["upper_triangle"]
    covariance += np.triu(covariance, 1).T
    xyz = np.array([faces["circles"][label] for label in labels])
    true = np.array([truth["circles"][label] for label in labels])
    centre, true_centre = xyz.mean(0), true.mean(0)
    u, _, vt = np.linalg.svd((xyz - centre).T @ (true - true_centre))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    error = (xyz - (true - true_centre) @ rotation.T - centre).ravel()
    motions = free_motions(xyz - centre, scale=False)
    scale = float(np.mean(np.diag(covariance)))
    whole = covariance + FREE * scale * motions @ motions.T
    return float(error @ np.linalg.solve(whole, error)), n - 6


def worst_of_draws(faces: dict) -> np.ndarray:
    """Largest error of a face's place, µm, in random draws from the stated covariances of the faces."""
    rng = np.random.default_rng(0)
    covariances = [np.array(c)[3:, 3:] for c in faces["target_from_face_covariance"].values()]
    errors = [rng.multivariate_normal(np.zeros(3), c, DRAWS, check_valid="ignore") for c in covariances]
    return 1e3 * np.linalg.norm(errors, axis=2).max(0)


def row_of(name: str, images: Path, folder: Path, run: Path, options: list[str]) -> list[str]:
    """One row of the table."""
    words = ["run", str(images), "--camera", str(folder / "cameras.txt"), "--out", str(run), "--quiet", *options]
    for design in ("target", "board"):
        if (folder / f"{design}.toml").exists():
            words += [f"--{design}", str(folder / f"{design}.toml")]
    subprocess.run([*COMMAND, *words], check=False, stdout=subprocess.DEVNULL)
    truth_file = run.parent / f"{run.name}-truth.json"
    text = (folder / "truth.json").read_text(encoding="utf-8")
    truth_file.write_text(text.replace(".jpg", ".png") if images.name.endswith("png") else text, encoding="utf-8")
    subprocess.run([*COMMAND, "compare", str(run), str(truth_file)], check=False, stdout=subprocess.DEVNULL)
    compared, report, faces, truth = (
        json.loads((place).read_text(encoding="utf-8"))
        for place in (run / "compare.json", run / "report.json", run / "faces.json", truth_file)
    )
    chi2, freedom = joint_chi2(faces, truth)
    errors = [face["normalised_error"] for face in compared["faces"].values() if face.get("normalised_error")]
    wrong = compared["labels"]["wrong"] if compared.get("labels") else "–"
    by_chance = worst_of_draws(faces)
    bad = [check["key"] for check in report["checks"] if check["verdict"] != "passed"]
    return [
        name,
        f"{compared['worst']['translation_um']:.1f}",
        f"{by_chance.mean():.1f}",
        f"{100 * (by_chance >= compared['worst']['translation_um']).mean():.0f}",
        f"{compared['worst']['rotation_mdeg']:.1f}",
        f"{max(errors):.2f}",
        f"{chi2 / freedom:.2f}",
        f"{max((row['shift_px'] for row in report['focus']), default=0.0):.4f}",
        str(wrong),
        *([f"{report['summary']['rim_mm'] or 0.0:.3f}"] if "--rim" in options else []),
        f"{report['judgement']['verdict']}{': ' if bad else ''}{', '.join(bad)}",
    ]


@script({"sets": list(SETS)}, data=DATA / "stereo_target", runs=Path, rim=False)
def main(args) -> None:
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        runs = args.runs or Path(scratch)
        for name in args.sets:
            for images in sorted((args.data / name).glob("images*")):
                form = " PNG" if images.name.endswith("png") else ""
                run = runs / f"{name}{form.strip().lower()}"
                rows.append(row_of(name + form, images, args.data / name, run, ["--rim"] if args.rim else []))
    heads = ["<set", "faces µm", "expected", "chance %", "mdeg", "worst σ", "χ²/dof", "defocus px", "wrong"]
    heads += [*(["rim mm"] if args.rim else []), "<verdict"]
    print("\n".join(text_table([heads, *rows])))
