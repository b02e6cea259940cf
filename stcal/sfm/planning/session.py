"""Forecast of a plan before any image exists: the σ to expect, and what would help most."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from stcal.design import (
    BoardDesign,
    KnownDistance,
    ScaleReference,
    TargetDesign,
    faces_of_known_shape,
    reference_board,
    scale_reference,
)
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, require_arguments, require_fields, rms
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel, camera_prior, refinable
from stcal.io.cameras.read import camera_model
from stcal.io.images import TOP_GROUP
from stcal.io.json import ResultFile
from stcal.labels import BOARD, CircleLabel, DotLabel, Label, circle_labels
from stcal.parallel import one_thread
from stcal.report.text import number, text_table
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.refine import with_edge_sigma
from stcal.sfm.data.group_model import ImageObservations, MetricModel, assemble
from stcal.sfm.detect.defocus import RESPONSE
from stcal.sfm.mapping.body import unknown_lens
from stcal.sfm.planning.forecast import (
    FORECAST,
    MICRO,
    ONE_PLATE,
    CentreNoise,
    Forecast,
    ForecastPart,
    Setup,
    forecast,
    nominal_poses,
    observe,
    true_models,
    variance_shares,
)
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.body_scene import BodyOptions, BodyScene, body_camera, make_body_scene
from stcal.synthetic.scene import FACE_MARGIN_MM, Scene, SceneOptions, group_name, make_scene

DISTANCE_SIGMA_MM = 0.02  # σ of a distance that is measured with a caliper, as a remedy
SPREADS_DEG = (80.0, 70.0, 60.0, 50.0, 40.0)  # tried from the largest down, as tilts often forbid wide ones
NEARER = 0.8  # distance of the remedy of nearer cameras, relative to the plan's
MIN_IMAGES = 2
MOST_DOTS = 200  # of a board in a forecast; of one with more, each dot that is kept stands for several


@dataclass(frozen=True, slots=True, repr=False)
class PlanOptions(Brief):
    """The plan of a session.

    Parameters
    ----------
    images : Number of images of each group.
    spread_deg : ± about the view that shows both faces equally, degrees.
    distance_mm : Distance of the cameras from the target, mm.
    width : Width of the images, px; 3:2 images of a 24 mm lens, if no ``camera`` is given.
    camera : Camera, whose file must state the image size.
    groups : Pairs of face ids; the pairs of the design if None.
    noise : σ of the centres.
    one_board : Whether the same plate is in all groups; else each group has its own.
    run : Flatness, frame, refined intrinsics and reference face.
    seed : Seed of the random places of board and cameras.
    margin_mm : How far plates without ``outline_mm`` reach beyond the rims of their circles.

    Raises
    ------
    InputError
        If a group has fewer than two images, or the camera file states no image size.
    """

    images: int = 10
    spread_deg: float = 40.0
    distance_mm: float = 1000.0
    width: int = 5184
    camera: Camera | CameraModel | None = None
    groups: tuple[tuple[str, str], ...] | None = None
    noise: CentreNoise = field(default_factory=CentreNoise.expected)
    one_board: bool = True
    run: RunOptions = field(default_factory=RunOptions)
    seed: int = 0
    margin_mm: float = FACE_MARGIN_MM

    def __post_init__(self):
        require_fields(self, "plan", spread_deg=0, distance_mm=0, width=1, seed=0, margin_mm=0)
        if self.images < MIN_IMAGES:
            fault = f"plan: {self.images} images in each group, {MIN_IMAGES} needed"
            raise InputError("E-OPTION-RANGE", f"{fault}; plan for more")
        model = None if self.camera is None else camera_model(self.camera)
        if model is not None and not (model.width and model.height):
            fault = f"plan: camera file {model.source} states no image size"
            raise InputError("E-CAMERA-SIZE", f"{fault}; add it to the file")


@dataclass(frozen=True, slots=True)
class Remedy:
    what: str
    sigma_mm: float | None  # of the worst face with it, or None and the ``reason`` if it is impossible
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Plan(Brief):
    """A plan with its forecast and remedies."""

    options: PlanOptions
    setup: Setup
    groups: tuple[str, ...]
    observations: int  # number of centres
    centre_sigma_px: float  # RMS
    aperture_mm: float  # see :func:`widest_aperture_mm`
    forecast: Forecast
    shares: dict[str, dict[str, float]]  # of the variance, by face and source
    remedies: tuple[Remedy, ...]
    hardly_seen: str = ""  # sentence on the faces of a body that the photographs hardly show


def pairs_of_faces(text: str, target: TargetDesign) -> tuple[tuple[str, str], ...]:
    """Returns the pairs of face ids that a text like ``12,14`` or ``top-left,top-right`` names."""
    pair_of_name = {group_name(pair): pair for pair in permutations([face.id for face in target.faces], 2)}
    names = [name.strip() for name in text.split(",")]
    if unknown := [name for name in names if name not in pair_of_name]:
        remedy = f"use for example {', '.join(list(pair_of_name)[:3])}"
        form = "ids of one character beside each other, longer ones with a hyphen"
        raise InputError("E-OPTION-VALUE", f"--groups: {unknown[0]!r} is not a pair of faces; {remedy}: {form}")
    return tuple(pair_of_name[name] for name in names)


Photographs = Callable[[PlanOptions], tuple[Scene | BodyScene, list[MetricModel], Setup]]
"""Type of functions that simulate the photographs of a plan."""


@require_arguments
@one_thread()
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
    options : Images, camera, groups and noise.
    target : Design of the target, drawing frame of each face, mm.
    board : Board with its σ, mm; the reference board if None. There must be none beside a body with boards or tags.
    nominal : Pose of every face in one common frame, mm, by face id, or ``faces.json`` of an earlier run; the rough
        poses of the design if None.

    Returns
    -------
    Plan : σ to expect of every face against the reference face, mm and rad, their sources, and what would help most.

    Raises
    ------
    InputError
        If a face has no nominal pose, a group names an unknown face, a board or groups are given for a body with boards
        or tags.
    DegenerateError
        If a group cannot be photographed as planned.
    """
    printed = bool(target.with_faces(printed=True).faces)
    if printed and (unfit := [n for n, v in {"--groups": options.groups, "--board": board}.items() if v]):
        fault = f"{unfit[0]}: not for a body with boards or tags on its faces"
        raise InputError("E-OPTION-CONFLICT", f"{fault}; leave it out")
    poses = dict(nominal) if isinstance(nominal, Mapping) else nominal_poses(target, nominal)
    if printed:
        faces = (replace(face, rough_target_from_face=poses[face.id]) for face in target.faces)
        make = partial(planned_photographs, target=replace(target, faces=tuple(faces)))
    else:
        board = reference_board() if board is None else board
        make = partial(_beside_board, target=target, board=board, nominal=poses)
    scene, models, setup = make(options)
    now = forecast(models, setup)
    better = {"a board of half the σ" if setup.board.rows else "print and size of half the σ": setup.better_board(0.5)}
    if isinstance(setup.board, ScaleReference):
        away = np.linalg.norm(models[0].xyz_model[:, None] - models[0].xyz_model, axis=2)
        one, two = circle_labels(models[0].labels[i] for i in np.unravel_index(int(away.argmax()), away.shape))
        known = KnownDistance(one, two, float(away.max()), DISTANCE_SIGMA_MM)
        size = replace(setup.board, distances=(*setup.board.distances, known))
        better[f"a distance known to {1e3 * DISTANCE_SIGMA_MM:g} µm"] = replace(setup, board=size)
    remedies = (
        _remedy(make, replace(options, images=2 * options.images), "twice the images"),
        *([] if printed else [_wider(make, options)]),
        *(Remedy(what, forecast(models, own, now.derivatives).worst()[1]) for what, own in better.items()),
        _remedy(make, replace(options, distance_mm=NEARER * options.distance_mm), "nearer by 20 %"),
    )
    return Plan(
        options=options,
        setup=setup,
        groups=tuple(model.group for model in models),
        observations=round(sum(setup.centres(model).sum() for model in models)),
        centre_sigma_px=rms(np.concatenate([model.sigma_px() for model in models])),
        aperture_mm=widest_aperture_mm(models, setup.camera),
        forecast=now,
        shares=variance_shares(now, models, setup),
        remedies=remedies,
        hardly_seen=scene.hardly_seen() if isinstance(scene, BodyScene) else "",
    )


