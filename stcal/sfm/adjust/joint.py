"""Joint adjustment of all groups: one target, one board with a pose per group, all cameras, intrinsics if requested.
Dots are observations with their stated σ, so that scale is estimated; circles of a face are coplanar within theirs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from stcal.adjust.blocks import Vector
from stcal.adjust.engine import JoinedSolution
from stcal.design import BoardDesign, faces_of_known_shape, known_distances
from stcal.errors import ConvergenceError, ScaleError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.least_squares import Minimum, minimise
from stcal.geometry.print_modes import AMPLITUDES, found_amplitude
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.io.cameras.camera_model import CameraPrior
from stcal.labels import CircleLabel, DotLabel, dot_cells
from stcal.sfm.adjust import equations
from stcal.sfm.adjust.equations import CIRCLES, GroupPart, Setting, ShapeFactors
from stcal.sfm.adjust.refine import EXACTLY, MIN_DOTS
from stcal.sfm.data.group_model import MetricModel

Values = dict[str, Any]  # unknowns by block
NEAR = 1e-8  # the same where a result is the start of another one: a hundredth of σ
NEARLY = 1e-6
"""The same where parts of the images are compared, or the σ of faces of known shape are estimated: a tenth of σ."""
MAX_STEPS = 100
MAX_MOVE_PX = 0.02
"""Largest move of a projection, in px, at which a result is returned. Contradictory observations make the last steps
slow; below this limit the result is good enough for the checks."""
DAMPING = 1e-12  # relative damping, below the information of every direction that the datum does not leave open
SETTLED_PX = 1e-6
"""Largest move of a projection in a settled result, in px: four orders of magnitude below the σ of a centre. The share
``EXACTLY`` of a χ² of 1e5 is a step of 1e-5 σ. Results between the two limits are returned, and marked."""
MIN_COMMON = 0.1
MAX_COMMON = 0.99
"""Limits of the share of the board's variance that is common to all groups. Below the first, the share is taken as
zero. Above the second, the remainder of a single group would be smaller than on any real board."""


@dataclass(frozen=True, slots=True, eq=False)
class JointResult:
    """The adjusted models, in one frame, mm."""

    models: tuple[MetricModel, ...]  # one for each group
    model_from_board: dict[str, Rigid]
    labels: tuple[CircleLabel, ...]  # (c,) of the target's circles
    xyz_model: np.ndarray  # (c, 3)
    covariance_mm2: np.ndarray  # (3c, 3c), datum of smallest trace, scaled by ``sigma_scale``²
    sigma0: float  # residuals over the σ of all observations
    board_common: float  # share of the board's variance that all groups have in common
    camera: Camera
    camera_covariance: np.ndarray  # (q, q) of the parameters of its COLMAP model, if adjusted
    redundancy: int  # degrees of freedom
    last_move_px: float  # largest move of a projection by the last whole step
    print_factor: float = 1.0  # on the stated σ of faces of known shape, in their plane
    bend_factor: float = 1.0  # off their plane
    print_amplitude: float = AMPLITUDES[0]  # of the smooth deviations of their prints
    differ: float = 1.0  # by how much photographs differ more than their pixels explain, as a ratio of σ
    enlarged: float = 1.0  # factor on all σ by which groups, ways and parts of the images agree

    def __post_init__(self):
        c = len(self.labels)
        freeze(self, "xyz_model", (c, 3), "circles")
        freeze(self, "covariance_mm2", (3 * c, 3 * c), "covariance")

    @property
    def sigma_scale(self) -> float:
        """Factor in the covariances: ``enlarged`` times σ₀, 1 at least, as groups confirmed the centres' σ."""
        return self.enlarged * max(1.0, self.sigma0)

    def with_larger_sigma(self, factor: float) -> "JointResult":
        covariances = {k: factor**2 * getattr(self, k) for k in ("covariance_mm2", "camera_covariance")}
        return replace(self, enlarged=factor * self.enlarged, **covariances)

    @property
    def settled(self) -> bool:
        """True if the adjustment reached its minimum and did not stop on the way to it."""
        return self.last_move_px < SETTLED_PX


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A joint adjustment at its minimum."""

    setting: Setting
    solution: JoinedSolution
    move_px: float  # largest move of a projection by the next whole step
    differ: float = 1.0  # by how much photographs differ more than their pixels explain, as a ratio of σ
    enlarged: float = 1.0  # factor on all σ by which groups, ways and parts of the images agree

    @property
    def models(self) -> list[MetricModel]:
        return [group.at(self.solution.values) for group in self.setting.groups]

    @property
    def camera(self) -> Camera:
        return self.setting.camera(self.solution.values)

    def result(self, sigma0: float | None = None) -> JointResult:
        """Returns the result with the covariances of independent errors; see :func:`.uncertainty.widened_result`.
        ``sigma0``: of the residuals if None."""
        setting, solution, values = self.setting, self.solution, self.solution.values
        groups, xyz = setting.groups, values[CIRCLES].array
        flat = len(list(equations.bars(xyz, setting)))
        flat += sum(len(members) - 3 for members, *_ in equations.planes(xyz, setting))
        for shape in equations.shapes(xyz, setting):
            flat += int((shape.weight > 0).sum()) - (6 if (shape.weight[:, 2] > 0).any() else 3)
        observations = sum(2 * len(g.model.image_index) + 3 * len(g.dots) for g in groups) + flat
        unknowns = xyz.size + sum(6 * len(g.model.images) + 3 * len(g.dots) + 6 * bool(len(g.dots)) for g in groups)
        redundancy = observations - unknowns + equations.FREE_DIRECTIONS
        if sigma0 is None:
            sigma0 = float(np.sqrt(solution.cost / max(redundancy, 1)))
        covariance = max(1.0, sigma0) ** 2 * solution.inverse
        intrinsics = solution.parts[0].places[equations.CAMERA]
        boards = {g.model.group: g.board_at(values) for g in groups}
        circles = setting.labels, xyz, covariance[: xyz.size, : xyz.size]
        lens = self.camera, covariance[intrinsics, intrinsics]
        more = redundancy, self.move_px, *setting.factors
        result = JointResult(tuple(self.models), boards, *circles, sigma0, setting.common, *lens, *more)
        return result.with_larger_sigma(self.enlarged)

    def extensible(self) -> "Extensible":
        """Returns the covariances of the points; σ₀ is 1."""
        setting, solution = self.setting, self.solution
        points, to_circles, c = {}, {}, solution.values[CIRCLES].array.size
        for group, part in zip(setting.groups, solution.whole, strict=True):
            blocks = {block.name: block for block in part.problem.blocks}
            dots = blocks.get(group.name(equations.DOTS))
            together = part.together(dots) if dots else part.inverse
            place = np.empty((len(group.model.labels), 3), int)
            place[group.circles] = 3 * group.circle_place[:, None] + np.arange(3)
            place[group.dots] = part.kept + np.arange(3 * len(group.dots)).reshape(-1, 3)
            row = np.concatenate([place.ravel(), np.arange(part.kept)[part.places[equations.CAMERA]]])
            points[group.model.group] = together[np.ix_(row, row)]
            to_circles[group.model.group] = together[row, :c]
        return Extensible(self.camera, setting.basis, solution.inverse[:c, :c], points, to_circles)


def adjusted(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,  # of a circle from the plane of its face, None if unknown
    prior: CameraPrior | None = None,  # covariance of the intrinsics about ``camera``; None: these are fixed
    start: Camera | None = None,  # of the intrinsics
    # share of the board's variance common to all groups; no residual is then down-weighted
    common: float | None = None,
    factors: ShapeFactors = equations.UNKNOWN_SHAPES,  # of an earlier result
    settled: float = EXACTLY,  # largest predicted decrease of the last step, as a share of χ²
) -> Adjusted:
    """Adjusts metric models that share one frame. The dots show whether the board kept its shape between the groups
    (one plate) or not (a film, a screen), if ``common`` is None."""
    begin = unmoved(models, board, camera, flatness_mm, prior, common or 0.0, start)
    setting, values = begin.setting, begin.solution.values
    if common is None:
        setting = replace(setting, huber=HUBER * _robust_sigma(setting, values))
        if faces_of_known_shape(board):
            setting, values = _with_shape_factors(setting, values, factors)
        near = _minimise(setting, values, NEAR).solution.values
        setting, values = _with_common(setting, near, _common_share(setting, near))
    return _minimise(setting, values, settled)


def adjust_part(
    models: Sequence[MetricModel], board: BoardDesign, flatness_mm: float | None, whole: JointResult
) -> Adjusted:
    """Adjusts a part of the models of a ``whole`` joint result, with its weights, camera, factors and common share."""
    # Of a single group, the variance of its board is the same whatever share of it other groups have.
    common = whole.board_common if len(models) > 1 else 0.0
    begin = unmoved(models, board, whole.camera, flatness_mm, None, common)
    setting, values = begin.setting, begin.solution.values
    factors = ShapeFactors(whole.print_factor, whole.bend_factor, whole.print_amplitude)
    setting = replace(setting, huber=HUBER * _robust_sigma(setting, values), factors=factors)
    return replace(_minimise(setting, values, NEARLY), differ=whole.differ)


PRIOR_FREEDOM = 4.0  # degrees of freedom that the stated σ of such faces are worth, in addition to their deviations
LEAST_FACTOR = 0.1  # smallest such factor: print may be better than stated, but is never exact


def _with_shape_factors(setting: Setting, values: Values, factors: ShapeFactors) -> tuple[Setting, Values]:
    """Returns the state near its minimum with the σ of faces of known shape that belong to it."""
    setting = replace(setting, factors=factors)
    for _ in range(6):
        minimum, before = _descent(setting, values, NEARLY), setting.factors
        values, setting = minimum.state, replace(setting, factors=_shape_factors(setting, minimum.linear))
        if np.abs(np.log(np.divide(setting.factors, before))).max() < 0.03:
            break
    return setting, values


def _shape_factors(setting: Setting, solution: JoinedSolution) -> ShapeFactors:
    """Returns print and bend factor (Förstner 1979; stated σ as weak prior), and the prints' smooth amplitude."""
    square, freedom, prints = np.zeros(2), np.zeros(2), []
    for shape in equations.shapes(solution.values[CIRCLES].array, setting):
        place = equations.coordinates(shape.members)
        own = solution.inverse[np.ix_(place, place)]
        left = np.where(shape.weight > 0, 1 - shape.leverage(own), 0.0)
        normalised_square = shape.weight * shape.off_mm**2
        square += [normalised_square[:, :2].sum(), normalised_square[:, 2].sum()]
        freedom += [left[:, :2].sum(), left[:, 2].sum()]
        prints.append(shape.told(own, setting.factors.amplitude))
    before = np.array(setting.factors[:2])
    variance = (before**2 * square + PRIOR_FREEDOM) / (np.maximum(freedom, 0) + PRIOR_FREEDOM)
    within, off = np.maximum(np.sqrt(variance), LEAST_FACTOR).tolist()
    return ShapeFactors(within, off, found_amplitude(prints, setting.factors.amplitude))


