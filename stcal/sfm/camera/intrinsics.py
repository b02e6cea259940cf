"""Intrinsics from views of the dot board: one adjustment over intrinsics, board poses and the board's own shape.

Every image has its own pose of the board. The dots of a folder's images are those of one board in one state: their
places are unknowns, and the design is an observation of them with the board's σ; scale does not matter here. That the
board is bowed or twisted as a whole, by far more than its dots are off, is left free where the images show it. The
image of a *circle* is the model. σ of the centres and of the dots are estimated too (variance components).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.geometry.variances import sigma_factor
from stcal.io.cameras.model import intrinsic_basis
from stcal.labels import Label
from stcal.sfm.adjust.blocks import robust_weights
from stcal.sfm.adjust.refine import eccentricity_px
from stcal.sfm.camera.equations import Normal, Setting, State, dots_costs, minimum
from stcal.sfm.camera.shape import BoardShape
from stcal.sfm.camera.views import start_pose
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations, by_group

MAX_ROUNDS = 20
FLAT_AFTER = 2
"""Rounds after which σ are known well enough to tell which boards are flat."""
SETTLED_FACTOR = 0.005
"""Rounds end when no variance component moves by more than this …"""
SETTLED_SHIFT_PX = 1e-5
"""… and no eccentricity by more than this."""
LEAST_ROBUST = 1e-6
"""Robust σ of residuals over σ: exact data have none."""
LEAST_DOTS = 0.1
"""Dots may be nearer to the grid than the board file says, but none is exact."""
MIN_BOARD_REDUNDANCY = 20.0
"""Below that the dots' residuals do not tell their σ, and the stated one stands."""


@dataclass(frozen=True, slots=True)
class SigmaFactors:
    """By how much residuals exceed the σ that the centres came with (``centres``) and that the board file states
    for the dots (``dots``)."""

    centres: float = 1.0
    dots: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """``cameras`` adjusted, c of them; ``covariance`` : (cq, cq) of the parameters of ``colmap_model``, camera by
    camera; ``models`` : the boards as seen by each camera, one for each folder, mm, board frame; ``camera_of`` each;
    ``factors`` ; ``huber`` : the length of a normalised residual beyond which it weighs less; ``redundancy`` ;
    ``settled`` : whether σ and eccentricities did within :data:`MAX_ROUNDS`."""

    cameras: tuple[Camera, ...]
    colmap_model: str
    covariance: np.ndarray
    models: tuple[MetricModel, ...]
    camera_of: tuple[int, ...]
    factors: SigmaFactors
    huber: float
    redundancy: int
    settled: bool

    @property
    def camera(self) -> Camera:
        """The first camera, the only one but for a comparison."""
        return self.cameras[0]

    def sigma(self) -> np.ndarray:
        """Standard deviations of the parameters, (cq,)."""
        return np.sqrt(np.diag(self.covariance))

    def residuals_px(self) -> np.ndarray:
        """Of all observations, (n, 2)."""
        parts = [m.residuals_px(self.cameras[k]) for m, k in zip(self.models, self.camera_of, strict=True)]
        return np.concatenate(parts)

    def weights(self) -> list[np.ndarray]:
        """Huber's, for each model."""
        return [
            robust_weights(m, self.cameras[k], self.huber) for m, k in zip(self.models, self.camera_of, strict=True)
        ]


def model_parameters(camera: Camera, colmap_model: str) -> np.ndarray:
    """Parameters of a COLMAP model, (q,), with OpenCV's pixel origin."""
    return np.linalg.pinv(intrinsic_basis(colmap_model)) @ camera.parameters()


def vague_prior(camera: Camera, colmap_model: str) -> np.ndarray:
    """Covariance (q, q) of what any lens fulfils: it only keeps the normal matrix regular.

    σ: focal length 100 %, centre a quarter of the longer side, each distortion coefficient what moves the corner of
    the image by its own distance from the middle (tangential: a tenth of it).
    """
    side = max(camera.width, camera.height)
    reach = float(np.hypot(camera.width, camera.height) / 2 / camera.focal.mean())
    radial = reach ** -np.array([2.0, 4, 6])
    tangential = [0.1 / reach] * 2
    prism = [tangential[0], 0.1 / reach**3] * 2
    flat = np.concatenate([camera.focal, [side / 4] * 2, radial[:2], tangential, radial[2:], radial, prism])
    return np.diag(flat[intrinsic_basis(colmap_model).argmax(0)] ** 2)


def adjust_intrinsics(
    views: Sequence[ImageObservations],
    board: BoardDesign,
    start: Camera,
    colmap_model: str,
    camera_of_view: Sequence[int] | None = None,
    factors: SigmaFactors | None = None,
    held: bool = False,
) -> Intrinsics:
    """Adjust the intrinsics from ``start``.

    Parameters
    ----------
    views : board dots alone, at least three views
    camera_of_view : which camera took each view, for a comparison of cameras 0, 1, … on the same boards
    factors : taken as known; estimated where None
    held : the intrinsics stay at ``start``, poses and board alone are adjusted; ``covariance`` is (0, 0) then

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    DegenerateError
        The dots of a view do not determine its pose.
    """
    basis = intrinsic_basis(colmap_model)[:, : 0 if held else None]
    state = _start_state(views, camera_of_view or [0] * len(views), board, start)
    c = len(state.cameras)
    setting = Setting(
        basis=(basis,) * c,
        weight=(np.zeros((0, 0)) if held else np.linalg.inv(vague_prior(start, colmap_model)),) * c,
        start=(start,) * c,
        shape=design_shapes(state, board),
        sigma_mm=board.sigma_mm,
        huber=np.inf,
    )
    found = adjusted(state, setting, board, factors)
    covariance = np.linalg.inv(found.last.normal)
    return Intrinsics(
        cameras=found.state.cameras,
        colmap_model=colmap_model,
        covariance=(covariance + covariance.T) / 2,
        models=found.state.models,
        camera_of=found.state.camera_of,
        factors=found.factors,
        huber=found.setting.huber,
        redundancy=found.state.redundancy(setting.kept),
        settled=found.settled,
    )


