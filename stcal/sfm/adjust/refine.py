"""One group: scale, bundle adjustment alternating with the circles' eccentricity, and the free network with its score
tests (Rao 1948; Baarda 1968)."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from stcal.adjust.blocks import Block, Vector
from stcal.adjust.engine import Adjustment, Joined
from stcal.design import (
    POINT_RADIUS_MM,
    BoardDesign,
    FaceDesign,
    ScaleReference,
    TargetDesign,
    faces_of_known_shape,
    known_distances,
)
from stcal.errors import ConvergenceError, DegenerateError, MappingError, ScaleError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import PARAMETER_NAMES, Camera
from stcal.geometry.normal_equations import Reduction, free_motions
from stcal.geometry.plane import circle_image_offset, fit_plane
from stcal.geometry.rigid import Poses, Rigid, Similarity, align_rigid, align_similarity, by_pose
from stcal.geometry.robust import robust_sigma
from stcal.labels import Label, dot_cells
from stcal.sfm.data.group_model import MIN_POINTS, GroupModel, ImageObservations, M, Outlier, WorldModel, rows_by

MIN_DOTS = 4
EDGE_SIGMA_PX = 0.1  # σ of the shift that all edges of all tags share
MIN_CORNERS = 3  # smallest number of corners that determine the scale of a face of known shape
ScaleSource = Literal["board", "faces", "distances", "drawing"]


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """The scale of one group."""

    board_from_world: Similarity  # over all dots by least squares, unless by rows; its scale is λ, mm per unit
    rows_mm_per_unit: float  # λ as in Zhang & Wei (2017): first and last row, all pairs
    rows: tuple[int, int]
    labels: tuple[Label, ...]  # (n,) the dots, or the corners of faces of known shape
    residuals_mm: np.ndarray  # (n, 3) minus design, board frame, of corners face frames
    sigma_mm_per_unit: float  # from the stated σ of the dots' positions
    source: ScaleSource = "board"  # what determines λ; ``drawing`` if no size is known

    def __post_init__(self):
        freeze(self, "residuals_mm", (len(self.labels), 3), "residuals")

    @property
    def mm_per_unit(self) -> float:
        """λ, by least squares or by rows, as requested."""
        return self.board_from_world.scale

    def group_from_world(self) -> Similarity:
        """Returns the similarity to the group's metric frame, which is the world in mm."""
        return Similarity(self.mm_per_unit, Rigid())

    def rms_mm(self) -> float:
        return float(np.sqrt((self.residuals_mm**2).sum(1).mean()))

    def mean_mm(self) -> float:
        """Returns the mean of the residuals' lengths: the first measure of Zhang & Wei's Table 1."""
        return float(np.linalg.norm(self.residuals_mm, axis=1).mean())

    def spread_mm(self) -> float:
        """Spread of the residuals' lengths, the second measure of Zhang & Wei's Table 1, there a mean square error."""
        return float(np.linalg.norm(self.residuals_mm, axis=1).std())


def find_scale(model: WorldModel, board: BoardDesign, by_rows: bool = False) -> Scale:
    """Returns the scale of a model from the dots of the board; ``by_rows``: λ as in Zhang & Wei (2017)."""
    members = model.points_by_face().get("board", np.zeros(0, int))
    where = f"group {model.group}: scale"
    if len(members) < MIN_DOTS and (own := _of_faces(model, board) or _of_distances(model, board)) is not None:
        return own
    if len(members) < MIN_DOTS:
        fault = f"{where}: {len(members)} board dots mapped, {MIN_DOTS} needed; photograph the board with the faces"
        remedy = "check that the camera file belongs to the images and the board file to the board"
        raise ScaleError("E-SCALE-FEW-DOTS", f"{fault}; {remedy}")
    labels = [model.labels[i] for i in members]
    cells = dot_cells(labels)
    xyz_board = board.places_mm(labels)
    xyz_world = model.xyz_model[members]
    try:
        board_from_world = align_similarity(xyz_board, xyz_world)
    except DegenerateError as error:
        raise ScaleError(
            "E-SCALE-COLLINEAR", f"{where}: the mapped board dots lie in one line; show more rows of the board"
        ) from error
    spread = np.sqrt(((xyz_board - xyz_board.mean(0)) ** 2).sum())
    # λ by Zhang & Wei (2017), eq. 7, with the correct mean over pairs: 2/(n(n−1)), not 1/(n−1)!
    rows = int(cells[:, 0].min()), int(cells[:, 0].max())
    chosen = np.isin(cells[:, 0], rows)
    i, j = np.triu_indices(int(chosen.sum()), 1)
    apart = [np.linalg.norm(xyz[chosen][i] - xyz[chosen][j], axis=1) for xyz in (xyz_board, xyz_world)]
    mean_ratio = float((apart[0] / apart[1]).mean())
    if by_rows:
        board_from_world = Similarity(mean_ratio, align_rigid(xyz_board, mean_ratio * xyz_world))
    residuals, sigma = board_from_world @ xyz_world - xyz_board, board_from_world.scale * board.sigma_mm / spread
    return Scale(board_from_world, mean_ratio, rows, tuple(labels), residuals, float(sigma))


