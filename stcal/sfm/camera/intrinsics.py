"""Intrinsics from views of the dot board: start, and one adjustment over intrinsics, board poses and places of dots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np

from stcal.adjust.blocks import Huber, Vector, sigma_factor
from stcal.adjust.engine import Adjustment, Joined, JoinedSolution
from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.arrays import rms
from stcal.geometry.camera import FISHEYE, Camera, intrinsic_basis
from stcal.geometry.clusters import ByClusters
from stcal.geometry.least_squares import minimise
from stcal.geometry.plane import apply_homography, camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.print_modes import PrintModes
from stcal.geometry.rigid import Poses, Rigid
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.labels import DotLabel, Label
from stcal.sfm.adjust.equations import image_cost, normalised, robust_weights
from stcal.sfm.adjust.refine import eccentricity_px, placed, reproject
from stcal.sfm.data.group_model import ImageObservations, MetricModel, assemble, by_group
from stcal.sfm.detect.detect_files import DetectedImage
from stcal.sfm.detect.labelling import labelled_image

MAX_STEPS = 200
EXACTLY = 1e-15  # largest relative decrease of χ² that is predicted for a step at convergence
SETTLED_PX = 1e-5  # largest move of a projection at convergence: along a valley, χ² may decrease forever, unseen
TINY_PX = 1e-3  # focal length that stands for invalid parameters
CREEPING_PX = 1e-3  # largest move accepted after all steps: what hardly changes the images has a large σ
START_DAMPING = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Camera, board poses and dots at a state of their adjustment, and what is known of them."""

    models: tuple[MetricModel, ...]  # of one folder's board each
    camera: Camera
    start: Camera
    basis: np.ndarray  # (16, q)
    weight: np.ndarray  # (q, q) of the vague prior about ``start``
    places: dict[str, np.ndarray]  # by folder, (n, 3) of the dots of its board as drawn, mm
    modes: dict[str, PrintModes]  # by folder, how the print of its board may deviate
    sigma_mm: float
    huber: float = np.inf

    def of_views(self, names: set[str]) -> "Fit":
        """Returns the fit with the images of these names alone, and with all of their points."""
        parts = []
        for model in self.models:
            keep = np.array([name in names for name in model.images])
            if keep.any():
                seen = model.observed(np.flatnonzero(keep[model.image_index]))
                images, poses = tuple(compress(model.images, keep)), tuple(compress(model.camera_from_model, keep))
                index = (np.cumsum(keep) - 1)[seen.image_index]
                parts.append(replace(seen, images=images, camera_from_model=poses, image_index=index))
        return replace(self, models=tuple(parts))

    def lengths(self) -> list[np.ndarray]:
        """Returns by model the lengths (n,) of the residuals over σ."""
        return [np.linalg.norm(normalised(model, self.camera), axis=1) for model in self.models]

    def cost(self) -> float:
        return sum(image_cost(model, self.camera, self.huber) for model in self.models)

    def redundancy(self) -> int:
        """Observed coordinates minus unknowns of poses and camera; dots are observed as often as unknown."""
        return sum(2 * len(m.image_index) - 6 * len(m.images) for m in self.models) - self.basis.shape[1]

    def camera_at(self, away: Vector) -> Camera:
        """Returns the camera with these parameters of the COLMAP model minus those at the start, (1, q)."""
        parameters = self.start.parameters() + self.basis @ away.array[0]
        if not ((parameters[:2] > 0).all() and np.isfinite(parameters).all()):  # of no camera: no image agrees with it
            parameters = np.r_[TINY_PX, TINY_PX, np.zeros(len(parameters) - 2)]
        return self.start.with_parameters(parameters)

    def at(self, values: Mapping[str, Any]) -> "Fit":
        """Returns the fit at a state of the unknowns of :meth:`linear`."""
        moved = (placed(m, values[POSES + m.group], values[DOTS_OF + m.group]) for m in self.models)
        return replace(self, models=tuple(moved), camera=self.camera_at(values["lens"]))

    def linear(self) -> "LinearFit":
        """Returns the adjustment of all boards linearised about this state."""
        parts, first = [], 0
        away = np.linalg.pinv(self.basis) @ (self.camera.parameters() - self.start.parameters())
        values: dict[str, Any] = {"lens": Vector(away[None])}
        for model in self.models:
            a = Adjustment()
            values[POSES + model.group] = Poses.of(model.camera_from_model)
            values[DOTS_OF + model.group] = Vector(model.xyz_model)
            lens = a.block("lens", values["lens"])
            dots = a.block(DOTS_OF + model.group, values[DOTS_OF + model.group])
            poses = a.block(POSES + model.group, values[POSES + model.group], eliminate=True)
            cluster, loss = first + model.image_index, Huber(self.huber)
            reproject(a, model, (dots, poses, lens), self.camera_at, self.basis, cluster=cluster, loss=loss)
            a.prior(dots, self.places[model.group], self.modes[model.group].weight(self.sigma_mm))
            if not parts:
                a.prior(lens, np.zeros((1, len(self.weight))), self.weight)
            parts.append(a)
            first += len(model.images)
        return LinearFit(Joined(parts, ("lens",)), values, self)

    def robust_minimum(self) -> "Fit":
        """Returns the fit of least cost, with Huber's limit by its residuals."""
        options: dict[str, Any] = {"damping": START_DAMPING, "settled": EXACTLY, "max_steps": MAX_STEPS}
        begin = self.linear()
        solution = minimise(begin.values, begin.at, begin.problem.moved, cost=begin.problem.cost, **options)
        if not solution.converged:  # a direction that hardly changes the images has a large σ
            move = solution.linear.largest_move(solution.linear.step(START_DAMPING)[0])
            if not move < CREEPING_PX:
                fault = f"projections still move by {move:.1g} px after {solution.steps} steps"
                views = "look at the images, add views that fill the image and are tilted"
                remedy = f"{CREEPING_PX:g} px needed; {views}, or choose a simpler --model"
                raise ConvergenceError("E-NO-MINIMUM", f"camera: {fault}, {remedy}")
        fit = solution.linear.fit
        return replace(fit, huber=HUBER * max(robust_sigma(np.concatenate(fit.lengths()), 2), LEAST_ROBUST))


