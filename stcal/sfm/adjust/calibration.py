"""From the models of the groups to the calibrated target: scale, faces, chaining, joint adjustment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import MappingError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraPrior
from stcal.parallel import Progress, counted
from stcal.sfm.adjust.chain import CalibratedTarget, chain_faces, chain_singly, unlinked_faces
from stcal.sfm.adjust.faces import FaceInGroup, faces_of_group, missing_frame_circles
from stcal.sfm.adjust.group import adjust
from stcal.sfm.adjust.joint import SETTLED_PX, JointResult, adjust_jointly
from stcal.sfm.adjust.options import AdjustOptions
from stcal.sfm.adjust.refine import eccentricity_px
from stcal.sfm.adjust.scale import Scale, find_scale
from stcal.sfm.adjust.uncertainty import calibrated_target
from stcal.sfm.data.model import GroupModel, M, MetricModel, WorldModel

JOINT_ROUNDS = 2
"""Eccentricity moves by nanometres between the first and the second joint adjustment."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """``target`` is the answer; ``scales`` by group; ``faces`` of the single groups; ``joint`` where it was asked for;
    ``sigma_factor`` : by how much residuals of the single groups exceed the centres' own σ; ``models`` : those that
    the answer rests on, mm, target frame, groups that are not linked to it absent; ``camera`` : as refined where it
    was, else as given; ``notes`` : faces without a frame, and why; an adjustment that did not settle."""

    target: CalibratedTarget
    scales: dict[str, Scale]
    faces: tuple[FaceInGroup, ...]
    joint: JointResult | None
    sigma_factor: float
    models: tuple[MetricModel, ...]
    camera: Camera
    notes: tuple[str, ...]


def calibrate(
    models: Sequence[WorldModel],
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    options: AdjustOptions,
    prior: CameraPrior | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the target from the groups' models (worlds without unit, corrections settled).

    ``prior`` : the camera's intrinsics as observations, for options that refine them; ``progress`` : called with
    (``faces``, done, total) after the chain, each joint adjustment, and the covariances.

    Raises
    ------
    ScaleError
        A group's board is not mapped.
    MappingError
        No face is, or the reference face is not, or a face is not linked to it.
    ConvergenceError
        The adjustment finds no minimum.
    """
    published, joint_rounds = options.solve == "paper", _joint_rounds(options, prior)
    step = counted(progress or (lambda *_: None), "faces", 1 + joint_rounds + (joint_rounds > 0))
    scales = {model.group: find_scale(model, board, published) for model in models}
    metric = [model.metric(scales[model.group].group_from_world()) for model in models]
    faces, notes = _faces(metric, camera, target, options)
    gone = unlinked_faces(faces, options.reference_face)
    faces = [each for each in faces if each.face not in gone]
    notes += [
        f"face {face_id}: left out, never linked to reference face {options.reference_face}; add a group that shows it "
        "together with a face that is linked"
        for face_id in gone
    ]
    try:
        calibrated = (chain_singly if published else chain_faces)(faces, target, options.reference_face)
    except MappingError as error:  # a face without a frame may be why
        raise MappingError(error.code, "; ".join([str(error), *notes])) from error
    factor = image_sigma_factor(models, camera)
    metric = [_placed(m, scales[m.group], calibrated) for m in models if m.group in calibrated.target_from_group]
    joint = None
    step(None)
    if joint_rounds:
        joint, factor = _adjust_all(metric, factor, camera, target, board, options, prior, step)
        calibrated = calibrated_target(joint, calibrated, target, options.frame)
        step(None)
        metric = [m.moved(calibrated.target_from_group[m.group]) for m in joint.models]
        camera = joint.camera
        notes += _unsettled(joint)
    return Calibration(
        target=calibrated,
        scales=scales,
        faces=tuple(faces),
        joint=joint,
        sigma_factor=factor,
        models=tuple(metric),
        camera=camera,
        notes=tuple(notes),
    )


def calibrate_board(
    models: Sequence[WorldModel], camera: Camera, board: BoardDesign, options: AdjustOptions
) -> Calibration:
    """Scale from models of the board alone: a target without faces, the models in the board's frame. Zhang & Wei
    (2017), §4.1.

    Raises
    ------
    ScaleError
        A group's board is not mapped.
    """
    scales = {model.group: find_scale(model, board, options.solve == "paper") for model in models}
    return Calibration(
        target=CalibratedTarget(options.reference_face, {}, {}, {name: Rigid() for name in scales}),
        scales=scales,
        faces=(),
        joint=None,
        sigma_factor=image_sigma_factor(models, camera),
        models=tuple(model.metric(scales[model.group].board_from_world) for model in models),
        camera=camera,
        notes=(),
    )


