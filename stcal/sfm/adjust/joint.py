"""Joint adjustment of all groups: one target, one board with a pose per group, all cameras, intrinsics if requested.
Dots are observations with their stated σ, so that scale is estimated; circles of a face are coplanar within theirs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from stcal.design import BoardDesign, faces_of_known_shape, known_distances
from stcal.errors import ConvergenceError, ScaleError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.least_squares import Minimum, minimise
from stcal.geometry.normal_equations import constrained_inverse
from stcal.geometry.print_modes import AMPLITUDES, found_amplitude
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.io.cameras.model import CameraPrior
from stcal.labels import CircleLabel, DotLabel, dot_cells
from stcal.sfm.adjust import equations
from stcal.sfm.adjust.equations import (
    FREE_DIRECTIONS,
    Block,
    JointState,
    Setting,
    Shared,
    SharedEquations,
    bars,
    cost_of,
    free_directions,
    normal_equations,
    normalised,
    planes,
    robust_weights,
    rows_of_view,
    shapes,
    without_cameras,
)
from stcal.sfm.adjust.scale import MIN_DOTS
from stcal.sfm.data.model import GroupModel, MetricModel

ShapeFactors = tuple[float, float, float]
"""``print_factor``, ``bend_factor`` and ``print_amplitude`` of faces of known shape."""
EXACTLY = 1e-15
"""Largest predicted decrease of the last step, as a share of χ²: corrections of nanometres must be seen."""
NEAR = 1e-8
"""The same where a result is the start of another one: a hundredth of σ."""
NEARLY = 1e-6
"""The same where parts of the images are compared, or the σ of faces of known shape are estimated: a tenth of σ."""
MAX_STEPS = 100
MAX_MOVE_PX = 0.02
"""Largest move of a projection, in px, at which a result is returned. Contradictory observations make the last steps
slow; below this limit the result is good enough for the checks."""
DAMPING = 1e-12
"""Relative damping, below the information of every direction that the datum does not leave open."""
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
    board_residuals_mm: dict[str, np.ndarray]  # by group, (n, 3), board frame
    board_common: float  # share of the board's variance that all groups have in common
    camera: Camera
    camera_covariance: np.ndarray  # (q, q) of the parameters of its COLMAP model, if adjusted
    weights: dict[str, np.ndarray]  # by group, (n,) Huber's
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
        """Factor in the covariances: ``enlarged`` times σ₀, which counts as 1 at least, as the single groups have
        confirmed the σ of the centres."""
        return self.enlarged * scale_of(self.sigma0)

    def with_larger_sigma(self, factor: float) -> "JointResult":
        """Returns the result with all σ multiplied by a factor."""
        covariances = {k: factor**2 * getattr(self, k) for k in ("covariance_mm2", "camera_covariance")}
        return replace(self, enlarged=factor * self.enlarged, **covariances)

    @property
    def settled(self) -> bool:
        """True if the adjustment reached its minimum and did not stop on the way to it."""
        return self.last_move_px < SETTLED_PX


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """State of a joint adjustment at its minimum."""

    blocks: tuple[Block, ...]
    shared: Shared
    setting: Setting  # weights included
    normal: np.ndarray  # over the shared unknowns
    move_px: float  # largest move of a projection by the next whole step
    differ: float = 1.0  # by how much photographs differ more than their pixels explain, as a ratio of σ
    enlarged: float = 1.0  # factor on all σ by which groups, ways and parts of the images agree

    def result(self) -> JointResult:
        """Returns the result with the covariances of independent errors; see ``uncertainty.result_of``."""
        places = self.setting.places(self.shared)
        equations = self.normal, places.circles, places.intrinsics
        joint = _result(list(self.blocks), self.shared, self.setting, self.move_px, equations=equations)
        return joint.with_larger_sigma(self.enlarged)


def adjust_jointly(models: Sequence[MetricModel], board: BoardDesign, camera: Camera) -> JointResult:
    """Returns the result of :func:`adjusted` with the covariances at its minimum."""
    return adjusted(models, board, camera).result()


def adjusted(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,  # of a circle from the plane of its face, None if unknown
    prior: CameraPrior | None = None,  # covariance of the intrinsics about ``camera``; None: these are fixed
    start: Camera | None = None,  # of the intrinsics
    # share of the board's variance common to all groups; no residual is then down-weighted
    common: float | None = None,
    factors: ShapeFactors = (1.0, 1.0, 1.0),  # of an earlier result
    settled: float = EXACTLY,  # largest predicted decrease of the last step, as a share of χ²
) -> Adjusted:
    """Adjusts metric models that share one frame. The dots show whether the board kept its shape between the groups
    (one plate) or not (a film, a screen), if ``common`` is None."""
    blocks, shared, setting = _start(models, board, camera, flatness_mm, prior, common or 0.0)
    shared = replace(shared, camera=start or camera)
    if common is None:
        setting = replace(setting, huber=HUBER * _robust_sigma(blocks, shared.camera))
    if common is None and faces_of_known_shape(board):
        blocks, shared, setting = _with_shape_factors(blocks, shared, setting, factors)
    if common is None:
        near = _minimise(blocks, shared, setting, NEAR)
        blocks, shared = list(near.blocks), near.shared
        share = _common_share(blocks, board)
        if share > 0:
            blocks, setting = _with_common(blocks, setting, share)
    return _minimise(blocks, shared, setting, settled)


def adjust_part(
    models: Sequence[MetricModel], board: BoardDesign, flatness_mm: float | None, whole: JointResult
) -> Adjusted:
    """Adjusts a part of the models of a ``whole`` joint result, with its weights, camera, factors and common share."""
    # Of a single group, the variance of its board is the same whatever share of it other groups have.
    common = whole.board_common if len(models) > 1 else 0.0
    blocks, shared, setting = _start(models, board, whole.camera, flatness_mm, None, common)
    huber = HUBER * _robust_sigma(blocks, shared.camera)
    setting = replace(
        setting,
        huber=huber,
        print_factor=whole.print_factor,
        bend_factor=whole.bend_factor,
        print_amplitude=whole.print_amplitude,
    )
    return replace(_minimise(blocks, shared, setting, NEARLY), differ=whole.differ)


SHAPE_ROUNDS, SETTLED_FACTOR = 6, 0.03
"""Most rounds of the factors on the σ of faces of known shape, and the change at which they end."""
PRIOR_FREEDOM = 4.0
"""Degrees of freedom that the stated σ of such faces are worth, in addition to their deviations."""
LEAST_FACTOR = 0.1
"""Smallest such factor: print may be better than stated, but is never exact."""


def _with_shape_factors(
    blocks: list[Block], shared: Shared, setting: Setting, factors: ShapeFactors
) -> tuple[list[Block], Shared, Setting]:
    """Returns the state near its minimum with the σ of faces of known shape that belong to it."""
    names = ("print_factor", "bend_factor", "print_amplitude")
    setting = replace(setting, **dict(zip(names, factors, strict=True)))
    for _ in range(SHAPE_ROUNDS):
        state = _descent(blocks, shared, setting, NEARLY).state
        blocks, shared = list(state.blocks), state.shared
        before, factors = factors, _shape_factors(blocks, shared, setting)
        setting = replace(setting, **dict(zip(names, factors, strict=True)))
        if np.abs(np.log(np.divide(factors, before))).max() < SETTLED_FACTOR:
            break
    return blocks, shared, setting


def _shape_factors(blocks: list[Block], shared: Shared, setting: Setting) -> ShapeFactors:
    """Returns print and bend factor, variance components (Förstner 1979) with the stated σ as a weak prior, and the
    amplitude of the prints' smooth deviations."""
    normal, _, _ = normal_equations(blocks, shared, setting)
    inverse = constrained_inverse(normal, free_directions(len(normal), shared))
    square, freedom, prints = np.zeros(2), np.zeros(2), []
    for shape in equations.shapes(shared, setting):
        place = (3 * shape.members[:, None] + np.arange(3)).ravel()
        own = inverse[np.ix_(place, place)]
        left = np.where(shape.weight > 0, 1 - shape.leverage(own), 0.0)
        normalised_square = shape.weight * shape.off_mm**2
        square += [normalised_square[:, :2].sum(), normalised_square[:, 2].sum()]
        freedom += [left[:, :2].sum(), left[:, 2].sum()]
        prints.append(shape.told(own, setting.print_amplitude))
    before = np.array([setting.print_factor, setting.bend_factor])
    variance = (before**2 * square + PRIOR_FREEDOM) / (np.maximum(freedom, 0) + PRIOR_FREEDOM)
    within, off = np.maximum(np.sqrt(variance), LEAST_FACTOR).tolist()
    return within, off, found_amplitude(prints, setting.print_amplitude)