def unmoved(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,
    prior: CameraPrior | None = None,
    common: float = 0.0,
    start: Camera | None = None,
) -> Adjusted:
    """Returns the adjustment of models that do not move, without down-weighting; arguments as of :func:`adjusted`."""
    labels = tuple(sorted({label for model in models for label in model.labels if isinstance(label, CircleLabel)}))
    basis, weight = np.zeros((len(PARAMETER_NAMES), 0)), np.zeros((0, 0))
    if prior:
        basis, weight = intrinsic_basis(prior.colmap_model), np.linalg.inv(prior.covariance)
    groups = tuple(_group(model, board, labels) for model in models)
    flatness_mm = np.inf if flatness_mm is None else flatness_mm
    setting = Setting(groups, labels, board, 0.0, flatness_mm, camera, basis, weight, np.inf)
    total, count = np.zeros((len(labels), 3)), np.zeros(len(labels))
    for group in groups:  # circles begin at their means over the groups
        np.add.at(total, group.circle_place, group.model.xyz_model[group.circles])
        np.add.at(count, group.circle_place, 1)
    setting, values = _with_common(setting, setting.values(total / count[:, None], start or camera), common)
    return Adjusted(setting, setting.joined(values).at(values), move_px=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Extensible:
    """The circle covariance of an adjustment, prepared for one more view, for any number of images."""

    camera: Camera
    basis: np.ndarray  # (16, q) derivative of its parameters by those that are adjusted
    covariance_mm2: np.ndarray  # (3c, 3c) of the circles
    points: dict[str, np.ndarray]  # by group, (3p + q, 3p + q) of its points and the intrinsics
    to_circles: dict[str, np.ndarray]  # by group, (3p + q, 3c) between these and the circles

    def lowered(self, view: MetricModel, to_functions: np.ndarray) -> np.ndarray:
        """Returns by how much one more view lowers the variances of f functions of the circles, (f,) (Woodbury 1950).
        ``to_functions``: (3p + q, f) covariance between points and intrinsics, and the functions."""
        rows = equations.RowsOfView.of(view, self.camera, self.basis)
        inner = np.eye(len(rows.pose)) + rows.square(self.points[view.group])
        half = solve_triangular(np.linalg.cholesky(inner), rows.along(to_functions), lower=True)
        return (half**2).sum(0)


def _with_common(setting: Setting, values: Values, common: float) -> tuple[Setting, Values]:
    """Returns setting and state with a shape of the board that all groups have in common, if ``common`` is not 0."""
    setting = replace(setting, common=common)
    return setting, values | {equations.SHAPE: Vector(np.zeros((len(setting.cells()), 3)))} if common else values


def _minimise(setting: Setting, values: Values, settled: float) -> Adjusted:
    """Returns the state of least cost; ``settled`` : see :func:`~stcal.geometry.least_squares.minimise`."""
    minimum = _descent(setting, values, settled)
    solution = minimum.linear
    beyond = solution.problem.moved(solution.values, solution.step(DAMPING)[0])
    before, after = (
        np.concatenate([group.at(state).residuals_px(setting.camera(state)) for group in setting.groups])
        for state in (solution.values, beyond)
    )
    move = float(np.abs(after - before).max(initial=0.0))
    if not move <= MAX_MOVE_PX:  # true of NaN, too
        fault = f"joint adjustment: projections still move by {move:.1g} px in the last of at most {MAX_STEPS} steps"
        raise ConvergenceError("E-NO-MINIMUM", f"{fault}; compare with --solve chain and look at the outliers")
    return Adjusted(setting, solution, move)


def _descent(setting: Setting, values: Values, settled: float) -> Minimum[Values, JoinedSolution]:
    joined = setting.joined(values)
    options: dict[str, Any] = {"damping": DAMPING, "least_damping": DAMPING, "max_steps": MAX_STEPS}
    return minimise(dict(values), joined.at, joined.moved, cost=joined.cost, settled=settled, **options)


def _group(model: MetricModel, board: BoardDesign, labels: tuple[CircleLabel, ...]) -> GroupPart:
    place = {label: i for i, label in enumerate(labels)}
    dots = np.array([i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)], int)
    circles = np.array([i for i, label in enumerate(model.labels) if isinstance(label, CircleLabel)], int)
    if len(dots) < MIN_DOTS and not (faces_of_known_shape(board) or known_distances(board)):
        fault = f"group {model.group}: {len(dots)} board dots in the joint adjustment, {MIN_DOTS} needed"
        raise ScaleError("E-SCALE-FEW-DOTS", f"{fault}; photograph the board with the faces")
    if 0 < len(dots) < MIN_DOTS:  # the scale is then from the target itself
        return _group(model.without(np.isin(model.point_index, dots)), board, labels)
    design = board.places_mm(model.labels[i] for i in dots)
    cells = dot_cells(model.labels[i] for i in dots) @ [board.columns, 1] if len(dots) else np.zeros(0, int)
    start = align_rigid(model.xyz_model[dots], design) if len(dots) else Rigid()
    circle_place = np.array([place[model.labels[i]] for i in circles], int)
    return GroupPart(model, start, design, dots, circles, cells, circle_place)


def _robust_sigma(setting: Setting, values: Values) -> float:
    camera = setting.camera(values)
    length = np.concatenate(
        [np.linalg.norm(equations.normalised(g.at(values), camera), axis=1) for g in setting.groups]
    )
    return max(robust_sigma(length, 2), 1e-6)


def _common_share(setting: Setting, values: Values) -> float:
    """Returns the covariance between the groups' board residuals over their variance; 0 if it is not significant."""
    by_dot = np.full((len(setting.groups), setting.board.rows * setting.board.columns, 3), np.nan)
    for own, group in zip(by_dot, setting.groups, strict=True):
        dots = group.board_at(values).inverse() @ values[group.name(equations.DOTS)].array
        own[group.cells] = dots - group.design
    product, square, count = 0.0, 0.0, 0
    for one, two in combinations(by_dot, 2):
        both = np.isfinite(one) & np.isfinite(two)
        product += float((one[both] * two[both]).sum())
        square += float((one[both] ** 2 + two[both] ** 2).sum()) / 2
        count += int(both.sum())
    if not count or square == 0:
        return 0.0
    share = product / square
    return 0.0 if share < max(MIN_COMMON, 3 / np.sqrt(count)) else min(share, MAX_COMMON)