@dataclass(frozen=True, eq=False)
class LinearFit(JoinedSolution):
    """The adjustment linearised about a state; only the lens is damped, as dots and poses are optimal for each step."""

    begin: Fit  # at any state

    def at(self, values: dict[str, Any]) -> "LinearFit":
        return replace(self, values=values)

    @cached_property
    def fit(self) -> Fit:
        return self.begin.at(self.values)

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step of all unknowns, and the predicted gain: none where no projection moves visibly."""
        step, gain = super().step(damping)
        return step, gain if self.largest_move(step) > SETTLED_PX else 0.0

    def moved(self, step: np.ndarray) -> Fit:
        return self.begin.at(self.problem.moved(self.values, step))

    def largest_move(self, step: np.ndarray) -> float:
        before, after = self.fit, self.moved(step)
        pairs = zip(before.models, after.models, strict=True)
        moves = (b.residuals_px(after.camera) - a.residuals_px(before.camera) for a, b in pairs)
        return max(float(np.abs(move).max()) for move in moves)

    def with_found_prints(self) -> tuple[float, dict[str, PrintModes]]:
        """Returns the redundancy of the dots by themselves, and the prints of the boards with their amplitudes."""
        prints, left, sigma_mm = {}, 0.0, self.begin.sigma_mm
        for model, part in zip(self.fit.models, self.whole, strict=True):
            print_modes, covariance = self.begin.modes[model.group], part.covariance(part.problem.blocks[DOTS])
            of_modes = print_modes.modes.T @ covariance @ print_modes.modes
            left += len(covariance) - len(of_modes) - float(np.trace(covariance) - np.trace(of_modes)) / sigma_mm**2
            away = model.xyz_model - self.begin.places[model.group]
            prints[model.group] = print_modes.as_found(away, of_modes, sigma_mm)
        return left, prints


POSES, DOTS_OF = "poses of ", "dots of "
LENS, DOTS = 0, 1

START_FOCAL, FISHEYE_FOCAL = 1.2, 0.45  # over the longer side: between wide-angle and portrait; equidistant, 127°
FOCAL_LIMITS = (0.2, 50.0)  # of the focal length over the longer image side; closed forms outside of them are noise
TRIED_FOCALS, TRIED_VIEWS = tuple(np.geomspace(0.4, 12.8, 11).tolist()), 12
"""Focal lengths over the longer side that are tried where the closed form gives none, a factor of √2 apart, and the
number of views, those of most dots, by which they are judged."""


def start_camera(width: int, height: int, colmap_model: str) -> Camera:
    """Returns a camera of medium focal length without distortion, with the principal point in the middle."""
    fisheye = FISHEYE in colmap_model
    focal = (FISHEYE_FOCAL if fisheye else START_FOCAL) * max(width, height)
    return Camera(width, height, [focal, focal], [(width - 1) / 2, (height - 1) / 2], np.zeros(8), fisheye)


def closed_form(observations: Sequence[ImageObservations], board: BoardDesign, camera: Camera) -> Camera:
    """Returns ``camera`` with the focal length by the homographies (Zhang 2000, sec. 3.1), for square pixels and the
    principal point in the middle, or else the one of :data:`TRIED_FOCALS` that fits best; with two focal lengths and
    the principal point by them where that fits far better. Unchanged for equidistant lenses, whose rays depend on
    it."""
    if camera.fisheye:
        return camera
    conics = []
    for image in observations:
        columns = _homography(image, board, camera)[:, :2].T
        first, second = columns / np.sqrt(np.linalg.norm(columns[:, :2], axis=1).prod())
        conics += [_conic(first, second), _conic(first, first) - _conic(second, second)]
    rows = np.array(conics)
    equal, constants = rows[:, 0] + rows[:, 1], -rows[:, 4]
    square = float(equal @ equal)
    inverse = float(equal @ constants) / square if square else 0.0  # (assumed focal / focal)²
    longer = max(camera.width, camera.height)
    low, high = FOCAL_LIMITS * np.array(longer) / camera.focal[0]
    largest = sorted(observations, key=len)[-TRIED_VIEWS:]

    def misfit_px(tried: Camera) -> float:
        poses = [(image, start_pose(image, board, tried)) for image in largest]
        off = [tried.project(pose @ board.places_mm(image.labels)) - image.centre_px for image, pose in poses]
        return sum(map(rms, off))

    if high**-2 < inverse < low**-2:
        usual = replace(camera, focal=camera.focal / np.sqrt(inverse))
    else:  # the one of several that fits best, by the mean over views of the RMS distance
        usual = min((replace(camera, focal=np.full(2, share * longer)) for share in TRIED_FOCALS), key=misfit_px)
    free = _of_any_pixels(rows, camera, low, high) if len(observations) >= LEAST_FREE else None
    return free if free is not None and misfit_px(free) < FAR_BETTER * misfit_px(usual) else usual


LEAST_FREE, FAR_BETTER = 3, 0.5
"""Fewest views for two focal lengths and the principal point, and most of the misfit that these may leave."""
ALMOST_SQUARE = 0.05  # relative difference of two focal lengths up to which pixels count as square at the start


def _conic(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the coefficients (5,) of B11, B22, B13, B23, B33 in firstᵀ B second (Zhang 2000, without skew)."""
    (a, b, c), (x, y, z) = first, second
    return np.array([a * x, b * y, a * z + c * x, b * z + c * y, c * z])


