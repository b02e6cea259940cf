"""Advice after a run: further photographs that would improve its worst face, or whether only a better board would."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, compress, product
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from stcal.errors import DegenerateError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.json import Named, ResultFile
from stcal.labels import BOARD, CircleLabel, Label
from stcal.parallel import Progress, kept_processes, one_thread, run_in_order
from stcal.report.text import join, number, text_table
from stcal.sfm.adjust.calibration import rim_covariance_mm2
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.adjust.uncertainty import widened_result
from stcal.sfm.data.group_model import MetricModel
from stcal.sfm.planning.forecast import (
    FORECAST,
    MICRO,
    CentreNoise,
    Forecast,
    ForecastPart,
    PositionsWith,
    Setup,
    forecast,
    observe,
    true_models,
    variance_shares,
    worst_of,
)
from stcal.sfm.runs.conditions import BLUR_PX, CONTRAST, IMAGE_NOISE, PRACTICE
from stcal.sfm.runs.saved import AnyRun, SavedRun, adjusted_run, saved_run
from stcal.synthetic.placement import look_along
from stcal.synthetic.scene import MAX_FOUND_TILT_RAD, Group, Scene, SceneOptions, image_circles, made_group

REACH_DEG = 50.0  # largest distance of candidates from the middle of a group's views, in azimuth and in elevation
GRID_DEG = 10.0  # step of the grid of candidates, in azimuth and in elevation
Turns = tuple[float, float, float]  # azimuth, elevation and roll, degrees
ROLLS_DEG = (0.0, 90.0)  # of the camera; 90° separates intrinsics from poses, and is tried if intrinsics are refined


@dataclass(frozen=True, slots=True, eq=False)
class PlannedView:
    """A photograph to take in a group, at angles about its middle that count from the ``middle`` photograph."""

    model: MetricModel  # of this one image
    azimuth_deg: float
    elevation_deg: float
    roll_deg: float  # about the camera's axis
    distance_mm: float
    tilts_deg: dict[str, float]  # between normal and line of sight, by face and ``board``
    middle: str
    nearest: str  # photograph, at the angle ``nearest_deg``
    nearest_deg: float

    @property
    def group(self) -> str:
        return self.model.group

    @property
    def camera_from_target(self) -> Rigid:
        return self.model.camera_from_model[0]

    @property
    def labels(self) -> list[Label]:
        return [self.model.labels[i] for i in self.model.point_index]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class KnownRun(Brief):
    """A finished run as input of a forecast: models in mm, target frame, with the σ of the run's adjustment."""

    models: tuple[MetricModel, ...]
    setup: Setup
    noise: CentreNoise
    scene: Scene


@dataclass(frozen=True, slots=True, eq=False)
class _Stand:
    """Where the cameras of a group stand."""

    centre: np.ndarray  # (3,) middle of all points
    distance_mm: float  # median, of the cameras from the centre
    directions: np.ndarray  # (m, 3) unit vectors from the centre to the cameras
    middle: int  # image in the middle of the views
    axes: np.ndarray  # (3, 3) rows right, up, towards the cameras, as that photograph shows them

    @classmethod
    def of(cls, model: MetricModel) -> "_Stand":
        centre = (model.xyz_model.min(0) + model.xyz_model.max(0)) / 2
        from_centre = np.array([pose.inverse().translation for pose in model.camera_from_model]) - centre
        distance = np.linalg.norm(from_centre, axis=1)
        directions = from_centre / distance[:, None]
        towards = directions.mean(0) / np.linalg.norm(directions.mean(0))
        middle = int(np.argmax(directions @ towards))
        axes = axes_of(model.camera_from_model[middle], towards)
        return cls(centre, float(np.median(distance)), directions, middle, axes)

    def pose(self, direction: np.ndarray, up: np.ndarray, roll_deg: float) -> Rigid:
        """Returns camera_from_target of a camera that looks at the centre from a direction (3,)."""
        rotation = look_along(-direction[None], up, np.array([-np.radians(roll_deg)]))[0]
        return Rigid(rotation, -rotation @ (self.centre + self.distance_mm * direction))

    def view(
        self, known: KnownRun, model, pose: Rigid, labels: list[Label], place: Turns, planes, middle: int
    ) -> PlannedView:
        """Returns the photograph that shows these points of a group, with the σ that they will have. ``place`` :
        azimuth, elevation and roll, counted from the image ``middle``; ``planes`` : normal and middle by name."""
        points, n, camera = np.array([model.labels.index(label) for label in labels]), len(labels), known.setup.camera
        image = replace(
            model,
            images=(f"{model.group}/view {place} from {model.images[middle]}",),
            camera_from_model=(pose,),
            image_index=np.zeros(n, int),
            point_index=points,
            keypoint=np.arange(n),
            measured_px=camera.project(pose @ model.xyz_model[points]),
            shift_px=np.zeros((n, 2)),
            covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        )
        cosine = self.directions @ (pose.inverse().translation - self.centre) / self.distance_mm
        tilts = {plane: tilt_deg(normal, at, pose) for plane, (normal, at) in planes.items()}
        nearest, nearest_deg = model.images[int(cosine.argmax())], angle_deg(cosine.max())
        noisy = known.noise.applied(image, camera, known.setup.radius_mm())
        return PlannedView(noisy, *place, self.distance_mm, tilts, model.images[middle], nearest, nearest_deg)


