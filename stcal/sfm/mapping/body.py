"""The way of mapping by faces of known shape: the poses of faces and images, of the whole body at once, and the camera
if it is unknown. Of the two reflections of each view (Schweighofer & Pinz 2006) those are taken on which the images
agree."""

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from stcal.adjust.blocks import Block, Huber, Vector
from stcal.adjust.engine import Adjustment
from stcal.design import FaceDesign
from stcal.errors import ConvergenceError, DegenerateError, MappingError
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.least_squares import Normal, descend
from stcal.geometry.plane import camera_from_plane, fit_homography, mirrored
from stcal.geometry.rigid import Poses, Rigid, by_pose, perspective
from stcal.geometry.robust import HUBER, huber_cost, huber_weights, robust_sigma, tailed_limit
from stcal.labels import Label
from stcal.sfm.data.group_model import MIN_POINTS, ImageObservations, Outlier, WorldModel, assemble
from stcal.sfm.mapping import incremental
from stcal.sfm.mapping.incremental import MIN_RAY_ANGLE_RAD, Mapping, rays_of, widest_angle_rad

BY_FACES = "faces of known shape, placed together"
SHOW_MORE = "show two faces of it at once, or one by more corners"
LENS = "OPENCV"  # model of an unknown camera
SIGMA_FOCAL, SIGMA_SQUARE = 0.5, 2e-3
"""Relative σ of the focal length of an unknown camera, and of the ratio of its two focal lengths."""
SIGMA_CENTRE = 0.03  # σ of its principal point, in longer image sides
SIGMA_RADIAL, SIGMA_TANGENTIAL = np.array([0.3, 0.1]), 0.003
"""σ of its distortion, as shares of a corner's distance from the middle of the image: lenses of cameras have no more,
and few or small faces would take noise for it."""
MIN_CORNERS = 4  # smallest number of corners of a view of a face: they determine its homography
SAME_TURN_RAD, SAME_PLACE = np.radians(10.0), 0.25
"""Largest differences of two poses of one face relative to another that agree: rotation, and translation as a share of
the distance of the faces."""
MOST_VOTES = 250  # most images that vote on how two faces lie; time and memory grow with their square
LEAST_SIGMA_PX = 0.05  # σ that print, lens and detector leave to any corner
LEAST_PAIRS, ROBUST_SIZES = 2, 10
"""Smallest number of images of two faces that tell the ratio of their sizes, and number of robust rounds."""
MOST_OFF, SURE_SIGMAS = np.log(1.15), 5.0
"""Logarithm of the factor, and number of σ, beyond both of which a face is drawn at another size than the others."""
LEAST_SIGMA_OFF = 0.02  # σ of such a logarithm that the reflections of views and a rough camera leave to any
LEAST_FOCAL = 0.1  # smallest focal length of the camera, as a share of that at the start
BETTER = 0.2  # share by which another pose of a face must fit its corners better
BY_CHANCE = 0.01  # number of sound corners in a run that may be taken for gross errors
SHARING = 2  # number of corners that share the error of an edge
PASSES, ROBUST_ROUNDS = 3, 3
MAX_STEPS = 100
FOCAL_STEPS = (0.6, 0.9, 1.4, 2.2, 3.5)
"""Focal lengths over the longer image side at which the search for an unknown camera starts."""


