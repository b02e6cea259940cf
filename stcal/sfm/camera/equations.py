"""Normal equations of a camera calibration, with the board's shape as unknowns."""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy.special import chdtrc

from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import Reduction, reduce
from stcal.sfm.adjust.equations import equations_of_poses, image_cost, normalised, robust_weights
from stcal.sfm.adjust.refine import moved_poses, projection_jacobians
from stcal.sfm.data.model import MetricModel

BOW_SHARE = 0.005
"""σ of a board's bends at its edge relative to its extent: 1 mm on 200 mm, more than that of any board in use."""
BENT_P = 1e-3
"""Significance level of bends. Insignificant bends are fixed to zero, as free bends cost accuracy."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardShape:
    """Design places of a folder's dots, and the prior of their deviations."""

    places: np.ndarray  # (n, 3) mm
    bow: np.ndarray  # (3n, m) orthonormal, second-order bends of the board out of its plane
    bow_sigma_mm: float  # of the amplitude of each bend; all else deviates with the board's σ

    @classmethod
    def of(cls, places: np.ndarray) -> "BoardShape":
        """Returns the shape of a board with these places, its bends scaled by their extent."""
        xy = places[:, :2] - places[:, :2].mean(axis=0)
        extent = max(float(np.ptp(xy, axis=0).max()), 1e-9)
        x, y = 2 * xy.T / extent
        flat = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))[0]
        bends = np.column_stack([x * x, x * y, y * y])
        bends -= flat @ (flat.T @ bends)
        u, size, _ = np.linalg.svd(bends, full_matrices=False)
        u = u[:, size > 1e-3 * np.sqrt(len(x))]  # fewer bends if the visible dots lie along a line
        bow = np.zeros((3 * len(places), u.shape[1]))
        bow[2::3] = u
        return cls(places, bow, BOW_SHARE * extent * float(np.sqrt(len(places))))

    def weight(self, sigma_mm: float) -> np.ndarray:
        """Returns the inverse covariance (3n, 3n) of the dots' places."""
        bent = 1 / (sigma_mm**2 + self.bow_sigma_mm**2)
        return np.eye(len(self.bow)) / sigma_mm**2 - (1 / sigma_mm**2 - bent) * (self.bow @ self.bow.T)

    def costs(self, xyz: np.ndarray, sigma_mm: float) -> tuple[float, float]:
        """Returns the χ² of the deviations of places (n, 3) from the design: without bends, and of the bends."""
        deviation = (xyz - self.places).ravel()
        bends = self.bow.T @ deviation
        cost_of_dots = float(deviation @ deviation - bends @ bends) / sigma_mm**2
        return cost_of_dots, float(bends @ bends) / (sigma_mm**2 + self.bow_sigma_mm**2)

    def redundancy(self, board: Reduction, covariance: np.ndarray, sigma_mm: float) -> float:
        """Returns the redundancy of the dots without the bends; ``covariance``: of the unknowns that are kept."""
        inverse, from_kept = board.inverse[0], board.from_kept[0]
        bent = from_kept.T @ self.bow
        taken = np.trace(inverse) + np.sum((from_kept @ covariance) * from_kept)
        taken -= np.sum(self.bow * (inverse @ self.bow)) + np.sum((covariance @ bent) * bent)
        return board.step.size - self.bow.shape[1] - float(taken) / sigma_mm**2

    def flat_by_chance(
        self, xyz: np.ndarray, board: Reduction, covariance: np.ndarray, sigma_mm: float
    ) -> "BoardShape":
        """Returns the shape without bends if those of ``xyz`` (n, 3) are insignificant, else itself."""
        bends = self.bow.T @ (xyz - self.places).ravel()
        bent = board.from_kept[0].T @ self.bow
        spread = self.bow.T @ board.inverse[0] @ self.bow + bent.T @ covariance @ bent
        spread += sigma_mm**2 * np.eye(len(bends))
        chance = chdtrc(max(len(bends), 1), float(bends @ np.linalg.solve(spread, bends)))
        return self if chance < BENT_P else replace(self, bow=self.bow[:, :0])