def _of_any_pixels(rows: np.ndarray, camera: Camera, low: float, high: float) -> Camera | None:
    """Returns ``camera`` with two focal lengths and a principal point by its views; None outside of the limits."""
    b11, b22, b13, b23, b33 = np.linalg.svd(rows)[2][-1]
    with np.errstate(all="ignore"):
        scale = b33 - b13**2 / b11 - b23**2 / b22
        ratios, centre = np.sqrt([scale / b11, scale / b22]), np.array([-b13 / b11, -b23 / b22])
    if not (low < ratios.min() and ratios.max() < high):
        return None
    if abs(np.log(ratios[0] / ratios[1])) < ALMOST_SQUARE:
        ratios = np.full(2, np.sqrt(ratios.prod()))
    return replace(camera, focal=camera.focal * ratios, centre=camera.centre + camera.focal * centre)


def start_pose(image: ImageObservations, board: BoardDesign, camera: Camera) -> Rigid:
    """Returns camera_from_board of one view; an error if the dots do not determine it."""
    pose = camera_from_plane(_homography(image, board, camera))
    return refine_planar_pose(pose, board.places_mm(image.labels)[:, :2], camera.normalised_from_pixel(image.centre_px))


def _homography(image: ImageObservations, board: BoardDesign, camera: Camera) -> np.ndarray:
    return fit_homography(board.places_mm(image.labels)[:, :2], camera.normalised_from_pixel(image.centre_px))