def _kept_dots(board: BoardDesign) -> set[DotLabel]:
    """Returns the dots of a board, or about ``MOST_DOTS`` of them in rows and columns from edge to edge."""
    times = max(1.0, float(np.sqrt(board.rows * board.columns / MOST_DOTS)))
    rows, columns = (
        np.linspace(0, count - 1, max(2, round(count / times))).round().astype(int).tolist()
        for count in (board.rows, board.columns)
    )
    return {DotLabel(row, column) for row in rows for column in columns}


def _remedy(make: Photographs, options: PlanOptions, what: str) -> Remedy:
    try:
        _, models, setup = make(options)
        return Remedy(what, forecast(models, setup).worst()[1])
    except (DegenerateError, InputError) as error:
        return Remedy(what, None, str(error))


def _wider(make: Photographs, options: PlanOptions) -> Remedy:
    """Returns the remedy of the largest spread at which there are enough views."""
    found = Remedy("larger spread", None, f"±{options.spread_deg:g}° is as far as both faces and the board show")
    for spread in SPREADS_DEG:
        if spread > options.spread_deg and found.sigma_mm is None:
            found = _remedy(make, replace(options, spread_deg=spread), f"spread of ±{spread:g}°")
    return found


def widest_aperture_mm(models: Sequence[MetricModel], camera: Camera) -> float:
    """Returns the diameter of the aperture up to which depth of field moves no centre by more than its σ. Each image is
    in focus at the mean inverse depth u_f; the squared blur is (f_px A/4)² (u − u_f)²."""
    focal_px, widest = float(np.sqrt(camera.focal.prod())), []
    for model in models:
        rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
        n, c = np.einsum("nij,nj->ni", rotation, model.normals()[model.point_index]), model.xyz_camera()
        gradient = np.linalg.norm(n[:, :2], axis=1) / np.abs((n * c).sum(1)) / focal_px
        u = 1 / c[:, 2]
        away = np.abs(u - (np.bincount(model.image_index, u) / np.bincount(model.image_index))[model.image_index])
        by_square = 2 * RESPONSE * (focal_px / 4) ** 2 * away * gradient
        widest.append(np.sqrt(model.sigma_px() / np.maximum(by_square, 1e-12)).min())
    return float(min(widest))


