"""Intrinsics from views of the dot board: one adjustment over intrinsics, board poses and the board's own shape.

Every image has its own pose of the board. The dots of a folder's images are those of one board in one state: their
places are unknowns, and the design is an observation of them with the board's σ; scale does not matter here. That the
board is bowed or twisted as a whole, by far more than its dots are off, is left free where the images show it. The
image of a *circle* is the model. σ of the centres and of the dots are estimated too (variance components).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import Reduction, reduce
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.geometry.variances import sigma_factor
from stcal.io.camera import intrinsic_basis
from stcal.labels import Label
from stcal.sfm.adjust.blocks import image_cost, normalised, robust_weights, without_cameras
from stcal.sfm.adjust.group import moved_poses
from stcal.sfm.adjust.refine import eccentricity_px
from stcal.sfm.camera.views import start_pose
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations, by_group

MAX_STEPS = 200
EXACTLY = 1e-15
"""Share of χ² that the last step may promise …"""
SETTLED_PX = 1e-6
"""… or by less than this it moves every projection: along a valley there is always more to gain, and nothing to see."""
TINY_PX = 1e-3
"""Focal length of no lens."""
CREEPING_PX = 1e-3
"""Moves below this after all steps are along a direction that hardly changes the images: its σ says so."""
START_DAMPING = 1e-3
MAX_ROUNDS = 20
FLAT_AFTER = 2
"""Rounds after which σ are known well enough to tell which boards are flat."""
SETTLED_FACTOR = 0.005
"""Rounds end when no variance component moves by more than this …"""
SETTLED_SHIFT_PX = 1e-5
"""… and no eccentricity by more than this."""
BOW_SHARE = 0.005
"""σ of a board's bends at its edge, in parts of its extent: a millimetre on 200 mm, more than any that is in use."""
BENT_P = 1e-3
"""Bends that chance makes in more than one flat board of a thousand are none: to leave them free costs accuracy."""
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


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Unknowns. ``folder`` : of each model; models of one folder share their points."""

    models: tuple[MetricModel, ...]
    folder: tuple[str, ...]
    camera_of: tuple[int, ...]
    cameras: tuple[Camera, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Design:
    """Where a folder's dots are by design, ``places`` (n, 3) mm, and how they may be off.

    ``bow`` : (3n, m) orthonormal, the second-order bends of the board out of its plane; ``bow_sigma_mm`` : of the
    amplitude along each. All else is off by the board's σ, independently.
    """

    places: np.ndarray
    bow: np.ndarray
    bow_sigma_mm: float

    @classmethod
    def of(cls, places: np.ndarray) -> "_Design":
        """Bends of the places' own extent."""
        xy = places[:, :2] - places[:, :2].mean(axis=0)
        extent = max(float(np.ptp(xy, axis=0).max()), 1e-9)
        x, y = 2 * xy.T / extent
        flat = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))[0]
        bends = np.column_stack([x * x, x * y, y * y])
        bends -= flat @ (flat.T @ bends)
        u, size, _ = np.linalg.svd(bends, full_matrices=False)
        u = u[:, size > 1e-3 * np.sqrt(len(x))]  # fewer where the dots that are seen lie along a line
        bow = np.zeros((3 * len(places), u.shape[1]))
        bow[2::3] = u
        return cls(places, bow, BOW_SHARE * extent * float(np.sqrt(len(places))))

    def weight(self, sigma_mm: float) -> np.ndarray:
        """Inverse covariance (3n, 3n) of the dots' places."""
        bent = 1 / (sigma_mm**2 + self.bow_sigma_mm**2)
        return np.eye(len(self.bow)) / sigma_mm**2 - (1 / sigma_mm**2 - bent) * (self.bow @ self.bow.T)

    def costs(self, xyz: np.ndarray, sigma_mm: float) -> tuple[float, float]:
        """χ² of places (n, 3): of the board's σ, and of its bends."""
        gap = (xyz - self.places).ravel()
        bends = self.bow.T @ gap
        own = float(gap @ gap - bends @ bends) / sigma_mm**2
        return own, float(bends @ bends) / (sigma_mm**2 + self.bow_sigma_mm**2)


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """What stays the same in one minimisation. ``weight`` : (q, q) of the vague prior about ``start``."""

    basis: np.ndarray
    weight: np.ndarray
    start: Camera
    design: dict[str, _Design]
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
    design = {f: _Design.of(board.places_mm(m.labels)) for f, m in zip(state.folder, state.models, strict=True)}
    weight = np.linalg.inv(vague_prior(start, colmap_model))
    setting = _Setting(basis, weight, start, design, board.sigma_mm, np.inf)
    known, factors = factors, factors or SigmaFactors()
    last: _Normal | None = None
    for done in range(MAX_ROUNDS):
        if last is not None and done == FLAT_AFTER:
            setting = replace(setting, design=last.with_flat_boards())
        before = state
        state = _weighted(state, own, factors, board)
        shifted = max(np.abs(a.shift_px - b.shift_px).max() for a, b in zip(state.models, before.models, strict=True))
        setting = replace(setting, sigma_mm=factors.dots * board.sigma_mm)
        state = _minimise(state, setting).state
        setting = replace(setting, huber=HUBER * _robust_sigma(state))
        last = _Normal.of(state, setting)
        updated = known or _updated_factors(state, setting, last.dots_left, factors)
        change = max(abs(updated.centres / factors.centres - 1), abs(updated.dots / factors.dots - 1))
        factors = updated
        settled = bool(done >= FLAT_AFTER and change < SETTLED_FACTOR and shifted < SETTLED_SHIFT_PX)
        if settled:
            break
    assert last is not None
    covariance = np.linalg.inv(last.normal)
    return Intrinsics(
        cameras=state.cameras,
        colmap_model=colmap_model,
        covariance=(covariance + covariance.T) / 2,
        models=state.models,
        camera_of=state.camera_of,
        factors=factors,
        huber=setting.huber,
        redundancy=_image_redundancy(state, basis.shape[1]),
        settled=settled,
    )