def board_views(images: Sequence[DetectedImage], board: BoardDesign, camera: Camera) -> list[ImageObservations]:
    """Returns the dots of every image that shows the board, numbered consistently in all images of a folder. A wrong
    numbering only breaks the match to deviations from the grid: by these, as ``camera`` shows them, it is selected."""
    views, numberings = [], {}
    for image in images:
        sighting = image.detection.board
        if sighting is not None and len(sighting.rows):
            dots = image.detection.centres.select(sighting.rows)
            numberings[image.file.name] = sighting.numberings
            labels = [DotLabel(0, i) for i in range(len(dots))]
            views.append(labelled_image(image.file.name, image.file.group, labels, dots, ()).observations)
    numbered: dict[str, ImageObservations] = {}
    for members in by_group(views).values():
        fields = [_deviations(numberings[v.name], camera.normalised_from_pixel(v.centre_px), board) for v in members]
        for view, choice in zip(members, _choose_alike(fields), strict=True):
            cells = numberings[view.name][choice].tolist()
            numbered[view.name] = replace(view, labels=tuple(DotLabel(*cell) for cell in cells))
    return [numbered[view.name] for view in views]


def _deviations(numberings: np.ndarray, xy_normalised: np.ndarray, board: BoardDesign) -> np.ndarray:
    """Returns measured minus designed dots in the board's plane, (k, rows·columns, 2) mm for k numberings, else 0."""
    fields = np.zeros((len(numberings), board.rows * board.columns, 2))
    for field, cells in zip(fields, numberings, strict=True):
        xy_mm = board.pitch_mm * cells[:, ::-1].astype(float)
        plane_from_image = fit_homography(xy_normalised, xy_mm)
        field[cells @ [board.columns, 1]] = apply_homography(plane_from_image, xy_normalised) - xy_mm
    return fields


def _choose_alike(fields: Sequence[np.ndarray]) -> list[int]:
    """Selects for each image the field of deviations that agrees best with those of the other images."""
    chosen = [0] * len(fields)
    order = sorted(range(len(fields)), key=lambda i: -np.count_nonzero(fields[i][0]))
    total = np.zeros_like(fields[0][0])
    for turn in range(3):
        for i in order:
            if turn:
                total -= fields[i][chosen[i]]
            chosen[i] = int(np.argmax([(field * total).sum() for field in fields[i]]))
            total += fields[i][chosen[i]]
    return chosen


MAX_ROUNDS = 20
SETTLED_FACTOR = 0.005  # largest relative change of a variance component in the last round
SETTLED_SHIFT_PX = 1e-5  # largest change of an eccentricity in the last round, px
LEAST_ROBUST = 1e-6  # smallest robust σ of normalised residuals, for exact data
LOUD = 1.5
"""Ratio of a photograph's residuals to those of most from which its σ grow with them: one that was moved or out of
focus does not decide. Of 20 centres, chance exceeds it in one photograph of 600."""
LEAST_DOTS = 0.1  # smallest factor of the dots' σ: dots may be more accurate than stated, but never exact
MIN_BOARD_REDUNDANCY = 20.0  # smallest redundancy of the dots that gives their σ; below it the board file's is kept


