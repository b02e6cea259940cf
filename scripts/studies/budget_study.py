"""Whether the uncertainty budget is true: its σ against the spread of simulated calibrations, each input alone and all.

.venv/bin/python scripts/studies/budget_study.py [--runs 200] [--only NAME]

One target, one board, one set of views; in each simulated calibration the inputs err anew by the σ that are stated of
them. Simulated are the centres of circles and dots, not pixels, and the adjustment starts at the truth: what detection
and mapping add is not in it. The budget is that of one further simulated calibration, with all inputs erring.

Alone: one input errs, and the weights of the adjustment are those of the budget. All together: every input errs, and
the whole of ``calibrate`` follows, with σ of the centres, the board's common share and Huber's weights found anew.
Temperatures and expansion are corrected for as the budget says. Inputs that are single numbers are drawn stratified
(Latin hypercube), so that their own spread is what is stated.

Printed for positions and rotations of the faces and the longest distances: budget over RMS error, over all of them
(each error over its σ first), with its least and largest value for one of them, and for all inputs together the share
of errors within U = 2 u, beside the share that the budget states.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from scripts.runner import executor_of, head, row, script
from stcal.design import StatedSize, reference_board
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Rigid, Similarity, align_rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.labels import CircleLabel
from stcal.sfm.adjust.calibration import SigmaFactors, calibrate, with_sigma
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.joint import JointResult, adjusted
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.sfm.adjust.uncertainty import contributions_of, derivatives
from stcal.sfm.budget.combine import FIELDS, Budget, Statement, budget, conditions_of, sources_of
from stcal.sfm.data.group_model import MetricModel
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.scene import Scene, SceneOptions, make_scene

GROUPS = ("1", "2"), ("1", "4"), ("1", "5")
NOISE_PX = 0.02
BOARD_SIGMA_MM = 0.005
ONE_PLATE = 0.99
"""Share of the board's variance that its one plate has in all groups."""
CAMERA_SIGMA = np.array([0.3, 0.3, 0.2, 0.2, 1e-4, 4e-4, 1e-5, 1e-5])
"""σ of fx, fy, cx, cy (px), k1, k2, p1, p2 that the camera file states."""
BOARD = StatedSize(10.0, 8.5, 1.5, 24.0, 1.0, 20.0)
TARGET = StatedSize(None, 23.0, 1.5, 23.0, 0.6, 20.0)
SINGLE = ("board_pitch", "board_temperature", "board_expansion", "target_temperature", "target_expansion")
ALONE = ("circle_centres", "dot_centres", "board_dots", "flatness", "intrinsics", *SINGLE)
ALL = "all"
LEAST = 0.01
"""Contributions below this share of u are not compared: a change of scale turns no face."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """``truth`` : models without noise, mm, target frame; ``refined`` : whether the intrinsics are adjusted."""

    scene: Scene
    truth: tuple[MetricModel, ...]
    statement: Statement
    refined: bool

    @property
    def camera(self) -> Camera:
        """With what its file states."""
        return replace(self.scene.camera, covariance=np.diag(CAMERA_SIGMA**2))

    @property
    def prior(self) -> CameraPrior | None:
        return CameraPrior(self.camera.colmap_model, np.diag(CAMERA_SIGMA**2)) if self.refined else None

    @property
    def board(self):
        return replace(self.scene.board, sigma_mm=BOARD_SIGMA_MM)

    @property
    def flatness_mm(self) -> float:
        return float(RunOptions().flatness_mm or 0.0)


def case_of(refined: bool, images: int = 6) -> Case:
    """The reference target exactly as designed, and a board of its size with fewer dots, which saves time."""
    options = SceneOptions(
        seed=1, width=2592, height=1728, images_per_group=images, groups=GROUPS, circle_sigma_mm=0.0, centre_sigma=0.0
    )
    board = replace(reference_board(), rows=5, columns=7, pitch_mm=40.0, sigma_mm=0.0)
    scene = make_scene(options, None, board)
    models = true_models(scene, observe(scene, NOISE_PX, np.random.default_rng(0)))
    origin = {(body, key): "study" for body in ("board", "target") for key in StatedSize.__dataclass_fields__}
    return Case(scene, tuple(models), Statement(BOARD, TARGET, origin, dict.fromkeys(FIELDS, "")), refined)


def stratified(count: int, rng: np.random.Generator) -> np.ndarray:
    """Normal numbers, one of each of ``count`` parts of equal probability, in any order."""
    return norm.ppf((rng.permutation(count) + rng.random(count)) / count)


def single_inputs(seed: int, count: int) -> np.ndarray:
    """Standard normal numbers of the single inputs and the intrinsics, (count, 5 + 8)."""
    rng = np.random.default_rng([seed, 5])
    return np.column_stack([stratified(count, rng) for _ in range(len(SINGLE) + len(CAMERA_SIGMA))])


def drawn(
    case: Case, which: str, single: np.ndarray, rng: np.random.Generator, common: float = ONE_PLATE
) -> tuple[list[MetricModel], dict[CircleLabel, np.ndarray]]:
    """Models as photographed in a simulated calibration, with their true circles (at the reference temperature) by
    label; ``single`` : of :func:`single_inputs`; ``common`` : share of the board's variance that all groups have."""
    on = set(ALONE) if which == ALL else {which}
    unit = dict(zip(SINGLE, single, strict=False))
    off = {key: unit[key] if key in on else 0.0 for key in SINGLE}
    grown = {}
    for body, stated in (("board", BOARD), ("target", TARGET)):
        warmer = stated.temperature_c + off[f"{body}_temperature"] * stated.temperature_sigma_k - 20.0
        rate = stated.expansion_ppm_per_k + off[f"{body}_expansion"] * stated.expansion_sigma_ppm_per_k
        grown[body] = 1e-6 * warmer * rate
    pitch = 1 + 1e-6 * BOARD.pitch_sigma_ppm * off["board_pitch"]
    camera = case.scene.camera
    if "intrinsics" in on:
        basis = intrinsic_basis(camera.colmap_model)
        camera = camera.with_parameters(camera.parameters() + basis @ (CAMERA_SIGMA * single[len(SINGLE) :]))
    circles = {label: np.array(xyz) for label, xyz in case.scene.circles_target.items()}
    if "flatness" in on:
        for label in circles:
            normal = case.scene.target_from_face[label.face].rotation[:, 2]
            circles[label] = circles[label] + case.flatness_mm * rng.standard_normal() * normal
    dots = case.scene.board.labels()
    own, plate = (np.sqrt(share) * BOARD_SIGMA_MM * ("board_dots" in on) for share in (1 - common, common))
    plate = plate * rng.standard_normal((len(dots), 3))
    radius = case.scene.target.radius_of() | case.scene.board.radius_of()
    models = []
    for model in case.truth:
        target_from_board = case.scene.groups[model.group].target_from_board
        places = np.column_stack([case.scene.board.xy_mm(), np.zeros(len(dots))]) * pitch * (1 + grown["board"])
        places = target_from_board @ (places + plate + own * rng.standard_normal(plate.shape))
        now = dict(zip(dots, places, strict=True)) | {k: xyz * (1 + grown["target"]) for k, xyz in circles.items()}
        seen = replace(model, xyz_model=np.array([now[label] for label in model.labels]))
        shift = eccentricity_px(seen, camera, radius, 1.0)
        of = {True: "dot_centres" in on, False: "circle_centres" in on}
        noisy = np.array([of[label.plane == "board"] for label in seen.labels])[seen.point_index]
        noise = NOISE_PX * noisy[:, None] * rng.standard_normal(shift.shape)
        measured = camera.project(seen.xyz_camera()) + shift + noise
        models.append(replace(seen, measured_px=measured, shift_px=shift))
    return models, circles


