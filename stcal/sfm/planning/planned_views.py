"""Candidates for further photographs: what they would show, and where the photographer has to stand."""

from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import ArrayLike

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel, DotLabel, Label
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.data.model import MetricModel
from stcal.sfm.planning.forecast import CentreNoise, Setup
from stcal.synthetic.placement import look_along
from stcal.synthetic.scene import MAX_FOUND_TILT_RAD, Group, Scene, image_circles

REACH_DEG = 50.0
"""Largest distance of candidates from the middle of a group's views, in azimuth and in elevation."""
GRID_DEG = 10.0
"""Step of the grid of candidates, in azimuth and in elevation."""
ROLLS_DEG = (0.0, 90.0)
"""Rolls of the camera. A turn by 90° separates intrinsics from poses, and is tried only if intrinsics are refined."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedView:
    """A photograph to take in a group, at angles about its middle that count from the ``middle`` photograph."""

    group: str
    model: MetricModel  # of this one image
    azimuth_deg: float
    elevation_deg: float
    roll_deg: float  # about the camera's axis
    distance_mm: float
    tilts_deg: dict[str, float]  # between normal and line of sight, by face and ``board``
    middle: str
    nearest: str  # photograph, at the angle ``nearest_deg``
    nearest_deg: float

    @property
    def camera_from_target(self) -> Rigid:
        return self.model.camera_from_model[0]

    @property
    def labels(self) -> list[Label]:
        return [self.model.labels[i] for i in self.model.point_index]


@dataclass(frozen=True, slots=True, eq=False)
class _Stand:
    centre: np.ndarray  # (3,) middle of board and faces
    axes: np.ndarray  # (3, 3) rows right, up, towards the cameras
    distance_mm: float  # median, of the cameras from the centre
    directions: np.ndarray  # (m, 3) unit vectors from the centre to the cameras
    middle: str  # image in the middle of the views

    @classmethod
    def of(cls, model: MetricModel) -> "_Stand":
        centre = (model.xyz_model.min(0) + model.xyz_model.max(0)) / 2
        from_centre = np.array([pose.inverse().translation for pose in model.camera_from_model]) - centre
        distance = np.linalg.norm(from_centre, axis=1)
        directions = from_centre / distance[:, None]
        towards = directions.mean(0) / np.linalg.norm(directions.mean(0))
        middle = int(np.argmax(directions @ towards))
        axes = axes_of(model.camera_from_model[middle], towards)
        return cls(centre, axes, float(np.median(distance)), directions, model.images[middle])

    def pose(self, azimuth_deg: float, elevation_deg: float, roll_deg: float) -> Rigid:
        azimuth, elevation, roll = np.radians([azimuth_deg, elevation_deg, roll_deg])
        local = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        return looking_at(self.centre, np.array(local) @ self.axes, self.axes[1], self.distance_mm, roll)


def axes_of(camera_from_target: Rigid, towards: np.ndarray) -> np.ndarray:
    """Returns the axes (3, 3) rows right, up, towards the camera, as a photograph shows right and up."""
    towards = towards / np.linalg.norm(towards)
    right = np.cross(-camera_from_target.rotation[1], towards)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(towards, right), towards])


def looking_at(centre: np.ndarray, direction: np.ndarray, up: np.ndarray, distance_mm: float, roll: float) -> Rigid:
    """Returns camera_from_target of a camera that looks at the centre from a direction (3,), rolled by rad."""
    rotation = look_along(-direction[None], up, np.array([-roll]))[0]
    return Rigid(rotation, -rotation @ (centre + distance_mm * direction))


def known_scene(models: tuple[MetricModel, ...], joint: JointResult, setup: Setup, colmap_model: str) -> Scene:
    """Returns the scene of a run, target frame: its calibrated faces and circles and its boards, without views."""
    circles = dict(zip(joint.labels, joint.xyz_model, strict=True))
    groups, dots = {}, np.column_stack([setup.board.xy_mm(), np.zeros(setup.board.rows * setup.board.columns)])
    for model in models:
        seen = tuple(sorted({label.face for label in model.labels if isinstance(label, CircleLabel)}))
        pose = joint.model_from_board[model.group]
        groups[model.group] = Group(model.group, seen, _Stand.of(model).axes, pose, pose @ dots, ())
    faces = []
    for face in setup.target.faces:
        if face.id in setup.start.target_from_face:
            keep = [i for i, label in enumerate(face.labels()) if label in circles]
            ids = tuple(face.ids[i] for i in keep)
            faces.append(replace(face, ids=ids, xy_mm=face.xy_mm[keep], radius_mm=face.radius_mm[keep]))
    return Scene(
        target=replace(setup.target, faces=tuple(faces)),
        board=setup.board,
        camera=Camera.of(setup.camera, colmap_model),
        target_from_face=setup.start.target_from_face,
        circles_target=circles,
        groups=groups,
        seed=0,
    )


def candidates(scene: Scene, model: MetricModel, setup: Setup, noise: CentreNoise) -> list[PlannedView]:
    """Returns the views, on a grid about the present ones, that show the whole board and at least one whole face."""
    stand = _Stand.of(model)
    steps = np.arange(-REACH_DEG, REACH_DEG + 1e-9, GRID_DEG)
    places = [
        (float(azimuth), float(elevation), roll)
        for roll in ROLLS_DEG[: 1 if setup.prior is None else None]
        for elevation in steps
        for azimuth in steps
    ]
    poses = [stand.pose(*place) for place in places]
    group = replace(scene.groups[model.group], camera_from_target=tuple(poses))
    scene = replace(scene, groups={model.group: group})
    limit = _largest_tilt(scene, model)
    members = {key: {model.labels[i] for i in rows} for key, rows in model.points_by_face().items()}
    views = []
    for i, place in enumerate(places):
        labels = set(model.labels) & shown(scene, model.group, i, limit)
        if not (members["board"] <= labels and any(own <= labels for key, own in members.items() if key != "board")):
            continue
        position = poses[i].inverse().translation
        cosine = stand.directions @ (position - stand.centre) / stand.distance_mm
        views.append(
            PlannedView(
                model.group,
                single(model, f"{model.group}/view {place}", poses[i], sorted(labels), setup, noise),
                *place,
                stand.distance_mm,
                _tilts_deg(scene, model.group, position, labels),
                stand.middle,
                model.images[int(np.argmax(cosine))],
                angle_deg(cosine.max()),
            )
        )
    return views


def _largest_tilt(scene: Scene, model: MetricModel) -> float:
    """Returns the largest tilt of the circles that the run measured in the group, rad, up to ``MAX_FOUND_TILT_RAD``."""
    normal = {face.id: scene.target_from_face[face.id].rotation[:, 2] for face in scene.target.faces}
    board = -scene.groups[model.group].target_from_board.rotation[:, 2]
    normals = np.array([board if isinstance(x, DotLabel) else normal.get(x.face, board) for x in model.labels])
    centres = np.array([pose.inverse().translation for pose in model.camera_from_model])[model.image_index]
    ray = centres - model.xyz_model[model.point_index]
    cosine = (ray * normals[model.point_index]).sum(1) / np.linalg.norm(ray, axis=1)
    return min(float(np.arccos(np.clip(cosine.min(), -1, 1))), MAX_FOUND_TILT_RAD)


def shown(scene: Scene, group: str, image: int, max_tilt_rad: float) -> set[str]:
    """Returns the labels of the group's circles that a view shows whole, not too oblique and not hidden by a plate."""
    circles = image_circles(scene, group, image)
    camera_from_target = scene.groups[group].camera_from_target[image]
    plates = [scene.face_outline(face.id) for face in scene.target.faces] + [scene.board_outline(group)]
    hidden = _behind(circles.xyz_camera, camera_from_target @ np.stack(plates)).any(0)
    visible = circles.must_find & (circles.tilt_rad <= max_tilt_rad) & ~hidden
    return {label for label, is_visible in zip(circles.labels, visible, strict=True) if is_visible}