def _beside_board(
    options: PlanOptions, target: TargetDesign, board: BoardDesign, nominal
) -> tuple[Scene, list[MetricModel], Setup]:
    """Returns the photographs of a plan with a board: scene with the nominal geometry, in which nothing is misplaced,
    models with their σ, input of a forecast."""
    same = ("seed", "distance_mm", "spread_deg", "groups", "width", "margin_mm")
    given: dict[str, Any] = {name: getattr(options, name) for name in same}
    given |= dict.fromkeys(("centre_sigma", "circle_sigma_mm", "face_shift_mm", "face_turn_deg"), 0.0)
    shape = SceneOptions(images_per_group=options.images, height=round(options.width * 2 / 3), **given)
    scene = make_scene(shape, target, replace(board, sigma_mm=0.0), nominal, options.camera)
    run = options.run.adjustment(scene.target)
    kept = _kept_dots(board)
    linked = _linked(run.reference_face, [group.faces for group in scene.groups.values()])
    poses = {face: pose for face, pose in scene.target_from_face.items() if face in linked}
    groups = dict.fromkeys(scene.groups, Rigid())
    start = CalibratedTarget(run.reference_face, poses, scene.circles_target, groups)
    setup = Setup(
        target=scene.target,
        board=board,
        camera=scene.camera,
        start=start,
        frame=run.frame,
        flatness_mm=run.flatness_mm,
        prior=camera_prior(refinable(scene.camera)) if run.refine_camera else None,
        common=ONE_PLATE if options.one_board else 0.0,
        stands_for=board.rows * board.columns / len(kept),
    )
    every = observe(scene, 0.0, np.random.default_rng(0))
    seen = [image.select([k for k, x in enumerate(image.labels) if x in kept or x.plane != BOARD]) for image in every]
    radius_mm = setup.radius_mm()
    return scene, [options.noise.applied(m, scene.camera, radius_mm) for m in true_models(scene, seen)], setup


