"""Pairs of images: the initial pair by ray angle as in Zhang & Wei (2017), and the pairs that the database holds."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Literal

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from stcal.design import BoardDesign
from stcal.errors import DegenerateError, InputError, MappingError
from stcal.geometry.arrays import require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.plane import camera_from_plane, fit_homography
from stcal.geometry.rigid import Rigid, best_rotations
from stcal.labels import DotLabel
from stcal.sfm.data.group_model import ImageObservations, WorldModel, rows_by
from stcal.sfm.data.patterns import planar_pose
from stcal.sfm.mapping.database import match_labels

RANSAC_PX = 1.0
MIN_LABELS = 8
"""Smallest number of common labels of a pair. Five determine essential matrices, the others select one of them."""
MIN_IN_FRONT = 0.9
OVER_LIMIT = "median angle over the limit"
SAFE_ANGLE_RAD = np.radians(60.0)
MIN_ANGLE_RAD = np.radians(1.0)
"""Smallest median ray angle of a pair. Below it the camera's movement is too small for a reconstruction."""


@dataclass(frozen=True, slots=True)
class PairOptions:
    """Options of the choice of the initial pair."""

    max_angle_rad: float | None = None  # largest safe median ray angle; None: 60°, or the smallest of a group beyond

    def __post_init__(self):
        require_fields(self, "options")
        if self.max_angle_rad is not None and not 0 < self.max_angle_rad <= np.pi:
            needed = f"option max_angle_rad {self.max_angle_rad:g}: more than 0, up to π needed; give another"
            raise InputError("E-OPTION-RANGE", needed)

    def limit_rad(self) -> float:
        """Returns the limit that is used."""
        return SAFE_ANGLE_RAD if self.max_angle_rad is None else self.max_angle_rad


@dataclass(frozen=True, slots=True, eq=False)
class PairScore:
    """Quality of one pair of images as the initial pair."""

    first: str
    second: str
    shared: int  # number of common labels
    median_angle_rad: float  # of the rays of triangulated points
    in_front: float  # share of the points in front of both cameras
    forward: float  # |t_z|/‖t‖
    second_from_first: Rigid | None  # with unit translation; of chosen and usable pairs
    verdict: str  # ``chosen``, ``usable`` or why not usable


def rank_pairs(
    group: list[ImageObservations], camera: Camera, options: PairOptions, board: BoardDesign | None = None
) -> list[PairScore]:
    """Returns all pairs of a group: the chosen one, the usable ones by angle, then the others; an error if none is.
    ``board`` gives the pose of pairs with only it in common, as a plane has two essential matrices."""
    scores = [_score(a, b, camera, options, board) for a, b in combinations(group, 2)]
    scores.sort(key=lambda s: (s.verdict != "usable", -round(s.median_angle_rad, 9), -s.shared, s.first, s.second))
    over = [s for s in scores if s.verdict.startswith(OVER_LIMIT)]
    if over and scores[0].verdict != "usable" and options.max_angle_rad is None:
        scores.remove(over[-1])
        return [replace(over[-1], verdict=f"chosen: the smallest {OVER_LIMIT}, none is under it"), *scores]
    if not scores or scores[0].verdict != "usable":
        why, remedy = "1 usable image, 2 needed", "photograph faces and board together, from different places"
        if scores:
            best = (over[::-1] or scores)[0]
            angle = f" (median ray angle {np.degrees(best.median_angle_rad):.2f}°)" if best.second_from_first else ""
            why = f"{best.first}, {best.second}: {best.verdict}{angle}"
            remedy += " with views in between; check that the camera file belongs to the images, and that nothing but "
            remedy += "the camera moved" + "; or raise --max-angle" * bool(over)
        raise MappingError("E-MAPPING-NO-PAIR", f"group {group[0].group}: no initial pair, {why}; {remedy}")
    return [replace(scores[0], verdict="chosen"), *scores[1:]]