def tilt_deg(normal: np.ndarray, middle: np.ndarray, camera_from_target: Rigid) -> float:
    ray = camera_from_target.inverse().translation - middle
    return angle_deg(normal @ ray / np.linalg.norm(ray))


def axes_of(camera_from_target: Rigid, towards: np.ndarray) -> np.ndarray:
    """Returns the axes (3, 3) rows right, up, towards the camera, as a photograph shows right and up."""
    towards = towards / np.linalg.norm(towards)
    right = np.cross(-camera_from_target.rotation[1], towards)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(towards, right), towards])


def known_scene(joint: JointResult, setup: Setup, colmap_model: str) -> Scene:
    """Returns the scene of a run, target frame: its calibrated faces and circles and its boards, without views."""
    circles = dict(zip(joint.labels, joint.xyz_model, strict=True))
    groups, dots = {}, np.column_stack([setup.board.xy_mm(), np.zeros(setup.board.rows * setup.board.columns)])
    for model in joint.models:
        seen = tuple(sorted({label.face for label in model.labels if isinstance(label, CircleLabel)}))
        pose = joint.model_from_board[model.group]
        groups[model.group] = Group(model.group, seen, _Stand.of(model).axes, pose, pose @ dots, ())
    faces = []
    for face in (face for face in setup.target.faces if face.id in setup.start.target_from_face):
        keep = [i for i, label in enumerate(face.labels()) if label in circles]
        ids = tuple(face.ids[i] for i in keep)
        faces.append(replace(face, ids=ids, xy_mm=face.xy_mm[keep], radius_mm=face.radius_mm[keep]))
    target, camera = replace(setup.target, faces=tuple(faces)), Camera.of(setup.camera, colmap_model)
    return Scene(target, setup.board, camera, setup.start.target_from_face, circles, groups, seed=0)


def candidates(known: KnownRun, model: MetricModel) -> list[PlannedView]:
    """Returns the views, on a grid about the present ones, that show the whole board and at least one whole face."""
    stand, steps = _Stand.of(model), np.arange(-REACH_DEG, REACH_DEG + 1e-9, GRID_DEG).tolist()
    rolls = ROLLS_DEG[: 1 if known.setup.prior is None else None]
    places = [(azimuth, elevation, roll) for roll, elevation, azimuth in product(rolls, steps, steps)]
    poses = []
    for *angles, roll in places:
        (x, y), (right, ahead) = np.sin(np.radians(angles)), np.cos(np.radians(angles))
        poses.append(stand.pose(np.array([ahead * x, y, ahead * right]) @ stand.axes, stand.axes[1], roll))
    group = replace(known.scene.groups[model.group], camera_from_target=tuple(poses))
    scene = replace(known.scene, groups={model.group: group})
    planes = {BOARD: (-group.target_from_board.rotation[:, 2], scene.board_outline(model.group).mean(0))}
    for face in (face.id for face in scene.target.faces):  # outward normal, and middle
        planes[face] = scene.target_from_face[face].rotation[:, 2], scene.face_outline(face).mean(0)
    normals = np.array([planes.get(label.plane, planes[BOARD])[0] for label in model.labels])
    centres = np.array([pose.inverse().translation for pose in model.camera_from_model])[model.image_index]
    ray = centres - model.xyz_model[model.point_index]
    measured = (ray * normals[model.point_index]).sum(1) / np.linalg.norm(ray, axis=1)  # cosines of tilts
    limit = min(float(np.arccos(np.clip(measured.min(), -1, 1))), MAX_FOUND_TILT_RAD)
    members = {key: {model.labels[i] for i in rows} for key, rows in model.points_by_face().items()}
    views = []
    for i, place in enumerate(places):
        labels = set(model.labels) & shown(scene, model.group, i, limit)
        if members[BOARD] <= labels and any(own <= labels for key, own in members.items() if key != BOARD):
            seen = {plane: planes[plane] for plane in [BOARD, *sorted({label.plane for label in labels} - {BOARD})]}
            views.append(stand.view(known, model, poses[i], sorted(labels), place, seen, stand.middle))
    return views