def whole(
    case: Case, drawn: list[MetricModel]
) -> tuple[JointResult, list[MetricModel], SigmaFactors, CalibratedTarget]:
    """``calibrate`` as in a run: joint adjustment, its models, the factors on σ of the centres, the start."""
    models = [adjust(m, case.camera).in_world(Similarity(1.0, Rigid())) for m in drawn]
    options = RunOptions(refine_camera=case.refined).adjustment(case.scene.target)
    result = calibrate(models, case.camera, case.scene.target, case.board, options, case.prior)
    return result.joint, list(result.models), result.sigma_factors, result.target


@dataclass(frozen=True, slots=True, eq=False)
class Stated:
    """Statements of one calibration: ``factors`` on σ of the centres, the board's ``common`` share, ``budget``."""

    factors: SigmaFactors
    common: float
    budget: Budget


def stated_by(case: Case) -> Stated:
    """Of one simulated calibration in which all inputs err."""
    photographed, _ = drawn(case, ALL, single_inputs(99, 40)[7], np.random.default_rng(99))
    _, models, factors, start = whole(case, photographed)
    start = replace(start, target_from_group=dict.fromkeys(start.target_from_group, Rigid()))
    state = adjusted(models, case.board, case.camera, case.flatness_mm, case.prior)
    found = contributions_of(state)
    own = derivatives(found.joint, start, case.scene.target, "plane")
    sources = sources_of(found, case.camera, case.board, case.flatness_mm, case.refined, case.statement)
    rows = budget(found.joint, own, sources, case.board, case.statement, start.reference_face)
    return Stated(factors, found.joint.board_common, rows)