def _score(
    a: ImageObservations, b: ImageObservations, camera: Camera, options: PairOptions, board: BoardDesign | None
) -> PairScore:
    matches = match_labels(a, b)
    n, pose = len(matches), None
    xy_a, xy_b = a.centre[matches[:, 0]], b.centre[matches[:, 1]]
    if n >= MIN_LABELS and board is not None and share_board_alone(a, b):
        xy_mm = board.places_mm(a.labels[i] for i in matches[:, 0])[:, :2]
        on_a, on_b = planar_pose(xy_mm, xy_a), planar_pose(xy_mm, xy_b)
        if on_a is not None and on_b is not None:
            b_from_a = on_b @ on_a.inverse()
            length = float(np.linalg.norm(b_from_a.translation))
            pose = Rigid(b_from_a.rotation, b_from_a.translation / length) if length > 0 else None
    elif n >= MIN_LABELS:
        pose = _relative_pose(xy_a, xy_b, RANSAC_PX / float(np.sqrt(camera.focal.prod())))
    if pose is None:
        why = "no essential matrix" if n >= MIN_LABELS else f"{n} labels in common, {MIN_LABELS} needed"
        return PairScore(a.name, b.name, n, 0.0, 0.0, 0.0, None, why)
    xyz, front = triangulate(xy_a, xy_b, pose)
    angle = ray_angle_rad(xyz, xyz + pose.rotation.T @ pose.translation)
    in_front, forward = float(front.mean()), float(abs(pose.translation[2]))
    # If a rotation explains the pair, only noise determines the translation: angles and depths are meaningless.
    rays_a, rays_b = (np.pad(xy, ((0, 0), (0, 1)), constant_values=1) for xy in (xy_a, xy_b))
    rays_a, rays_b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (rays_a, rays_b))
    error = np.linalg.norm(rays_b - rays_a @ best_rotations(rays_b.T @ rays_a)[0].T, axis=1)
    if np.sqrt((error**2).mean()) * camera.focal.max() < RANSAC_PX:
        angle = min(angle, MIN_ANGLE_RAD / 2)
        verdict = "a mere rotation explains the pair: the camera hardly moved"
    elif angle < MIN_ANGLE_RAD:
        verdict = f"median angle under {np.degrees(MIN_ANGLE_RAD):.0f}°: the camera hardly moved"
    elif in_front < MIN_IN_FRONT:
        verdict = f"{100 * in_front:.0f} % of the points in front of both cameras, {100 * MIN_IN_FRONT:.0f} % needed"
    elif angle > options.limit_rad():
        verdict = f"{OVER_LIMIT} of {np.degrees(options.limit_rad()):.0f}°"
    else:
        verdict = "usable"
    return PairScore(a.name, b.name, n, angle, in_front, forward, pose, verdict)


def ray_angle_rad(to_a: np.ndarray, to_b: np.ndarray) -> float:
    """Returns the median angle between the rays (n, 3) of n points; 0 without points."""
    length = np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1)
    cosine = (to_a * to_b).sum(1) / np.maximum(length, 1e-300)
    return float(np.median(np.arccos(np.clip(cosine, -1, 1)))) if len(cosine) else 0.0


def pair_of_model(model: WorldModel) -> PairScore:
    """Returns the pair of images with most points in common: a report names one for each group."""
    sees = np.zeros((len(model.images), len(model.labels)), bool)
    sees[model.image_index, model.point_index] = True
    shared = np.triu(sees.astype(int) @ sees.T.astype(int), 1)
    i, j = np.unravel_index(int(shared.argmax()), shared.shape)
    pose = model.camera_from_model[j] @ model.camera_from_model[i].inverse()
    both = model.xyz_model[sees[i] & sees[j]]
    angle = ray_angle_rad(*(both - model.camera_from_model[k].inverse().translation for k in (i, j)))
    length = float(np.linalg.norm(pose.translation)) or 1.0
    pair, forward = (model.images[i], model.images[j], int(shared[i, j])), abs(float(pose.translation[2])) / length
    return PairScore(*pair, angle, 1.0, forward, Rigid(pose.rotation, pose.translation / length), "chosen")


def _relative_pose(xy_a: np.ndarray, xy_b: np.ndarray, threshold: float) -> Rigid | None:
    """Returns b_from_a with unit translation by five-point RANSAC (Nistér 2004) on normalised points."""
    essential, inliers = cv2.findEssentialMat(
        xy_a, xy_b, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=threshold, maxIters=200
    )
    if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, xy_a, xy_b, np.eye(3), mask=inliers)
    if not np.isfinite(rotation).all() or np.linalg.norm(translation) == 0:
        return None
    return Rigid(rotation, translation.ravel())


def share_board_alone(a: ImageObservations, b: ImageObservations) -> bool:
    """Returns whether all common labels of two images are dots of the board."""
    return all(isinstance(label, DotLabel) for label in set(a.labels) & set(b.labels))


