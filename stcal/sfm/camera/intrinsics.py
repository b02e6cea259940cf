"""Intrinsics from views of the dot board: start, and one adjustment over intrinsics and board poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError
from stcal.geometry.camera import FISHEYE, Camera, intrinsic_basis
from stcal.geometry.plane import apply_homography, camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.print_modes import PrintModes
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.geometry.variances import sigma_factor
from stcal.labels import DotLabel, Label
from stcal.sfm.adjust.equations import normalised, robust_weights
from stcal.sfm.adjust.refine import eccentricity_px
from stcal.sfm.camera.camera_equations import Board, Normal, Setting, State, minimum
from stcal.sfm.data.model import ImageObservations, MetricModel, by_group
from stcal.sfm.detect.files import DetectedImage
from stcal.sfm.detect.labels import labelled_image

START_FOCAL, FISHEYE_FOCAL = 1.2, 0.45
"""Approximate focal lengths over the longer image side: between wide-angle and portrait; equidistant lens of 127°."""
FOCAL_LIMITS = (0.2, 50.0)
"""Limits of the focal length over the longer image side. Results of the closed form outside of them are noise."""
TRIED_FOCALS, TRIED_VIEWS = tuple(np.geomspace(0.4, 12.8, 11).tolist()), 12
"""Focal lengths over the longer side that are tried where the closed form gives none, a factor of √2 apart, and the
number of views, those of most dots, by which they are judged."""
SETTLING_PASSES = 3


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
    coefficients, constants, rows = [], [], []
    for image in observations:
        h = _homography(image, board, camera)
        first, second = h[:, 0], h[:, 1]
        first, second = np.array([first, second]) / np.sqrt(np.linalg.norm(first[:2]) * np.linalg.norm(second[:2]))
        coefficients += [first[:2] @ second[:2], first[:2] @ first[:2] - second[:2] @ second[:2]]
        constants += [-first[2] * second[2], second[2] ** 2 - first[2] ** 2]
        rows += [_conic(first, second), _conic(first, first) - _conic(second, second)]
    square = float(np.dot(coefficients, coefficients))
    inverse = float(np.dot(coefficients, constants)) / square if square else 0.0  # (assumed focal / focal)²
    low, high = FOCAL_LIMITS * np.array(max(camera.width, camera.height)) / camera.focal[0]
    largest = sorted(observations, key=len)[-TRIED_VIEWS:]

    def misfit_px(tried: Camera) -> float:
        off = 0.0
        for image in largest:
            pose = start_pose(image, board, tried)
            seen = tried.project(pose @ board.places_mm(image.labels))
            off += float(np.sqrt(((seen - image.centre_px) ** 2).sum(1).mean()))
        return off

    if high**-2 < inverse < low**-2:
        usual = replace(camera, focal=camera.focal / np.sqrt(inverse))
    else:  # the one of several that fits best, by the mean over views of the RMS distance
        longer = max(camera.width, camera.height)
        usual = min((replace(camera, focal=np.full(2, share * longer)) for share in TRIED_FOCALS), key=misfit_px)
    free = _of_any_pixels(np.array(rows), camera, low, high) if len(observations) >= LEAST_FREE else None
    return free if free is not None and misfit_px(free) < FAR_BETTER * misfit_px(usual) else usual


LEAST_FREE, FAR_BETTER = 3, 0.5
"""Fewest views for two focal lengths and the principal point, and most of the misfit that these may leave."""
ALMOST_SQUARE = 0.05
"""Relative difference of two focal lengths up to which pixels count as square at the start."""


def _conic(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the coefficients (5,) of B11, B22, B13, B23, B33 in firstᵀ B second (Zhang 2000, without skew)."""
    (a, b, c), (x, y, z) = first, second
    return np.array([a * x, b * y, a * z + c * x, b * z + c * y, c * z])


def _of_any_pixels(rows: np.ndarray, camera: Camera, low: float, high: float) -> Camera | None:
    """Returns ``camera`` with two focal lengths and a principal point by the rows of its views; None if there are none
    within the limits of the ratio of a focal length and the assumed one."""
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
    for turn in range(SETTLING_PASSES):
        for i in order:
            if turn:
                total -= fields[i][chosen[i]]
            chosen[i] = int(np.argmax([(field * total).sum() for field in fields[i]]))
            total += fields[i][chosen[i]]
    return chosen