def _of_faces(model: WorldModel, board: BoardDesign) -> Scale | None:
    """Returns the scale from the corners of faces of known shape, None if there are none."""
    labels: list[Label] = []
    scales, weights, parts = [], [], []
    for face, members in known_points(model.labels, board):
        design, xyz = face.places_mm(model.labels[i].circle for i in members), model.xyz_model[members]
        try:
            scales.append(align_similarity(design, xyz).scale)
        except DegenerateError:
            continue
        weights.append(((design - design.mean(0)) ** 2).sum() / (face.sigma_mm or 1.0) ** 2)
        parts.append((design, xyz))
        labels += [model.labels[i] for i in members]
    if not scales:
        return None
    scale = float(np.exp(np.average(np.log(scales), weights=weights)))
    residuals = np.concatenate([align_rigid(design, scale * xyz) @ (scale * xyz) - design for design, xyz in parts])
    sigma = scale / float(np.sqrt(np.sum(weights)))
    return Scale(Similarity(scale, Rigid()), scale, (0, 0), tuple(labels), residuals, sigma, "faces")


def _of_distances(model: WorldModel, board: BoardDesign) -> Scale | None:
    """Returns the scale from known distances, None if there are none."""
    place = {label: i for i, label in enumerate(model.labels)}
    known = [d for d in known_distances(board) if d.first in place and d.second in place]
    if not known:
        return None
    units = [np.linalg.norm(model.xyz_model[place[d.first]] - model.xyz_model[place[d.second]]) for d in known]
    weights = np.array([(d.mm / d.sigma_mm) ** 2 for d in known])
    ratios = np.array([d.mm for d in known]) / units
    scale = float(np.average(ratios, weights=weights))
    away = np.array([[scale * unit - d.mm, 0.0, 0.0] for d, unit in zip(known, units, strict=True)])
    labels = tuple(d.first for d in known)
    sigma = scale / float(np.sqrt(weights.sum()))
    source: ScaleSource = "drawing" if known[0].drawn else "distances"
    return Scale(Similarity(scale, Rigid()), scale, (0, 0), labels, away, sigma, source)


def with_edge_sigma(board: BoardDesign, observations: Sequence[ImageObservations]) -> BoardDesign:
    """Returns the board with the σ of printed sizes enlarged by that of a common shift of the edges of tags: light, ink
    and camera make all tags look larger or smaller alike, which no residual shows."""
    if not isinstance(board, ScaleReference) or not any(face.of_tags for face in board.faces):
        return board
    labels = [label for face in board.faces if face.of_tags for label in face.labels()]
    lengths: dict[str, list[float]] = defaultdict(list)
    for image in observations:
        place = dict(zip(image.labels, image.centre_px, strict=True))
        for first, second in zip(labels[::4], labels[1::4], strict=True):
            if first in place and second in place:
                lengths[first.face].append(float(np.linalg.norm(place[first] - place[second])))
    faces = []
    for face in board.faces:
        moved = 2 * EDGE_SIGMA_PX / float(np.median(lengths[face.id])) if face.id in lengths else 0.0
        variance = face.size_sigma**2 + moved**2
        share = moved**2 / variance if variance else 0.0
        faces.append(replace(face, size_sigma=float(np.sqrt(variance)), edge_share=share))
    return replace(board, faces=tuple(faces))