def errors(
    case: Case, stated: Stated, which: str, single: np.ndarray, seed: int, common: float = ONE_PLATE
) -> list[np.ndarray]:
    """Error (r,) of each measurand of the budget in one simulated calibration, µm and mdeg; arguments as of
    :func:`drawn`."""
    models, circles = drawn(case, which, single, np.random.default_rng([seed, 11]), common)
    if which == ALL:
        joint = whole(case, models)[0]
    else:
        weighed = [with_sigma(m, stated.factors) for m in models]
        camera: Camera = case.camera
        joint = adjusted(weighed, case.board, camera, case.flatness_mm, case.prior, common=stated.common).result()
    true = np.array([circles[label] for label in joint.labels])
    xyz = joint.xyz_model * (1 + conditions_of(case.statement, case.board).correction)
    away = align_rigid(true, xyz) @ xyz - true  # moved as one: derivatives are for small moves
    return [each.unit * each.jacobian @ away.ravel() for each, _ in stated.budget.rows]


def study(case: Case, which: str, count: int, pool) -> tuple[tuple[float, float, float], float, float]:
    """Budget over spread in ``count`` simulated calibrations: of all measurands, and the least and largest of one; the
    share of errors within U, and as the budget has it."""
    stated, inputs = stated_by(case), list(single_inputs(1, count))
    rows = list(pool(errors, [case] * count, [stated] * count, [which] * count, inputs, range(count)))
    shares, inside = [], []
    for k, (_, own) in enumerate(stated.budget.rows):
        length = np.array([np.linalg.norm(each[k]) for each in rows])
        predicted = own.standard if which == ALL else own.contributions[which]
        inside.append((length <= own.expanded).mean())
        if predicted > LEAST * own.standard:
            shares.append((length**2).mean() / predicted**2)
    expected = np.mean([own.coverage for _, own in stated.budget.rows])
    single = 1 / np.sqrt(shares)
    return (1 / np.sqrt(np.mean(shares)), single.min(), single.max()), np.mean(inside), expected


@script(runs=200, only="", scheduler=str, limited=True)
def main(given) -> None:
    fixed, refined = case_of(False), case_of(True)
    said = f"3 groups of 6 images, 2592×1728 px, {NOISE_PX} px (simulated centres)"
    print(f"{given.runs} simulated calibrations a row, {said}\n")
    head("erring", "budget / spread", "least", "largest", "within U, %", "stated, %")
    rows = [(which, fixed, which.replace("_", " ")) for which in (*ALONE, ALL)]
    rows += [("intrinsics", refined, "intrinsics, adjusted"), (ALL, refined, "all, intrinsics adjusted")]
    with executor_of(given.scheduler) as pool:
        for which, case, title in rows:
            if given.only in ("", which):
                ratio, *covered = study(case, which, given.runs, pool.map)
                covered = [f"{100 * share:.1f}" if which == ALL else "–" for share in covered]
                row(title, *(f"{each:.3f}" for each in ratio), *covered)