def shown(scene: Scene, group: str, image: int, max_tilt_rad: float) -> set[str]:
    """Returns the labels of the group's circles that a view shows whole, not too oblique and not hidden by a plate."""
    circles = image_circles(scene, group, image)
    plates = [scene.face_outline(face.id) for face in scene.target.faces] + [scene.board_outline(group)]
    origin, a, _, b = np.moveaxis(scene.groups[group].camera_from_target[image] @ np.stack(plates), 1, 0)  # corners
    sides, normal = (a - origin, b - origin), np.cross(a - origin, b - origin)
    with np.errstate(divide="ignore", invalid="ignore"):  # lines of sight parallel to a plate never meet it
        depth_ratio = (origin * normal).sum(1)[:, None] / (normal @ circles.xyz_camera.T)
        from_corner = depth_ratio[..., None] * circles.xyz_camera - origin[:, None]
        u, v = ((from_corner @ side[..., None])[..., 0] / (side * side).sum(1)[:, None] for side in sides)
        hides = (depth_ratio > 0) & (depth_ratio < 1 - 1e-3) & (u > 0) & (u < 1) & (v > 0) & (v < 1)
    visible = circles.must_find & (circles.tilt_rad <= max_tilt_rad) & ~hides.any(0)
    return set(compress(circles.labels, visible.tolist()))


def angle_deg(cosine: ArrayLike) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


LEAST_COSINE = -0.2  # smallest cosine of the angle between two faces that one view is to show
MAX_TILT_DEG = 60.0  # largest tilt of a face whose corners count as seen
SHARES = (0.35, 0.5, 0.65)  # where candidates stand between the normals of two faces


def body_views(known: KnownRun, model: MetricModel) -> list[PlannedView]:
    """Returns candidates, each with two faces that one view can show, as a motion from the nearest photograph."""
    poses, stand = known.setup.start.target_from_face, _Stand.of(model)
    planes = {  # outward normal, and middle
        face.id: (face.outward * poses[face.id].rotation[:, 2], poses[face.id] @ np.append(face.xy_mm.mean(0), 0.0))
        for face in known.setup.target.faces
        if face.id in poses
    }
    views = []
    for (one, two), share, roll in product(combinations(planes, 2), SHARES, ROLLS_DEG):
        if planes[one][0] @ planes[two][0] < LEAST_COSINE:
            continue
        direction = share * planes[one][0] + (1 - share) * planes[two][0]
        direction /= np.linalg.norm(direction)
        near = int((stand.directions @ direction).argmax())
        axes = axes_of(model.camera_from_model[near], stand.directions[near])
        right, up, ahead = (axes @ direction).tolist()
        azimuth, elevation = np.degrees([np.arctan2(right, ahead), np.arcsin(np.clip(up, -1, 1))]).round().tolist()
        pose = stand.pose(direction, axes[1], roll)
        seen = {face: planes[face] for face in sorted(planes) if tilt_deg(*planes[face], pose) < MAX_TILT_DEG}
        labels: list[Label] = [e for e in model.labels if isinstance(e, CircleLabel) and e.face in seen]
        views.append(stand.view(known, model, pose, labels, (azimuth, elevation, roll), seen, near))
    return views


SHORTLIST = 8  # number of candidates that stay in the search after the first choice: the best so many for each face
NEW_GROUP_SPREAD_DEG = 40.0  # spread of the views of a new group about the view that shows both faces equally
AT_ONCE = 50  # number of candidates that one process computes at a time
MIN_NEW_GROUP = 3  # least number of images with which a new group can be mapped
BOARD_DOMINATES = 0.5  # share of the board in the variance of the worst face beyond which more views hardly help