MAX_STEPS = 200
EXACTLY = 1e-15
"""Largest relative decrease of χ² that is predicted for a step at convergence."""
SETTLED_PX = 1e-5
"""Largest move of a projection at convergence, px. Along a valley, χ² may decrease forever without a visible change."""
TINY_PX = 1e-3
"""Focal length that stands for invalid parameters."""
CREEPING_PX = 1e-3
"""Largest move of a projection accepted after all steps: a direction that hardly changes the images has a large σ."""
START_DAMPING = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Unknowns of a calibration."""

    models: tuple[MetricModel, ...]  # of one folder's board by one camera each; those of a folder share points
    camera_of: tuple[int, ...]  # of each model
    cameras: tuple[Camera, ...]

    def boards(self) -> dict[str, list[int]]:
        """Returns the indices of the models by folder."""
        members: dict[str, list[int]] = {}
        for i, model in enumerate(self.models):
            members.setdefault(model.group, []).append(i)
        return members

    def only(self, names: set[str]) -> "State":
        """Returns the state with the images of these ``names`` alone."""
        parts = [_of_images(model, names) for model in self.models]
        kept = [(part, k) for part, k in zip(parts, self.camera_of, strict=True) if part.images]
        return replace(self, models=tuple(part for part, _ in kept), camera_of=tuple(k for _, k in kept))

    def in_two(self, half: dict[str, int]) -> "State":
        """Returns the state of one camera as that of two, of which each took the images of one ``half``, 0 or 1."""
        names = [{name for name, own in half.items() if own == k} for k in (0, 1)]
        parts = [(_of_images(model, names[k]), k) for model in self.models for k in (0, 1)]
        kept = [(part, k) for part, k in parts if part.images]
        return State(tuple(part for part, _ in kept), tuple(k for _, k in kept), self.cameras * 2)

    def cost(self, huber: float) -> float:
        """Returns the χ² of the images, with Huber's loss beyond ``huber``."""
        return sum(image_cost(m, self.cameras[k], huber) for m, k in zip(self.models, self.camera_of, strict=True))

    def normalised(self) -> np.ndarray:
        """Returns the normalised residuals of all observations, (n, 2)."""
        each = zip(self.models, self.camera_of, strict=True)
        return np.concatenate([normalised(m, self.cameras[k]) for m, k in each])

    def redundancy(self, kept: int) -> int:
        """Observed coordinates minus unknowns of poses minus ``kept``; dots are observed as often as unknown."""
        poses = sum(len(m.images) for m in self.models)
        return sum(2 * len(m.image_index) for m in self.models) - 6 * poses - kept


def _of_images(model: MetricModel, names: set[str]) -> MetricModel:
    """Returns the model with the images of these names alone, and with all its points."""
    keep = np.array([name in names for name in model.images])
    rows = np.flatnonzero(keep[model.image_index])
    return replace(
        model,
        images=tuple(name for name in model.images if name in names),
        camera_from_model=tuple(pose for pose, own in zip(model.camera_from_model, keep, strict=True) if own),
        image_index=(np.cumsum(keep) - 1)[model.image_index[rows]],
        **{name: getattr(model, name)[rows] for name in OF_OBSERVATIONS},
    )


OF_OBSERVATIONS = ("point_index", "keypoint", "measured_px", "shift_px", "covariance_px2")


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Constants of one minimisation."""

    basis: tuple[np.ndarray, ...]  # by camera, (16, q)
    weight: tuple[np.ndarray, ...]  # by camera, (q, q) of the vague prior about ``start``
    start: tuple[Camera, ...]
    shape: dict[str, BoardShape]
    sigma_mm: float
    huber: float

    def away(self, k: int, camera: Camera) -> np.ndarray:
        """Returns the parameters of the COLMAP model minus those at the start, (q,)."""
        return np.linalg.pinv(self.basis[k]) @ (camera.parameters() - self.start[k].parameters())

    def intrinsics(self, k: int) -> slice:
        """Returns the place of a camera's intrinsics among the kept unknowns."""
        ends = np.cumsum([0, *(b.shape[1] for b in self.basis)])
        return slice(int(ends[k]), int(ends[k + 1]))

    @property
    def kept(self) -> int:
        """Number of kept unknowns."""
        return self.intrinsics(len(self.basis) - 1).stop


