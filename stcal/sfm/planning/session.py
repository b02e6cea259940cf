"""Forecast of a plan before any image exists: the σ to expect, and what would help most."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import TypeVar

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, require_fields, rms
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel, camera_prior, refinable
from stcal.io.cameras.read import camera_model
from stcal.parallel import one_thread, run_in_order
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.data.model import MetricModel
from stcal.sfm.detect.defocus import RESPONSE
from stcal.sfm.planning.forecast import (
    ONE_PLATE,
    CentreNoise,
    Forecast,
    Setup,
    forecast,
    observe,
    true_models,
    variance_shares,
)
from stcal.sfm.runs.options import RunOptions
from stcal.synthetic.scene import FACE_MARGIN_MM, Scene, SceneOptions, group_name, make_scene, seen_by

R = TypeVar("R")
SPREADS_DEG = (80.0, 70.0, 60.0, 50.0, 40.0)
"""Spreads that are tried, from the largest down. The largest tilts that a view may have often forbid wide ones."""
NEARER = 0.8
"""Distance of the remedy of nearer cameras, relative to the plan's."""
MIN_IMAGES = 2
MANY_DOTS = 2000
"""Number of dots from which on remedies are forecast in processes of their own; fewer take less time than their
start."""
MAX_DOTS = 10_000
"""Largest number of dots of a board."""
FINE_DOTS, MAX_CENTRES = 500, 450_000
"""Largest number of dots in all images, for boards of more than ``FINE_DOTS`` dots: about a minute and 0.8 GB."""