def triangulate(xy_a: np.ndarray, xy_b: np.ndarray, b_from_a: Rigid) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (n, 3) in frame a by linear triangulation, and the mask of points in front of both cameras."""
    rows = np.zeros((len(xy_a), 4, 4))
    p = np.hstack([b_from_a.rotation, b_from_a.translation[:, None]])
    for k in range(2):
        rows[:, k, k], rows[:, k, 2] = -1, xy_a[:, k]
        rows[:, 2 + k] = xy_b[:, k, None] * p[2] - p[k]
    homogeneous = np.linalg.svd(rows)[2][:, 3]
    w = np.where(np.abs(homogeneous[:, 3:]) < 1e-12, 1e-12, homogeneous[:, 3:])
    xyz = homogeneous[:, :3] / w
    return xyz, (xyz[:, 2] > 0) & ((b_from_a @ xyz)[:, 2] > 0)


GraphKind = Literal["all", "sparse"]
SPARSE_FROM = 80
"""Largest set of images that gets all pairs. Above it the sparse graph is faster (scripts/studies/scale_study.py)."""
MIN_SHARED = 6  # smallest number of common labels of a pair of images that is written
SKELETON = 20  # number of images of a group that are mapped first. Smaller groups are mapped as a whole.
MIN_VIEWS = 3  # smallest number of views of every circle in the skeleton, if the group has that many
MIN_DOTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class ImageGraph:
    """Pairs of images to match."""

    kind: GraphKind
    pairs: np.ndarray  # (n, 2) indices of images, ascending
    skeleton: dict[str, np.ndarray]  # indices of the images mapped first, by group


def image_graph(
    observations: Sequence[ImageObservations], board: BoardDesign, kind: GraphKind | None = None
) -> ImageGraph:
    """Returns all pairs of images with six common labels, or just enough to keep every track connected (sparse)."""
    kind = kind or ("sparse" if len(observations) > SPARSE_FROM else "all")
    sees = incidence(observations)
    shared = (sees.astype(np.float32) @ sees.T.astype(np.float32)).astype(np.int32)
    members = rows_by(image.group for image in observations)
    if kind == "all":
        return ImageGraph(kind, np.argwhere(np.triu(shared, 1) >= MIN_SHARED), members)
    skeleton, joined = {}, np.zeros(shared.shape, bool)
    for name, indices in members.items():
        direction = np.array([_direction(observations[i], board) for i in indices])
        skeleton[name] = indices[_skeleton(direction, sees[indices])]
        among = np.ix_(skeleton[name], skeleton[name])
        joined[among] = shared[among] >= MIN_SHARED
    _join_tracks(joined, sees, shared, np.isin(np.arange(len(observations)), np.concatenate([*skeleton.values()])))
    return ImageGraph(kind, np.argwhere(np.triu(joined, 1)), skeleton)


def incidence(observations: Sequence[ImageObservations]) -> np.ndarray:
    """Returns which image sees which circle, (images, circles) bool. Dots of two groups are different circles."""
    seen = [[(i.group if isinstance(x, DotLabel) else "", x) for x in i.labels] for i in observations]
    column = {circle: k for k, circle in enumerate(dict.fromkeys(chain.from_iterable(seen)))}
    sees = np.zeros((len(observations), len(column)), bool)
    for row, circles in zip(sees, seen, strict=True):
        row[[column[circle] for circle in circles]] = True
    return sees


def _direction(image: ImageObservations, board: BoardDesign) -> np.ndarray:
    """Returns the unit vector (3,) from the board's middle to the camera, board frame; nan if there is no pose."""
    dots = [k for k, label in enumerate(image.labels) if isinstance(label, DotLabel)]
    if len(dots) >= MIN_DOTS:
        design, xy = board.places_mm(image.labels[k] for k in dots)[:, :2], board.xy_mm()
        with suppress(DegenerateError):
            camera_from_board = camera_from_plane(fit_homography(design, image.centre[dots]))
            offset = camera_from_board.inverse().translation - np.append((xy.min(0) + xy.max(0)) / 2, 0.0)
            return offset / np.linalg.norm(offset)
    return np.full(3, np.nan)


def _skeleton(direction: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Returns indices (into the group) of images far apart that see every circle at least ``MIN_VIEWS`` times."""
    count = len(direction)
    if count <= SKELETON:
        return np.arange(count)
    known = np.isfinite(direction[:, 0])
    chosen = [int(np.argmax(seen.sum(1) + count * known))]
    nearest = np.full(count, -1.0)
    while known[chosen[-1]] and len(chosen) < SKELETON:
        nearest = np.fmax(nearest, direction @ direction[chosen[-1]])
        apart = np.where(known, nearest, 1.0)
        apart[chosen] = 1.0
        if apart.min() >= 1.0:
            break
        chosen.append(int(np.argmin(apart)))
    wanted = np.minimum(seen.sum(0), MIN_VIEWS)
    while (short := seen[chosen].sum(0) < wanted).any():
        gain = seen[:, short].sum(1)
        gain[chosen] = 0
        chosen.append(int(np.argmax(gain)))
    return np.sort(chosen)


def _join_tracks(joined: np.ndarray, seen: np.ndarray, shared: np.ndarray, preferred: np.ndarray) -> None:
    """Joins images, ``preferred`` ones first, until every circle's are as connected as all pairs would make them."""
    for images in map(np.flatnonzero, seen.T):
        among = np.ix_(images, images)
        if connected_components(joined[among], directed=False)[0] == 1:
            continue
        i, j = np.nonzero(np.triu(joined[among] | (shared[among] >= MIN_SHARED), 1))
        a, b = images[i], images[j]
        order = np.lexsort((-shared[a, b], ~(preferred[a] & preferred[b]), ~joined[a, b]))
        graph = coo_array((1.0 + np.argsort(order), (i, j)), shape=(len(images), len(images)))
        a, b = minimum_spanning_tree(graph).nonzero()
        joined[images[a], images[b]] = True