class BodyCorners:
    """n corners of known faces in the images, of views with at least four corners of a face."""

    def __init__(self, observations: Sequence[ImageObservations], faces: Sequence[FaceDesign]):
        self.images, self.faces = tuple(each.name for each in observations), tuple(faces)
        place: dict[Label, tuple[int, int]] = {
            label: (f, k) for f, face in enumerate(faces) for k, label in enumerate(face.labels())
        }
        rows: list[tuple[int, int, int]] = []
        seen = [ImageObservations("", "", (), *np.zeros((2, 0, 2)), *np.zeros((2, 0, 2, 2)))]
        for i, image in enumerate(observations):
            of_face = np.array([place.get(label, (-1,))[0] for label in image.labels], int)
            keep = np.flatnonzero((of_face >= 0) & (np.sum(of_face[:, None] == of_face, axis=1) >= MIN_CORNERS))
            rows += [(i, *place[image.labels[k]]) for k in keep]
            seen.append(image.select(keep))
        # (n,) indices into ``images``, into ``faces``, and among the corners of the face
        self.image, self.face, self.corner = np.array(rows, int).reshape(-1, 3).T
        self.xy_face = np.array([faces[f].xy_mm[k] for _, f, k in rows]).reshape(-1, 2)  # (n, 2) mm
        self.xy_px = np.concatenate([each.centre_px for each in seen])  # (n, 2)
        covariance = np.concatenate([each.covariance_px2 for each in seen]) + LEAST_SIGMA_PX**2 * np.eye(2)
        self.root = np.linalg.inv(np.linalg.cholesky(covariance))  # (n, 2, 2) whitens residuals in px

    def select(self, keep: np.ndarray) -> "BodyCorners":
        """Returns the corners of a mask."""
        part = copy(self)
        for name in ("image", "face", "corner", "xy_face", "xy_px", "root"):
            setattr(part, name, getattr(self, name)[keep])
        return part

    def xyz_face(self) -> np.ndarray:
        """Returns the corners in the frames of their faces, (n, 3)."""
        return np.pad(self.xy_face, ((0, 0), (0, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Poses of faces and images by index in the corners, and the camera; only those of the masks have a meaning."""

    body_from_face: Poses
    camera_from_body: Poses
    camera: Camera
    placed_faces: np.ndarray
    placed_images: np.ndarray
    cost: float = np.inf  # of all corners of placed faces in placed images, in σ²

    def xyz_camera(self, corners: BodyCorners) -> np.ndarray:
        """Returns the corners in the frames of the cameras, (n, 3)."""
        xyz_body = self.body_from_face[corners.face] @ corners.xyz_face()
        return self.camera_from_body[corners.image] @ xyz_body

    def lengths(self, corners: BodyCorners) -> np.ndarray:
        """Returns the lengths of the residuals in σ, (n,); infinite behind a camera."""
        return _lengths(self.xyz_camera(corners), corners, self.camera)

    def used(self, corners: BodyCorners) -> np.ndarray:
        """Returns the mask of the corners of placed faces in placed images, (n,)."""
        return self.placed_faces[corners.face] & self.placed_images[corners.image]


def _lengths(xyz_camera: np.ndarray, corners: BodyCorners, camera: Camera) -> np.ndarray:
    ahead = xyz_camera[:, 2] > 0
    safe = np.where(ahead[:, None], xyz_camera, [0.0, 0.0, 1.0])
    with np.errstate(over="ignore", invalid="ignore"):
        residual = np.einsum("nij,nj->ni", corners.root, corners.xy_px - camera.project(safe))
        length = np.linalg.norm(residual, axis=1)
    return np.where(ahead & np.isfinite(length), length, np.inf)


def place_body(corners: BodyCorners, camera: Camera) -> Body:
    """Returns start values of all poses for a given camera, linked by what most images agree on."""
    views, count = _FaceViews(corners, camera), len(corners.faces)
    edges: dict[tuple[int, int], tuple[Rigid, int]] = {}  # in both directions
    for (a, b), pairs in _pairs(views).items():
        a_from_b, votes = _edge(pairs, views)
        edges |= {(a, b): (a_from_b, votes), (b, a): (a_from_b.inverse(), votes)}
    if not edges:
        fault = f"target: {count} faces of known shape, but no image shows two of them"
        remedy = "add images that show neighbouring faces with at least four corners each"
        raise MappingError("E-BODY-UNLINKED", f"{fault}; {remedy}")
    seen = np.bincount(views.face, minlength=count)
    poses = {max({a for a, _ in edges}, key=lambda face: seen[face]): Rigid()}
    while open_edges := [(a, b) for a, b in edges if a in poses and b not in poses]:
        a, b = max(open_edges, key=lambda edge: edges[edge][1])
        poses[b] = poses[a] @ edges[a, b][0]
    placed_faces = np.isin(np.arange(count), list(poses))
    body_from_face = Poses.of(poses.get(face, Rigid()) for face in range(count))
    camera_from_body, placed_images = _images(views, corners, body_from_face, placed_faces, camera)
    return Body(body_from_face, camera_from_body, camera, placed_faces, placed_images)


class _FaceViews:
    """v views of a face in an image, in the order of images and faces."""

    def __init__(self, corners: BodyCorners, camera: Camera):
        normalised = camera.normalised_from_pixel(corners.xy_px)
        key, view_of = np.unique(np.column_stack([corners.image, corners.face]), axis=0, return_inverse=True)
        starts: list[Rigid] = []
        kept: list[int] = []
        members: list[np.ndarray] = []  # of each start
        for v, own in ((v, np.flatnonzero(view_of == v)) for v in range(len(key))):
            with suppress(DegenerateError):
                pose = camera_from_plane(fit_homography(corners.xy_face[own], normalised[own]))
                if ((pose @ corners.xyz_face()[own])[:, 2] > 0).all():
                    middle = Rigid(np.eye(3), np.append(corners.xy_face[own].mean(0), 0.0))
                    starts += [pose, *mirrored(Poses.of([pose]), middle)]
                    members += [own, own]
                    kept.append(v)
        self.image, self.face = key[kept].T  # (v,)
        self.poses, self.cost = Poses.of([]), np.zeros((0, 2))
        if not kept:
            return
        most = max(map(len, members))
        index = np.array([np.pad(own, (0, most - len(own))) for own in members])
        real = np.arange(most) < np.array([*map(len, members)])[:, None]
        xyz, xy = corners.xyz_face()[index], normalised[index]
        root = corners.root[index] * camera.focal * real[..., None, None]

        def evaluate(poses: Poses) -> Normal:
            rotated = xyz @ np.swapaxes(poses.rotation, 1, 2)
            p = rotated + poses.translation[:, None]
            ahead = p[..., 2] > 0
            p[..., 2] = np.where(ahead, p[..., 2], 1.0)
            ideal, by_point = perspective(p)
            residual = (root @ (xy - ideal)[..., None])[..., 0]
            return Normal.of(residual, root @ by_pose(by_point, rotated), np.asarray((ahead | ~real).all(1)), np.inf)

        minima = descend(evaluate, Poses.of(starts), 1e-6)
        # (2v,) camera_from_face, both minima of each view one after the other, and (v, 2) their costs
        self.poses, self.cost = minima.poses, minima.cost.reshape(-1, 2)

    def both(self, of: np.ndarray) -> Poses:
        """Returns both poses of each of some views."""
        return self.poses[np.stack([2 * of, 2 * of + 1], 1).ravel()]


def _pairs(views: _FaceViews) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Returns the two views of each image that shows two faces, by these faces, in order."""
    by_pair: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for image in np.unique(views.image):
        for v, w in combinations(np.flatnonzero(views.image == image).tolist(), 2):
            by_pair.setdefault((int(views.face[v]), int(views.face[w])), []).append((v, w))
    return dict(sorted(by_pair.items()))


class _Relative:
    """Poses a_from_b of two faces in p images, 4 in each by the two minima of both views; of at most ``MOST_VOTES``
    pairs of views, evenly drawn."""

    def __init__(self, pairs: list[tuple[int, int]], views: _FaceViews):
        pairs = pairs[:: 1 + len(pairs) // MOST_VOTES]
        a, b = np.array([(2 * v + i, 2 * w + j) for v, w in pairs for i in range(2) for j in range(2)]).T
        back, place = np.swapaxes(views.poses.rotation[a], 1, 2), views.poses.translation[..., None]
        self.rotation = back @ views.poses.rotation[b]  # (4p, 3, 3)
        # (4p, 3) of the origins, from the camera, in the axes of a
        self.a_place, self.b_place = ((back @ place[k])[..., 0] for k in (a, b))
        self.of_pair = np.repeat(np.arange(len(pairs)), 4)
        cost = (views.cost.ravel()[a] + views.cost.ravel()[b]).reshape(-1, 4)
        self.excess = (cost - cost.min(1, keepdims=True)).ravel()  # over that of the best pose of the image
        cosine = (np.einsum("xij,yij->xy", self.rotation, self.rotation) - 1) / 2
        self.turned_alike = np.arccos(np.clip(cosine, -1, 1)) < SAME_TURN_RAD  # (4p, 4p)

    def best(self, agrees: np.ndarray) -> tuple[int, int]:
        """Returns the pose with which most images agree, and their number; ``agrees`` : (4p, 4p)."""
        votes = agrees.reshape(len(agrees), -1, 4).any(2).sum(1)
        # Where few images vote, the residuals do: of equal votes the pose of least cost in its image.
        best = int(np.lexsort((self.excess, -votes))[0])
        return best, int(votes[best])


def _edge(pairs: list[tuple[int, int]], views: _FaceViews) -> tuple[Rigid, int]:
    """Returns a_from_b of two faces as the images see it, and the number of images that agree on it."""
    poses = _Relative(pairs, views)
    translation = poses.b_place - poses.a_place
    apart = np.linalg.norm(translation[:, None] - translation, axis=2) / np.linalg.norm(translation, axis=1)[:, None]
    agrees = poses.turned_alike & (apart < SAME_PLACE)
    best, votes = poses.best(agrees)
    near = np.flatnonzero(agrees[best])
    mean = Rotation.from_matrix(poses.rotation[near]).mean().as_matrix()
    return Rigid(mean, np.median(translation[near], axis=0)), votes


def wrong_sizes(corners: BodyCorners, camera: Camera) -> tuple[dict[int, float], int]:
    """Returns true over stated size of faces whose size contradicts those of most others, by index of the face, and the
    number of the others that were compared. Too large by q, a face seems farther by q: face b is at the same place d in
    the frame of a in all images, q R_aᵀ t_b − R_aᵀ t_a = d."""
    views = _FaceViews(corners, camera)
    ratios: list[tuple[int, int, float, float]] = []
    for (a, b), pairs in _pairs(views).items():
        if len(pairs) < LEAST_PAIRS:
            continue
        poses = _Relative(pairs, views)
        near = np.flatnonzero(poses.turned_alike[poses.best(poses.turned_alike)[0]])
        near = near[np.unique(poses.of_pair[near], return_index=True)[1]]
        if len(near) < LEAST_PAIRS:
            continue
        a_place, b_place, weight = poses.a_place[near], poses.b_place[near], np.ones(len(near))
        for _ in range(ROBUST_SIZES):
            total = weight.sum()
            u, v = (place - weight @ place / total for place in (b_place, a_place))
            square = float(weight @ (u**2).sum(1))
            ratio = float(weight @ (u * v).sum(1)) / square
            length = np.linalg.norm(ratio * u - v, axis=1)
            weight = huber_weights(length, HUBER * max(robust_sigma(length, 3), 1e-12))
        freedom = max(3 * total - 4, 1.0)
        variance = float(weight @ length**2) / freedom
        if ratio > 0:
            ratios.append((a, b, np.log(ratio), np.sqrt(variance / square) / ratio))
    off = _off(ratios, len(corners.faces)) if ratios else {}
    return off, len({face for a, b, *_ in ratios for face in (a, b)}) - len(off)


def _off(ratios: list[tuple[int, int, float, float]], faces: int) -> dict[int, float]:
    """Factors of faces that differ from the median of those linked to them, from log ratios (a, b, log, σ)."""
    a, b, value, sigma = (np.array(each) for each in zip(*ratios, strict=True))
    rows = np.eye(faces)[b] - np.eye(faces)[a]
    sigma = np.hypot(sigma, LEAST_SIGMA_OFF)
    weight, logs, spread = sigma**-2, np.zeros(faces), 1.0
    for _ in range(ROBUST_SIZES):
        away = np.linalg.pinv((rows.T * weight) @ rows)
        logs = away @ ((rows.T * weight) @ value)
        length = np.abs(rows @ logs - value) / sigma
        spread = max(robust_sigma(length, 1), 1.0)
        weight = huber_weights(length, HUBER * spread) / sigma**2
    off: dict[int, float] = {}
    linked = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(faces, faces)), directed=False)[1]
    for component in np.unique(linked[np.concatenate([a, b])]):
        own = np.flatnonzero(linked == component)
        away_of = logs[own] - np.median(logs[own])
        sure = SURE_SIGMAS * spread * np.sqrt(np.diag(away)[own])
        far = np.flatnonzero(np.abs(away_of) > np.maximum(MOST_OFF, sure))
        off |= {int(own[k]): float(np.exp(away_of[k])) for k in far}
    return off


def _images(
    views: _FaceViews, corners: BodyCorners, body_from_face: Poses, placed_faces: np.ndarray, camera: Camera
) -> tuple[Poses, np.ndarray]:
    """Returns camera_from_body of each image: of what its views say, that which fits most of its corners best."""
    poses, placed = [Rigid(np.eye(3), [0.0, 0.0, 1.0]) for _ in corners.images], np.zeros(len(corners.images), bool)
    xyz_body = body_from_face[corners.face] @ corners.xyz_face()
    for image in np.unique(views.image):
        own = np.flatnonzero((corners.image == image) & placed_faces[corners.face])
        if len(own) < MIN_POINTS:
            continue
        part, of = corners.select(own), np.flatnonzero((views.image == image) & placed_faces[views.face])
        candidates = views.both(of) @ body_from_face[np.repeat(views.face[of], 2)].inverse()
        costs = [_robust(_lengths(pose @ xyz_body[own], part, camera)) for pose in candidates]
        if min(costs, default=np.inf) < np.inf:
            poses[image], placed[image] = candidates[int(np.argmin(costs))], True
    return Poses.of(poses), placed


def _faces_again(views: _FaceViews, corners: BodyCorners, body: Body) -> Poses:
    """Returns body_from_face by the view that fits all corners of a face best, or as before if none does."""
    poses, camera_from_body = list(body.body_from_face), body.camera_from_body
    for face in np.flatnonzero(body.placed_faces)[1:]:
        part = corners.select((corners.face == face) & body.placed_images[corners.image])
        of = np.flatnonzero((views.face == face) & body.placed_images[views.image])
        candidates = [poses[face], *(camera_from_body[np.repeat(views.image[of], 2)].inverse() @ views.both(of))]
        seen = (camera_from_body[part.image] @ (pose @ part.xyz_face()) for pose in candidates)
        costs = np.array([_robust(_lengths(xyz, part, body.camera)) for xyz in seen])
        costs[0] *= 1 - BETTER
        poses[face] = candidates[int(np.argmin(costs))]
    return Poses.of(poses)


def adjust_body(start: Body, corners: BodyCorners, basis: np.ndarray, prior: np.ndarray, given: Camera) -> Body:
    """Returns the body of least robust cost over all poses, and over the camera's parameters of ``basis`` (16, q),
    which have the weight matrix ``prior`` (q, q) about those of ``given``."""
    body = start
    used = corners.select(body.used(corners))
    for _ in range(ROBUST_ROUNDS):
        length = body.lengths(used)
        huber = HUBER * max(robust_sigma(length[np.isfinite(length)], 2), 1e-3) if len(length) else np.inf
        body = _minimum(body, used, basis, prior, given, huber)
    length = np.minimum(body.lengths(used), 1e6)
    return replace(body, cost=float(huber_cost(length, HUBER * max(robust_sigma(length, 2), 1e-3)).sum()))


def _minimum(body: Body, used: BodyCorners, basis: np.ndarray, prior: np.ndarray, given: Camera, huber: float) -> Body:
    a, q = Adjustment(), basis.shape[1]
    held = ~body.placed_faces
    held[body.placed_faces.argmax()] = True
    faces = a.block("faces", body.body_from_face, fixed=np.flatnonzero(held))
    images = a.block("images", body.camera_from_body, eliminate=True, fixed=np.flatnonzero(~body.placed_images))
    on: list[tuple[Block, np.ndarray | None]] = [(faces, used.face), (images, used.image)]
    if q:
        lens = a.block("lens", Vector(np.zeros((1, q))))
        a.prior(lens, (np.linalg.pinv(basis) @ (given.parameters() - body.camera.parameters()))[None], prior)
        on.append((lens, None))

    def at(faces: Poses, images: Poses, *lens: Vector) -> Body:
        parameters = body.camera.parameters() + sum(basis @ own.array[0] for own in lens)
        parameters[:2] = np.maximum(parameters[:2], LEAST_FOCAL * body.camera.focal)
        camera = body.camera.with_parameters(parameters)
        return replace(body, body_from_face=faces, camera_from_body=images, camera=camera)

    def residuals(*own) -> np.ndarray:
        state = at(*own)
        return state.camera.project(state.xyz_camera(used)) - used.xy_px

    def slopes(*own) -> list[np.ndarray]:
        state, (faces, images, *lens) = at(*own), own
        xyz, turn = state.xyz_camera(used), images.rotation[used.image]
        in_face = np.einsum("nij,nj->ni", faces.rotation[used.face], used.xyz_face())
        by_point = state.camera.projection_jacobian(xyz)
        by_image = by_pose(by_point, xyz - images.translation[used.image])
        by_lens = [state.camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis for _ in lens]
        return [by_pose(by_point @ turn, in_face), by_image, *by_lens]

    a.factor(residuals, on, derivatives=slopes, root=used.root, loss=Huber(huber))
    start = {block.name: block.start for block in a.blocks}
    if not np.isfinite(a.cost(start)):
        return body
    return at(*a.minimum(start, settled=1e-7, max_steps=MAX_STEPS).state.values())


def settled_body(body: Body, corners: BodyCorners, basis: np.ndarray, prior: np.ndarray, given: Camera) -> Body:
    """Returns the adjusted body, with faces and images placed again where another of their poses fits better."""
    body = adjust_body(body, corners, basis, prior, given)
    for _ in range(PASSES - 1):
        views = _FaceViews(corners, body.camera)
        faces = _faces_again(views, corners, body)
        poses, placed = _images(views, corners, faces, body.placed_faces, body.camera)
        start = replace(body, body_from_face=faces, camera_from_body=poses, placed_images=placed)
        again = adjust_body(start, corners, basis, prior, given)
        if again.placed_images.sum() <= body.placed_images.sum() and again.cost >= (1 - 1e-3) * body.cost:
            break
        body = again
    return body


def contradictions(body: Body, corners: BodyCorners) -> list[Outlier]:
    """Returns the corners that lie elsewhere than the rigid body has them, with a limit by their number and their tail.
    Lengths are compared with those of the same corner in other images too: a print that is off is no gross error."""
    printed = np.array([face.sigma_mm is not None for face in corners.faces])
    used = corners.select(body.used(corners) & printed[corners.face])
    length = np.minimum(body.lengths(used), 1e6)
    if not len(length):
        return []
    usual = np.full(len(length), max(robust_sigma(length, 2), 1e-3))
    _, corner = np.unique(np.column_stack([used.face, used.corner]), axis=0, return_inverse=True)
    for own in (corner == k for k in range(corner.max() + 1)):
        usual[own] = np.maximum(usual[own], robust_sigma(length[own], 2))
    limit = tailed_limit(length / usual, BY_CHANCE / len(length), SHARING) * usual
    outliers = []
    for k in np.flatnonzero(length > limit):
        image, label = used.images[used.image[k]], used.faces[used.face[k]].labels()[used.corner[k]]
        size_px = np.array([length[k], limit[k]]) / np.linalg.norm(used.root[k], 2)
        outliers.append(Outlier(image, label, *size_px.tolist()))
    return outliers


def _robust(length: np.ndarray) -> float:
    """Returns the cost of residuals of these lengths, in σ, that hardly grows with gross ones."""
    return float((np.minimum(length, 1e3) ** 0.5).sum())


class PlacedBody:
    """A body with the faces and images that are placed."""

    def __init__(self, body: Body, corners: BodyCorners, camera: Camera):
        self.camera = camera  # with the covariance of the assumptions about an unknown one
        placed, images = (np.flatnonzero(mask).tolist() for mask in (body.placed_faces, body.placed_images))
        self.faces = tuple(corners.faces[f] for f in placed)
        self.body_from_face = {corners.faces[f].id: body.body_from_face[f] for f in placed}
        self.camera_from_body = {corners.images[i]: body.camera_from_body[i] for i in images}
        # faces that are seen, and never with a placed one
        self.unlinked = [corners.faces[f].id for f in np.unique(corners.face) if not body.placed_faces[f]]
        self.contradictions = contradictions(body, corners)  # corners that lie elsewhere than the body has them

    def unlinked_notes(self) -> list[str]:
        """Returns a note for each face of known shape that no image shows together with one that is placed."""
        why = f"left out, no image shows it with a face that is linked to the others, by {MIN_CORNERS} corners each"
        return [f"face {face}: {why}; add one that does" for face in self.unlinked]


def plain_lens(camera: Camera) -> Camera:
    """Returns a camera of this focal length with a tenth of the σ of :func:`unknown_lens` about no distortion and a
    principal point in the middle: for images that do not tell these."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    return unknown_lens(replace(camera, centre=middle, distortion=np.zeros_like(camera.distortion)), 0.1)


def unknown_lens(camera: Camera, share: float = 1.0) -> Camera:
    """Returns a camera with the weak prior of an unknown lens; ``share`` : factor on σ of all but the focal length."""
    side, focal = max(camera.width, camera.height), float(camera.focal.mean())
    reach = float(np.hypot(camera.width, camera.height) / 2 / focal)
    radial, tangential = SIGMA_RADIAL / reach ** np.array([2.0, 4.0]), SIGMA_TANGENTIAL / reach
    sigma = share * np.array([0.0, 0.0, *[SIGMA_CENTRE * side] * 2, *radial, *[tangential] * 2])
    covariance = np.diag(sigma**2)
    covariance[:2, :2] = focal**2 * (SIGMA_FOCAL**2 * np.ones((2, 2)) + SIGMA_SQUARE**2 / 2 * np.eye(2))
    return Camera.of(camera, LENS, covariance)


def place_with_camera(
    observations: Sequence[ImageObservations], faces: Sequence[FaceDesign], camera: Camera
) -> PlacedBody:
    """Returns the body by its faces, with a known camera; for faces of circles the design is a start."""
    corners = BodyCorners(observations, faces)
    _require_sizes(corners, camera)
    body = settled_body(place_body(corners, camera), corners, np.zeros((16, 0)), np.zeros((0, 0)), camera)
    return PlacedBody(body, corners, camera)


def place_and_find_camera(
    observations: Sequence[ImageObservations], faces: Sequence[FaceDesign], starts: Sequence[Camera]
) -> PlacedBody:
    """Body by faces of known shape and the camera, of least cost from ``starts`` and several focal lengths."""
    corners = BodyCorners(observations, faces)
    side, first = max(starts[0].width, starts[0].height), starts[0]
    cameras = [*starts, *(replace(first, focal=np.full(2, step * side)) for step in FOCAL_STEPS)]
    _require_sizes(corners, first)
    bodies = [body for camera in cameras if (body := _with_focal_length(corners, camera)) is not None]
    best = max(bodies, key=lambda body: (int(body.placed_images.sum()), -body.cost), default=None)
    if best is None:
        fault = f"camera: no focal length of {cameras[-1].focal[0]:.0f} px and less explains the views of the faces"
        remedy = "check the sizes in target.toml, or give a camera file with --camera"
        raise MappingError("E-BODY-NO-CAMERA", f"{fault}; {remedy}")
    lens = unknown_lens(best.camera)
    assert lens.covariance is not None
    basis, prior = intrinsic_basis(LENS), np.linalg.inv(lens.covariance)
    with suppress(ConvergenceError):  # a lens that folds the image: the adjustment of all begins without distortion
        best = settled_body(best, corners, basis, prior, lens)
    return PlacedBody(best, corners, unknown_lens(best.camera))


def _require_sizes(corners: BodyCorners, camera: Camera) -> None:
    """Refuses faces of which some are drawn at another size than the others. A rough camera is enough."""
    wrong, alike = wrong_sizes(corners, camera)
    if not wrong:
        return
    names, factors = [corners.faces[face].id for face in wrong], list(wrong.values())
    if alike < len(names):
        told = f"sizes of faces {' and '.join(names)} contradict one another: by the photographs, face {names[-1]} is "
        told += f"{factors[-1] / factors[0]:.3g} times as large against face {names[0]} as target.toml states"
        remedy = "measure the side of each print, and correct it"
    else:
        each = ", ".join(f"face {name} {v:.3g}" for name, v in zip(names, factors, strict=True))
        told = f"the photographs show {each} times as large as target.toml states, and the sizes of {alike} other "
        told += "faces agree with one another"
        remedy = "measure the side of its print, and correct it"
    raise MappingError("E-BODY-SIZES", f"target: {told}; {remedy}")


def _with_focal_length(corners: BodyCorners, camera: Camera) -> Body | None:
    """Returns the body with an adjusted focal length, None if there is none from this start."""
    basis = intrinsic_basis("SIMPLE_PINHOLE")[:, :1]
    try:
        for _ in range(2):  # the reflections are chosen again with the better camera
            prior = np.array([[(2 * camera.focal[0]) ** -2]])
            body = adjust_body(place_body(corners, camera), corners, basis, prior, camera)
            camera = body.camera
        return body
    except (ConvergenceError, DegenerateError, np.linalg.LinAlgError):
        return None


def model_of_body(body: PlacedBody, group: Sequence[ImageObservations], camera: Camera) -> WorldModel:
    """Returns the model of a group: placed images, points that two of them see, and what these determine further."""
    placed = [image for image in group if image.name in body.camera_from_body]
    if len(placed) < 2:
        shown = f"{len(placed)} of {len(group)} images show faces of known shape well enough, 2 needed"
        remedy = "add images that each show two faces"
        raise MappingError("E-BODY-FEW-IMAGES", f"group {group[0].group}: {shown}; {remedy}")
    designed: dict[Label, np.ndarray] = {
        label: xyz
        for face in body.faces
        for label, xyz in zip(face.labels(), body.body_from_face[face.id] @ face.places_mm(face.ids), strict=True)
    }
    rays = rays_of(placed, body.camera_from_body, designed)
    xyz = {label: designed[label] for label, (_, ray) in rays.items() if widest_angle_rad(ray) > MIN_RAY_ANGLE_RAD}
    poses = [body.camera_from_body[image.name] for image in placed]
    model = assemble(WorldModel, group[0].group, placed, poses, xyz)
    return incremental.complete(model, list(group), camera, incremental.MAX_REPROJECTION_PX)


def map_body(body: PlacedBody, group: Sequence[ImageObservations], camera: Camera) -> Mapping:
    """Maps one group by a body that its faces have placed, without the corners that contradict it."""
    model = model_of_body(body, group, camera)
    gross = {(o.image, o.label): o for o in body.contradictions if o.image in model.images}
    is_gross = np.array([seen in gross for seen in model.seen()], bool)
    missing = incremental.left_out(group, model, SHOW_MORE)
    return Mapping(model.without(is_gross), tuple(gross.values()), missing, BY_FACES, SHOW_MORE)
