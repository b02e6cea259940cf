"""Advice after a run: further photographs that would improve its worst face, or whether only a better board would."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.parallel import Progress, kept_processes, one_thread, run_in_order
from stcal.sfm.adjust.calibration import rim_covariance_mm2
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.adjust.uncertainty import result_of
from stcal.sfm.data.model import MetricModel
from stcal.sfm.planning.forecast import (
    BLUR_PX,
    CONTRAST,
    IMAGE_NOISE,
    PRACTICE,
    CentreNoise,
    Forecast,
    PositionsWith,
    Setup,
    forecast,
    observe,
    true_models,
    variance_shares,
    worst_of,
)
from stcal.sfm.planning.planned_views import PlannedView, body_views, candidates, known_scene
from stcal.sfm.runs.saved import AnyRun, SavedRun, adjusted_run, saved_run
from stcal.synthetic.placement import GroupShape, place_group, viewing_axes
from stcal.synthetic.scene import Group, Scene, group_name

SHORTLIST = 8
"""Number of candidates that stay in the search after the first choice: the best so many for each face."""
NEW_GROUP_SPREAD_RAD = float(np.radians(40))
"""Spread of the views of a new group about the view that shows both faces equally."""
AT_ONCE = 50
"""Number of candidates that one process computes at a time."""
MIN_NEW_GROUP = 3
"""Least number of images with which a new group can be mapped."""
BOARD_DOMINATES = 0.5
"""Share of the board in the variance of the worst face beyond which more views hardly help."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
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
    noise: CentreNoise
    choices: tuple[Choice, ...]  # each chosen in addition to those before it
    new_groups: tuple[NewGroup, ...]  # the best first
    better_board: Forecast  # with half the board's σ
    tried: int  # number of candidates

    @property
    def has_board(self) -> bool:
        """Whether the size is from a board."""
        return any("board" in shares for shares in self.shares.values())

    @property
    def board_dominates(self) -> bool:
        """Whether most of the worst face's variance is the board's, so that more views help little."""
        return self.shares[self.now.worst()[0]].get("board", 0.0) > BOARD_DOMINATES


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Known(Brief):
    """A finished run as input of a forecast: models in mm, target frame, with the σ of the run's adjustment."""

    models: tuple[MetricModel, ...]
    joint: JointResult
    setup: Setup
    noise: CentreNoise
    scene: Scene


def known_of(run: SavedRun) -> Known:
    """Returns the geometry of a finished run, adjusted once more for the data that ``faces.json`` does not contain."""
    again = adjusted_run(run)
    joint = result_of(again.state)
    heights, rim_sigma_mm = run.rims_mm()
    rims = rim_covariance_mm2(joint, again.start.target_from_face, heights, rim_sigma_mm) if rim_sigma_mm else None
    setup = Setup(
        target=run.target_design,
        board=run.board_design,
        camera=joint.camera,
        start=again.start,
        frame=run.faces.frame,
        flatness_mm=run.options.flatness_mm,
        prior=again.prior,
        common=joint.board_common,
        sigma0=joint.sigma_scale,
        rims_mm2=rims,
    )
    noise = CentreNoise.measured(joint.models, joint.camera, setup.radius_mm())
    return Known(joint.models, joint, setup, noise, known_scene(joint.models, joint, setup, run.camera.colmap_model))


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
def advise(known: Known | AnyRun, count: int = 5, progress: Progress | None = None) -> Advice:
    """Returns the views that lower the σ of the worst face most, one after the other, and new groups of as many images.

    Parameters
    ----------
    known : str, Path, SavedRun or RunResult
        The folder of a finished run, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned; or its
        geometry, by :func:`known_of`.
    count : int
        Number of views to choose, each in addition to those before it.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Advice
        The views, with the worst face and its σ (mm) after each; the present σ and their sources.
    """
    if not isinstance(known, Known):
        known = known_of(saved_run(known))
    setup = known.setup
    now = forecast(known.models, setup)
    shares = variance_shares(now, known.models, setup)
    with kept_processes():
        if setup.board.rows:
            jobs = [(known.scene, model, setup, known.noise) for model in known.models]
            by_group = run_in_order(candidates, jobs, 1)
        else:
            by_group = [body_views(model, setup, known.noise) for model in known.models]
        views = [view for views_of_group in by_group for view in views_of_group]
        chosen = _greedy(known, views, now, count, progress or (lambda *_: None))
    return Advice(
        now,
        shares,
        known.noise,
        tuple(chosen),
        tuple(_new_groups(known, now, max(count, MIN_NEW_GROUP))) if setup.board.rows else (),
        forecast(known.models, setup.better_board(0.5), now.derivatives),
        len(views),
    )