def dots_costs(state: State, setting: Setting) -> np.ndarray:
    """Returns the χ² of the dots' places: without the bends of boards, and of the bends."""
    each = [
        setting.shape[folder].costs(state.models[rows[0]].xyz_model, setting.sigma_mm)
        for folder, rows in state.boards().items()
    ]
    return np.sum(each, axis=0)


def _cost(state: State, setting: Setting) -> float:
    cost = float(dots_costs(state, setting).sum())
    for k, camera in enumerate(state.cameras):
        away = setting.away(k, camera)
        cost += float(away @ setting.weight[k] @ away)
    return cost + state.cost(setting.huber)


def _of_board(state: State, setting: Setting, folder: str, rows: list[int]):
    """Returns the normal equations of a board's dots and the kept unknowns, and the reduction of the poses."""
    p = setting.shape[folder].places.size
    size = p + setting.kept
    full, full_right = np.zeros((size, size)), np.zeros(size)
    block, block_right, cross = [], [], []
    for i in rows:
        model, k = state.models[i], state.camera_of[i]
        camera = state.cameras[k]
        by_pose, by_point = projection_jacobians(model, camera)
        by_kept = model.by_parameters(camera) @ setting.basis[k]
        root = np.sqrt(robust_weights(model, camera, setting.huber))[:, None]
        a, c, e = (model.whiten(d) * root[..., None] for d in (by_pose, by_point, by_kept))
        equations = equations_of_poses(model, a, c, e, normalised(model, camera) * root)
        place = np.concatenate([np.arange(p), p + np.arange(setting.kept)[setting.intrinsics(k)]])
        if len(place) == size:
            full += equations.normal  # an index of all rows takes as long as all else here
        else:
            full[np.ix_(place, place)] += equations.normal
        full_right[place] += equations.right
        block.append(equations.block)
        block_right.append(equations.block_right)
        cross.append(np.zeros((len(model.images), 6, size)))
        cross[-1][:, :, place] = equations.cross
    poses = reduce(np.concatenate(block), np.concatenate(block_right), np.concatenate(cross))
    return full - poses.normal, full_right - poses.right, poses


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of the kept unknowns, after elimination of the poses and then of each board's dots."""

    cost: float
    state: State
    setting: Setting
    normal: np.ndarray
    right: np.ndarray
    boards: tuple[Reduction, ...]
    poses: tuple[Reduction, ...]

    @classmethod
    def of(cls, state: State, setting: Setting) -> "Normal":
        normal, right = np.zeros((setting.kept, setting.kept)), np.zeros(setting.kept)
        for k, camera in enumerate(state.cameras):
            place = setting.intrinsics(k)
            normal[place, place] += setting.weight[k]
            right[place] -= setting.weight[k] @ setting.away(k, camera)
        boards, poses = [], []
        for folder, rows in state.boards().items():
            shape = setting.shape[folder]
            p = shape.places.size
            full, full_right, away = _of_board(state, setting, folder, rows)
            own = shape.weight(setting.sigma_mm)
            full[:p, :p] += own
            full_right[:p] -= own @ (state.models[rows[0]].xyz_model - shape.places).ravel()
            dots = reduce(full[None, :p, :p], full_right[None, :p], full[None, :p, p:])
            normal += full[p:, p:] - dots.normal
            right += full_right[p:] - dots.right
            boards.append(dots)
            poses.append(away)
        return cls(_cost(state, setting), state, setting, normal, right, tuple(boards), tuple(poses))

    def dots_left(self) -> float:
        """Returns the redundancy of the observations of the dots."""
        covariance, setting = np.linalg.inv(self.normal), self.setting
        left = (
            setting.shape[folder].redundancy(board, covariance, setting.sigma_mm)
            for board, folder in zip(self.boards, self.state.boards(), strict=True)
        )
        return float(sum(left))

    def with_flat_boards(self) -> dict[str, BoardShape]:
        """Returns the shapes of the boards, without bends if these are insignificant."""
        covariance, setting = np.linalg.inv(self.normal), self.setting
        return {
            folder: setting.shape[folder].flat_by_chance(
                self.state.models[rows[0]].xyz_model, board, covariance, setting.sigma_mm
            )
            for board, (folder, rows) in zip(self.boards, self.state.boards().items(), strict=True)
        }

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step of the kept unknowns, the boards' dots, and their poses; and the predicted gain."""
        kept_step = np.linalg.solve(self.normal + damping * np.diag(np.diag(self.normal)), self.right)
        gain = 2 * float(kept_step @ self.right) - float(kept_step @ self.normal @ kept_step)
        gain += sum(each.gain for each in (*self.boards, *self.poses))
        dots = [board.back(kept_step).ravel() for board in self.boards]
        poses = [
            each.back(np.concatenate([moved, kept_step])).ravel() for each, moved in zip(self.poses, dots, strict=True)
        ]
        step = np.concatenate([kept_step, *dots, *poses])
        return step, gain if self.largest_move(step) > SETTLED_PX else 0.0

    def largest_move(self, step: np.ndarray) -> float:
        """Returns the largest move of a projection by a step, px."""
        new = moved(self.state, self.setting, step)
        moves = [
            np.abs(b.residuals_px(new.cameras[k]) - a.residuals_px(self.state.cameras[k])).max()
            for a, b, k in zip(self.state.models, new.models, self.state.camera_of, strict=True)
        ]
        return float(max(moves))


