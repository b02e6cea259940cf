"""Intrinsics from views of the dot board: one adjustment over intrinsics, board poses and the board's own shape.

Every image has its own pose of the board. The dots of a folder's images are those of one board in one state: their
places are unknowns, and the design is an observation of them with the board's σ; scale does not matter here. The
image of a *circle* is the model. σ of the centres and of the dots are estimated too (variance components).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.camera import intrinsic_basis
from stcal.labels import DotLabel
from stcal.sfm.adjust.blocks import image_cost, normalised, robust_weights, without_cameras
from stcal.sfm.adjust.refine import eccentricity_px
from stcal.sfm.camera.views import start_pose
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations, by_group

HUBER = 3.0
"""In units of the residuals' robust spread: one honest residual in ninety is longer, and loses hardly anything."""
MAX_STEPS = 60
SETTLED_PX = 1e-6
CREEPING_PX = 1e-3
"""Moves below this after all steps are along a direction that hardly changes the images: its σ says so."""
START_DAMPING = 1e-3
MAX_DAMPING = 1e12
MAX_ROUNDS = 20
SETTLED_FACTOR = 0.005
"""Rounds end when no variance component moves by more than this …"""
SETTLED_SHIFT_PX = 1e-5
"""… and no eccentricity by more than this."""
MIN_BOARD_REDUNDANCY = 20.0
"""Below that the dots' residuals do not tell their σ, and the stated one stands."""


@dataclass(frozen=True, slots=True)
class SigmaFactors:
    """By how much residuals exceed the σ that the centres came with (``centres``) and that the board file states
    for the dots (``dots``, not below 1)."""

    centres: float = 1.0
    dots: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """``cameras`` adjusted, c of them; ``covariance`` : (cq, cq) of the parameters of ``colmap_model``, camera by
    camera; ``models`` : the boards as seen by each camera, one for each folder, mm, board frame; ``camera_of`` each;
    ``factors`` ; ``huber`` : the length of a normalised residual beyond which it weighs less; ``redundancy`` ."""

    cameras: tuple[Camera, ...]
    colmap_model: str
    covariance: np.ndarray
    models: tuple[MetricModel, ...]
    camera_of: tuple[int, ...]
    factors: SigmaFactors
    huber: float
    redundancy: int

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


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Unknowns. ``folder`` : of each model; models of one folder share their points."""

    models: tuple[MetricModel, ...]
    folder: tuple[str, ...]
    camera_of: tuple[int, ...]
    cameras: tuple[Camera, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """What stays the same in one minimisation. ``weight`` : (q, q) of the vague prior about ``start``."""

    basis: np.ndarray
    weight: np.ndarray
    start: Camera
    design: dict[str, np.ndarray]
    sigma_mm: float
    huber: float

    def away(self, camera: Camera) -> np.ndarray:
        """Parameters of the COLMAP model minus those at the start, (q,)."""
        return np.linalg.pinv(self.basis) @ (camera.parameters() - self.start.parameters())


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
    flat = np.concatenate([camera.focal, [side / 4] * 2, radial[:2], tangential, radial[2:], radial])
    return np.diag(flat[intrinsic_basis(colmap_model).argmax(0)] ** 2)


def adjust_intrinsics(
    views: Sequence[ImageObservations],
    board: BoardDesign,
    start: Camera,
    colmap_model: str,
    camera_of_view: Sequence[int] | None = None,
    factors: SigmaFactors | None = None,
) -> Intrinsics:
    """Adjust the intrinsics from ``start``.

    Parameters
    ----------
    views : board dots alone, at least three views
    camera_of_view : which camera took each view, for a comparison of cameras 0, 1, … on the same boards
    factors : taken as known; estimated where None

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    DegenerateError
        The dots of a view do not determine its pose.
    """
    basis = intrinsic_basis(colmap_model)
    state = _start_state(views, camera_of_view or [0] * len(views), board, start)
    own = [m.covariance_px2 for m in state.models]
    design = {f: board.places_mm(m.labels) for f, m in zip(state.folder, state.models, strict=True)}
    weight = np.linalg.inv(vague_prior(start, colmap_model))
    setting = _Setting(basis, weight, start, design, board.sigma_mm, np.inf)
    known, factors = factors, factors or SigmaFactors()
    for _ in range(MAX_ROUNDS):
        before = state
        state = _weighted(state, own, factors, board)
        shifted = max(np.abs(a.shift_px - b.shift_px).max() for a, b in zip(state.models, before.models, strict=True))
        setting = replace(setting, sigma_mm=factors.dots * board.sigma_mm)
        state = _minimise(state, setting)
        setting = replace(setting, huber=HUBER * _spread(state))
        reduced, _, _, dots_left = _normal_equations(state, setting)
        updated = known or _updated_factors(state, setting, dots_left, factors)
        change = max(abs(updated.centres / factors.centres - 1), abs(updated.dots / factors.dots - 1))
        factors = updated
        if change < SETTLED_FACTOR and shifted < SETTLED_SHIFT_PX:
            break
    covariance = np.linalg.inv(reduced)
    return Intrinsics(
        cameras=state.cameras,
        colmap_model=colmap_model,
        covariance=(covariance + covariance.T) / 2,
        models=state.models,
        camera_of=state.camera_of,
        factors=factors,
        huber=setting.huber,
        redundancy=_image_redundancy(state, basis.shape[1]),
    )


def _start_state(views, camera_of_view, board: BoardDesign, start: Camera) -> _State:
    models, folders, which = [], [], []
    camera_of = {v.name: k for v, k in zip(views, camera_of_view, strict=True)}
    for folder, members in by_group(views).items():
        labels = tuple(sorted({label for v in members for label in v.labels}))
        for k in sorted({camera_of[v.name] for v in members}):
            models.append(_model(folder, labels, [v for v in members if camera_of[v.name] == k], board, start))
            folders.append(folder)
            which.append(k)
    return _State(tuple(models), tuple(folders), tuple(which), (start,) * (max(which) + 1))


def _model(folder: str, labels: tuple[DotLabel, ...], views, board: BoardDesign, camera: Camera) -> MetricModel:
    """The views of a folder around its board, which stands still in the world."""
    place = {label: i for i, label in enumerate(labels)}
    rows = [(i, place[label], k) for i, v in enumerate(views) for k, label in enumerate(v.labels)]
    image_index, point_index, keypoint = np.array(rows).T
    return MetricModel(
        group=folder,
        images=tuple(v.name for v in views),
        camera_from_world=tuple(start_pose(v, board, camera) for v in views),
        labels=labels,
        xyz_world=board.places_mm(labels),
        image_index=image_index,
        point_index=point_index,
        keypoint=keypoint,
        measured_px=np.concatenate([v.centre_px for v in views]),
        shift_px=np.zeros((len(rows), 2)),
        covariance_px2=np.concatenate([v.covariance_px2 for v in views]),
    )


def _weighted(state: _State, own: list[np.ndarray], factors: SigmaFactors, board: BoardDesign) -> _State:
    """The state with the centres' σ scaled, and the eccentricity as it is now."""
    radius = board.radius_of()
    models = tuple(
        replace(
            m,
            shift_px=eccentricity_px(m, state.cameras[k], radius, 1.0),
            covariance_px2=factors.centres**2 * covariance,
        )
        for m, k, covariance in zip(state.models, state.camera_of, own, strict=True)
    )
    return replace(state, models=models)