def design_shapes(state: State, board: BoardDesign) -> dict[str, BoardShape]:
    """By folder, of the dots that it shows."""
    labels = {folder: state.models[rows[0]].labels for folder, rows in state.boards().items()}
    return {folder: BoardShape.of(board.places_mm(own)) for folder, own in labels.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Where the rounds of an adjustment ended; ``last`` : its normal equations; ``settled`` : whether they settled."""

    state: State
    setting: Setting
    last: Normal
    factors: SigmaFactors
    settled: bool


def adjusted(state: State, setting: Setting, board: BoardDesign, known: SigmaFactors | None = None) -> Adjusted:
    """Minimise, estimate σ and eccentricity, and again, until these settle.

    Parameters
    ----------
    state, setting : where it begins; its models have the centres' own σ
    known : factors of σ; estimated where None

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    own, factors = [m.covariance_px2 for m in state.models], known or SigmaFactors()
    last: Normal | None = None
    settled = False
    for done in range(MAX_ROUNDS):
        if last is not None and done == FLAT_AFTER:
            setting = replace(setting, shape=last.with_flat_boards())
        before = state
        state = _weighted(state, own, factors, board)
        shifted = max(np.abs(a.shift_px - b.shift_px).max() for a, b in zip(state.models, before.models, strict=True))
        setting = replace(setting, sigma_mm=factors.dots * board.sigma_mm)
        state = minimum(state, setting)
        robust = max(robust_sigma(np.linalg.norm(state.normalised(), axis=1), 2), LEAST_ROBUST)
        setting = replace(setting, huber=HUBER * robust)
        last = Normal.of(state, setting)
        updated = known or _updated_factors(last, factors)
        change = max(abs(updated.centres / factors.centres - 1), abs(updated.dots / factors.dots - 1))
        factors = updated
        settled = bool(done >= FLAT_AFTER and change < SETTLED_FACTOR and shifted < SETTLED_SHIFT_PX)
        if settled:
            break
    assert last is not None
    return Adjusted(state, setting, last, factors, settled)


def _start_state(views, camera_of_view, board: BoardDesign, start: Camera) -> State:
    models, folders, which, instants = [], [], [], []
    camera_of = {v.name: k for v, k in zip(views, camera_of_view, strict=True)}
    poses: dict[str, tuple[Rigid, ...]] = {}
    for folder, members in by_group(views).items():
        labels = tuple(sorted({label for v in members for label in v.labels}))
        for k in sorted({camera_of[v.name] for v in members}):
            own = [v for v in members if camera_of[v.name] == k]
            models.append(model_of_views(folder, labels, own, board, start))
            folders.append(folder)
            which.append(k)
            known = poses.get(folder, ())
            instants.append(len(known) + np.arange(len(own)))
            poses[folder] = known + models[-1].camera_from_model
    cameras = (start,) * (max(which) + 1)
    return State(tuple(models), tuple(folders), tuple(which), tuple(instants), poses, cameras)


def model_of_views(folder: str, labels: tuple[Label, ...], views, board: BoardDesign, camera: Camera) -> MetricModel:
    """The views of a folder around its board, which stands still, at its design's places."""
    place = {label: i for i, label in enumerate(labels)}
    rows = [(i, place[label], k) for i, v in enumerate(views) for k, label in enumerate(v.labels)]
    image_index, point_index, keypoint = np.array(rows).T
    return MetricModel(
        group=folder,
        images=tuple(v.name for v in views),
        camera_from_model=tuple(start_pose(v, board, camera) for v in views),
        labels=labels,
        xyz_model=board.places_mm(labels),
        image_index=image_index,
        point_index=point_index,
        keypoint=keypoint,
        measured_px=np.concatenate([v.centre_px for v in views]),
        shift_px=np.zeros((len(rows), 2)),
        covariance_px2=np.concatenate([v.covariance_px2 for v in views]),
    )


def _weighted(state: State, own: list[np.ndarray], factors: SigmaFactors, board: BoardDesign) -> State:
    """The state with the centres' σ scaled, and the eccentricity as it is now."""
    radius: dict[Label, float] = {**board.radius_of()}
    models = tuple(
        replace(
            m,
            shift_px=eccentricity_px(m, state.cameras[k], radius, 1.0),
            covariance_px2=factors.centres**2 * covariance,
        )
        for m, k, covariance in zip(state.models, state.camera_of, own, strict=True)
    )
    return replace(state, models=models)


def _updated_factors(last: Normal, factors: SigmaFactors) -> SigmaFactors:
    """Variance components of centres and dots (Förstner 1979), each from its own residuals and redundancy."""
    state, setting = last.state, last.setting
    image_left = state.redundancy(setting.kept) - last.dots_left
    dots = factors.dots
    if last.dots_left > MIN_BOARD_REDUNDANCY:
        dots = max(LEAST_DOTS, dots * sigma_factor(dots_costs(state, setting)[0], last.dots_left))
    return SigmaFactors(factors.centres * sigma_factor(state.cost(setting.huber), image_left), dots)
