"""Calibration of the target from models of the groups: scale, faces, chaining, joint adjustment; and its options."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, MappingError
from stcal.geometry.arrays import Brief, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.clusters import NOTED
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.io.toml import LEAST
from stcal.labels import CircleLabel, DotLabel, Label
from stcal.parallel import Progress, counted
from stcal.sfm.adjust import chain
from stcal.sfm.adjust.chain import CalibratedTarget, FaceInGroup, FrameKind
from stcal.sfm.adjust.equations import CIRCLES, UNKNOWN_SHAPES
from stcal.sfm.adjust.joint import EXACTLY, NEAR, SETTLED_PX, Adjusted, JointResult, adjusted
from stcal.sfm.adjust.refine import Scale, adjust, eccentricity_px, find_scale, free_network
from stcal.sfm.adjust.uncertainty import calibrated_target, centre_sigma_px, widened_result, with_scatter
from stcal.sfm.data.group_model import GroupModel, M, MetricModel, WorldModel

FLATNESS_MM = 0.02  # σ of the circles off the plane of their face where none is stated
MOST_FLATNESS_MM = 1e6
Solve = Literal["joint", "chain", "paper"]


@dataclass(frozen=True, slots=True)
class AdjustOptions:
    """Options of the adjustment of models to a calibrated target, with every default decided."""

    reference_face: str  # whose frame is the target frame
    solve: Solve = "joint"  # over all groups at once, chained over all ways, or as Zhang & Wei (2017)
    frame: FrameKind = "plane"  # Z from the plane of all circles of a face, or as in the paper
    eccentricity: bool = True
    flatness_mm: float | None = FLATNESS_MM  # σ of a circle about the plane of its face, None if it is unknown
    refine_camera: bool = False  # with the given intrinsics as observations

    def __post_init__(self):
        require_fields(self, "options")
        if self.flatness_mm is not None and not LEAST <= self.flatness_mm <= MOST_FLATNESS_MM:
            fault = f"a σ in mm, {LEAST:g} to {MOST_FLATNESS_MM:g} needed, or off"
            raise InputError("E-OPTION-RANGE", f"--flatness {self.flatness_mm:g}: {fault}")
        if self.solve == "paper" and (self.eccentricity or self.frame != "three-point"):
            fault = "--solve paper: three-point frames without eccentricity, as published"
            raise InputError("E-OPTION-CONFLICT", f"{fault}; leave frame out, or use chain")
        if self.refine_camera and self.solve != "joint":
            fault = f"--refine-camera: part of the joint adjustment, the solve is {self.solve}"
            raise InputError("E-OPTION-NEEDS", f"{fault}; use --solve joint")


MIN_REDUNDANCY = 30.0
"""Smallest redundancy of a kind of circle for a factor of its own; below, that of all circles holds. Of 30, a factor is
known to 13 %."""


@dataclass(frozen=True, slots=True)
class SigmaFactors:
    """Ratios of the residuals of the single groups to the centres' own σ, in all and by kind."""

    all: float
    circles: float
    dots: float
    printed: float = 1.0  # corners of the ``printed_faces``
    printed_faces: frozenset[str] = frozenset()

    @property
    def of_target(self) -> float:
        """Returns the factor for all points of the target: the larger one if it has circles and printed corners."""
        return max(self.circles, self.printed) if self.printed_faces else self.circles

    def kinds(self, labels: Sequence[Label]) -> np.ndarray:
        """Returns the kinds (n,) of points: 0 of circles, 1 of dots, 2 of printed corners."""
        return np.array(
            [1 if isinstance(label, DotLabel) else 2 * (label.face in self.printed_faces) for label in labels], int
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Calibration(Brief):
    """The calibrated target, and what it rests on."""

    target: CalibratedTarget
    scales: dict[str, Scale]  # by group
    faces: tuple[FaceInGroup, ...]  # of the single groups
    joint: JointResult | None
    sigma_factors: SigmaFactors
    models: tuple[MetricModel, ...]  # mm, target frame, without groups that are not linked to the result
    camera: Camera  # as refined
    notes: tuple[str, ...]  # faces without a frame and the reasons, and an adjustment that did not settle
    # of circles whose luminous surface is the result; empty: the visible outline
    rim_mm: Mapping[CircleLabel, float] = field(default_factory=dict)
    rim_sigma_mm: float = 0.0  # of all of them together
    circle_sigma_px: float | None = None  # of the target's points in the joint adjustment, RMS per axis

    def with_larger_sigma(self, factor: float) -> "Calibration":
        if self.joint is None or factor == 1:
            return self
        return replace(self, target=self.target.with_larger_sigma(factor), joint=self.joint.with_larger_sigma(factor))


def calibrate(
    models: Sequence[WorldModel],
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    options: AdjustOptions,
    prior: CameraPrior | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrates the target from the groups' models (lengths not yet in mm, eccentricity corrections settled).

    ``prior`` : intrinsics of the camera as observations, for options that refine them; ``progress`` : called with
    (``faces``, done, total) after the chain, each joint adjustment, and the covariances. ScaleError: a group's board is
    not mapped. MappingError: no face is mapped, or the reference face is not, or nothing is linked to it.
    ConvergenceError: there is no minimum.
    """
    published = options.solve == "paper"
    prior = prior if options.refine_camera else None
    # Eccentricity changes by nanometres between the first and the second; refined intrinsics take one more.
    joint_rounds = 0 if options.solve != "joint" else 2 + (prior is not None)
    step = counted(progress or (lambda *_: None), "faces", 1 + joint_rounds + (joint_rounds > 0))
    scales = {model.group: find_scale(model, board, published) for model in models}
    metric = [model.metric(scales[model.group].group_from_world()) for model in models]
    faces, notes = _faces(metric, camera, target, options)
    unlinked = chain.unlinked_faces(faces, options.reference_face)
    faces = [face for face in faces if face.face not in unlinked]
    why = f"left out, never linked to reference face {options.reference_face}"
    remedy = "add a group that shows it together with a face that is linked"
    notes += [f"face {face_id}: {why}; {remedy}" for face_id in unlinked]
    try:
        calibrated = chain.chain_faces(faces, target, options.reference_face, published)
    except MappingError as error:  # a face without a frame may be why
        raise MappingError(error.code, "; ".join([str(error), *notes])) from error
    factors = image_sigma_factors(models, camera, target.printed_ids())
    metric = [  # in the target frame, placed by its chain
        m.metric(calibrated.target_from_group[m.group] @ scales[m.group].group_from_world())
        for m in models
        if m.group in calibrated.target_from_group
    ]
    joint, circle_sigma_px = None, None
    step(None)
    if joint_rounds:
        state, factors = _adjust_all(metric, factors, camera, target, board, options, prior, joint_rounds, step)
        state = with_scatter(state, calibrated, target, options.frame)
        joint = widened_result(state)
        calibrated = calibrated_target(joint, calibrated, target, options.frame, state)
        circle_sigma_px = joint.sigma_scale * centre_sigma_px(state, CIRCLES)
        step(None)
        metric = [m.moved(calibrated.target_from_group[m.group]) for m in joint.models]
        camera = joint.camera
        move_px = f"{joint.last_move_px:.1g} px in the last step, less than {SETTLED_PX:g} px needed"
        remedy = "look at the checks for what contradicts the rest, take it out and run again"
        if not joint.settled:
            notes.append(f"joint adjustment: not settled, projections still moved by {move_px}; {remedy}")
        differ = f"photographs differ {state.differ:.1f} times more than their pixels explain"
        notes += [f"{differ}: σ are larger by that"] if state.differ > NOTED else []
    found = calibrated, scales, tuple(faces), joint, factors, tuple(metric), camera, tuple(notes)
    return Calibration(*found, circle_sigma_px=circle_sigma_px)


def calibrate_board(
    models: Sequence[WorldModel], camera: Camera, board: BoardDesign, options: AdjustOptions
) -> Calibration:
    """Returns the scale from models of the board alone, in its frame, without faces (Zhang & Wei 2017, §4.1)."""
    scales = {model.group: find_scale(model, board, options.solve == "paper") for model in models}
    target = CalibratedTarget(options.reference_face, {}, {}, {name: Rigid() for name in scales})
    metric = tuple(model.metric(scales[model.group].board_from_world) for model in models)
    return Calibration(target, scales, (), None, image_sigma_factors(models, camera), metric, camera, notes=())


def on_luminous_surface(
    calibration: Calibration,
    rim_mm: Mapping[CircleLabel, float],
    sigma_mm: float,
    target: TargetDesign,
    frame: FrameKind,
) -> Calibration:
    """Calibration with circles behind rims, which are seen half a height in front of their luminous surface."""
    joint = calibration.joint
    if joint is None:
        raise InputError("E-RIM-SOLVE", "rims are corrected by the joint adjustment alone; use --solve joint")
    seen, height = calibration.target, np.array([rim_mm.get(label, 0.0) for label in joint.labels])
    xyz = joint.xyz_model - 0.5 * height[:, None] * _outward(joint, seen.target_from_face)
    covariance = joint.covariance_mm2 + rim_covariance_mm2(joint, seen.target_from_face, rim_mm, sigma_mm)
    surface = calibrated_target(replace(joint, xyz_model=xyz, covariance_mm2=covariance), seen, target, frame)
    surface = replace(surface, position_sources_mm=seen.position_sources_mm)
    models = tuple(m.moved(surface.target_from_group[m.group]) for m in joint.models)
    return replace(calibration, target=surface, models=models, rim_mm=dict(rim_mm), rim_sigma_mm=sigma_mm)


def rim_covariance_mm2(
    joint: JointResult, target_from_face: Mapping[str, Rigid], rim_mm: Mapping[CircleLabel, float], sigma_mm: float
) -> np.ndarray:
    """Returns the covariance (3c, 3c) of the circles from σ of the heights of all rims together."""
    behind = np.array([rim_mm.get(label, 0.0) != 0 for label in joint.labels])
    common = (-0.5 * sigma_mm * behind[:, None] * _outward(joint, target_from_face)).ravel()
    return np.outer(common, common)


def _outward(joint: JointResult, target_from_face: Mapping[str, Rigid]) -> np.ndarray:
    """Outward normals of the circles' faces, (c, 3), in the frame of the adjustment; zero without a pose."""
    outward = np.zeros_like(joint.xyz_model)
    for face, pose in target_from_face.items():
        members = [i for i, label in enumerate(joint.labels) if label.face == face]
        outward[members] = fit_plane(joint.xyz_model[members], pose.rotation[:, 2]).normal
    return outward


def _faces(
    models: Sequence[MetricModel], camera: Camera, target: TargetDesign, options: AdjustOptions
) -> tuple[list[FaceInGroup], list[str]]:
    """Returns the frames of the faces in all groups, frame circles that one lacks placed by others, and notes."""
    results = [chain.faces_of_group(model, camera, target, options.frame) for model in models]
    places: dict[str, dict[str, list[np.ndarray]]] = {}
    for face in (face for group_faces, _ in results for face in group_faces):
        for label, xyz in zip(face.labels, face.xyz_face, strict=True):
            places.setdefault(face.face, {}).setdefault(label.circle, []).append(xyz)
    known = {face: {c: np.mean(xyz, axis=0) for c, xyz in centres.items()} for face, centres in places.items()}
    if any(notes for _, notes in results):
        design = {face.id: dict(zip(face.ids, face.places_mm(face.ids), strict=True)) for face in target.faces}
        results = [chain.faces_of_group(model, camera, target, options.frame, design | known) for model in models]
    faces, notes = ([each for parts in of_kind for each in parts] for of_kind in zip(*results, strict=True))
    mapped = {label for model in models for label in model.labels}
    for face in (target.face(face_id) for face_id in sorted({each.face for each in faces} - known.keys())):
        if unseen := chain.unmapped(face, [label.circle for label in face.labels() if label in mapped]):
            names = ", ".join(f"{face.id}:{circle}" for circle in unseen)
            place = "it stands where the design has it, and σ carries how far circles are off the design"
            notes.append(f"face {face.id}: frame circle {names} not mapped; {place}")
    return faces, notes


def _adjust_all(
    models: list[MetricModel], factors: SigmaFactors, camera: Camera, target, board, options, prior, rounds: int, step
) -> tuple[Adjusted, SigmaFactors]:
    """Runs joint adjustments, eccentricity new before each; returns the last state and factors on the centres' σ."""
    radius = target.radius_of() | board.radius_of()
    covariances = [m.covariance_px2 for m in models]
    current, shape_factors = camera, UNKNOWN_SHAPES
    for last in [False] * (rounds - 1) + [True]:
        if options.eccentricity:
            models = [replace(m, shift_px=eccentricity_px(m, current, radius, 1.0)) for m in models]
        models = [with_sigma(replace(m, covariance_px2=c), factors) for m, c in zip(models, covariances, strict=True)]
        settled = EXACTLY if last else NEAR
        state = adjusted(models, board, camera, options.flatness_mm, prior, current, None, shape_factors, settled)
        shape_factors, models, current = state.setting.factors, state.models, state.camera
        step(None)
        if prior is not None:
            unscaled = [replace(m, covariance_px2=c) for m, c in zip(models, covariances, strict=True)]
            factors = image_sigma_factors([adjust(m, current) for m in unscaled], current, target.printed_ids())
    return state, factors


def image_sigma_factors(models: Sequence[GroupModel], camera: Camera, printed: Iterable[str] = ()) -> SigmaFactors:
    """Returns the ratios of the residuals of free networks to the centres' own σ: variance components (Förstner 1979).
    Those of circles and of ``printed`` faces are at least 1: their σ include errors that residuals do not show."""
    start = SigmaFactors(1.0, 1.0, 1.0, 1.0, frozenset(printed))
    square, redundancy = np.zeros(3), np.zeros(3)
    for model in models:
        network = free_network(model, camera)
        kind = start.kinds(model.labels)[model.point_index]
        square += np.bincount(kind, (network.residual**2).sum(1), minlength=3)
        redundancy += np.bincount(kind, network.redundancy, minlength=3)
    if redundancy.sum() <= 0:
        return start
    overall = float(np.sqrt(square.sum() / redundancy.sum()))
    circles, dots, corners = (
        float(np.sqrt(s / r)) if r >= MIN_REDUNDANCY else overall for s, r in zip(square, redundancy, strict=True)
    )
    circles, corners = max(circles, 1.0), max(corners, 1.0)
    if start.printed_faces and redundancy[0] < MIN_REDUNDANCY:  # hardly a circle: that of the corners
        circles = corners
    return replace(start, all=overall, circles=circles, dots=dots, printed=corners)


def with_sigma(model: M, factors: SigmaFactors) -> M:
    """Returns the model with the σ of its observations multiplied by the factor of their kind."""
    of_kind = np.array([factors.circles, factors.dots, factors.printed])
    factor = of_kind[factors.kinds(model.labels)[model.point_index]]
    return replace(model, covariance_px2=factor[:, None, None] ** 2 * model.covariance_px2)