@dataclass(frozen=True, slots=True, eq=False)
class AdvisedView:
    """A view to add. ``face``, ``sigma_mm`` : the worst face with this view and all choices before it, and its σ."""

    view: PlannedView
    face: str
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class NewGroup:
    faces: tuple[str, str]
    images: int  # number of views
    face: str  # the worst one with these views, and its σ
    sigma_mm: float


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Advice(Brief):
    """Further photographs, and what each of them would improve."""

    now: Forecast  # of the run as it is
    shares: dict[str, dict[str, float]]  # of its variance, by face and source
    choices: tuple[AdvisedView, ...]  # each chosen in addition to those before it
    new_groups: tuple[NewGroup, ...]  # the best first
    better_board: Forecast  # with half the board's σ
    tried: int  # number of candidates

    @property
    def board_dominates(self) -> bool:
        """Whether most of the worst face's variance is the board's, so that more views help little."""
        return self.shares[self.now.worst()[0]].get("board", 0.0) > BOARD_DOMINATES


def known_of(run: SavedRun) -> KnownRun:
    """Returns the geometry of a finished run, adjusted once more for the data that ``faces.json`` does not contain."""
    state, start = adjusted_run(run)
    joint = widened_result(state)
    heights, rim_sigma_mm = run.rims_mm()
    rims = rim_covariance_mm2(joint, start.target_from_face, heights, rim_sigma_mm) if rim_sigma_mm else None
    setup = Setup(
        target=run.target_design,
        board=run.board_design,
        camera=joint.camera,
        start=start,
        frame=run.faces.frame,
        flatness_mm=run.options.flatness_mm,
        prior=camera_prior(run.camera) if run.options.refine_camera else None,
        common=joint.board_common,
        sigma0=joint.sigma_scale,
        rims_mm2=rims,
    )
    noise = CentreNoise.measured(joint.models, joint.camera, setup.radius_mm())
    return KnownRun(joint.models, setup, noise, known_scene(joint, setup, run.camera.colmap_model))


def doubts(run: SavedRun) -> str:
    """Returns the reason why the forecast σ may not hold for the run's faces; empty if there is none."""
    if not run.options.eccentricity:
        return f"{run.folder} is an uncorrected control, whose faces are biased by tens of µm: these σ are not theirs"
    failures = failures_of(run)
    return failures and f"{failures}: its faces may be off by far more than these σ"


def failures_of(run: SavedRun) -> str:
    """Returns in words which checks of a run failed; empty if none did."""
    failed = run.failed_checks()
    return f"{len(failed)} checks of {run.folder} failed, first {failed[0]['title']}" if failed else ""


@require_arguments
@one_thread()
def advise(known: KnownRun | AnyRun, count: int = 5, progress: Progress | None = None) -> Advice:
    """Returns the views that lower the σ of the worst face most, one after the other, and new groups of as many images.

    Parameters
    ----------
    known : The folder of a finished run, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned; or its
        geometry, by :func:`known_of`.
    count : Number of views to choose, each in addition to those before it.
    progress : Called with (stage, done, total).

    Returns
    -------
    Advice : The views, with the worst face and its σ (mm) after each; the present σ and their sources.
    """
    if not isinstance(known, KnownRun):
        known = known_of(saved_run(known))
    models, setup = known.models, known.setup
    now = forecast(models, setup)
    with kept_processes():
        if setup.board.rows:
            by_group = run_in_order(candidates, [(known, model) for model in models], 1)
        else:
            by_group = [body_views(known, model) for model in models]
        views = [view for views_of_group in by_group for view in views_of_group]
        chosen = tuple(_greedy(known, views, now, count, progress or (lambda *_: None)))
    new_groups = tuple(_new_groups(known, now, max(count, MIN_NEW_GROUP))) if setup.board.rows else ()
    better = forecast(models, setup.better_board(0.5), now.derivatives)
    shares = variance_shares(now, models, setup)
    return Advice(now, shares, chosen, new_groups, better, len(views))


