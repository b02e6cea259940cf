"""Normal equations of a camera calibration, with the places of the board's dots as unknowns."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.clusters import ByClusters, by_clusters
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import Reduction, blocks_of, reduce
from stcal.geometry.print_modes import PrintModes
from stcal.sfm.adjust.equations import equations_of_poses, image_cost, normalised, robust_weights
from stcal.sfm.adjust.refine import moved_poses, projection_jacobians
from stcal.sfm.data.model import MetricModel

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

    models: tuple[MetricModel, ...]  # of one folder's board each
    camera: Camera

    def only(self, names: set[str]) -> "State":
        """Returns the state with the images of these ``names`` alone."""
        parts = [_of_images(model, names) for model in self.models]
        return replace(self, models=tuple(part for part in parts if part.images))

    def cost(self, huber: float) -> float:
        """Returns the χ² of the images, with Huber's loss beyond ``huber``."""
        return sum(image_cost(model, self.camera, huber) for model in self.models)

    def normalised(self) -> np.ndarray:
        """Returns the normalised residuals of all observations, (n, 2)."""
        return np.concatenate([normalised(model, self.camera) for model in self.models])

    def redundancy(self, kept: int) -> int:
        """Observed coordinates minus unknowns of poses minus ``kept``; dots are observed as often as unknown."""
        return sum(2 * len(m.image_index) - 6 * len(m.images) for m in self.models) - kept


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
class Board:
    """The board of one folder as drawn: ``places`` (n, 3) of its dots, mm, and how its print may deviate."""

    places: np.ndarray
    modes: PrintModes


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Constants of one minimisation."""

    basis: np.ndarray  # (16, q)
    weight: np.ndarray  # (q, q) of the vague prior about ``start``
    start: Camera
    boards: dict[str, Board]
    sigma_mm: float
    huber: float

    def away(self, camera: Camera) -> np.ndarray:
        """Returns the parameters of the COLMAP model minus those at the start, (q,)."""
        return np.linalg.pinv(self.basis) @ (camera.parameters() - self.start.parameters())

    @property
    def kept(self) -> int:
        """Number of kept unknowns."""
        return self.basis.shape[1]


def dots_costs(state: State, setting: Setting) -> np.ndarray:
    """Returns the χ² of the dots' places: of dots by themselves, and of the modes of the prints."""
    boards = [setting.boards[model.group] for model in state.models]
    each = [
        board.modes.costs(model.xyz_model - board.places, setting.sigma_mm)
        for model, board in zip(state.models, boards, strict=True)
    ]
    return np.sum(each, axis=0)


