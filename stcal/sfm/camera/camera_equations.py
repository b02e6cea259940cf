"""Normal equations of a camera calibration, with the places of the board's dots as unknowns."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np

from stcal.adjust.blocks import Huber, Vector
from stcal.adjust.engine import Adjustment, Joined, JoinedSolution
from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.clusters import ByClusters
from stcal.geometry.least_squares import PoseStack, minimise
from stcal.geometry.print_modes import PrintModes
from stcal.sfm.adjust.equations import image_cost
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
    models: tuple[MetricModel, ...]  # of one folder's board each
    camera: Camera

    def only(self, names: set[str]) -> "State":
        parts = [_of_images(model, names) for model in self.models]
        return replace(self, models=tuple(part for part in parts if part.images))

    def cost(self, huber: float) -> float:
        return sum(image_cost(model, self.camera, huber) for model in self.models)

    def redundancy(self, kept: int) -> int:
        """Observed coordinates minus unknowns of poses minus ``kept``; dots are observed as often as unknown."""
        return sum(2 * len(m.image_index) - 6 * len(m.images) for m in self.models) - kept


def _of_images(model: MetricModel, names: set[str]) -> MetricModel:
    """Returns the model with the images of these names alone, and with all its points."""
    keep = np.array([name in names for name in model.images])
    seen = model.observed(np.flatnonzero(keep[model.image_index]))
    return replace(
        seen,
        images=tuple(compress(model.images, keep)),
        camera_from_model=tuple(compress(model.camera_from_model, keep)),
        image_index=(np.cumsum(keep) - 1)[seen.image_index],
    )


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """The board of one folder as drawn: ``places`` (n, 3) of its dots, mm, and how its print may deviate."""

    places: np.ndarray
    modes: PrintModes


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
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
        parameters = self.start.parameters() + self.basis @ away.array[0]
        if not ((parameters[:2] > 0).all() and np.isfinite(parameters).all()):  # of no camera: no image agrees with it
            parameters = np.r_[TINY_PX, TINY_PX, np.zeros(len(parameters) - 2)]
        return self.start.with_parameters(parameters)

    @property
    def kept(self) -> int:
        return self.basis.shape[1]

    def dots_cost(self, state: State) -> float:
        """Returns the χ² of the places of dots by themselves, without the modes of the prints."""
        off = [(self.boards[model.group], model.xyz_model) for model in state.models]
        return float(sum(own.modes.costs(xyz - own.places, self.sigma_mm)[0] for own, xyz in off))


@dataclass(frozen=True, eq=False)
class Normal:
    """The adjustment linearised about a state; only the lens is damped, as dots and poses are optimal for each step."""

    models: tuple[MetricModel, ...]  # at any state
    setting: Setting
    solution: JoinedSolution

    @classmethod
    def of(cls, state: State, setting: Setting) -> "Normal":
        joined, values = _problem(state, setting)
        return cls(state.models, setting, joined.at(values))

    @cached_property
    def state(self) -> State:
        return self._state(self.solution.values)

    @property
    def cost(self) -> float:
        return float(self.solution.cost)

    def by_photographs(self) -> ByClusters:
        """Returns the covariance of the lens model's parameters by how the photographs differ."""
        if not self.setting.kept:
            return ByClusters(np.zeros((0, 0)), np.zeros((0, 0)), 1.0, np.zeros(0))
        return self.solution.by_clusters(self.solution.problem.parts[0].blocks[LENS])

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
        new = self.moved(step)
        pairs = zip(self.state.models, new.models, strict=True)
        moves = (b.residuals_px(new.camera) - a.residuals_px(self.state.camera) for a, b in pairs)
        return max(float(np.abs(move).max()) for move in moves)

    def moved(self, step: np.ndarray) -> State:
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
        values[POSES + model.group] = PoseStack.of(*model.camera_from_model)
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