def minimum(state: State, setting: Setting) -> State:
    """Returns the state of least cost. Only the kept unknowns are damped; dots and poses are optimal for each step."""
    solution = minimise(
        state,
        lambda at: Normal.of(at, setting),
        lambda at, step: moved(at, setting, step),
        cost=lambda at: _cost(at, setting),
        damping=START_DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    if not solution.converged:  # a direction that hardly changes the images has a large σ
        move = solution.linear.largest_move(solution.linear.step(START_DAMPING)[0])
        if not move < CREEPING_PX:
            raise ConvergenceError(
                "E-NO-MINIMUM",
                f"camera: projections still move by {move:.1g} px after {solution.steps} steps, {CREEPING_PX:g} px "
                "needed; look at the images, add views that fill the image and are tilted, or choose a simpler --model",
            )
    return solution.state


def moved(state: State, setting: Setting, step: np.ndarray) -> State:
    """Returns the state after a step of :meth:`Normal.step`."""
    boards, models = state.boards(), list(state.models)
    kept_step, remaining = np.split(step, [setting.kept])
    for folder, rows in boards.items():
        dots, remaining = np.split(remaining, [setting.shape[folder].places.size])
        for i in rows:
            models[i] = replace(models[i], xyz_model=models[i].xyz_model + dots.reshape(-1, 3))
    for i in chain(*boards.values()):
        poses, remaining = np.split(remaining, [6 * len(models[i].images)])
        models[i] = replace(models[i], camera_from_model=moved_poses(models[i].camera_from_model, poses.reshape(-1, 6)))
    cameras = tuple(
        camera.with_parameters(_positive(camera.parameters() + setting.basis[k] @ kept_step[setting.intrinsics(k)]))
        for k, camera in enumerate(state.cameras)
    )
    return replace(state, models=tuple(models), cameras=cameras)


def _positive(parameters: np.ndarray) -> np.ndarray:
    """Returns the parameters if they are those of a camera, else parameters that no image agrees with."""
    if (parameters[:2] > 0).all() and np.isfinite(parameters).all():
        return parameters
    return np.concatenate([[TINY_PX, TINY_PX], np.zeros(len(parameters) - 2)])