def _start_state(views, camera_of_view, board: BoardDesign, start: Camera) -> _State:
    models, folders, which = [], [], []
    camera_of = {v.name: k for v, k in zip(views, camera_of_view, strict=True)}
    for folder, members in by_group(views).items():
        labels = tuple(sorted({label for v in members for label in v.labels}))
        for k in sorted({camera_of[v.name] for v in members}):
            models.append(model_of_views(folder, labels, [v for v in members if camera_of[v.name] == k], board, start))
            folders.append(folder)
            which.append(k)
    return _State(tuple(models), tuple(folders), tuple(which), (start,) * (max(which) + 1))


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


def _weighted(state: _State, own: list[np.ndarray], factors: SigmaFactors, board: BoardDesign) -> _State:
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


def _robust_sigma(state: _State) -> float:
    """Robust σ of the normalised residuals per axis."""
    parts = [normalised(m, state.cameras[k]) for m, k in zip(state.models, state.camera_of, strict=True)]
    length = np.linalg.norm(np.concatenate(parts), axis=1)
    return max(robust_sigma(length, 2), 1e-6)


def _image_redundancy(state: _State, q: int) -> int:
    """Observed coordinates less poses and intrinsics: the dots bring as many observations as unknowns."""
    each = sum(2 * len(m.image_index) - 6 * len(m.images) for m in state.models)
    return each - q * len(state.cameras)


def _updated_factors(state: _State, setting: _Setting, dots_left: float, factors: SigmaFactors) -> SigmaFactors:
    """Variance components of centres and dots (Förstner 1979), each from its own residuals and redundancy."""
    image = sum(
        image_cost(m, state.cameras[k], setting.huber) for m, k in zip(state.models, state.camera_of, strict=True)
    )
    image_left = _image_redundancy(state, setting.basis.shape[1]) - dots_left
    dots = factors.dots
    if dots_left > MIN_BOARD_REDUNDANCY:
        dots = max(LEAST_DOTS, dots * sigma_factor(_dots_costs(state, setting)[0], dots_left))
    return SigmaFactors(factors.centres * sigma_factor(image, image_left), dots)


