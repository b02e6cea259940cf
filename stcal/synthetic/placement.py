"""Placement of board and camera for simulated photographs: rejection sampling until everything is in view."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid

MAX_FACE_TILT_RAD = np.radians(67)
MAX_BOARD_TILT_RAD = np.radians(50)
CANDIDATES = 600
CANDIDATES_PER_VIEW = 8
AT_ONCE = 600  # number of views tested at a time, which bounds the memory
PLACES = 60
GOOD_SHARE = 0.5
"""A place of the board is accepted at once if this share of the views of both faces also shows the board."""
IMAGE_MARGIN = 0.03  # free border of the image, in image widths
BODY_GAP = 0.01  # free space between target and board in the image, in focal lengths


@dataclass(frozen=True, slots=True, eq=False)
class GroupShape:
    """Geometry that the images of one group must show; target frame unless named otherwise, mm."""

    name: str
    circles: np.ndarray  # (n, 3) of the two faces
    normals: np.ndarray  # (n, 3)
    axes: np.ndarray  # (3, 3), see :func:`viewing_axes`
    body: np.ndarray  # (k, 3) corners of the target's faces
    dots_board: np.ndarray  # (m, 3)
    outline_board: np.ndarray  # (4, 3) corners


def to_camera(views: Poses, xyz_target: np.ndarray) -> np.ndarray:
    """Returns points (k, 3) in the frame of every camera, (n, k, 3), of views camera_from_target."""
    return xyz_target @ np.swapaxes(views.rotation, 1, 2) + views.translation[:, None]


def tilt_rad(views: Poses, xyz_target: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the angles between normals and lines of sight, (n, k)."""
    ray = views.inverse().translation[:, None] - xyz_target
    return np.arccos(np.clip((ray * normals).sum(-1) / np.linalg.norm(ray, axis=-1), -1, 1))


def viewing_axes(normal_a: np.ndarray, normal_b: np.ndarray, where: str) -> np.ndarray:
    """Returns the axes (3, 3) of the view that shows two faces equally well: rows right, up, towards the camera."""
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(normal_a, normal_b)), normal_a @ normal_b))
    if not 5 <= angle <= 130:
        fault = f"{where}: {angle:.0f}° between the faces, 5° to 130° needed"
        raise DegenerateError("E-SCENE-FACES", f"{fault}; pair others")
    up, towards = np.cross(normal_a, normal_b), normal_a + normal_b
    up, towards = up / np.linalg.norm(up), towards / np.linalg.norm(towards)
    return np.array([np.cross(up, towards), up, towards])


def place_group(
    shape: GroupShape, camera: Camera, count: int, distance_mm: float, spread_rad: float, rng: np.random.Generator
) -> tuple[Rigid, list[Rigid]]:
    """Returns target_from_board and ``count`` camera_from_target. In every view both faces are tilted by up to 67°
    and the board by up to 50°, all of target and board is inside the image, and neither covers the other. Among the
    views that satisfy this, those farthest apart are chosen."""
    places, shown = [], 0
    for _ in range(PLACES):
        target_from_board = _board_place(shape, rng)
        tried = max(CANDIDATES, CANDIDATES_PER_VIEW * count)
        views = _candidate_views(shape, target_from_board, camera, tried, distance_mm, spread_rad, rng)
        faces_seen = np.flatnonzero((tilt_rad(views, shape.circles, shape.normals) <= MAX_FACE_TILT_RAD).all(1))
        valid = faces_seen[_board_seen(shape, target_from_board, views[faces_seen], camera)]
        shown = max(shown, len(faces_seen))
        places.append((target_from_board, views, valid))
        if len(valid) >= max(count, GOOD_SHARE * len(faces_seen)):
            break
    target_from_board, views, valid = max(places, key=lambda place: len(place[2]))
    if len(valid) < count:
        width, height = np.ptp(shape.outline_board[:, :2], axis=0)
        fault = f"{len(valid)} of {tried} views show faces and board ({shown} show the faces), {count} needed"
        remedy = f"take a smaller board than {width:.0f} × {height:.0f} mm, a larger distance_mm (--distance)"
        raise DegenerateError("E-SCENE-VIEWS", f"{shape.name}: {fault}; {remedy} or a shorter focal length")
    picked = rng.permutation(_farthest(views[valid].inverse().translation - shape.circles.mean(0), count))
    return target_from_board, list(views[valid[picked]])


def _board_place(shape: GroupShape, rng) -> Rigid:
    right, up, towards = shape.axes
    middle = shape.circles.mean(0)
    outline = shape.outline_board - shape.outline_board.mean(0)
    half_width, side = np.abs(outline[:, 0]).max(), rng.choice([-1.0, 1.0])
    body_reach = ((shape.body - middle) @ right * side).max()
    shift = [side * (body_reach + half_width + rng.uniform(10, 120)), rng.uniform(-50, 50), rng.uniform(-80, 60)]
    facing = Rotation.from_matrix(np.column_stack([right, -up, -towards]))
    turn = Rotation.from_euler("zxy", rng.uniform([-12, -12, -12], [12, 12, 12]), degrees=True)
    rotation = (facing * turn).as_matrix()
    return Rigid(rotation, middle + shift @ shape.axes - rotation @ shape.outline_board.mean(0))