def covariance_of(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,
    prior: CameraPrior | None = None,
    common: float = 0.0,
    photographs: Mapping[str, np.ndarray] | None = None,  # of :func:`photographs_of`
) -> JointResult:
    """Returns the result of :func:`adjust_jointly` for models at their true positions, which do not move; σ₀ is 1."""
    blocks, shared, setting = _start(models, board, camera, flatness_mm, prior, common, photographs)
    if photographs or not equations.is_dots_first_cheaper(blocks):
        return _result(blocks, shared, setting, 0.0, 1.0)
    normal = equations.circle_equations(blocks, shared, setting)
    c = 3 * len(setting.labels)
    return _result(blocks, shared, setting, 0.0, 1.0, (normal, slice(0, c), slice(c, len(normal))))


def basis_of(prior: CameraPrior | None) -> np.ndarray:
    """Returns the derivative (16, q) of a camera's parameters by those that are adjusted."""
    return intrinsic_basis(prior.colmap_model) if prior else np.zeros((len(PARAMETER_NAMES), 0))


def photographs_of(
    models: Sequence[MetricModel], board: BoardDesign, camera: Camera, prior: CameraPrior | None
) -> dict[str, np.ndarray]:
    """Normal matrices (3p + q, 3p + q) of points and intrinsics from the photographs alone, by group; σ₀ is 1."""
    blocks, shared, _ = _start(models, board, camera, None, prior)
    return {b.model.group: without_cameras(b.model, camera, shared.basis, np.inf)[0] for b in blocks}