def _boards(state: _State) -> dict[str, list[int]]:
    """Models by folder."""
    members: dict[str, list[int]] = {}
    for i, folder in enumerate(state.folder):
        members.setdefault(folder, []).append(i)
    return members


def _dots_costs(state: _State, setting: _Setting) -> np.ndarray:
    """χ² of the dots' places: of the board's σ, and of its bends."""
    return np.sum(
        [
            setting.design[folder].costs(state.models[rows[0]].xyz_model, setting.sigma_mm)
            for folder, rows in _boards(state).items()
        ],
        axis=0,
    )


def _cost(state: _State, setting: _Setting) -> float:
    cost = float(_dots_costs(state, setting).sum())
    for camera in state.cameras:
        away = setting.away(camera)
        cost += float(away @ setting.weight @ away)
    return cost + sum(
        image_cost(m, state.cameras[k], setting.huber) for m, k in zip(state.models, state.camera_of, strict=True)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations over the intrinsics of all cameras; the dots of each board are reduced away, the poses of each
    model before them. ``dots_left`` : redundancy of the observations of the dots."""

    cost: float
    state: _State
    setting: _Setting
    normal: np.ndarray
    right: np.ndarray
    boards: tuple[Reduction, ...]
    poses: tuple[Reduction, ...]
    dots_left: float

    @classmethod
    def of(cls, state: _State, setting: _Setting) -> "_Normal":
        q, c = setting.basis.shape[1], len(state.cameras)
        normal = np.kron(np.eye(c), setting.weight)
        right = -np.concatenate([setting.weight @ setting.away(camera) for camera in state.cameras])
        boards, poses = [], []
        for folder, rows in _boards(state).items():
            design = setting.design[folder]
            p = design.places.size
            full, full_right = np.zeros((p + c * q, p + c * q)), np.zeros(p + c * q)
            for i in rows:
                k = state.camera_of[i]
                part, part_right, away = without_cameras(
                    state.models[i], state.cameras[k], setting.basis, setting.huber
                )
                place = np.concatenate([np.arange(p), p + k * q + np.arange(q)])
                full[np.ix_(place, place)] += part
                full_right[place] += part_right
                poses.append(away)
            own = design.weight(setting.sigma_mm)
            full[:p, :p] += own
            full_right[:p] -= own @ (state.models[rows[0]].xyz_model - design.places).ravel()
            dots = reduce(full[None, :p, :p], full_right[None, :p], full[None, :p, p:])
            normal += full[p:, p:] - dots.normal
            right += full_right[p:] - dots.right
            boards.append(dots)
        covariance = np.linalg.inv(normal)
        dots_left = sum(
            _left_of(board, covariance, setting.design[folder].bow, setting.sigma_mm)
            for board, folder in zip(boards, _boards(state), strict=True)
        )
        return cls(_cost(state, setting), state, setting, normal, right, tuple(boards), tuple(poses), float(dots_left))

    def with_flat_boards(self) -> dict[str, _Design]:
        """The designs, without bends of the boards whose bends may be chance."""
        covariance = np.linalg.inv(self.normal)
        found = {}
        for board, (folder, rows) in zip(self.boards, _boards(self.state).items(), strict=True):
            design = self.setting.design[folder]
            bends = design.bow.T @ (self.state.models[rows[0]].xyz_model - design.places).ravel()
            bent = board.from_kept[0].T @ design.bow
            spread = design.bow.T @ board.inverse[0] @ design.bow + bent.T @ covariance @ bent
            spread += self.setting.sigma_mm**2 * np.eye(len(bends))
            chance = chdtrc(max(len(bends), 1), float(bends @ np.linalg.solve(spread, bends)))
            found[folder] = design if chance < BENT_P else replace(design, bow=design.bow[:, :0])
        return found

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Of the intrinsics, then of the dots of each board, then of the poses of each model."""
        own = np.linalg.solve(self.normal + damping * np.diag(np.diag(self.normal)), self.right)
        gain = 2 * float(own @ self.right) - float(own @ self.normal @ own)
        gain += sum(each.gain for each in (*self.boards, *self.poses))
        each_camera = own.reshape(len(self.state.cameras), -1)
        dots = [board.back(own).ravel() for board in self.boards]
        poses, models = [], iter(self.poses)
        for rows, moved in zip(_boards(self.state).values(), dots, strict=True):
            poses += [next(models).back(np.concatenate([moved, each_camera[self.state.camera_of[i]]])) for i in rows]
        step = np.concatenate([own, *dots, *(each.ravel() for each in poses)])
        return step, gain if self.largest_move(step) > SETTLED_PX else 0.0

    def largest_move(self, step: np.ndarray) -> float:
        """By which a step moves any projection, px."""
        new = _moved(self.state, self.setting, step)
        moves = [
            np.abs(b.residuals_px(new.cameras[k]) - a.residuals_px(self.state.cameras[k])).max()
            for a, b, k in zip(self.state.models, new.models, self.state.camera_of, strict=True)
        ]
        return float(max(moves))


def _left_of(board: Reduction, covariance: np.ndarray, bow: np.ndarray, sigma_mm: float) -> float:
    """Redundancy of the observations of a board's dots, but for its bends; ``covariance`` : of the intrinsics."""
    inverse, from_kept = board.inverse[0], board.from_kept[0]
    bent = from_kept.T @ bow
    taken = np.trace(inverse) + np.sum((from_kept @ covariance) * from_kept)
    taken -= np.sum(bow * (inverse @ bow)) + np.sum((covariance @ bent) * bent)
    return board.step.size - bow.shape[1] - float(taken) / sigma_mm**2


def _minimise(state: _State, setting: _Setting) -> _Normal:
    """Normal equations at the minimum: intrinsics are damped, dots and poses at their best for each step of them."""
    found = minimise(
        state,
        lambda at: _Normal.of(at, setting),
        lambda at, step: _moved(at, setting, step),
        cost=lambda at: _cost(at, setting),
        damping=START_DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    last = found.linear
    if not found.converged:  # along a direction that hardly changes the images: its σ says so
        move = last.largest_move(last.step(START_DAMPING)[0])
        if not move < CREEPING_PX:
            raise ConvergenceError(
                f"camera: projections still move by {move:.1g} px after {found.steps} steps, {CREEPING_PX:g} px "
                "needed; look at the images, add views that fill the image and are tilted, or choose a simpler --model"
            )
    return last


def _moved(state: _State, setting: _Setting, step: np.ndarray) -> _State:
    """The state after a step of :meth:`_Normal.step`."""
    q, models = setting.basis.shape[1], list(state.models)
    own, rest = np.split(step, [q * len(state.cameras)])
    boards = _boards(state)
    sizes = [setting.design[folder].places.size for folder in boards]
    *dots, rest = np.split(rest, np.cumsum(sizes))
    order = [i for rows in boards.values() for i in rows]
    poses = dict(zip(order, np.split(rest, np.cumsum([6 * len(models[i].images) for i in order])[:-1]), strict=True))
    for rows, moved in zip(boards.values(), dots, strict=True):
        for i in rows:
            cameras = moved_poses(models[i].camera_from_model, poses[i].reshape(-1, 6))
            xyz = models[i].xyz_model + moved.reshape(-1, 3)
            models[i] = replace(models[i], camera_from_model=cameras, xyz_model=xyz)
    cameras = tuple(
        camera.with_parameters(_positive(camera.parameters() + setting.basis @ s))
        for camera, s in zip(state.cameras, own.reshape(len(state.cameras), q), strict=True)
    )
    return replace(state, models=tuple(models), cameras=cameras)


def _positive(parameters: np.ndarray) -> np.ndarray:
    """Parameters of a camera; where a step leaves none, such as no image agrees with."""
    if (parameters[:2] > 0).all() and np.isfinite(parameters).all():
        return parameters
    return np.concatenate([[TINY_PX, TINY_PX], np.zeros(len(parameters) - 2)])