def _spread(state: _State) -> float:
    """Robust σ of the normalised residuals per axis, from the median of their lengths (Rayleigh)."""
    parts = [normalised(m, state.cameras[k]) for m, k in zip(state.models, state.camera_of, strict=True)]
    length = np.linalg.norm(np.concatenate(parts), axis=1)
    return max(float(np.median(length) / np.sqrt(2 * np.log(2))), 1e-6)


def _image_redundancy(state: _State, q: int) -> int:
    """Observed coordinates less poses and intrinsics: the dots bring as many observations as unknowns."""
    each = sum(2 * len(m.image_index) - 6 * len(m.images) for m in state.models)
    return each - q * len(state.cameras)


def _updated_factors(state: _State, setting: _Setting, dots_left: float, factors: SigmaFactors) -> SigmaFactors:
    """Variance components of centres and dots (Förstner 1979), each from its own residuals and redundancy."""
    image = sum(
        image_cost(m, state.cameras[k], setting.huber) for m, k in zip(state.models, state.camera_of, strict=True)
    )
    image_left = max(_image_redundancy(state, setting.basis.shape[1]) - dots_left, 1.0)
    dots = factors.dots
    if dots_left > MIN_BOARD_REDUNDANCY:
        dots = max(1.0, dots * float(np.sqrt(_dots_cost(state, setting) / dots_left)))
    return SigmaFactors(factors.centres * float(np.sqrt(image / image_left)), dots)


def _boards(state: _State) -> dict[str, list[int]]:
    """Models by folder."""
    members: dict[str, list[int]] = {}
    for i, folder in enumerate(state.folder):
        members.setdefault(folder, []).append(i)
    return members


def _dots_cost(state: _State, setting: _Setting) -> float:
    gaps = [state.models[rows[0]].xyz_world - setting.design[folder] for folder, rows in _boards(state).items()]
    return sum(float((gap**2).sum()) for gap in gaps) / setting.sigma_mm**2


def _cost(state: _State, setting: _Setting) -> float:
    cost = _dots_cost(state, setting)
    for camera in state.cameras:
        away = setting.away(camera)
        cost += float(away @ setting.weight @ away)
    return cost + sum(
        image_cost(m, state.cameras[k], setting.huber) for m, k in zip(state.models, state.camera_of, strict=True)
    )