def _candidate_views(shape, target_from_board, camera, n: int, distance_mm, spread_rad, rng) -> Poses:
    azimuth, elevation = rng.uniform(-spread_rad, spread_rad, (2, n))
    local = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    direction = np.column_stack(local) @ shape.axes
    roll = np.radians(rng.uniform(-15, 15, n)) + np.pi / 2 * rng.choice([-1, 0, 1], n, p=[0.08, 0.84, 0.08])
    points = np.vstack([shape.body, target_from_board @ shape.outline_board])
    aim = (points.min(0) + points.max(0)) / 2
    centres = aim + direction * (distance_mm * rng.uniform(0.9, 1.1, n))[:, None]

    def looking(forward: np.ndarray) -> Poses:
        rotation = look_along(forward, shape.axes[1], roll)
        return Poses(rotation, -(rotation @ centres[..., None])[..., 0])

    views = looking(-direction)
    free = np.array([camera.width, camera.height]) / camera.focal / 2 - IMAGE_MARGIN * camera.width / camera.focal
    place = rng.uniform(-0.7, 0.7, (n, 2))
    for step in range(3):
        xyz = to_camera(views, points)
        xy = xyz[..., :2] / xyz[..., 2:]
        by_point = np.swapaxes(xy, 0, 1).copy()  # reductions along the first axis are far faster
        low, high = by_point.min(0), by_point.max(0)
        offset = place * np.maximum(free - (high - low) / 2, 0) if step == 2 else 0
        towards_middle = np.column_stack([(low + high) / 2 - offset, np.ones(n)])
        forward = np.einsum("nji,nj->ni", views.rotation, towards_middle)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        views = looking(forward)
    return views


def look_along(forward: np.ndarray, up: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Returns camera_from_target, (n, 3, 3), of cameras whose axes point along ``forward`` (n, 3), with the direction
    ``up`` (3,) upwards in the image, then rolled by ``roll`` (n,) rad."""
    x = np.cross(forward, up)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(forward, x)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * x - s * y, s * x + c * y, forward], axis=1)


def _board_seen(shape, target_from_board, views: Poses, camera: Camera) -> np.ndarray:
    """Returns the mask of the views that show the board, (n,). What takes most time is tested last, of what is left."""
    outline = target_from_board @ shape.outline_board
    # The tangent of the tilt grows with the distance from the camera's foot, which is largest at a corner of the dots.
    dots = target_from_board @ shape.dots_board[ConvexHull(shape.dots_board[:, :2]).vertices]
    facing = -target_from_board.rotation[:, 2]
    valid = (tilt_rad(views, dots, facing) <= MAX_BOARD_TILT_RAD).all(1)
    points = np.concatenate([shape.body, outline])
    xyz = to_camera(views[valid], points)
    in_front = (xyz[..., 2] > 0).all(1)
    valid[valid] = in_front
    xy = xyz[in_front, :, :2] / xyz[in_front, :, 2:]
    # Points far outside the image may be folded back into it by the distortion.
    size = np.array([camera.width, camera.height])
    pixel, margin = camera.pixel_from_normalised(xy), IMAGE_MARGIN * camera.width
    inside = (np.abs(xy) < size / camera.focal) & (pixel > margin) & (pixel < size - 1 - margin)
    inside = inside.all((1, 2))
    valid[valid] = inside
    body, plate = np.split(xy[inside], [len(shape.body)], axis=1)
    valid[valid] = _apart(body, plate)
    return valid


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns whether a line with a gap separates the point sets (n, k, 2) and (n, m, 2); directions in steps of 2°."""
    angle = np.radians(np.arange(0, 180, 2))
    direction = np.array([np.cos(angle), np.sin(angle)])
    found = np.zeros(len(a), bool)
    for at in range(0, len(a), AT_ONCE):
        along = [np.swapaxes(points[at : at + AT_ONCE], 0, 1) @ direction for points in (a, b)]
        (low_a, low_b), (high_a, high_b) = ([axis(each, 0) for each in along] for axis in (np.min, np.max))
        found[at : at + AT_ONCE] = (np.maximum(low_b - high_a, low_a - high_b) > BODY_GAP).any(1)
    return found


def _farthest(directions: np.ndarray, count: int) -> np.ndarray:
    """Chooses directions (n, 3) greedily by farthest-point sampling, and returns their indices (count,)."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = unit @ unit.T
    chosen = [int(np.argmin(unit @ unit.mean(0)))]
    nearest = cosine[chosen[0]].copy()
    while len(chosen) < count:
        nearest[chosen] = 2.0
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, cosine[chosen[-1]])
    return np.array(chosen)