def _linked(reference: str, pairs: list[tuple[str, ...]]) -> set[str]:
    """Returns the faces of all groups; an error if one is not linked to the reference face."""
    planned = {face for pair in pairs for face in pair}
    linked = {reference}
    for _ in planned:
        linked |= {face for pair in pairs if linked & set(pair) for face in pair}
    if len(linked) < 2 or planned - linked:
        unlinked = ", ".join(sorted(planned - linked)) or "any other face"
        fault = f"plan: no group links face {unlinked} to reference face {reference}"
        raise InputError("E-PLAN-UNLINKED", f"{fault}; add a group that shows one of each")
    return linked


def planned_photographs(options: PlanOptions, target: TargetDesign) -> tuple[BodyScene, list[MetricModel], Setup]:
    """Returns the photographs of a body in random poses: scene, its model with σ, input of a forecast."""
    file = None if options.camera is None else camera_model(options.camera)
    camera = body_camera(options.width) if file is None else file.calibrated(0, 0)
    shape = BodyOptions(options.images, options.distance_mm, seed=options.seed, pose_sigma_mm=0, pose_sigma_deg=0)
    scene = make_body_scene(target, camera, shape)
    run = options.run.adjustment(target)
    images, place = corners_seen(scene, options.noise.corner_px)
    xyz: dict[Label, np.ndarray] = {**place}
    model = assemble(MetricModel, TOP_GROUP, images, list(scene.camera_from_target), xyz)
    faces = {label.face for label in model.labels if isinstance(label, CircleLabel)}
    if unseen := [face.id for face in target.faces if face.id not in faces]:
        fault = f"plan: {options.images} images of which fewer than two show face {unseen[0]}"
        raise InputError("E-PLAN-UNLINKED", f"{fault}; plan more images")
    start = CalibratedTarget(run.reference_face, scene.target_from_face, place, {TOP_GROUP: Rigid()})
    prior = camera_prior(unknown_lens(camera)) if file is None else None
    if file is not None and run.refine_camera:
        prior = camera_prior(refinable(camera))
    size = with_edge_sigma(scale_reference(None, target), images)
    return scene, [model], Setup(target, size, camera, start, run.frame, run.flatness_mm, prior, 0)


def corners_seen(scene: BodyScene, sigma_px: float) -> tuple[list[ImageObservations], dict[CircleLabel, np.ndarray]]:
    """Returns exact corners with this σ of the faces that two photographs show, and their places, (3,) mm by label."""
    shown = [scene.faces_in_view(image) for image in range(len(scene.camera_from_target))]
    often = Counter(face.id for faces in shown for face in faces)
    images: list[ImageObservations] = []
    place: dict[CircleLabel, np.ndarray] = {}
    for i, (faces, pose) in enumerate(zip(shown, scene.camera_from_target, strict=True)):
        own: dict[CircleLabel, np.ndarray] = {}
        for face in (face for face in faces if often[face.id] > 1):
            xyz = scene.target_from_face[face.id] @ face.places_mm(face.ids)
            own |= dict(zip(face.labels(), xyz, strict=True))
        xy, n = scene.camera.project(pose @ np.array(list(own.values())).reshape(-1, 3)), len(own)
        covariance = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
        images.append(ImageObservations(f"{i:04d}", TOP_GROUP, tuple(own), xy, xy, np.zeros((n, 2, 2)), covariance))
        place |= own
    return images, place