def _greedy(
    known: KnownRun, views: list[PlannedView], now: Forecast, count: int, progress: Progress
) -> Iterator[AdvisedView]:
    """Yields view after view, each time the one with which the worst face has the smallest σ."""
    models = {model.group: model for model in known.models}
    for place in range(1, count + 1):
        if not views:
            return
        progress(f"view {place}", 0, len(views))
        positions = PositionsWith.of(list(models.values()), known.setup, now.derivatives)
        jobs = [(positions, views[i : i + AT_ONCE]) for i in range(0, len(views), AT_ONCE)]
        results = [sigma for part in run_in_order(_positions, jobs, 1) for sigma in part]
        progress(f"view {place}", len(views), len(views))
        best = int(np.argmin([worst_of(sigma)[1] for sigma in results]))
        yield AdvisedView(views[best], *worst_of(results[best]))
        models[views[best].group] = models[views[best].group].plus(views[best].model)
        # The best views for each of the faces, as another face may become the worst one.
        ranked = [sorted(range(len(views)), key=lambda i, face=face: results[i][face]) for face in results[0]]
        keep = {i for order in ranked for i in order[:SHORTLIST]} - {best}
        views = [views[i] for i in sorted(keep)]


def _positions(positions: PositionsWith, views: Sequence[PlannedView]) -> list[dict[str, float]]:
    return [positions(view.model) for view in views]


def _new_groups(known: KnownRun, now: Forecast, images: int) -> list[NewGroup]:
    together = [model.points_by_face().keys() for model in known.models]
    new_groups = []
    for pair in combinations(sorted(face.id for face in known.scene.target.faces), 2):
        if any(faces >= set(pair) for faces in together):
            continue
        try:
            model = _new_model(known, pair, images)
        except DegenerateError:
            continue  # the two cannot be seen together at this distance
        with_model = forecast([*known.models, model], known.setup, now.derivatives)
        new_groups.append(NewGroup(pair, images, *with_model.worst()))
    return sorted(new_groups, key=lambda group: group.sigma_mm)


def _new_model(known: KnownRun, pair: tuple[str, str], images: int) -> MetricModel:
    """Returns a group of two faces with the board beside them, at the distance of the present photographs."""
    scene, rng = known.scene, np.random.default_rng(0)
    depth = float(np.median(np.concatenate([model.xyz_camera()[:, 2] for model in known.models])))
    options = SceneOptions(
        images_per_group=images, distance_mm=depth, spread_deg=NEW_GROUP_SPREAD_DEG, margin_mm=scene.margin_mm
    )
    parts = scene.target, scene.board, scene.camera, scene.target_from_face, scene.circles_target
    group = made_group(pair, *parts, options, np.zeros((1, 3)), rng)
    alone = replace(scene, groups={group.name: group})
    (model,) = true_models(alone, observe(alone, 0.0, rng))
    new = replace(model, group=f"new {group.name}")  # a group of the run may have the name, and show other faces
    return known.noise.applied(new, scene.camera, known.setup.radius_mm())


@require_arguments
def noise_of_run(run: AnyRun) -> CentreNoise:
    """Returns the noise of centres by size and tilt of the circles, as estimated from a run.

    Parameters
    ----------
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.

    Returns
    -------
    CentreNoise : As :class:`stcal.sfm.PlanOptions` takes it.
    """
    known = known_of(saved_run(run))
    return known.noise.scaled(known.setup.sigma0)


def expected_noise(of_corners: bool = False) -> tuple[CentreNoise, str]:
    """Returns the σ to expect in good photographs; ``of_corners`` : of tags and squares, not of circles."""
    light = f"image noise {100 * IMAGE_NOISE:g} % and contrast {100 * CONTRAST:g} % of full scale"
    of_circles = f"{light}, edges blurred by {BLUR_PX:g} px, {PRACTICE:g} × the Cramér–Rao bound"
    return CentreNoise.expected(), "what corners of tags have in rendered photographs" if of_corners else of_circles


Choice = Annotated[
    AdvisedView,
    Named(
        "view.group view.middle view.azimuth_deg view.elevation_deg view.roll_deg view.distance_mm view.tilts_deg "
        "view.nearest view.nearest_deg view.camera_from_target view.labels face sigma_mm"
    ),
]


