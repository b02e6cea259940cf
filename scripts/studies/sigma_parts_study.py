"""Errors of circles over their σ: of centres in the images, of residuals, and of places by all images of a group.

    .venv/bin/python scripts/studies/sigma_parts_study.py [SET …] [--data FOLDER]

For each set of `../shared/data/stereo_target` (or of `stcal-sfm simulate`, with --data), JPEG and PNG where both exist:
mean squares over the centres' own variances of the faces' circles. `images`: centres against the truth; `residuals`: of
the free networks of the groups, over their redundancy; `places`: the place of each circle by the images of a group with
true cameras, against the truth. Without errors that the images of a circle share all three are 1.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np

from stcal.geometry.camera import Camera
from stcal.labels import CircleLabel
from stcal.report.text import text_table
from stcal.sfm.adjust.network import free_network
from stcal.sfm.pipeline import run
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.result import RunResult

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "stereo_target"
STEP_MM = 1e-3


def errors(result: RunResult, truth: dict) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares of centres and of places, each with its number of degrees of freedom, (2,)."""
    poses, true_px = {}, {}
    for group in truth["groups"].values():
        for name, image in group["images"].items():
            poses[Path(name).with_suffix("")] = np.array(image["camera_from_target"])
            true_px[Path(name).with_suffix("")] = {k: np.array(v["centre_px"]) for k, v in image["circles"].items()}
    images, parts = np.zeros(2), defaultdict(list)
    for solution in result.solutions:
        model = solution.model
        for i, p, centre, covariance in zip(
            model.image_index, model.point_index, model.corrected_px(), model.covariance_px2, strict=True
        ):
            label, name = model.labels[p], Path(model.images[i]).with_suffix("")
            if not isinstance(label, CircleLabel) or str(label) not in true_px[name]:
                continue
            error, weight = centre - true_px[name][str(label)], np.linalg.inv(covariance)
            images += [error @ weight @ error, 2]
            by_place = derivative(result.camera, poses[name], np.array(truth["circles"][str(label)]))
            parts[model.group, label].append((by_place.T @ weight @ by_place, by_place.T @ weight @ error))
    places = np.zeros(2)
    for own in parts.values():
        if len(own) > 1:
            normal, right = (np.sum(each, axis=0) for each in zip(*own, strict=True))
            places += [right @ np.linalg.solve(normal, right), 3]
    return images, places


def derivative(camera: Camera, camera_from_target: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Derivative (2, 3) of a point's projection by its place in the target frame, px/mm."""
    steps = xyz + STEP_MM * np.concatenate([np.eye(3), -np.eye(3)])
    seen = camera.project(steps @ camera_from_target[:3, :3].T + camera_from_target[:3, 3])
    return (seen[:3] - seen[3:]).T / (2 * STEP_MM)


def residuals(result: RunResult) -> np.ndarray:
    """Sum of the squares of the circles' residuals, and their redundancy, (2,)."""
    total = np.zeros(2)
    for solution in result.solutions:
        network = free_network(solution.model, result.camera)
        own = np.array([isinstance(label, CircleLabel) for label in solution.model.labels])[solution.model.point_index]
        total += [(network.residual[own] ** 2).sum(), network.redundancy[own].sum()]
    return total


def main() -> None:
    """The table of all sets, and their sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", default=["exact", "sample", "clean", "clutter", "focus"])
    parser.add_argument("--data", type=Path, default=DATA)
    args = parser.parse_args()
    rows, sums = [], np.zeros((3, 2))
    for name in args.sets:
        folder = args.data / name
        designs = {d: folder / f"{d}.toml" for d in ("target", "board") if (folder / f"{d}.toml").exists()}
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        for images in sorted(folder.glob("images*")):
            result = run(images, folder / "cameras.txt", options=RunOptions(workers=1), **designs)
            found = np.array([*errors(result, truth), residuals(result)])[[0, 2, 1]]
            sums += found
            form = " PNG" if images.name.endswith("png") else ""
            rows.append([name + form, *(f"{square / freedom:.2f}" for square, freedom in found)])
    rows.append(["all", *(f"{s / n:.3f} ± {np.sqrt(2 / n):.3f}" for s, n in sums)])
    print("\n".join(text_table([["<set", "images", "residuals", "places"], *rows])))


if __name__ == "__main__":
    main()