def _faces(
    models: Sequence[MetricModel], camera: Camera, target: TargetDesign, options: AdjustOptions
) -> tuple[list[FaceInGroup], list[str]]:
    """Frames of the faces in all groups, and notes. Frame circles that a group does not map are placed by the face's
    others: as other groups have them, or, where no group maps all three, as the design has them. (The joint adjustment
    starts from there, and takes them from all groups.)"""
    own = [faces_of_group(model, camera, target, options.frame) for model in models]
    whole = _circles_of([face for found, _ in own for face in found])
    if any(notes for _, notes in own):
        known = {face.id: whole.get(face.id) for face in target.faces}
        own = [faces_of_group(model, camera, target, options.frame, known) for model in models]
    notes = [note for _, more in own for note in more]
    mapped = {label for m in models for label in m.labels}
    for face_id in sorted({face.face for found, _ in own for face in found} - whole.keys()):
        face = target.face(face_id)
        unseen = missing_frame_circles(face, {x.circle for x in face.labels() if x in mapped})
        if unseen:
            notes.append(
                f"face {face_id}: frame circle {', '.join(f'{face_id}:{c}' for c in unseen)} not mapped; it stands "
                "where the design has it against the face's other circles, and σ carries how far circles are off the "
                "design"
            )
    return [face for found, _ in own for face in found], notes


def _circles_of(faces: Sequence[FaceInGroup]) -> dict[str, dict[str, np.ndarray]]:
    """Circles (3,) in their face's frame by face and id, means over the groups."""
    places: dict[str, dict[str, list[np.ndarray]]] = {}
    for each in faces:
        for label, xyz in zip(each.labels, each.xyz_face, strict=True):
            places.setdefault(each.face, {}).setdefault(label.circle, []).append(xyz)
    return {face_id: {c: np.mean(xyz, axis=0) for c, xyz in own.items()} for face_id, own in places.items()}


def _placed(model: WorldModel, scale: Scale, start: CalibratedTarget) -> MetricModel:
    """The model in mm in the target frame, by its chain."""
    return model.metric(start.target_from_group[model.group] @ scale.group_from_world())


def _unsettled(joint: JointResult) -> list[str]:
    """What is to be said of an adjustment that stopped on the way."""
    if joint.settled:
        return []
    return [
        f"joint adjustment: not settled, projections still moved by {joint.last_move_px:.1g} px in the last step, less "
        f"than {SETTLED_PX:g} px needed; look at the checks for what contradicts the rest, take it out and run again"
    ]


def _joint_rounds(options: AdjustOptions, prior: CameraPrior | None) -> int:
    """How many joint adjustments are made; refined intrinsics want one more."""
    return 0 if options.solve != "joint" else JOINT_ROUNDS + (options.refine_camera and prior is not None)


def _adjust_all(
    models: list[MetricModel], factor: float, camera: Camera, target, board, options: AdjustOptions, prior, step
) -> tuple[JointResult, float]:
    """The joint adjustment from the chained result, and the factor on the centres' σ; eccentricity follows, and with
    refined intrinsics that factor too: a wrong camera makes residuals of its own."""
    radius = target.radius_of() | board.radius_of()
    own = [m.covariance_px2 for m in models]
    rounds = _joint_rounds(options, prior)
    prior = prior if options.refine_camera else None
    current = camera
    for _ in range(rounds):
        if options.eccentricity:
            models = [replace(m, shift_px=eccentricity_px(m, current, radius, 1.0)) for m in models]
        models = [replace(m, covariance_px2=factor**2 * c) for m, c in zip(models, own, strict=True)]
        result = adjust_jointly(models, board, camera, options.flatness_mm, prior, current)
        models, current = list(result.models), result.camera
        step(None)
        if prior is not None:
            plain = [replace(m, covariance_px2=c) for m, c in zip(models, own, strict=True)]
            factor = image_sigma_factor([adjust(m, current) for m in plain], current)
    return result, factor


def image_sigma_factor(models: Sequence[GroupModel], camera: Camera) -> float:
    """How much larger the residuals of free networks are than the centres' own σ (one variance component)."""
    square = sum(float((m.whiten(m.residuals_px(camera)) ** 2).sum()) for m in models)
    redundancy = sum(2 * len(m.image_index) - 6 * len(m.images) - 3 * len(m.labels) + 7 for m in models)
    return float(np.sqrt(square / redundancy)) if redundancy > 0 else 1.0


def with_sigma(model: M, factor: float) -> M:
    """The model with its observations' σ scaled."""
    return replace(model, covariance_px2=factor**2 * model.covariance_px2)