def known_points(labels: Sequence[Label], board: BoardDesign) -> list[tuple[FaceDesign, np.ndarray]]:
    """Returns the faces of known shape with three points or more among ``labels``, and the indices of these."""
    faces, members = {face.id: face for face in faces_of_known_shape(board)}, rows_by(label.plane for label in labels)
    return [(faces[face], rows) for face, rows in members.items() if face in faces and len(rows) >= MIN_CORNERS]


EXACTLY = 1e-15  # largest predicted decrease of the last step, as a share of χ²: corrections of nanometres must be seen
MAX_STEPS = 50
DAMPING = 1e-10  # relative damping, which holds the seven free directions of the world
NO_PARAMETERS = np.zeros((len(PARAMETER_NAMES), 0))


def adjust(model: M, camera: Camera) -> M:
    """Minimises the weighted reprojection error of the corrected centres over poses and points."""
    if not model.images:
        fault = f"group {model.group}: no two images have {MIN_POINTS} circles or corners in common"
        raise MappingError("E-GROUP-FEW-IMAGES", f"{fault}; add images, until two show each face beside a neighbour")
    a, poses = Adjustment(), Poses.of(model.camera_from_model)
    few = 2 * len(model.images) <= len(model.labels)  # the larger part of the unknowns is eliminated
    cameras = a.block("poses", poses, eliminate=not few)
    points = a.block("points", Vector(model.xyz_model), eliminate=few)
    reproject(a, model, (points, cameras), lambda *_: camera)
    remedy = "check the camera file, and the sizes of printed faces in target.toml"
    minimum = a.minimum(damping=DAMPING, least_damping=DAMPING, settled=EXACTLY, max_steps=MAX_STEPS)
    values = minimum.required(f"group {model.group}: bundle adjustment", remedy).state
    return placed(model, values["poses"], values["points"])


def reproject(
    a: Adjustment,
    model: GroupModel,
    on: Sequence[Block],  # points, poses, and the parameters of a camera if they are adjusted
    camera_at: Callable[..., Camera],  # of these parameters
    basis: np.ndarray = NO_PARAMETERS,  # (16, q) derivative of the camera's parameters by them
    **known: Any,  # kind, cluster and loss of the rows
) -> None:
    """Adds the rows of a model's observations, projected minus measured centres, px; infinite behind a camera."""
    point, image, measured_px = model.point_index, model.image_index, model.corrected_px()

    @lru_cache(maxsize=2)
    def seen(points: Vector, poses: Poses) -> np.ndarray:
        return np.einsum("nij,nj->ni", poses.rotation[image], points.array[point]) + poses.translation[image]

    def residuals(points: Vector, poses: Poses, *lens: Vector) -> np.ndarray:
        xyz = seen(points, poses)
        behind = (xyz[:, 2] <= 0).any()
        return np.full_like(measured_px, np.inf) if behind else camera_at(*lens).project(xyz) - measured_px

    def derivatives(points: Vector, poses: Poses, *lens: Vector) -> list[np.ndarray]:
        xyz, camera = seen(points, poses), camera_at(*lens)
        of_poses, by_point = _jacobians(xyz, poses[image], camera)
        return [by_point, of_poses, *(camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis for _ in lens)]

    root = model.whiten(np.tile(np.eye(2), (len(image), 1, 1)))
    a.factor(residuals, list(zip(on, (point, image, None), strict=False)), derivatives=derivatives, root=root, **known)


def placed(model: M, poses: Poses, points: Vector) -> M:
    return replace(model, camera_from_model=tuple(poses), xyz_model=points.array)