@dataclass(frozen=True, slots=True)
class BoardSigmaFactors:
    """Ratios of residuals to the detected centres' σ (``centres``), and to the board file's σ of dots (``dots``)."""

    centres: float = 1.0
    dots: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    camera: Camera
    colmap_model: str
    covariance: np.ndarray  # (q, q) of the parameters of ``colmap_model``, by how the photographs differ
    independent: np.ndarray  # (q, q) by independent errors of pixels: what the views' geometry determines
    differ: float  # by how much photographs differ more than their pixels explain, as a ratio of σ
    freedom: np.ndarray  # (q,) effective degrees of freedom of what the photographs tell
    models: tuple[MetricModel, ...]  # of one folder's board each, mm, board frame
    factors: BoardSigmaFactors
    huber: float  # length of a normalised residual beyond which its weight decreases
    redundancy: int
    settled: bool  # whether σ and eccentricities converged within :data:`MAX_ROUNDS`
    fit: Fit  # from which solutions of some of the views start
    restarted: bool = False  # the descent from the start did not end, and began again with the focal length alone

    def sigma(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def residuals_px(self) -> np.ndarray:
        return np.concatenate([model.residuals_px(self.camera) for model in self.models])

    def prints(self) -> dict[str, tuple[float, float]]:
        """Returns by how much more the board of each folder is stretched along its rows than across, and its shear."""
        modes, places = self.fit.modes, self.fit.places
        return {m.group: modes[m.group].stretch(m.xyz_model - places[m.group]) for m in self.models}

    def weights(self) -> list[np.ndarray]:
        return [robust_weights(model, self.camera, self.huber) for model in self.models]


def model_parameters(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns the parameters of a COLMAP model, (q,), with OpenCV's pixel origin."""
    return np.linalg.pinv(intrinsic_basis(colmap_model)) @ camera.parameters()


def vague_prior(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns the covariance (q, q) of a prior that any lens fulfils, for a regular normal matrix: focal length 100 %,
    principal point a quarter of the side; distortion takes corners to the middle (tangential: a tenth)."""
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
    held: bool = False,  # intrinsics stay at ``start``, and ``covariance`` is (0, 0)
) -> Intrinsics:
    """Adjusts the intrinsics from ``start`` by at least three views, with dots of the board only."""
    basis = intrinsic_basis(colmap_model)[:, : 0 if held else None]
    groups = by_group(views)
    largest = max(groups, key=lambda name: len(groups[name]))
    for name in [name for name, members in groups.items() if len(members) < 2 and name != largest]:
        # A single view cannot tell errors of the print from those of its centres: it is taken for one of this board.
        groups[largest] += [replace(view, group=largest) for view in groups.pop(name)]
    models = tuple(model_of_views(members, board, start) for members in groups.values())
    weight = np.zeros((0, 0)) if held else np.linalg.inv(vague_prior(start, colmap_model))
    places = {m.group: m.xyz_model for m in models}
    modes = {m.group: PrintModes.of(m.xyz_model[:, :2]) for m in models}
    fit = Fit(models, start, start, basis, weight, places, modes, board.sigma_mm)
    try:
        return _adjusted(fit, board, colmap_model)
    except ConvergenceError:
        if held:
            raise
    # A focal length far off makes the rest of the lens wander: it comes first, alone, and one for both axes.
    focal = intrinsic_basis("SIMPLE_PINHOLE")[:, :1]
    alone = replace(fit, basis=focal, weight=np.full((1, 1), start.focal[0] ** -2.0))
    for _ in range(FOCAL_ROUNDS):
        alone = alone.robust_minimum()
    begun = replace(alone, basis=basis, weight=weight, huber=fit.huber)
    return replace(_adjusted(begun, board, colmap_model), restarted=True)


def _intrinsics(last: LinearFit, colmap_model: str, factors: BoardSigmaFactors, settled: bool) -> Intrinsics:
    fit, spread = last.fit, ByClusters(np.zeros((0, 0)), np.zeros((0, 0)), 1.0, np.zeros(0))
    if fit.basis.shape[1]:
        spread = last.by_clusters(last.problem.parts[0].blocks[LENS])
    of_both = {name: getattr(fit, name) for name in ("camera", "models", "huber")}
    of_both |= {each.name: getattr(spread, each.name) for each in fields(spread)}
    redundancy = fit.redundancy()
    return Intrinsics(
        colmap_model=colmap_model, factors=factors, redundancy=redundancy, settled=settled, fit=fit, **of_both
    )


FOCAL_ROUNDS = 2
MOST_STEPS, NO_GAIN = 10, 0.1
"""Most steps from the solution of all views to that of some of them, and the predicted decrease of the cost at which
they end, in σ²: no parameter is then off by more than a third of its σ."""


def of_some_views(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> Intrinsics:
    """Returns the intrinsics from some of the views of ``result``: by steps from the solution of all, with its weights,
    and the factors of σ by one step of their own; by :func:`adjust_intrinsics` where the steps do not settle."""
    fit = result.fit.of_views({view.name for view in views})
    for _ in range(MOST_STEPS):
        last = fit.linear()
        step, gain = last.step(0.0)
        if gain < NO_GAIN:
            return _intrinsics(last, result.colmap_model, _updated_factors(last, result.factors)[0], True)
        fit = last.moved(step)
        if not np.isfinite(fit.cost()):
            break
    return adjust_intrinsics(views, board, result.camera, result.colmap_model)


def _adjusted(fit: Fit, board: BoardDesign, colmap_model: str) -> Intrinsics:
    """Alternates minimisation and estimation of σ, amplitudes of the prints, and eccentricity."""
    detected_covariance, factors = [m.covariance_px2 for m in fit.models], BoardSigmaFactors()
    for round_index in range(MAX_ROUNDS):
        before = fit
        fit = replace(_weighted(fit, detected_covariance, factors, board), sigma_mm=factors.dots * board.sigma_mm)
        shifted = max(np.abs(a.shift_px - b.shift_px).max() for a, b in zip(fit.models, before.models, strict=True))
        fit = fit.robust_minimum()
        last = fit.linear()
        updated, modes = _updated_factors(last, factors)
        changes = [updated.centres / factors.centres, updated.dots / factors.dots]
        changes += [modes[folder].amplitude / old.amplitude for folder, old in fit.modes.items()]
        factors, fit = updated, replace(fit, modes=modes)
        change = float(np.abs(np.log(changes)).max())
        settled = bool(round_index >= 2 and change < SETTLED_FACTOR and shifted < SETTLED_SHIFT_PX)
        if settled:
            break
    return _intrinsics(last, colmap_model, factors, settled)


def model_of_views(views: Sequence[ImageObservations], board: BoardDesign, camera: Camera) -> MetricModel:
    """Returns the model of a folder's views of its board, with the dots at their design places."""
    labels = sorted({label for view in views for label in view.labels})
    places = dict(zip(labels, board.places_mm(labels), strict=True))
    return assemble(MetricModel, views[0].group, views, (start_pose(v, board, camera) for v in views), places)


def _weighted(fit: Fit, own: list[np.ndarray], factors: BoardSigmaFactors, board: BoardDesign) -> Fit:
    """Returns the fit with scaled σ, larger in photographs whose residuals stand out, and new eccentricity."""
    radius: dict[Label, float] = {**board.radius_of()}
    scaled = [replace(m, covariance_px2=factors.centres**2 * each) for m, each in zip(fit.models, own, strict=True)]
    lengths = replace(fit, models=tuple(scaled)).lengths()
    sizes = [
        np.array([robust_sigma(length[rows], 2) for rows in model.rows_by_image()])
        for model, length in zip(scaled, lengths, strict=True)
    ]
    usual = LOUD * max(float(np.median(np.concatenate(sizes))), LEAST_ROBUST)
    models = []
    for model, size in zip(scaled, sizes, strict=True):
        times, shift = np.maximum(size / usual, 1.0), eccentricity_px(model, fit.camera, radius, 1.0)
        covariance = times[model.image_index, None, None] ** 2 * model.covariance_px2
        models.append(replace(model, shift_px=shift, covariance_px2=covariance))
    return replace(fit, models=tuple(models))


def _updated_factors(last: LinearFit, factors: BoardSigmaFactors) -> tuple[BoardSigmaFactors, dict[str, PrintModes]]:
    """Returns variance components of centres and dots (Förstner 1979), and the prints with their amplitudes."""
    fit, (dots_left, modes) = last.fit, last.with_found_prints()
    dots, image_redundancy = factors.dots, fit.redundancy() - dots_left
    if dots_left > MIN_BOARD_REDUNDANCY:  # by the χ² of the places of dots by themselves, without the modes of prints
        off = {model.group: model.xyz_model - fit.places[model.group] for model in fit.models}
        square = float(sum(fit.modes[folder].cost(away, fit.sigma_mm) for folder, away in off.items()))
        dots = max(LEAST_DOTS, dots * sigma_factor(square, dots_left))
    return BoardSigmaFactors(factors.centres * sigma_factor(fit.cost(), image_redundancy), dots), modes


GRID = (13, 9)


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionSigma:
    sigma_px: np.ndarray  # (n,) per axis at :func:`image_grid`, up to a rotation of the camera, which poses absorb
    reach: np.ndarray  # (4,) of dots towards the corners (top left, top right, bottom left, bottom right), 1 there
    corner_sigma_px: np.ndarray  # (4,)


def image_grid(camera: Camera) -> np.ndarray:
    """Returns a grid of places over the whole image, including the corners, (n, 2) px."""
    x, y = np.linspace(0, camera.width - 1, GRID[0]), np.linspace(0, camera.height - 1, GRID[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def projection_jacobian(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns derivatives (n, 2, q) of projections by the parameters, up to a rotation of the camera."""
    try:
        ideal = camera.normalised_from_pixel(image_grid(camera))
    except ConvergenceError as error:
        fault = "camera: the distortion folds over in a part of the image without dots"
        remedy = "add views that fill the image to its corners, or choose a --model with fewer parameters"
        raise DegenerateError("E-CAMERA-FOLDED", f"{fault}; {remedy}") from error
    jacobian = camera.parameter_jacobian(ideal) @ intrinsic_basis(colmap_model)
    x, y = ideal.T
    rotation = np.stack([np.stack([-x * y, 1 + x * x, -y], axis=-1), np.stack([-1 - y * y, x * y, x], axis=-1)], axis=1)
    by_ideal = camera.pixel_jacobian(ideal)
    by_rotation = (by_ideal @ rotation).reshape(-1, 3)
    flat = jacobian.reshape(len(by_rotation), -1)
    return (flat - by_rotation @ np.linalg.lstsq(by_rotation, flat, rcond=None)[0]).reshape(jacobian.shape)


def projection_sigma(result: Intrinsics) -> ProjectionSigma:
    """Returns σ of projections over the image, and how far dots reach towards its corners."""
    camera = result.camera
    xy = image_grid(camera)
    jacobian = projection_jacobian(camera, result.colmap_model)
    sigma = np.sqrt(np.einsum("nip,pq,niq->n", jacobian, result.covariance, jacobian) / 2)
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    dots = np.concatenate([m.measured_px for m in result.models]) - middle
    # The smaller of the two coordinates counts: a dot at the side of the image is not in its corner.
    reach = np.minimum.reduce(dots[:, None] * corners / middle, axis=2).max(0)
    corner_index = [int(np.argmin(((xy - middle - corner * middle) ** 2).sum(1))) for corner in corners]
    return ProjectionSigma(sigma, np.maximum(reach, 0), sigma[corner_index])