def _behind(xyz_camera: np.ndarray, corners_camera: np.ndarray) -> np.ndarray:
    """Returns whether rectangles (m, 4, 3) are between the camera and points (n, 3); (m, n)."""
    origin, a, b = corners_camera[:, 0], corners_camera[:, 1], corners_camera[:, 3]
    a, b = a - origin, b - origin
    normal = np.cross(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):  # lines of sight parallel to the plane never meet it
        depth_ratio = (origin * normal).sum(1)[:, None] / (normal @ xyz_camera.T)
        from_corner = depth_ratio[..., None] * xyz_camera - origin[:, None]
        u, v = ((from_corner @ side[..., None])[..., 0] / (side * side).sum(1)[:, None] for side in (a, b))
        return (depth_ratio > 0) & (depth_ratio < 1 - 1e-3) & (u > 0) & (u < 1) & (v > 0) & (v < 1)


def _tilts_deg(scene: Scene, group: str, position: np.ndarray, seen: set[Label]) -> dict[str, float]:
    normal, middle = scene.groups[group].target_from_board.rotation[:, 2], scene.board_outline(group).mean(0)
    tilts = {"board": tilt_deg(-normal, middle, position)}
    for face in sorted({label.face for label in seen if isinstance(label, CircleLabel)}):
        outward, middle = scene.target_from_face[face].rotation[:, 2], scene.face_outline(face).mean(0)
        tilts[face] = tilt_deg(outward, middle, position)
    return tilts