def projection_jacobians(model: GroupModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns the derivatives of the projections (px) by poses, left perturbed, (n, 2, 6), and by points, (n, 2, 3)."""
    return _jacobians(model.xyz_camera(), Poses.of(model.camera_from_model)[model.image_index], camera)


def _jacobians(xyz: np.ndarray, poses: Poses, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns :func:`projection_jacobians` of points (n, 3) in the frames of n cameras."""
    by_camera = camera.projection_jacobian(xyz)
    return by_pose(by_camera, xyz - poses.translation), by_camera @ poses.rotation


MAX_ROUNDS = 20
SETTLED_PX = 1e-5  # largest change of corrections that have settled, in px: far below any centring noise
OUTLIER_RMS = 6.0
"""Limit of a residual, as a multiple of the residuals' robust RMS length, √2 σ. Observations that exceed it, and twice
this multiple of their own σ, are named and left out."""
MIN_OUTLIER_PX = 0.1
WORST_SHARE = 0.5
MAX_OUTLIER_SHARE = 0.1
CONTRADICTS = (
    "check that nothing but the camera moved, and that the camera file belongs to the images (without --camera it is "
    "found from the board's dots)"
)


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    model: WorldModel
    rounds: int
    outliers: tuple[Outlier, ...]  # observations that were left out


def refine(
    model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign, eccentricity: bool = True
) -> Refined:
    """Alternates between the eccentricity of the circles and bundle adjustment until the corrections settle."""
    radius = target.radius_of() | board.radius_of()
    model = adjust(model, camera)
    observations, rounds = len(model.image_index), 0
    outliers: list[Outlier] = []
    while rounds < MAX_ROUNDS:  # rounds that find outliers do not count: their number is limited separately
        rounds += 1
        shift = np.zeros_like(model.shift_px)
        if eccentricity:
            shift = eccentricity_px(model, camera, radius, find_scale(model, board).mm_per_unit)
        change = np.abs(shift - model.shift_px).max(initial=0.0)
        model = replace(model, shift_px=shift)
        if change > SETTLED_PX:
            model = adjust(model, camera)
        if rounds >= 2 or not eccentricity:
            is_outlier, new_outliers = _outliers(model, camera)
            if len(new_outliers):
                outliers += new_outliers
                if len(outliers) > MAX_OUTLIER_SHARE * observations:  # the model is wrong, not the observations
                    share = f"more than {100 * MAX_OUTLIER_SHARE:.0f} % of {observations} observations"
                    first = f"{outliers[0].image} {outliers[0].label} by {outliers[0].residual_px:.1f} px"
                    fault = f"group {model.group}: {share} contradict the others, first {first}"
                    raise MappingError("E-GROUP-CONTRADICTS", f"{fault}; {CONTRADICTS}")
                model = adjust(model.without(is_outlier), camera)
                rounds -= 1
                continue
        if change <= SETTLED_PX:
            return Refined(model, rounds, tuple(outliers))
    fault = f"the eccentricity still changes by {change:.2g} px after {MAX_ROUNDS} rounds, {SETTLED_PX:g} needed"
    remedy = "check the radii in the target and board files"
    raise ConvergenceError("E-NO-MINIMUM", f"group {model.group}: {fault}; {remedy}")


def eccentricity_px(model: GroupModel, camera: Camera, radius_mm: dict[Label, float], mm_per_unit: float) -> np.ndarray:
    """Centre of the imaged ellipse minus the image of the circle's centre, (n, 2), for every observation."""
    normal = np.zeros((len(model.labels), 3))
    for key, members in model.points_by_face().items():
        if max(radius_mm[model.labels[i]] for i in members) <= POINT_RADIUS_MM:
            continue  # corners have no eccentricity
        try:
            normal[members] = fit_plane(model.xyz_model[members]).normal
        except DegenerateError as error:
            surface = "the board" if key == "board" else f"face {key}"
            fault = f"{surface}: {len(members)} circles mapped, 3 needed for its plane that are not on one line"
            text = f"group {model.group}: {fault}; add views that show {surface}"
            raise MappingError("E-GROUP-FEW-CIRCLES", text) from error
    radius = np.array([radius_mm[label] for label in model.labels]) / mm_per_unit
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
    xyz = model.xyz_camera()
    normal_camera = np.einsum("nij,nj->ni", rotation, normal[model.point_index])
    ellipse = circle_image_offset(xyz, normal_camera, radius[model.point_index])
    return camera.project(ellipse) - camera.project(xyz)


def _outliers(model: GroupModel, camera: Camera) -> tuple[np.ndarray, list[Outlier]]:
    """Returns the worst observation of each image near the worst of all: it affects those it shares a point with."""
    residual = np.linalg.norm(model.residuals_px(camera), axis=1)
    rms = np.sqrt(2) * robust_sigma(residual, 2)
    limit = np.maximum(np.maximum(OUTLIER_RMS * rms, 2 * OUTLIER_RMS * model.sigma_px()), MIN_OUTLIER_PX)
    least = max(1.0, WORST_SHARE * float((residual / limit).max(initial=0.0)))
    is_outlier = np.zeros(len(residual), bool)
    outliers = []
    for name, rows in zip(model.images, model.rows_by_image(), strict=True):
        worst = rows[np.argmax(residual[rows] / limit[rows])]
        if residual[worst] > least * limit[worst]:
            is_outlier[worst] = True
            label = model.labels[model.point_index[worst]]
            outliers.append(Outlier(name, label, float(residual[worst]), float(limit[worst])))
    return is_outlier, outliers


MIN_SHARE = 1e-6
"""Smallest share of a parameter's information that poses and points leave to it. Below this share, the parameter cannot
be separated from them."""
MIN_CONTROL = 0.1
"""Smallest redundancy of one coordinate at which the other observations control it: its residual then shows a tenth of
its error."""


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """An adjusted group, mm, with n observations, m images, p points."""

    model: GroupModel
    residual: np.ndarray  # (n, 2) over σ
    by_pose: np.ndarray  # (n, 2, 6) derivatives of the projections over σ
    by_point: np.ndarray  # (n, 2, 3)
    poses: Reduction  # elimination of the poses
    point_right: np.ndarray  # (3p,) right-hand side without the poses, after the adjustment almost zero
    covariance_mm2: np.ndarray  # (3p, 3p) of the points, in the datum of smallest trace
    residual_cofactor: np.ndarray  # (n, 2, 2) covariance of each residual over σ²

    def __post_init__(self):
        p = 3 * len(self.model.labels)
        freeze(self, "covariance_mm2", (p, p), "covariance")

    @property
    def redundancy(self) -> np.ndarray:
        """Redundancy of each observation, (n,), between 0 and 2."""
        return np.trace(self.residual_cofactor, axis1=1, axis2=2)

    def squares_of_observations(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the squared residuals over their own covariances, (n,), and the degrees of freedom, 0 to 2: a
        direction that the other observations hardly control tells nothing."""
        value, vector = np.linalg.eigh(self.residual_cofactor)
        held = value > MIN_CONTROL
        along = (np.swapaxes(vector, 1, 2) @ self.residual[..., None])[..., 0]
        square = np.where(held, along**2 / np.where(held, value, 1.0), 0.0)
        return square.sum(1), held.sum(1)

    def noise(self) -> float:
        """Returns the squared residual per degree of freedom of this group; 1 if that is less, as σ explain it."""
        return max(float((self.residual**2).sum() / max(self.redundancy.sum(), 1e-9)), 1.0)

    def square_by_image(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns squared residuals over σ² and redundancy of each image, (m,)."""
        image, count = self.model.image_index, len(self.model.images)
        return np.bincount(image, (self.residual**2).sum(1), count), np.bincount(image, self.redundancy, count)

    def covariance_of(self, points: np.ndarray) -> np.ndarray:
        """Returns the covariance of some of the points, (3k, 3k)."""
        place = (3 * np.asarray(points)[:, None] + np.arange(3)).ravel()
        return self.covariance_mm2[np.ix_(place, place)]

    def pose_covariance(self) -> np.ndarray:
        """Returns (m, 6, 6) rad and mm, in the datum of the points, rotations perturbed on the left."""
        to_points = self.poses.from_kept
        return self.poses.inverse + to_points @ self.covariance_mm2 @ np.swapaxes(to_points, 1, 2)

    def score(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Equations (q, q), (q,) of parameters of the group by the derivatives ``columns`` (n, 2, q) over σ."""
        normal, right, to_points = self._by_image(columns)
        coupled = to_points.sum(0)
        weighted = coupled @ self.covariance_mm2
        return normal.sum(0) - weighted @ coupled.T, right.sum(0) - weighted @ self.point_right

    def score_by_image(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns :meth:`score` of separate parameters for each image: (m, q, q) and (m, q)."""
        normal, right, to_points = self._by_image(columns)
        weighted = to_points @ self.covariance_mm2
        return normal - weighted @ np.swapaxes(to_points, 1, 2), right - weighted @ self.point_right

    def score_of_image(self, image: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns :meth:`score` (2k, 2k), (2k,) of one parameter per coordinate of an image, the first ones first. They
        explain any residuals of the image, as if the image were left out."""
        rows = self.model.rows_by_image()[image]
        k, p = len(rows), len(self.model.labels)
        by_pose = np.concatenate([self.by_pose[rows, 0], self.by_pose[rows, 1]])
        to_points = np.zeros((2 * k, p, 3))
        for axis in range(2):
            to_points[axis * k + np.arange(k), self.model.point_index[rows]] = self.by_point[rows, axis]
        coupled = to_points.reshape(2 * k, 3 * p) - by_pose @ self.poses.from_kept[image]
        weighted = coupled @ self.covariance_mm2
        right = self.residual[rows].T.ravel() - by_pose @ self.poses.step[image]
        normal = np.eye(2 * k) - by_pose @ np.linalg.solve(self.poses.block[image], by_pose.T)
        return normal - weighted @ coupled.T, right - weighted @ self.point_right

    def _by_image(self, e: np.ndarray):
        """Returns by image, without its pose: normal (m, q, q), right side (m, q), coupling to points (m, q, 3p)."""
        model = self.model
        m, q, p = len(model.images), e.shape[2], len(model.labels)
        normal, by_pose, right = np.empty((m, q, q)), np.empty((m, q, 6)), np.empty((m, q))
        for i, rows in enumerate(model.rows_by_image()):
            own = e[rows].reshape(-1, q).T
            normal[i], by_pose[i] = own @ own.T, own @ self.by_pose[rows].reshape(-1, 6)
            right[i] = own @ self.residual[rows].ravel()
        to_points = np.zeros((m, q, p, 3))
        to_points[model.image_index, :, model.point_index] = np.swapaxes(e, 1, 2) @ self.by_point
        return (
            normal - by_pose @ self.poses.inverse @ np.swapaxes(by_pose, 1, 2),
            right - np.einsum("mqi,mi->mq", by_pose, self.poses.step),
            to_points.reshape(m, q, 3 * p) - by_pose @ self.poses.from_kept,
        )


def free_network(model: GroupModel, camera: Camera) -> Network:
    a = Adjustment()
    points = a.block("points", Vector(model.xyz_model))
    poses = a.block("poses", Poses.of(model.camera_from_model), eliminate=True)
    reproject(a, model, (points, poses), lambda *_: camera)
    joined = Joined([a], ("points",), lambda values: free_motions(values["points"].array, scale=True))
    (solution,) = joined.at({block.name: block.start for block in a.blocks}).whole
    (rows,), covariance, p = solution.rows, solution.inverse, len(model.labels)
    by_point, by_pose = rows.slopes
    # cofactors of each adjusted observation, (n, 2, 2)
    mixed = (solution.reduction.from_kept @ covariance).reshape(-1, 6, p, 3)[model.image_index, :, model.point_index]
    blocks = covariance.reshape(p, 3, p, 3)[np.arange(p), :, np.arange(p)]
    cross = by_pose @ mixed @ np.swapaxes(by_point, 1, 2)
    of_poses = by_pose @ solution.covariance(poses)[model.image_index] @ np.swapaxes(by_pose, 1, 2)
    of_points = by_point @ blocks[model.point_index] @ np.swapaxes(by_point, 1, 2)
    cofactor = np.eye(2) - (of_poses - cross - np.swapaxes(cross, 1, 2) + of_points)
    return Network(model, -rows.residual, by_pose, by_point, solution.reduction, solution.right, covariance, cofactor)


@dataclass(frozen=True, slots=True, eq=False)
class ScoreTest:
    """Result of a score test: ``statistic`` follows χ² if no further parameter is needed."""

    estimate: np.ndarray
    covariance: np.ndarray
    statistic: float
    freedom: int


def solve_score(normal: np.ndarray, right: np.ndarray) -> ScoreTest:
    """Returns the test for the equations of :meth:`Network.score`, without directions that they do not determine."""
    own = np.diag(normal)
    scale = np.sqrt(np.where(own > 0, own, np.inf))  # a parameter that rounding alone determines counts for nothing
    value, vector = np.linalg.eigh(normal / np.outer(scale, scale))
    held = value > MIN_SHARE
    half = vector[:, held] / np.sqrt(value[held]) / scale[:, None]
    along = half.T @ right
    return ScoreTest(half @ along, half @ half.T, float(along @ along), int(held.sum()))