MAX_ROUNDS = 20
LEAST_ROUNDS = 2
SETTLED_FACTOR = 0.005
"""Largest relative change of a variance component in the last round."""
SETTLED_SHIFT_PX = 1e-5
"""Largest change of an eccentricity in the last round, px."""
LEAST_ROBUST = 1e-6
"""Smallest robust σ of normalised residuals, for exact data."""
LOUD = 1.5
"""Ratio of a photograph's residuals to those of most from which its σ grow with them: one that was moved or out of
focus does not decide. Of 20 centres, chance exceeds it in one photograph of 600."""
LEAST_DOTS = 0.1
"""Smallest factor of the dots' σ: dots may be more accurate than the board file states, but never exact."""
MIN_BOARD_REDUNDANCY = 20.0
"""Smallest redundancy of the dots for estimating their σ. Below it the σ of the board file is kept."""


@dataclass(frozen=True, slots=True)
class SigmaFactors:
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
    factors: SigmaFactors
    huber: float  # length of a normalised residual beyond which its weight decreases
    redundancy: int
    settled: bool  # whether σ and eccentricities converged within :data:`MAX_ROUNDS`
    solution: tuple[State, Setting]  # from which solutions of some of the views start
    restarted: bool = False  # the descent from the start did not end, and began again with the focal length alone

    def sigma(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def residuals_px(self) -> np.ndarray:
        return np.concatenate([model.residuals_px(self.camera) for model in self.models])

    def prints(self) -> dict[str, tuple[float, float]]:
        """Returns by how much more the board of each folder is stretched along its rows than across, and its shear."""
        boards = self.solution[1].boards
        return {m.group: boards[m.group].modes.stretch(m.xyz_model - boards[m.group].places) for m in self.models}

    def weights(self) -> list[np.ndarray]:
        return [robust_weights(model, self.camera, self.huber) for model in self.models]


def model_parameters(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns the parameters of a COLMAP model, (q,), with OpenCV's pixel origin."""
    return np.linalg.pinv(intrinsic_basis(colmap_model)) @ camera.parameters()


def vague_prior(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns the covariance (q, q) of a prior that any lens fulfils, for a regular normal matrix: focal length 100 %,
    principal point a quarter of the side; distortion moves the corner by its distance from the middle (tangential: a
    tenth)."""
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
    models = []
    for folder, members in by_group(views).items():
        labels = tuple(sorted({label for view in members for label in view.labels}))
        models.append(model_of_views(folder, labels, members, board, start))
    state = State(tuple(models), start)
    setting = Setting(
        basis=basis,
        weight=np.zeros((0, 0)) if held else np.linalg.inv(vague_prior(start, colmap_model)),
        start=start,
        boards={m.group: Board(m.xyz_model, PrintModes.of(m.xyz_model[:, :2])) for m in models},
        sigma_mm=board.sigma_mm,
        huber=np.inf,
    )
    try:
        return _adjusted(state, setting, board, colmap_model)
    except ConvergenceError:
        if held:
            raise
    # A focal length far off makes the rest of the lens wander: it comes first, alone, and one for both axes.
    focal, weight = intrinsic_basis("SIMPLE_PINHOLE")[:, :1], np.full((1, 1), start.focal[0] ** -2.0)
    alone = replace(setting, basis=focal, weight=weight)
    for _ in range(FOCAL_ROUNDS):
        state, alone = _robust_minimum(state, alone)
    return replace(_adjusted(state, setting, board, colmap_model), restarted=True)


def _intrinsics(last: Normal, colmap_model: str, factors: SigmaFactors, settled: bool) -> Intrinsics:
    state, setting, by_photographs = last.state, last.setting, last.by_photographs()
    return Intrinsics(
        camera=state.camera,
        colmap_model=colmap_model,
        covariance=by_photographs.covariance,
        independent=by_photographs.independent,
        differ=by_photographs.differ,
        freedom=by_photographs.freedom,
        models=state.models,
        factors=factors,
        huber=setting.huber,
        redundancy=state.redundancy(setting.kept),
        settled=settled,
        solution=(state, setting),
    )


FOCAL_ROUNDS = 2
MOST_STEPS, NO_GAIN = 10, 0.1
"""Most steps from the solution of all views to that of some of them, and the predicted decrease of the cost at which
they end, in σ²: no parameter is then off by more than a third of its σ."""


def of_some_views(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> Intrinsics:
    """Returns the intrinsics from some of the views of ``result``: by steps from the solution of all, with its weights,
    and the factors of σ by one step of their own; by :func:`adjust_intrinsics` where the steps do not settle."""
    whole, setting = result.solution
    state = whole.only({view.name for view in views})
    for _ in range(MOST_STEPS):
        last = Normal.of(state, setting)
        step, gain = last.step(0.0)
        if gain < NO_GAIN:
            return _intrinsics(last, result.colmap_model, _updated_factors(last, result.factors)[0], True)
        state = last.moved(step)
        if not np.isfinite(state.cost(setting.huber)):
            break
    return adjust_intrinsics(views, board, result.camera, result.colmap_model)


def _adjusted(state: State, setting: Setting, board: BoardDesign, colmap_model: str) -> Intrinsics:
    """Alternates minimisation and estimation of σ, amplitudes of the prints, and eccentricity."""
    detected_covariance, factors = [m.covariance_px2 for m in state.models], SigmaFactors()
    for round_index in range(MAX_ROUNDS):
        before = state
        state = _weighted(state, detected_covariance, factors, board)
        shifted = max(np.abs(a.shift_px - b.shift_px).max() for a, b in zip(state.models, before.models, strict=True))
        setting = replace(setting, sigma_mm=factors.dots * board.sigma_mm)
        state, setting = _robust_minimum(state, setting)
        last = Normal.of(state, setting)
        updated, boards = _updated_factors(last, factors)
        changes = [updated.centres / factors.centres, updated.dots / factors.dots] + [
            boards[folder].modes.amplitude / old.modes.amplitude for folder, old in setting.boards.items()
        ]
        factors, setting = updated, replace(setting, boards=boards)
        change = float(np.abs(np.log(changes)).max())
        settled = bool(round_index >= LEAST_ROUNDS and change < SETTLED_FACTOR and shifted < SETTLED_SHIFT_PX)
        if settled:
            break
    return _intrinsics(last, colmap_model, factors, settled)


def _robust_minimum(state: State, setting: Setting) -> tuple[State, Setting]:
    """Returns the state of least cost, and the setting with Huber's limit by its residuals."""
    state = minimum(state, setting)
    length = np.linalg.norm(np.concatenate([normalised(model, state.camera) for model in state.models]), axis=1)
    return state, replace(setting, huber=HUBER * max(robust_sigma(length, 2), LEAST_ROBUST))


def model_of_views(folder: str, labels: tuple[Label, ...], views, board: BoardDesign, camera: Camera) -> MetricModel:
    """Returns the model of a folder's views of its board, with the dots at their design places."""
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
    """Returns the state with scaled σ of the centres, larger ones in loud photographs, and updated eccentricity."""
    radius: dict[Label, float] = {**board.radius_of()}
    equal = [replace(m, covariance_px2=factors.centres**2 * each) for m, each in zip(state.models, own, strict=True)]
    loud = _loudness(replace(state, models=tuple(equal)))
    models = tuple(
        replace(
            model,
            shift_px=eccentricity_px(model, state.camera, radius, 1.0),
            covariance_px2=times[model.image_index, None, None] ** 2 * model.covariance_px2,
        )
        for model, times in zip(equal, loud, strict=True)
    )
    return replace(state, models=models)


def _loudness(state: State) -> list[np.ndarray]:
    """Returns by model the factor on σ of each photograph: above 1 where its residuals exceed those of most by far."""
    sizes = []
    for model in state.models:
        length = np.linalg.norm(normalised(model, state.camera), axis=1)
        sizes.append(np.array([robust_sigma(length[rows], 2) for rows in model.rows_by_image()]))
    usual = LOUD * max(float(np.median(np.concatenate(sizes))), LEAST_ROBUST)
    return [np.maximum(own / usual, 1.0) for own in sizes]


def _updated_factors(last: Normal, factors: SigmaFactors) -> tuple[SigmaFactors, dict[str, Board]]:
    """Returns variance components of centres and dots (Förstner 1979), each from its own residuals and redundancy, and
    the boards with the amplitudes of their prints."""
    state, setting = last.state, last.setting
    dots_left, boards = last.with_found_prints()
    dots, image_redundancy = factors.dots, state.redundancy(setting.kept) - dots_left
    if dots_left > MIN_BOARD_REDUNDANCY:
        dots = max(LEAST_DOTS, dots * sigma_factor(setting.dots_cost(state), dots_left))
    return SigmaFactors(factors.centres * sigma_factor(state.cost(setting.huber), image_redundancy), dots), boards