def tilt_deg(normal: np.ndarray, middle: np.ndarray, position: np.ndarray) -> float:
    ray = position - middle
    return angle_deg(normal @ ray / np.linalg.norm(ray))


def angle_deg(cosine: ArrayLike) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def single(
    model: MetricModel, name: str, pose: Rigid, labels: list[Label], setup: Setup, noise: CentreNoise
) -> MetricModel:
    """Returns the model of one image of the group that shows these points, with the σ that they will have."""
    points, n = np.array([model.labels.index(label) for label in labels]), len(labels)
    image = replace(
        model,
        images=(name,),
        camera_from_model=(pose,),
        image_index=np.zeros(n, int),
        point_index=points,
        keypoint=np.arange(n),
        measured_px=setup.camera.project(pose @ model.xyz_model[points]),
        shift_px=np.zeros((n, 2)),
        covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
    )
    return noise.applied(image, setup.camera, setup.radius_mm())


LEAST_COSINE = -0.2
"""Smallest cosine of the angle between two faces that one view is to show."""
MAX_TILT_DEG = 60.0
"""Largest tilt of a face whose corners count as seen."""
SHARES = (0.35, 0.5, 0.65)
"""Where candidates stand between the normals of two faces."""


def body_views(model: MetricModel, setup: Setup, noise: CentreNoise) -> list[PlannedView]:
    """Returns candidates, each with two faces that one view can show, as a motion from the nearest photograph."""
    target_from_face = setup.start.target_from_face
    faces = [face for face in setup.target.faces if face.id in target_from_face]
    normals = {face.id: face.outward * target_from_face[face.id].rotation[:, 2] for face in faces}
    middles = {face.id: target_from_face[face.id] @ np.append(face.xy_mm.mean(0), 0.0) for face in faces}
    centre = (model.xyz_model.min(0) + model.xyz_model.max(0)) / 2
    towards = np.array([pose.inverse().translation for pose in model.camera_from_model]) - centre
    away = np.linalg.norm(towards, axis=1)
    distance = float(np.median(away))
    views = []
    for (one, two), share, roll in product(combinations(normals, 2), SHARES, ROLLS_DEG):
        if normals[one] @ normals[two] < LEAST_COSINE:
            continue
        direction = share * normals[one] + (1 - share) * normals[two]
        direction /= np.linalg.norm(direction)
        cosine = towards @ direction / away
        near = int(cosine.argmax())
        axes = axes_of(model.camera_from_model[near], towards[near])
        right, up, ahead = (axes @ direction).tolist()
        pose = looking_at(centre, direction, axes[1], distance, np.radians(roll))
        tilts = {face: tilt_deg(normals[face], middles[face], centre + distance * direction) for face in normals}
        shown = {face: tilt for face, tilt in sorted(tilts.items()) if tilt < MAX_TILT_DEG}
        labels: list[Label] = [e for e in model.labels if isinstance(e, CircleLabel) and e.face in shown]
        name = f"{model.group}/view {one} {two} {share} {roll}"
        views.append(
            PlannedView(
                model.group,
                single(model, name, pose, labels, setup, noise),
                float(np.degrees(np.arctan2(right, ahead)).round()),
                float(np.degrees(np.arcsin(np.clip(up, -1, 1))).round()),
                roll,
                distance,
                shown,
                model.images[near],
                model.images[near],
                angle_deg(cosine[near]),
            )
        )
    return views