def _greedy(known: Known, views: list[PlannedView], now: Forecast, count: int, progress: Progress) -> list[Choice]:
    """Chooses view after view, each time the one with which the worst face has the smallest σ."""
    chosen: list[Choice] = []
    models = {model.group: model for model in known.models}
    while views and len(chosen) < count:
        progress(f"view {len(chosen) + 1}", 0, len(views))
        positions = PositionsWith.of(list(models.values()), known.setup, now.derivatives)
        jobs = [(positions, views[i : i + AT_ONCE]) for i in range(0, len(views), AT_ONCE)]
        results = [sigma for part in run_in_order(_positions, jobs, 1) for sigma in part]
        progress(f"view {len(chosen) + 1}", len(views), len(views))
        best = int(np.argmin([worst_of(sigma)[1] for sigma in results]))
        chosen.append(Choice(views[best], *worst_of(results[best])))
        models[views[best].group] = models[views[best].group].plus(views[best].model)
        # The best views for each of the faces, as another face may become the worst one.
        ranked = [sorted(range(len(views)), key=lambda i, face=face: results[i][face]) for face in results[0]]
        keep = {i for order in ranked for i in order[:SHORTLIST]} - {best}
        views = [views[i] for i in sorted(keep)]
    return chosen


def _positions(positions: PositionsWith, views: Sequence[PlannedView]) -> list[dict[str, float]]:
    return [positions(view.model) for view in views]


def _new_groups(known: Known, now: Forecast, images: int) -> list[NewGroup]:
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


def _new_model(known: Known, pair: tuple[str, str], images: int) -> MetricModel:
    """Returns a group of two faces with the board beside them, at the distance of the present photographs."""
    scene = known.scene
    name = f"new {group_name(pair)}"
    normals = [scene.target_from_face[face].rotation[:, 2] for face in pair]
    axes = viewing_axes(normals[0], normals[1], name)
    present = next(iter(scene.groups))
    dots = np.column_stack([scene.board.xy_mm(), np.zeros(scene.board.rows * scene.board.columns)])
    shape = GroupShape(
        name,
        np.vstack([scene.face_circles(face) for face in pair]),
        np.repeat(normals, [len(scene.target.face(face).ids) for face in pair], axis=0),
        axes,
        np.vstack([scene.face_outline(face.id) for face in scene.target.faces]),
        dots,
        scene.groups[present].target_from_board.inverse() @ scene.board_outline(present),
    )
    depth = np.median(np.concatenate([model.xyz_camera()[:, 2] for model in known.models]))
    target_from_board, poses = place_group(
        shape, scene.camera, images, float(depth), NEW_GROUP_SPREAD_RAD, np.random.default_rng(0)
    )
    group = Group(name, pair, axes, target_from_board, target_from_board @ dots, tuple(poses))
    alone = replace(scene, groups={name: group})
    (model,) = true_models(alone, observe(alone, 0.0, np.random.default_rng(0)))
    return known.noise.applied(model, scene.camera, known.setup.radius_mm())


@require_arguments
def noise_of_run(run: AnyRun) -> CentreNoise:
    """Returns the noise of centres by size and tilt of the circles, as estimated from a run.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.

    Returns
    -------
    CentreNoise
        As :class:`stcal.sfm.PlanOptions` takes it.
    """
    known = known_of(saved_run(run))
    return known.noise.scaled(known.setup.sigma0)


def expected_noise(of_corners: bool = False) -> tuple[CentreNoise, str]:
    """Returns the σ to expect in good photographs; ``of_corners`` : of tags and squares, not of circles."""
    of_circles = (
        f"image noise {100 * IMAGE_NOISE:g} % and contrast {100 * CONTRAST:g} % of full scale, edges blurred by "
        f"{BLUR_PX:g} px, {PRACTICE:g} × the Cramér–Rao bound"
    )
    return CentreNoise.expected(), "what corners of tags have in rendered photographs" if of_corners else of_circles