def _normal_equations(state: _State, setting: _Setting):
    """Normal matrix and right-hand side over the intrinsics of all cameras; the way back to dots and poses; and the
    redundancy of the observations of the dots."""
    q, c = setting.basis.shape[1], len(state.cameras)
    reduced = np.kron(np.eye(c), setting.weight)
    right = -np.concatenate([setting.weight @ setting.away(camera) for camera in state.cameras])
    back, own = [], []
    for folder, rows in _boards(state).items():
        p = 3 * len(setting.design[folder])
        full, full_right, poses = np.zeros((p + c * q, p + c * q)), np.zeros(p + c * q), []
        for i in rows:
            k = state.camera_of[i]
            part, part_right, *pose = without_cameras(state.models[i], state.cameras[k], setting.basis, setting.huber)
            place = np.concatenate([np.arange(p), p + k * q + np.arange(q)])
            full[np.ix_(place, place)] += part
            full_right[place] += part_right
            poses.append((i, *pose))
        gap = state.models[rows[0]].xyz_world - setting.design[folder]
        full[np.arange(p), np.arange(p)] += 1 / setting.sigma_mm**2
        full_right[:p] -= gap.ravel() / setting.sigma_mm**2
        inverse = np.linalg.inv(full[:p, :p])
        from_intrinsics = inverse @ full[:p, p:]
        reduced += full[p:, p:] - full[p:, :p] @ from_intrinsics
        right += full_right[p:] - from_intrinsics.T @ full_right[:p]
        back.append((inverse @ full_right[:p], from_intrinsics, poses))
        own.append((p, np.trace(inverse), from_intrinsics))
    covariance = np.linalg.inv(reduced)
    left = sum(p - (trace + np.sum((b @ covariance) * b)) / setting.sigma_mm**2 for p, trace, b in own)
    return reduced, right, back, float(left)


def _minimise(state: _State, setting: _Setting) -> _State:
    """Levenberg–Marquardt: intrinsics damped, dots and poses at their best for each step of them."""
    damping, cost = START_DAMPING, _cost(state, setting)
    for _ in range(MAX_STEPS):
        reduced, right, back, _ = _normal_equations(state, setting)
        while True:
            step = np.linalg.solve(reduced + damping * np.diag(np.diag(reduced)), right)
            trial = _moved(state, setting, step, back)
            move = _largest_move(state, trial) if trial else np.inf
            if move < SETTLED_PX:
                return state
            trial_cost = _cost(trial, setting) if trial else np.inf
            if trial_cost <= cost * (1 + 1e-12):
                break
            damping *= 10
            if damping > MAX_DAMPING:
                raise ConvergenceError(
                    "camera: the adjustment finds no better intrinsics; look at the images, leave out the worst, "
                    "or choose a simpler --model"
                )
        state, cost, damping = trial, trial_cost, damping / 10
    if move < CREEPING_PX:
        return state
    raise ConvergenceError(
        f"camera: projections still move by {move:.1g} px after {MAX_STEPS} steps, {CREEPING_PX:g} px needed; "
        "add views that fill the image and are tilted, or choose a simpler --model"
    )


def _moved(state: _State, setting: _Setting, step: np.ndarray, back) -> _State | None:
    """The state after a step of the intrinsics; None where that leaves no camera."""
    q = setting.basis.shape[1]
    steps = step.reshape(len(state.cameras), q)
    models = list(state.models)
    for dots_step, from_intrinsics, poses in back:
        dots = dots_step - from_intrinsics @ step
        for i, pose_step, from_kept in poses:
            kept = np.concatenate([dots, steps[state.camera_of[i]]])
            models[i] = _with_steps(models[i], dots, pose_step - from_kept @ kept)
    parameters = [c.parameters() + setting.basis @ s for c, s in zip(state.cameras, steps, strict=True)]
    if any((p[:2] <= 0).any() or not np.isfinite(p).all() for p in parameters):
        return None
    cameras = tuple(c.with_parameters(p) for c, p in zip(state.cameras, parameters, strict=True))
    return replace(state, models=tuple(models), cameras=cameras)


def _with_steps(model: MetricModel, dots: np.ndarray, poses: np.ndarray) -> MetricModel:
    turned = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    cameras = tuple(
        Rigid(turn @ pose.rotation, pose.translation + step[3:])
        for turn, pose, step in zip(turned, model.camera_from_world, poses, strict=True)
    )
    return replace(model, camera_from_world=cameras, xyz_world=model.xyz_world + dots.reshape(-1, 3))


def _largest_move(old: _State, new: _State) -> float:
    moves = [
        np.abs(b.residuals_px(new.cameras[k]) - a.residuals_px(old.cameras[k])).max()
        for a, b, k in zip(old.models, new.models, old.camera_of, strict=True)
    ]
    return float(max(moves))