def _cost(state: State, setting: Setting) -> float:
    away = setting.away(state.camera)
    return float(dots_costs(state, setting).sum() + away @ setting.weight @ away) + state.cost(setting.huber)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Derivatives of a model's observations by pose (n, 2, 6), dot (n, 2, 3) and kept unknowns (n, 2, q), and their
    residuals (n, 2), all over σ and with robust weights."""

    by_pose: np.ndarray
    by_point: np.ndarray
    by_kept: np.ndarray
    residual: np.ndarray

    @classmethod
    def of(cls, model: MetricModel, state: State, setting: Setting) -> "_Rows":
        by_pose, by_point = projection_jacobians(model, state.camera)
        by_kept = model.by_parameters(state.camera) @ setting.basis
        root = np.sqrt(robust_weights(model, state.camera, setting.huber))[:, None]
        a, c, e = (model.whiten(derivative) * root[..., None] for derivative in (by_pose, by_point, by_kept))
        return cls(a, c, e, normalised(model, state.camera) * root)


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
        normal, right = setting.weight.copy(), -setting.weight @ setting.away(state.camera)
        boards, poses = [], []
        for model in state.models:
            board, rows, p = setting.boards[model.group], _Rows.of(model, state, setting), model.xyz_model.size
            equations = equations_of_poses(model, rows.by_pose, rows.by_point, rows.by_kept, rows.residual)
            away = reduce(equations.block, equations.block_right, equations.cross)
            full, full_right = equations.normal - away.normal, equations.right - away.right
            own = board.modes.weight(setting.sigma_mm)
            full[:p, :p] += own
            full_right[:p] -= own @ (model.xyz_model - board.places).ravel()
            dots = reduce(full[None, :p, :p], full_right[None, :p], full[None, :p, p:])
            normal += full[p:, p:] - dots.normal
            right += full_right[p:] - dots.right
            boards.append(dots)
            poses.append(away)
        return cls(_cost(state, setting), state, setting, normal, right, tuple(boards), tuple(poses))

    def with_found_prints(self) -> tuple[float, dict[str, Board]]:
        """Returns the redundancy of the observations of the dots by themselves, and the boards with the amplitudes of
        their modes that explain the dots best."""
        covariance, setting = np.linalg.inv(self.normal), self.setting
        boards, left = {}, 0.0
        for model, dots in zip(self.state.models, self.boards, strict=True):
            board, inverse, from_kept = setting.boards[model.group], dots.inverse[0], dots.from_kept[0]
            modes, to_kept = board.modes.modes, from_kept.T @ board.modes.modes
            of_modes = modes.T @ inverse @ modes + to_kept.T @ covariance @ to_kept
            taken = np.trace(inverse) + np.sum((from_kept @ covariance) * from_kept) - np.trace(of_modes)
            left += dots.step.size - modes.shape[1] - float(taken) / setting.sigma_mm**2
            found = board.modes.as_found(model.xyz_model - board.places, of_modes, setting.sigma_mm)
            boards[model.group] = replace(board, modes=found)
        return left, boards

    def by_photographs(self) -> ByClusters:
        """Returns the covariance of the kept unknowns by how the photographs differ."""
        pulls, informations, q = [], [], self.setting.kept
        if not q:
            return ByClusters(np.zeros((0, 0)), np.zeros((0, 0)), 1.0, np.zeros(0))
        for model, dots in zip(self.state.models, self.boards, strict=True):
            rows, m = _Rows.of(model, self.state, self.setting), len(model.images)
            by_dot = dots.from_kept[0].reshape(-1, 3, q)[model.point_index]
            by_kept = np.concatenate([rows.by_kept - rows.by_point @ by_dot, rows.residual[..., None]], axis=2)
            both = np.concatenate([rows.by_pose, by_kept], axis=2)
            square, _ = blocks_of(both, np.zeros(both.shape[:2]), model.image_index, m)
            inner, cross = square[:, :6, :6], square[:, :6, 6:]
            square = square[:, 6:, 6:] - np.swapaxes(cross, 1, 2) @ np.linalg.solve(inner, cross)
            informations.append(square[:, :q, :q])
            pulls.append(square[:, :q, q])
        return by_clusters(self.normal, np.concatenate(pulls), np.concatenate(informations))

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
        before, after = (
            np.concatenate([model.residuals_px(state.camera) for model in state.models]) for state in (self.state, new)
        )
        return float(np.abs(after - before).max())


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
    sizes = [3 * len(model.labels) for model in state.models] + [6 * len(model.images) for model in state.models]
    kept_step, *parts = np.split(step, setting.kept + np.cumsum([0, *sizes[:-1]]))
    models = tuple(
        replace(
            model,
            xyz_model=model.xyz_model + dots.reshape(-1, 3),
            camera_from_model=moved_poses(model.camera_from_model, poses.reshape(-1, 6)),
        )
        for model, dots, poses in zip(state.models, parts, parts[len(state.models) :], strict=False)
    )
    parameters = _positive(state.camera.parameters() + setting.basis @ kept_step)
    return State(models, state.camera.with_parameters(parameters))


def _positive(parameters: np.ndarray) -> np.ndarray:
    """Returns the parameters if they are those of a camera, else parameters that no image agrees with."""
    if (parameters[:2] > 0).all() and np.isfinite(parameters).all():
        return parameters
    return np.concatenate([[TINY_PX, TINY_PX], np.zeros(len(parameters) - 2)])
