"""Error of the faces against noise, number of views, their spread and the circles' radius, with the Cramér–Rao bound.

.venv/bin/python scripts/studies/noise_study.py [--seeds 20]

Labels are simulated, no pixels: 5184×3456 px, groups and designs as in Zhang & Wei (2017), from the true model. One
quantity at a time departs from the base (0.01 px, 10 images a group, 40°, the reference radii). σ of a centre falls
with the root of its rim's length, so that radii change the noise too. Prints, as Markdown, the RMS over seeds and faces
of the position and rotation errors, the Cramér–Rao bound of the position (the adjustment's covariance at the noise that
was put in, σ₀ = 1), and the position error of the uncorrected control (no eccentricity, chained), in the same labels.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from scripts.runner import executor_of, face_errors, row, script
from stcal.design import BoardDesign, TargetDesign, reference_board, reference_target
from stcal.geometry.rigid import Rigid, Similarity
from stcal.sfm.adjust.calibration import Calibration, calibrate
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.scene import Scene, SceneOptions, make_scene


@dataclass(frozen=True, slots=True)
class Point:
    """What is simulated: σ per axis of the centre of a circle of the reference radius, images of a group, spread of the
    views, radii over those of the reference designs."""

    noise_px: float = 0.01
    views: int = 10
    spread_deg: float = 40.0
    radius: float = 1.0


PANELS = {
    "noise_px": ("centring noise, px", (0.002, 0.005, 0.01, 0.02, 0.05)),
    "views": ("images in each group", (3, 5, 10, 20, 40)),
    "spread_deg": ("spread of the views, ±°", (15.0, 25.0, 40.0, 55.0)),
    "radius": ("radius over the reference", (0.5, 0.75, 1.0, 1.5)),
}


def designs(radius: float) -> tuple[TargetDesign, BoardDesign]:
    """The reference designs with other radii."""
    target, board = reference_target(), reference_board()
    faces = tuple(replace(face, radius_mm=radius * face.radius_mm) for face in target.faces)
    return replace(target, faces=faces), replace(board, radius_mm=radius * board.radius_mm)


def one_run(seed: int, point: Point) -> np.ndarray:
    """Mean squares over the faces but the reference: position error (µm²) and rotation error (mdeg²), bound and
    position error of the control (µm²)."""
    target, board = designs(point.radius)
    scene_options = SceneOptions(seed=seed, images_per_group=point.views, spread_deg=point.spread_deg)
    scene = make_scene(scene_options, target, board, reference_target().rough_poses())
    noise_px = point.noise_px / np.sqrt(point.radius)
    observations = observe(scene, noise_px, np.random.default_rng([seed, 41]))
    measured = [m.in_world(Similarity(1.0, Rigid())) for m in true_models(scene, observations)]
    radius = target.radius_of() | board.radius_of()
    corrected = [replace(m, shift_px=eccentricity_px(m, scene.camera, radius, 1.0)) for m in measured]
    ours, control = (
        calibrate([adjust(m, scene.camera) for m in models], scene.camera, target, board, options.adjustment(target))
        for models, options in ((corrected, RunOptions()), (measured, RunOptions(eccentricity=False)))
    )
    scale = (ours.sigma_factors.circles * ours.joint.sigma_scale) ** 2
    covariances = [c for face, c in ours.target.face_covariance.items() if face != ours.target.reference_face]
    bound = 1e6 * np.mean([np.trace(c[3:, 3:]) for c in covariances]) / scale
    return np.array([*squared_errors(ours, scene), bound, squared_errors(control, scene)[0]])


def squared_errors(calibration: Calibration, scene: Scene) -> np.ndarray:
    """Mean squares over the faces: position (µm²), rotation (mdeg²)."""
    off = np.array(list(face_errors(calibration.target, scene.target_from_face).values()))
    squares = 1e6 * (off**2).reshape(-1, 2, 3).sum(2).mean(0)
    return np.array([squares[1], squares[0] * np.degrees(1) ** 2])


@script(seeds=20, scheduler=str, limited=True)
def main(given) -> None:
    points = list(dict.fromkeys(Point(**{name: v}) for name, (_, values) in PANELS.items() for v in values))
    jobs = list(product(range(given.seeds), points))
    with executor_of(given.scheduler) as pool:
        answers = list(pool.map(one_run, *zip(*jobs, strict=True)))
    squares = np.reshape(answers, (given.seeds, len(points), 4))
    found = dict(zip(points, np.sqrt(squares.mean(0)), strict=True))
    print(f"Simulated labels, 5184×3456 px, {given.seeds} runs at each point, RMS over faces 2–5\n")
    titles = "position, µm", "bound, µm", "position / bound", "rotation, mdeg", "uncorrected, µm"
    print(f"| | | {' | '.join(titles)} |\n|{'---|' * 7}")
    for name, (title, values) in PANELS.items():
        for value in values:
            position, rotation, bound, control = found[Point(**{name: value})]
            figures = (f"{each:.2f}" for each in (position, bound, position / bound, rotation))
            row(title, f"{value:g}", *figures, f"{control:.1f}")