class PlanFile(ResultFile):
    """The JSON file of ``plan``: the planned photographs, the forecast, and what would help."""

    format: Literal["stcal plan 1"] = Field(description="the file's form and its version")
    images_per_group: int = Field(description="photographs")
    groups: tuple[str, ...] = Field(description="names")
    spread_deg: float = Field(description="± about the view that shows both faces equally")
    distance_mm: float = Field(description="of the camera")
    reference_face: str = Field(description="face id")
    observations: int = Field(description="centres in all images")
    centre_sigma_px: float = Field(description="their RMS σ per axis")
    aperture_mm: float = Field(
        description="widest aperture, focal length / f-number, up to which depth of field moves no centre by more than "
        "its σ"
    )
    forecast: ForecastPart = Field(description=FORECAST)
    remedies: tuple[Remedy, ...] = Field(
        description="`what` could be changed, `sigma_mm` of the worst face after that, null where it is not possible "
        "for `reason`"
    )

    @classmethod
    def of_plan(cls, plan: Plan) -> "PlanFile":
        same = ("groups", "observations", "centre_sigma_px", "aperture_mm", "remedies")
        given: dict[str, Any] = {name: getattr(plan, name) for name in same}
        given |= {name: getattr(plan.options, name) for name in ("spread_deg", "distance_mm")}
        given |= {"images_per_group": plan.options.images, "reference_face": plan.setup.start.reference_face}
        return cls(format="stcal plan 1", forecast=ForecastPart.of(plan.forecast, plan.shares), **given)


USUAL_FOCAL_MM = 24.0  # focal length of the lens that is planned with if no camera is given, on a sensor 22.3 mm wide


def plan_text(plan: Plan, noise: str) -> str:
    """Returns the forecast as a table. ``noise`` : where the σ of the centres comes from."""
    options, board, now = plan.options, plan.setup.board, ForecastPart.of(plan.forecast, plan.shares)
    remedies: list[list[str]] = [["<what would help", "worst face, µm", "<"]]
    for remedy in sorted(plan.remedies, key=lambda each: each.sigma_mm or np.inf):
        told = f"not possible, {remedy.reason.partition('; ')[0]}"
        if remedy.sigma_mm is not None:
            told = f"{100 * (MICRO * remedy.sigma_mm / now.worst_sigma_um - 1):+.0f} %"
        remedies.append([remedy.what, number(remedy.sigma_mm and MICRO * remedy.sigma_mm, 2), told])
    lens = f"f/{USUAL_FOCAL_MM / plan.aperture_mm:.1f} of a {USUAL_FOCAL_MM:g} mm lens"
    lines = [
        _photographs_said(plan),
        f"{plan.observations} {'centres' if board.rows else 'corners'}, σ {plan.centre_sigma_px:.4f} px RMS: {noise}",
        *now.table(),
        f"scale: σ {now.scale_sigma_ppm:.1f} ppm; worst is face {now.worst_face}, {now.worst_sigma_um:.2f} µm, against "
        f"face {plan.setup.start.reference_face}",
        "",
        *text_table(remedies),
        "in focus at the middle of each image, depth of field moves no centre by more than its σ up to an aperture "
        f"{plan.aperture_mm:.2g} mm across ({'focal length / f-number' if options.camera else lens}), and up to one "
        "2.8 times as wide from twice as far; what it moves is corrected to about 15 %",
    ]
    if assumed := [face.id for face in plan.setup.target.faces if face.outline_mm is None]:
        plates = f"plates of {', '.join(assumed)} are assumed to end {options.margin_mm:g} mm beyond their circles"
        lines.append(f"{plates} (--margin-mm, or outline_mm in target.toml)")
    if board.rows:
        lines.append("the random places of board and cameras (--seed) change it by about ±3 %")
    else:
        lines += filter(None, [plan.hardly_seen])
        lines.append("which faces the photographs happen to show together (--seed) changes it: compare two seeds")
    return "\n".join(lines)


def _photographs_said(plan: Plan) -> str:
    options, camera, board = plan.options, plan.setup.camera, plan.setup.board
    size = f"{camera.width}×{camera.height} px, {options.distance_mm:g} mm away"
    if not board.rows:
        faces = faces_of_known_shape(board)
        prints = sorted({MICRO * (face.sigma_mm or 0.0) for face in faces})
        ends = " to ".join(dict.fromkeys(f"{each:g}" for each in (prints[0], prints[-1])))
        found = "found from them" if options.camera is None else "of the file"
        shown = f"of a body in random poses that show two or more of {len(faces)} faces"
        return f"{options.images} images, {size}, {shown}; camera {found}, σ of print {ends} µm"
    boards = "the same board in all groups" if options.one_board else "a board of its own in each group"
    views = f"{options.images} images each, {size}, spread ±{options.spread_deg:g}°"
    return f"groups {', '.join(plan.groups)}, {views}; {boards}, σ {MICRO * board.sigma_mm:g} µm"
