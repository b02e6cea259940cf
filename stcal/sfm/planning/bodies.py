"""Forecast of photographs of a body with boards or tags on its faces, which is turned before a camera; no board."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np

from stcal.design import (
    BoardDesign,
    KnownDistance,
    ScaleReference,
    TargetDesign,
    reference_board,
    scale_reference,
)
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import camera_prior, refinable
from stcal.io.cameras.read import camera_model
from stcal.labels import CircleLabel, Label
from stcal.parallel import one_thread
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.scale import with_edge_sigma
from stcal.sfm.data.model import ImageObservations, MetricModel
from stcal.sfm.mapping.models import assemble
from stcal.sfm.mapping.placed import unknown_lens
from stcal.sfm.planning.forecast import CentreNoise, Forecast, Setup, forecast, nominal_poses
from stcal.sfm.planning.session import NEARER, Plan, PlanOptions, Remedy, plan_as_asked, plan_with_board, remedy
from stcal.sfm.planning.views import ROLLS_DEG, PlannedView, angle_deg, axes_of, looking_at, single, tilt_deg
from stcal.synthetic.body import BodyOptions, BodyScene, body_camera, make_body_scene

GROUP = "."
DISTANCE_SIGMA_MM = 0.02
"""σ of a distance that is measured with a caliper, as a remedy."""
LEAST_COSINE = -0.2
"""Smallest cosine of the angle between two faces that one view is to show."""
MAX_TILT_DEG = 60.0
"""Largest tilt of a face whose corners count as seen."""


@require_arguments
def plan(
    options: PlanOptions,
    target: TargetDesign,
    board: BoardDesign | None = None,
    nominal: Mapping[str, Rigid] | str | Path | None = None,
) -> Plan:
    """Returns the forecast of a plan.

    The geometry is nominal. Board and cameras stand where a simulated session would have them; a body with boards or
    tags on its faces is turned before a camera, without a board.

    Parameters
    ----------
    options : PlanOptions
        Images, camera, groups and noise.
    target : TargetDesign
        Design of the target, drawing frame of each face, mm.
    board : BoardDesign, optional
        Board with its σ, mm; the reference board if None. There must be none beside a body with boards or tags.
    nominal : dict of Rigid, or path, optional
        Pose of every face in one common frame, mm, by face id, or ``faces.json`` of an earlier run; the rough poses of
        the design if None.

    Returns
    -------
    Plan
        σ to expect of every face against the reference face, mm and rad, their sources, and what would help most.

    Raises
    ------
    InputError
        If a face has no nominal pose, a group names an unknown face, a board or groups are given for a body with boards
        or tags, or there are more dots than ``MAX_DOTS`` or ``MAX_CENTRES``.
    DegenerateError
        If a group cannot be photographed as planned.
    """
    printed = bool(target.with_faces(printed=True).faces)
    if printed and (unfit := [n for n, v in {"--groups": options.groups, "--board": board}.items() if v]):
        raise InputError(
            "E-OPTION-CONFLICT", f"{unfit[0]}: not for a body with boards or tags on its faces; leave it out"
        )
    poses = dict(nominal) if isinstance(nominal, Mapping) else nominal_poses(target, nominal)
    if printed:
        return plan_body(options, target, poses)
    return plan_with_board(options, target, reference_board() if board is None else board, poses)


@one_thread()
def plan_body(options: PlanOptions, target: TargetDesign, nominal: dict[str, Rigid]) -> Plan:
    """Returns the forecast of photographs of a body in random poses, each of which shows two faces at least."""
    placed = replace(
        target, faces=tuple(replace(face, rough_target_from_face=nominal[face.id]) for face in target.faces)
    )
    scene, model, setup = planned_photographs(options, placed)
    now = plan_as_asked(options, setup, [model], "print and size of half the σ")
    measured = forecast([model], _with_distance(setup, model), now.forecast.derivatives)
    remedies = (
        remedy("twice the images", _forecast, replace(options, images=2 * options.images), placed),
        *now.remedies,
        Remedy(f"a distance known to {1e3 * DISTANCE_SIGMA_MM:g} µm", measured.worst()[1]),
        remedy("nearer by 20 %", _forecast, replace(options, distance_mm=NEARER * options.distance_mm), placed),
    )
    return replace(now, remedies=remedies, hardly_seen=scene.hardly_seen())


def _with_distance(setup: Setup, model: MetricModel) -> Setup:
    """Returns the setup with the distance of two corners known, those that are farthest apart."""
    away = np.linalg.norm(model.xyz_model[:, None] - model.xyz_model, axis=2)
    one, two = (model.labels[i] for i in np.unravel_index(int(away.argmax()), away.shape))
    assert isinstance(setup.board, ScaleReference)
    assert isinstance(one, CircleLabel)
    assert isinstance(two, CircleLabel)
    known = KnownDistance(one, two, float(away.max()), DISTANCE_SIGMA_MM)
    return replace(setup, board=replace(setup.board, distances=(*setup.board.distances, known)))


def _forecast(options: PlanOptions, target: TargetDesign) -> Forecast:
    _, model, setup = planned_photographs(options, target)
    return forecast([model], setup)


def planned_photographs(options: PlanOptions, target: TargetDesign) -> tuple[BodyScene, MetricModel, Setup]:
    """Returns the photographs of a plan: scene, model with the σ of its corners, and input of a forecast."""
    file = None if options.camera is None else camera_model(options.camera)
    camera = body_camera(options.width) if file is None else file.calibrated(0, 0)
    shape = BodyOptions(options.images, options.distance_mm, seed=options.seed, pose_sigma_mm=0, pose_sigma_deg=0)
    scene = make_body_scene(target, camera, shape)
    run = options.run.adjustment(target)
    images, place = corners_seen(scene, options.noise.corner_px)
    xyz: dict[Label, np.ndarray] = {**place}
    model = assemble(MetricModel, GROUP, images, list(scene.camera_from_target), xyz)
    faces = {label.face for label in model.labels if isinstance(label, CircleLabel)}
    if unseen := [face.id for face in target.faces if face.id not in faces]:
        raise InputError(
            "E-PLAN-UNLINKED",
            f"plan: {options.images} images of which fewer than two show face {unseen[0]}; plan more images",
        )
    start = CalibratedTarget(run.reference_face, scene.target_from_face, place, {GROUP: Rigid()})
    prior = camera_prior(unknown_lens(camera)) if file is None else None
    if file is not None and run.refine_camera:
        prior = camera_prior(refinable(camera))
    size = with_edge_sigma(scale_reference(None, target), images)
    return scene, model, Setup(target, size, camera, start, run.frame, run.flatness_mm, prior, 0)


def corners_seen(scene: BodyScene, sigma_px: float) -> tuple[list[ImageObservations], dict[CircleLabel, np.ndarray]]:
    """Returns exact corners with this σ of the faces that two photographs show, and their places, (3,) mm by label."""
    shown = [scene.faces_in_view(image) for image in range(len(scene.camera_from_target))]
    often = Counter(face.id for faces in shown for face in faces)
    images: list[ImageObservations] = []
    place: dict[CircleLabel, np.ndarray] = {}
    for i, (faces, pose) in enumerate(zip(shown, scene.camera_from_target, strict=True)):
        own = {
            label: xyz
            for face in faces
            if often[face.id] > 1
            for label, xyz in zip(
                face.labels(), scene.target_from_face[face.id] @ face.places_mm(face.ids), strict=True
            )
        }
        xy, n = scene.camera.project(pose @ np.array(list(own.values())).reshape(-1, 3)), len(own)
        covariance = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
        images.append(ImageObservations(f"{i:04d}", GROUP, tuple(own), xy, xy, np.zeros((n, 2, 2)), covariance))
        place |= own
    return images, place


SHARES = (0.35, 0.5, 0.65)
"""Where candidates stand between the normals of two faces."""


def body_views(model: MetricModel, setup: Setup, noise: CentreNoise) -> list[PlannedView]:
    """Returns candidates, each with two faces that one view can show, as a motion from the nearest photograph."""
    target_from_face = setup.start.target_from_face
    faces = [face for face in setup.target.faces if face.id in target_from_face]
    normals = {face.id: face.outward * target_from_face[face.id].rotation[:, 2] for face in faces}
    middles = {face.id: target_from_face[face.id] @ np.append(face.xy_mm.mean(0), 0.0) for face in faces}
    centre = (model.xyz_model.min(0) + model.xyz_model.max(0)) / 2
    towards = np.array([pose.inverse().translation for pose in model.camera_from_model]) - centre
    away = np.linalg.norm(towards, axis=1)
    distance = float(np.median(away))
    views = []
    for (one, two), share, roll in product(combinations(normals, 2), SHARES, ROLLS_DEG):
        if normals[one] @ normals[two] < LEAST_COSINE:
            continue
        direction = share * normals[one] + (1 - share) * normals[two]
        direction /= np.linalg.norm(direction)
        cosine = towards @ direction / away
        near = int(cosine.argmax())
        axes = axes_of(model.camera_from_model[near], towards[near])
        right, up, ahead = (axes @ direction).tolist()
        pose = looking_at(centre, direction, axes[1], distance, np.radians(roll))
        tilts = {face: tilt_deg(normals[face], middles[face], centre + distance * direction) for face in normals}
        shown = {face: tilt for face, tilt in sorted(tilts.items()) if tilt < MAX_TILT_DEG}
        labels: list[Label] = [e for e in model.labels if isinstance(e, CircleLabel) and e.face in shown]
        name = f"{model.group}/view {one} {two} {share} {roll}"
        views.append(
            PlannedView(
                model.group,
                single(model, name, pose, labels, setup, noise),
                float(np.degrees(np.arctan2(right, ahead)).round()),
                float(np.degrees(np.arcsin(np.clip(up, -1, 1))).round()),
                roll,
                distance,
                shown,
                model.images[near],
                model.images[near],
                angle_deg(cosine[near]),
            )
        )
    return views