@dataclass(frozen=True, slots=True, repr=False)
class PlanOptions(Brief):
    """The plan of a session.

    Parameters
    ----------
    images : int
        Number of images of each group.
    spread_deg : float
        ± about the view that shows both faces equally, degrees.
    distance_mm : float
        Distance of the cameras from the target, mm.
    width : int
        Width of the images, px; 3:2 images of a 24 mm lens, if no ``camera`` is given.
    camera : Camera, optional
        Camera, whose file must state the image size.
    groups : tuple of pairs of str, optional
        Pairs of face ids; the pairs of the design if None.
    noise : CentreNoise
        σ of the centres.
    one_board : bool
        Whether the same plate is in all groups; else each group has its own.
    run : RunOptions
        Flatness, frame, refined intrinsics and reference face.
    seed : int
        Seed of the random places of board and cameras.
    margin_mm : float
        How far plates without ``outline_mm`` reach beyond the rims of their circles.

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
            raise InputError(
                "E-OPTION-RANGE", f"plan: {self.images} images in each group, {MIN_IMAGES} needed; plan for more"
            )
        model = None if self.camera is None else camera_model(self.camera)
        if model is not None and not (model.width and model.height):
            raise InputError(
                "E-CAMERA-SIZE", f"plan: camera file {model.source} states no image size; add it to the file"
            )


@dataclass(frozen=True, slots=True)
class Remedy:
    """A change of the plan."""

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
    for name in names:
        if name not in pair_of_name:
            raise InputError(
                "E-OPTION-VALUE",
                f"--groups: {name!r} is not a pair of faces; use for example {', '.join(list(pair_of_name)[:3])}: ids "
                "of one "
                "character beside each other, longer ones with a hyphen",
            )
    return tuple(pair_of_name[name] for name in names)


@one_thread()
def plan_with_board(
    options: PlanOptions, target: TargetDesign, board: BoardDesign, nominal: dict[str, Rigid] | None = None
) -> Plan:
    """Returns the forecast of photographs of a target of circles beside a board; see :func:`stcal.sfm.plan`."""
    if (dots := board.rows * board.columns) > MAX_DOTS:
        raise InputError(
            "E-PLAN-TOO-LARGE",
            f"plan: board of {board.rows}×{board.columns} = {dots} dots, up to {MAX_DOTS} possible; plan with "
            "fewer dots over the same area, the σ of the faces hardly change",
        )
    scene = _scene(options, target, board, nominal)
    if dots > FINE_DOTS and (centres := dots * options.images * len(scene.groups)) > MAX_CENTRES:
        raise InputError(
            "E-PLAN-TOO-LARGE",
            f"plan: {dots} dots in {options.images * len(scene.groups)} images are {centres} centres, up to "
            f"{MAX_CENTRES} possible; plan fewer images, or fewer dots over the same area",
        )
    inputs = (target, board, nominal)
    jobs = [
        (_now, scene, options, board),
        (remedy, "twice the images", _forecast, replace(options, images=2 * options.images), *inputs),
        (_wider, options, *inputs),
        (remedy, "nearer by 20 %", _forecast, replace(options, distance_mm=NEARER * options.distance_mm), *inputs),
    ]
    workers = None if dots > MANY_DOTS else 1
    now, more, wider, near = run_in_order(_called, jobs, workers)
    return replace(now, remedies=(more, wider, *now.remedies, near))


def _called(function: Callable[..., R], *arguments) -> R:
    """Returns what a function returns; a job of another process."""
    with one_thread():
        return function(*arguments)


def _now(scene: Scene, options: PlanOptions, board: BoardDesign) -> Plan:
    return plan_as_asked(options, _setup(scene, options, board), _models(scene, options), "a board of half the σ")


def plan_as_asked(options: PlanOptions, setup: Setup, models: Sequence[MetricModel], half_sigma: str) -> Plan:
    """Returns the plan of these photographs, with ``half_sigma``, half the σ of what tells the size, as only remedy."""
    expected = forecast(models, setup)
    better = forecast(models, setup.better_board(0.5), expected.derivatives)
    return Plan(
        options,
        setup,
        tuple(model.group for model in models),
        sum(len(model.image_index) for model in models),
        rms(np.concatenate([model.sigma_px() for model in models])),
        widest_aperture_mm(models, setup.camera),
        expected,
        variance_shares(expected, models, setup),
        (Remedy(half_sigma, better.worst()[1]),),
    )


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


def _scene(options: PlanOptions, target: TargetDesign, board: BoardDesign, nominal) -> Scene:
    """Returns the scene with the nominal geometry, in which nothing is misplaced."""
    file = None if options.camera is None else camera_model(options.camera)
    shape = SceneOptions(
        seed=options.seed,
        centre_sigma=0.0,
        distance_mm=options.distance_mm,
        spread_deg=options.spread_deg,
        images_per_group=options.images,
        groups=options.groups,
        circle_sigma_mm=0.0,
        face_shift_mm=0.0,
        face_turn_deg=0.0,
        width=options.width,
        height=round(options.width * 2 / 3),
        margin_mm=options.margin_mm,
    )
    if file is not None:
        shape = seen_by(shape, file)
    scene = make_scene(shape, target, replace(board, sigma_mm=0.0), nominal)
    return scene if file is None else replace(scene, camera=file.calibrated(0, 0))


def _setup(scene: Scene, options: PlanOptions, board: BoardDesign) -> Setup:
    run = options.run.adjustment(scene.target)
    linked = _linked(run.reference_face, [group.faces for group in scene.groups.values()])
    start = CalibratedTarget(
        run.reference_face,
        {face: pose for face, pose in scene.target_from_face.items() if face in linked},
        scene.circles_target,
        dict.fromkeys(scene.groups, Rigid()),
    )
    return Setup(
        target=scene.target,
        board=board,
        camera=scene.camera,
        start=start,
        frame=run.frame,
        flatness_mm=run.flatness_mm,
        prior=camera_prior(refinable(scene.camera)) if run.refine_camera else None,
        common=ONE_PLATE if options.one_board else 0.0,
    )


def _linked(reference: str, pairs: list[tuple[str, ...]]) -> set[str]:
    """Returns the faces of all groups; an error if one is not linked to the reference face."""
    planned = {face for pair in pairs for face in pair}
    linked = {reference}
    for _ in planned:
        linked |= {face for pair in pairs if linked & set(pair) for face in pair}
    if len(linked) < 2 or planned - linked:
        unlinked = ", ".join(sorted(planned - linked)) or "any other face"
        raise InputError(
            "E-PLAN-UNLINKED",
            f"plan: no group links face {unlinked} to reference face {reference}; add a group that shows one of each",
        )
    return linked


def _models(scene: Scene, options: PlanOptions) -> list[MetricModel]:
    radius = scene.target.radius_of() | scene.board.radius_of()
    exact = true_models(scene, observe(scene, 0.0, np.random.default_rng(0)))
    return [options.noise.applied(model, scene.camera, radius) for model in exact]


def _forecast(options: PlanOptions, target: TargetDesign, board: BoardDesign, nominal) -> Forecast:
    scene = _scene(options, target, board, nominal)
    return forecast(_models(scene, options), _setup(scene, options, board))


def remedy(what: str, make: Callable[..., Forecast], *inputs) -> Remedy:
    """Returns a change with the σ of the worst face of its forecast, or with the reason why it is impossible."""
    try:
        return Remedy(what, make(*inputs).worst()[1])
    except (DegenerateError, InputError) as error:
        return Remedy(what, None, str(error))


def _wider(options: PlanOptions, *inputs) -> Remedy:
    """Returns the remedy of the largest spread at which there are enough views."""
    found = Remedy("larger spread", None, f"±{options.spread_deg:g}° is as far as both faces and the board show")
    for spread in SPREADS_DEG:
        if spread > options.spread_deg and found.sigma_mm is None:
            found = remedy(f"spread of ±{spread:g}°", _forecast, replace(options, spread_deg=spread), *inputs)
    return found