@dataclass(frozen=True, slots=True, eq=False)
class Extensible:
    """The circle covariance of :func:`covariance_of`, prepared for one more view, for any number of images."""

    camera: Camera
    basis: np.ndarray  # (16, q) derivative of its parameters by those that are adjusted
    covariance_mm2: np.ndarray  # (3c, 3c) of the circles
    points: dict[str, np.ndarray]  # by group, (3p + q, 3p + q) of its points and the intrinsics
    to_circles: dict[str, np.ndarray]  # by group, (3p + q, 3c) between these and the circles

    def lowered(self, view: MetricModel, to_functions: np.ndarray) -> np.ndarray:
        """Returns by how much one more view lowers the variances of f functions of the circles, (f,) (Woodbury 1950).
        ``to_functions``: (3p + q, f) covariance between points and intrinsics, and the functions."""
        rows, _ = rows_of_view(view, self.camera, self.basis)
        inner = np.eye(len(rows)) + rows @ self.points[view.group] @ rows.T
        half = solve_triangular(np.linalg.cholesky(inner), rows @ to_functions, lower=True)
        return (half**2).sum(0)


def extensible(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,
    prior: CameraPrior | None = None,
    common: float = 0.0,
    photographs: Mapping[str, np.ndarray] | None = None,
) -> Extensible:
    """Returns the :class:`Extensible` covariance of models; arguments as of :func:`covariance_of`."""
    return _extensible(*_start(models, board, camera, flatness_mm, prior, common, photographs))


def points_of(state: Adjusted) -> Extensible:
    """Returns the covariances of the points at the minimum of an adjustment; σ₀ is 1."""
    return _extensible(list(state.blocks), state.shared, state.setting)


def _extensible(blocks: list[Block], shared: Shared, setting: Setting) -> Extensible:
    normal, _, groups = normal_equations(blocks, shared, setting)
    inverse = constrained_inverse(normal, free_directions(len(normal), shared))
    circles = inverse[setting.places(shared).circles]
    points, to_circles = {}, {}
    for block, group_equations in zip(blocks, groups, strict=True):
        outer_index, inner = setting.outer(block, shared), group_equations.inner
        from_kept, d, q = inner.from_kept[0], 3 * len(block.dots), shared.basis.shape[1]
        outer = inverse[np.ix_(outer_index, outer_index)]
        # Rows: the dots, which are eliminated, then the unknowns that the groups share.
        to_kept = np.concatenate([-from_kept[:d] @ outer, outer])
        covariance = np.block(
            [[inner.inverse[0, :d, :d] - to_kept[:d] @ from_kept[:d].T, to_kept[:d]], [to_kept[:d].T, outer]]
        )
        covariance_to_circles = np.concatenate([-from_kept[:d] @ circles[:, outer_index].T, circles[:, outer_index].T])
        row = np.empty(3 * len(block.model.labels) + q, int)
        row[(3 * block.dots[:, None] + np.arange(3)).ravel()] = np.arange(d)
        row[(3 * block.circles[:, None] + np.arange(3)).ravel()] = d + np.arange(3 * len(block.circles))
        row[len(row) - q :] = len(covariance) - q + np.arange(q)
        points[block.model.group], to_circles[block.model.group] = (
            covariance[np.ix_(row, row)],
            covariance_to_circles[row],
        )
    c = circles.shape[0]
    return Extensible(shared.camera, shared.basis, circles[:, :c], points, to_circles)


