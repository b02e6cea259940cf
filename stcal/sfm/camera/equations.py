"""Normal equations of a camera calibration, with the places of the board's dots as unknowns."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from stcal.adjust.blocks import Block, Huber, Vector
from stcal.adjust.engine import Adjustment, Joined, JoinedSolution
from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.clusters import ByClusters
from stcal.geometry.least_squares import minimise
from stcal.geometry.print_modes import PrintModes
from stcal.geometry.rigid import Poses
from stcal.sfm.adjust.equations import image_cost, normalised
from stcal.sfm.adjust.refine import placed, reproject
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

    def camera(self, away: Vector) -> Camera:
        """Returns the camera with these parameters of the COLMAP model minus those at the start, (1, q)."""
        return self.start.with_parameters(_positive(self.start.parameters() + self.basis @ away.array[0]))

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


@dataclass(frozen=True, eq=False)
class Normal:
    """The adjustment linearised about a state; only the lens is damped, as dots and poses are optimal for each step."""

    models: tuple[MetricModel, ...]  # at any state
    setting: Setting
    solution: JoinedSolution

    @classmethod
    def of(cls, state: State, setting: Setting) -> "Normal":
        """Returns the equations at a state."""
        joined, values = _problem(state, setting)
        return cls(state.models, setting, joined.at(values))

    @cached_property
    def state(self) -> State:
        """The state."""
        return self._state(self.solution.values)

    @property
    def cost(self) -> float:
        """Cost of the state, in σ²."""
        return float(self.solution.cost)

    @property
    def lens(self) -> Block:
        """The parameters of the lens model, minus those at the start."""
        return self.solution.problem.parts[0].blocks[LENS]

    def by_photographs(self) -> ByClusters:
        """Returns the covariance of the lens model's parameters by how the photographs differ."""
        if not self.setting.kept:
            return ByClusters(np.zeros((0, 0)), np.zeros((0, 0)), 1.0, np.zeros(0))
        return self.solution.by_clusters(self.lens)

    def with_found_prints(self) -> tuple[float, dict[str, Board]]:
        """Returns the redundancy of the observations of the dots by themselves, and the boards with the amplitudes of
        their modes that explain the dots best."""
        boards, left, sigma_mm = {}, 0.0, self.setting.sigma_mm
        for model, part in zip(self.state.models, self.solution.whole, strict=True):
            board, covariance = self.setting.boards[model.group], part.covariance(part.problem.blocks[DOTS])
            modes = board.modes.modes
            of_modes = modes.T @ covariance @ modes
            left += len(covariance) - len(of_modes) - float(np.trace(covariance) - np.trace(of_modes)) / sigma_mm**2
            found = board.modes.as_found(model.xyz_model - board.places, of_modes, sigma_mm)
            boards[model.group] = replace(board, modes=found)
        return left, boards

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step of all unknowns, and the predicted gain: none where no projection moves visibly."""
        step, gain = self.solution.step(damping)
        return step, gain if self.largest_move(step) > SETTLED_PX else 0.0

    def largest_move(self, step: np.ndarray) -> float:
        """Returns the largest move of a projection by a step, px."""
        new = self.moved(step)
        before, after = (
            np.concatenate([model.residuals_px(state.camera) for model in state.models]) for state in (self.state, new)
        )
        return float(np.abs(after - before).max())

    def moved(self, step: np.ndarray) -> State:
        """Returns the state after a step of all unknowns."""
        return self._state(self.solution.problem.moved(self.solution.values, step))

    def _state(self, values: Mapping[str, Any]) -> State:
        names = [model.group for model in self.models]
        moved = [placed(m, values[POSES + n], values[DOTS_OF + n]) for m, n in zip(self.models, names, strict=True)]
        return State(tuple(moved), self.setting.camera(values["lens"]))


POSES, DOTS_OF = "poses of ", "dots of "
LENS, DOTS = 0, 1


def _problem(state: State, setting: Setting) -> tuple[Joined, dict[str, Any]]:
    """Returns the adjustment of all boards from a state, and its unknowns there."""
    parts, first = [], 0
    values: dict[str, Any] = {"lens": Vector(setting.away(state.camera)[None])}
    for model in state.models:
        a, board = Adjustment(), setting.boards[model.group]
        values[POSES + model.group] = Poses.of(model.camera_from_model)
        values[DOTS_OF + model.group] = Vector(model.xyz_model)
        lens = a.block("lens", values["lens"])
        dots = a.block(DOTS_OF + model.group, values[DOTS_OF + model.group])
        poses = a.block(POSES + model.group, values[POSES + model.group], eliminate=True)
        cluster, loss = first + model.image_index, Huber(setting.huber)
        reproject(a, model, (dots, poses, lens), setting.camera, setting.basis, cluster=cluster, loss=loss)
        a.prior(dots, board.places, board.modes.weight(setting.sigma_mm))
        if not parts:
            a.prior(lens, np.zeros((1, setting.kept)), setting.weight)
        parts.append(a)
        first += len(model.images)
    return Joined(parts, ("lens",)), values


def minimum(state: State, setting: Setting) -> State:
    """Returns the state of least cost."""
    joined, values = _problem(state, setting)
    solution = minimise(
        values,
        lambda at: Normal(state.models, setting, joined.at(at)),
        joined.moved,
        cost=joined.cost,
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
    return solution.linear.state


def _positive(parameters: np.ndarray) -> np.ndarray:
    """Returns the parameters if they are those of a camera, else parameters that no image agrees with."""
    if (parameters[:2] > 0).all() and np.isfinite(parameters).all():
        return parameters
    return np.concatenate([[TINY_PX, TINY_PX], np.zeros(len(parameters) - 2)])