class AdviceFile(ResultFile):
    """The JSON file of ``advise``: the present forecast, and further photographs."""

    format: Literal["stcal advice 1"] = Field(description="the file's form and its version")
    now: ForecastPart = Field(description=FORECAST)
    choices: list[Choice] = Field(
        description="further photographs, one after the other: `view`, and the worst `face` with its `sigma_mm` with "
        "this view and those before. A view has `group`; `middle`, the photograph in the middle of the group's views; "
        "`azimuth_deg` to the right and `elevation_deg` up from there as that photograph shows them (longitude and "
        "latitude about the middle of board and faces), `roll_deg` about the camera's axis, `distance_mm` to that "
        "middle; `tilts_deg` by face and `board`, between normal and line of sight; `nearest` photograph and "
        "`nearest_deg` to it; `camera_from_target` 4×4; `labels` in view"
    )
    new_groups: tuple[NewGroup, ...] = Field(
        description="pairs of `faces` that no group shows together, the best first: the worst `face` and its "
        "`sigma_mm` with `images` of them and the board"
    )
    board_dominates: bool = Field(
        description="more than half of the worst face's variance is the board's: more views help little"
    )
    half_board_sigma_um: float = Field(description="of the worst face with half the board's σ and no further view")
    tried: int = Field(description="views that were compared")

    @classmethod
    def of_advice(cls, advice: Advice) -> "AdviceFile":
        same: dict[str, Any] = {name: getattr(advice, name) for name in ("new_groups", "board_dominates", "tried")}
        now, half_um = ForecastPart.of(advice.now, advice.shares), MICRO * advice.better_board.worst()[1]
        choices = list(advice.choices)
        return cls(format="stcal advice 1", now=now, choices=choices, half_board_sigma_um=half_um, **same)


HOW_TO_GO = (
    "go right and up as seen in the photograph named, about the middle of board and faces, which is to be in the "
    "middle of the image, mm away; degrees of board and faces are from their normal. A body without a board may be "
    "turned the other way instead; if board or target have been moved since, photograph a new group"
)


def advice_text(advice: Advice) -> str:
    """Returns what to photograph next, as a table that a photographer can follow."""
    now, better_um = ForecastPart.of(advice.now, advice.shares), MICRO * advice.better_board.worst()[1]
    lines = [*now.table(), f"worst is face {now.worst_face}, {now.worst_sigma_um:.2f} µm"]
    lines.append("by the mean noise of all centres; the σ of the report are by the noise of each centre")
    shares = advice.shares[now.worst_face]
    if advice.board_dominates:
        little = f"{100 * shares['board']:.0f} % of its variance comes from the board: further views will help little"
        lines.append(f"{little}; with a board of half the σ: {better_um:.2f} µm")
    lines += ["", f"further views, one after the other, the best of {advice.tried}:"]
    lines += text_table([["<group", "<from", "<go", "mm", "<sees", "<nearest", "<worst face, µm"], *_views(advice)])
    if not advice.choices:
        lines.append("none: no other view within ±50° shows the whole board and a face")
    lines.append(HOW_TO_GO)
    ways = [(better_um, "a board of half the σ" if "board" in shares else "print and size of half the σ")]
    if count := len(advice.choices):
        together = f"the {count} views together" if count > 1 else "the one view"
        ways.append((MICRO * advice.choices[-1].sigma_mm, together))
    for pair in advice.new_groups:
        words = f"{pair.images} images of faces {join(pair.faces)} with the board next to them, a new group"
        ways.append((MICRO * pair.sigma_mm, words))
    rows = [["<worst face afterwards, the best first", "µm"], *([words, number(um, 2)] for um, words in sorted(ways))]
    return "\n".join([*lines, "", *text_table(rows)])


def _views(advice: Advice) -> Iterator[list[str]]:
    face, sigma = advice.now.worst()
    for choice in advice.choices:
        view = choice.view
        turns = ((view.azimuth_deg, ("right", "left")), (view.elevation_deg, ("up", "down")))
        parts = [f"{abs(angle):g}° {names[angle < 0]}" for angle, names in turns if angle]
        go = ", ".join([*parts, *(["camera on end"] if view.roll_deg else [])]) or "the same place"
        sees = join(f"{'' if key == 'board' else 'face '}{key} {tilt:.0f}°" for key, tilt in view.tilts_deg.items())
        change = f"{face}: {MICRO * sigma:.2f} → {choice.face}: {MICRO * choice.sigma_mm:.2f}"
        nearest = f"{view.nearest} {view.nearest_deg:.0f}°"
        yield [view.group, view.middle, go, f"{view.distance_mm:.0f}", sees, nearest, change]
        face, sigma = choice.face, choice.sigma_mm