def _start(
    models,
    board: BoardDesign,
    camera: Camera,
    flatness_mm,
    prior: CameraPrior | None,
    common: float = 0.0,
    photographs: Mapping[str, np.ndarray] | None = None,
) -> tuple[list[Block], Shared, Setting]:
    """Returns groups, shared unknowns, and a setting without down-weighting; ``common`` : see :func:`covariance_of`."""
    labels = tuple(sorted({label for model in models for label in model.labels if isinstance(label, CircleLabel)}))
    basis = basis_of(prior)
    weight = np.linalg.inv(prior.covariance) if prior else np.zeros((0, 0))
    blocks = [replace(_block(m, board, labels), photographs=(photographs or {}).get(m.group)) for m in models]
    xyz = _shared_circles(blocks, len(labels))
    shared = Shared(xyz, np.zeros((board.rows * board.columns, 3)), camera, basis)
    blocks = [replace(b, model=_with_circles(b, xyz)) for b in blocks]
    flatness_mm = np.inf if flatness_mm is None else flatness_mm
    setting = Setting(labels, board, 0.0, flatness_mm, camera, weight, np.inf)
    if common > 0:
        blocks, setting = _with_common(blocks, setting, common)
    return blocks, shared, setting


def _with_common(blocks: list[Block], setting: Setting, common: float) -> tuple[list[Block], Setting]:
    """Returns groups and setting with a shape of the board that all groups have in common."""
    setting = replace(setting, common=common)
    own_sigma, board = setting.own_sigma_mm(), setting.board
    return [replace(b, sigma_mm=own_sigma, dot_place=_dot_place(b.model, b.dots, board)) for b in blocks], setting


def _minimise(blocks: list[Block], shared: Shared, setting: Setting, settled: float) -> Adjusted:
    """Returns the state of least cost; ``settled`` : see :func:`~stcal.geometry.least_squares.minimise`."""
    minimum = _descent(blocks, shared, setting, settled)
    last, beyond = minimum.state, minimum.state.moved(minimum.linear.step(DAMPING)[0], setting)
    move = max(_largest_move(a, last.shared, b, beyond.shared) for a, b in zip(last.blocks, beyond.blocks, strict=True))
    if not move <= MAX_MOVE_PX:  # true of NaN, too
        raise ConvergenceError(
            "E-NO-MINIMUM",
            f"joint adjustment: projections still move by {move:.1g} px in the last of at most {MAX_STEPS} steps; "
            "compare with --solve chain and look at the outliers",
        )
    return Adjusted(last.blocks, last.shared, setting, minimum.linear.normal, float(move))


def _descent(
    blocks: list[Block], shared: Shared, setting: Setting, settled: float
) -> Minimum[JointState, SharedEquations]:
    return minimise(
        JointState(tuple(blocks), shared),
        lambda state: SharedEquations.of(state, setting),
        lambda state, step: state.moved(step, setting),
        cost=lambda state: cost_of(state.blocks, state.shared, setting),
        damping=DAMPING,
        least_damping=DAMPING,
        settled=settled,
        max_steps=MAX_STEPS,
    )


def _block(model: MetricModel, board: BoardDesign, labels: tuple[CircleLabel, ...]) -> Block:
    place = {label: i for i, label in enumerate(labels)}
    dots = np.array([i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)], int)
    circles = np.array([i for i, label in enumerate(model.labels) if isinstance(label, CircleLabel)], int)
    if len(dots) < MIN_DOTS and not (faces_of_known_shape(board) or known_distances(board)):
        raise ScaleError(
            "E-SCALE-FEW-DOTS",
            f"group {model.group}: {len(dots)} board dots in the joint adjustment, {MIN_DOTS} needed; "
            "photograph the board with the faces",
        )
    if 0 < len(dots) < MIN_DOTS:  # the scale is then from the target itself
        return _block(model.without(np.isin(model.point_index, dots)), board, labels)
    design = board.places_mm(model.labels[i] for i in dots)
    return Block(
        model,
        align_rigid(model.xyz_model[dots], design) if len(dots) else Rigid(),
        design,
        board.sigma_mm,
        dots,
        circles,
        np.zeros(0, int),
        np.array([place[model.labels[i]] for i in circles], int),
    )


def _dot_place(model: GroupModel, dots: np.ndarray, board: BoardDesign) -> np.ndarray:
    cells = dot_cells(model.labels[i] for i in dots)
    return cells[:, 0] * board.columns + cells[:, 1]


def _robust_sigma(blocks: list[Block], camera: Camera) -> float:
    """Returns the robust σ of the normalised residuals per axis."""
    length = np.concatenate([np.linalg.norm(normalised(b.model, camera), axis=1) for b in blocks])
    return max(robust_sigma(length, 2), 1e-6)


def _common_share(blocks: list[Block], board: BoardDesign) -> float:
    """Returns the covariance between the groups' board residuals over their variance; 0 if it is not significant."""
    by_dot = np.full((len(blocks), board.rows * board.columns, 3), np.nan)
    for k, b in enumerate(blocks):
        by_dot[k, _dot_place(b.model, b.dots, board)] = b.board_residual()
    product, square, count = 0.0, 0.0, 0
    for i in range(len(blocks)):
        for j in range(i):
            both = np.isfinite(by_dot[i]) & np.isfinite(by_dot[j])
            product += float((by_dot[i][both] * by_dot[j][both]).sum())
            square += float((by_dot[i][both] ** 2 + by_dot[j][both] ** 2).sum()) / 2
            count += int(both.sum())
    if not count or square == 0:
        return 0.0
    share = product / square
    return 0.0 if share < max(MIN_COMMON, 3 / np.sqrt(count)) else min(share, MAX_COMMON)


def _shared_circles(blocks: list[Block], count: int) -> np.ndarray:
    """Returns start values of the circles: their means over the groups."""
    total, group_count = np.zeros((count, 3)), np.zeros(count)
    for b in blocks:
        np.add.at(total, b.circle_place, b.model.xyz_model[b.circles])
        np.add.at(group_count, b.circle_place, 1)
    return total / group_count[:, None]


def _with_circles(block: Block, xyz: np.ndarray) -> MetricModel:
    points = block.model.xyz_model.copy()
    points[block.circles] = xyz[block.circle_place]
    return replace(block.model, xyz_model=points)


def _largest_move(old: Block, shared: Shared, new: Block, new_shared: Shared) -> float:
    before, after = old.model.residuals_px(shared.camera), new.model.residuals_px(new_shared.camera)
    return float(np.abs(after - before).max(initial=0.0))


def scale_of(sigma0: float) -> float:
    """Returns the factor on σ by which residuals of ``sigma0`` times their σ enlarge the covariances."""
    return max(1.0, sigma0)


def _result(
    blocks: list[Block],
    shared: Shared,
    setting: Setting,
    move_px: float,
    sigma0: float | None = None,
    equations: tuple[np.ndarray, slice, slice] | None = None,
) -> JointResult:
    """Returns the result with its covariances; ``equations``: normal matrix, places of circles and intrinsics in it."""
    if equations is None:
        places = setting.places(shared)
        equations = normal_equations(blocks, shared, setting)[0], places.circles, places.intrinsics
    normal, circles, intrinsics = equations
    inverse = constrained_inverse(normal, free_directions(len(normal), shared))
    c = circles.stop
    flat = sum(len(members) - 3 for members, _, _ in planes(shared, setting))
    for shape in shapes(shared, setting):
        flat += int((shape.weight > 0).sum()) - (6 if (shape.weight[:, 2] > 0).any() else 3)
    flat += sum(1 for _ in bars(shared, setting))
    observations = sum(2 * len(b.model.image_index) + 3 * len(b.dots) for b in blocks) + flat
    unknowns = c + sum(6 * len(b.model.images) + 3 * len(b.dots) + 6 * bool(len(b.dots)) for b in blocks)
    redundancy = observations - unknowns + FREE_DIRECTIONS
    if sigma0 is None:
        sigma0 = float(np.sqrt(cost_of(blocks, shared, setting) / max(redundancy, 1)))
    covariance = scale_of(sigma0) ** 2 * inverse
    return JointResult(
        tuple(b.model for b in blocks),
        {b.model.group: b.model_from_board for b in blocks},
        setting.labels,
        shared.xyz_model,
        covariance[:c, :c],
        sigma0,
        {b.model.group: b.board_residual() for b in blocks},
        setting.common,
        shared.camera,
        covariance[intrinsics, intrinsics],
        {b.model.group: robust_weights(b.model, shared.camera, setting.huber) for b in blocks},
        redundancy,
        move_px,
        setting.print_factor,
        setting.bend_factor,
        setting.print_amplitude,
    )
