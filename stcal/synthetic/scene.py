"""Scenes of a target and a board before a camera, perspective or wide, and observations without rendered pixels."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from stcal.boards.target_file import three_point_frame
from stcal.design import BoardDesign, FaceDesign, TargetDesign, reference_board, reference_target
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, freeze, frozen, require_arguments, require_fields
from stcal.geometry.camera import FISHEYE, Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.labels import CircleLabel, Label
from stcal.synthetic.designs import REFERENCE_GROUPS, second_design
from stcal.synthetic.placement import GroupShape, place_group, viewing_axes

__all__ = ["Group", "Scene", "SceneOptions", "make_scene", "second_design"]
FACE_MARGIN_MM = 15.0
"""How far a plate is assumed to reach beyond the rims of its circles, mm, if the design states no outline."""
BOARD_MARGIN_MM = 15.0
SENSOR_WIDTH_MM = 22.3
FOCAL_PER_WIDTH = 24 / SENSOR_WIDTH_MM  # focal length in image widths of a 24 mm lens on this sensor
CONVEX_TOLERANCE_MM = 5.0


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """Options of a simulated scene.

    Parameters
    ----------
    seed : int
    width, height : Image size, px.
    focal_px : Focal length; by default that of a 24 mm lens on a 22.3 mm wide sensor.
    distortion : k1, k2, p1, p2, k3, k4, k5, k6.
    centre_sigma : Standard deviation of the principal point about the middle of the image, in image widths.
    distance_mm : Distance from the camera to target and board; varies by ±10 %.
    spread_deg : Angle by which the views spread to every side, as far as both faces stay visible.
    images_per_group : int
    groups : By default the groups of the paper for the reference design, else all pairs that can be seen together.
    circle_sigma_mm : float
        σ of the in-plane placement of the target's circles, per axis. That of the board's dots is in its design.
    face_shift_mm, face_turn_deg : RMS length and angle of the deviations of true face poses from nominal ones.
    margin_mm : How far plates without ``outline_mm`` reach beyond the rims of their circles.
    one_board : Whether all groups show the same board, whose dots err alike; otherwise each has a board of its own.
    fisheye_deg : Field of an equidistant lens over the image's diagonal, 60° to 170°, that is not centred on the
        target. It has a focal length and distortion of its own. By default the lens is perspective.
    body_seed : Draws the errors of target, camera and ``one_board``, so that another ``seed`` photographs the same ones
        again; ``seed`` by default.
    """

    seed: int = 0
    width: int = 5184
    height: int = 3456
    focal_px: float | None = None
    distortion: tuple[float, ...] = (-0.06, 0.045, 1.5e-4, -1e-4)
    centre_sigma: float = 0.002
    distance_mm: float = 1000.0
    spread_deg: float = 40.0
    images_per_group: int = 10
    groups: tuple[tuple[str, str], ...] | None = None
    circle_sigma_mm: float = 0.02
    face_shift_mm: float = 0.5
    face_turn_deg: float = 0.5
    margin_mm: float = FACE_MARGIN_MM
    one_board: bool = False
    fisheye_deg: float | None = None
    body_seed: int | None = None

    def __post_init__(self):
        zero = dict.fromkeys(("seed", "body_seed", "centre_sigma", "circle_sigma_mm", "face_shift_mm"), 0)
        require_fields(self, "scene", **zero, focal_px=1, face_turn_deg=0, margin_mm=0)
        for name in ("width", "height", "images_per_group", "distance_mm", "spread_deg"):
            if getattr(self, name) <= 0:
                raise InputError("E-SIMULATE-OPTIONS", f"scene: {name} {getattr(self, name)}, a positive number needed")
        if self.spread_deg > 80:
            raise InputError("E-OPTION-RANGE", f"scene: spread_deg {self.spread_deg:g}, at most 80 possible")
        if self.fisheye_deg is not None and not 60 <= self.fisheye_deg <= 170:
            raise InputError("E-OPTION-RANGE", f"scene: fisheye_deg {self.fisheye_deg:g}, 60 to 170 possible")
        if len(self.distortion) > 8:
            raise InputError("E-CAMERA-COEFFICIENTS", f"scene: {len(self.distortion)} coefficients, at most 8 possible")


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Group of photographs between which only the camera moves."""

    name: str
    faces: tuple[str, ...]  # that the group shows, two in a scene of :func:`make_scene`
    axes: np.ndarray  # (3, 3) rows right, up, towards the camera of the middle view, target frame
    target_from_board: Rigid
    board_circles_target: np.ndarray  # (n, 3) mm, row-major
    camera_from_target: tuple[Rigid, ...]  # by image

    def __post_init__(self):
        freeze(self, "axes", (3, 3), "axes")
        freeze(self, "board_circles_target", (None, 3), "board circles")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Scene(Brief):
    """Truth of a simulated measurement.

    Parameters
    ----------
    target, board, camera : Designs of what is photographed, and the camera as it really is.
    target_from_face : dict of Rigid
        Three-point frames through the circles as really placed, by face id; that of the first face is the target frame.
    circles_target : dict of (3,) array. Centres of the circles as really placed, by label, target frame, mm.
    groups : Board and views of each group, by name.
    seed, margin_mm : As in the options.
    """

    target: TargetDesign
    board: BoardDesign
    camera: Camera
    target_from_face: dict[str, Rigid]
    circles_target: dict[CircleLabel, np.ndarray]
    groups: dict[str, Group]
    seed: int
    margin_mm: float = FACE_MARGIN_MM

    def __post_init__(self):
        require_fields(self, "scene", seed=0, margin_mm=0)

    def views(self) -> list[tuple[str, int]]:
        """Returns group and number of all photographs."""
        return [(name, i) for name, group in self.groups.items() for i in range(len(group.camera_from_target))]

    def face_circles(self, face_id: str) -> np.ndarray:
        """Returns the circle centres of a face, (n, 3), target frame, in the design's order."""
        return np.array([self.circles_target[label] for label in self.target.face(face_id).labels()])

    def face_outline(self, face_id: str) -> np.ndarray:
        """Returns the corners of the visible side of a face, (k, 3), target frame."""
        return self.target_from_face[face_id] @ _face_corners(self.target.face(face_id), self.margin_mm)

    def patterns(self, group: str) -> "Iterator[PlacedCircles]":
        """Yields the circles of each face, and those of the board of a group."""
        for face in self.target.faces:
            normal = self.target_from_face[face.id].rotation[:, 2]
            yield PlacedCircles(face.labels(), self.face_circles(face.id), normal, face.radius_mm)
        g = self.groups[group]
        normal = -g.target_from_board.rotation[:, 2]
        yield PlacedCircles(self.board.labels(), g.board_circles_target, normal, self.board.radii_mm())

    def board_outline(self, group: str) -> np.ndarray:
        """Returns the corners of the board's plate, (4, 3), target frame."""
        return self.groups[group].target_from_board @ _board_rectangle(self.board)


class PlacedCircles(NamedTuple):
    """Circles of one plane: labels, centres (n, 3) and outward normal (3,) in the target frame, and radii, mm."""

    labels: Sequence[Label]
    xyz_target: np.ndarray
    normal: np.ndarray
    radius_mm: np.ndarray


@require_arguments
def make_scene(
    options: SceneOptions | None = None,
    target: TargetDesign | None = None,
    board: BoardDesign | None = None,
    nominal: dict[str, Rigid] | None = None,
    camera: Camera | CameraModel | None = None,
) -> Scene:
    """Returns target, board and camera as really made, and views of groups; the same arguments give the same scene.

    Parameters
    ----------
    options, target, board : Options, and designs of target and board; the defaults and the reference designs if None.
    nominal : Nominal pose of every face in one common frame, by face id; the rough poses of ``target`` by default.
    camera : The camera, in place of the one that the options describe.

    Raises InputError: a group names an unknown face, a nominal pose is missing, or the camera states no image size or
    is given beside ``fisheye_deg``.
    Raises DegenerateError: the faces do not bound a convex body, or a group cannot be photographed.
    """
    options = options or SceneOptions()
    if camera is not None:
        if options.fisheye_deg is not None:
            raise InputError("E-OPTION-CONFLICT", "scene: camera and fisheye_deg are two cameras; give one of them")
        model = camera_model(camera)
        if not (model.width and model.height):
            raise InputError("E-CAMERA-SIZE", f"camera file {model.source} states no image size; add it to the file")
        distortion = () if FISHEYE in model.colmap_model else tuple(model.distortion[:8])
        like_it = {"focal_px": float(np.sqrt(model.focal.prod())), "distortion": distortion}
        scene = make_scene(replace(options, width=model.width, height=model.height, **like_it), target, board, nominal)
        return replace(scene, camera=model.calibrated(0, 0))
    if options.fisheye_deg is not None:
        perspective = replace(options, focal_px=PLACED_FOCAL * options.width, fisheye_deg=None)
        return _seen_wide(make_scene(perspective, target, board, nominal), options.fisheye_deg, options.seed)
    target, board = target or reference_target(), board or reference_board()
    nominal = nominal or target.rough_poses()
    if missing := [face.id for face in target.faces if face.id not in nominal]:
        raise InputError("E-TARGET-ROUGH-POSE", f"scene: no nominal pose of face {missing[0]}; give one pose per face")
    rng = np.random.default_rng(options.seed)
    made = rng if options.body_seed is None else np.random.default_rng(options.body_seed)
    target_from_face, circles = _made_target(target, nominal, options, made)
    _check_convex(target, target_from_face, options.margin_mm)
    focal = options.focal_px or FOCAL_PER_WIDTH * options.width
    centre = (np.array([options.width, options.height]) - 1) / 2
    centre = centre + options.centre_sigma * options.width * made.standard_normal(2)
    lens = np.pad(options.distortion, (0, 8 - len(options.distortion)))
    kind = "FULL_OPENCV" if lens[4:].any() else "OPENCV" if lens.any() else "PINHOLE"
    camera = Camera(options.width, options.height, [focal, focal], centre, lens, colmap_model=kind)
    common = board.sigma_mm * made.standard_normal((len(board.labels()), 3)) if options.one_board else None
    groups = {}
    for pair in options.groups or _default_groups(target, target_from_face):
        group = made_group(pair, target, board, camera, target_from_face, circles, options, common, rng)
        if group.name in groups:
            raise InputError("E-SCENE-GROUP", f"scene: group {group.name} occurs twice; give different pairs")
        groups[group.name] = group
    return Scene(target, board, camera, target_from_face, circles, groups, options.seed, options.margin_mm)


def group_name(pair: tuple[str, str]) -> str:
    """Returns the folder name of a group: ``12``, or ``top-left`` if ids are longer than one character."""
    return ("" if all(len(face) == 1 for face in pair) else "-").join(pair)


def _made_target(target, nominal, options, rng) -> tuple[dict[str, Rigid], dict[CircleLabel, np.ndarray]]:
    placed, frames = {}, {}
    for face in target.faces:
        turn, shift = rng.standard_normal((2, 3)) / np.sqrt(3)
        moved = Rigid.exp([*(np.radians(options.face_turn_deg) * turn), *(options.face_shift_mm * shift)])
        # The face turns about its own origin, so that only the shift moves the origin.
        rough = nominal[face.id]
        pose = Rigid(moved.rotation @ rough.rotation, rough.translation + options.face_shift_mm * shift)
        xy = face.xy_mm + options.circle_sigma_mm * rng.standard_normal(face.xy_mm.shape)
        xyz = pose @ np.column_stack([xy, np.zeros(len(xy))])
        placed[face.id] = xyz
        frames[face.id] = three_point_frame(*(xyz[face.ids.index(circle)] for circle in (face.origin, face.x, face.y)))
    target_from_any = frames[target.faces[0].id].inverse()
    circles = {
        label: frozen(xyz, (3,), label)
        for face in target.faces
        for label, xyz in zip(face.labels(), target_from_any @ placed[face.id], strict=True)
    }
    return {face: target_from_any @ frame for face, frame in frames.items()}, circles


def _default_groups(target: TargetDesign, target_from_face: dict[str, Rigid]) -> list[tuple[str, str]]:
    pairs = combinations([face.id for face in target.faces], 2)
    normal = {face: pose.rotation[:, 2] for face, pose in target_from_face.items()}
    visible_pairs = [
        (a, b) for a, b in pairs if np.cos(np.radians(120)) <= normal[a] @ normal[b] <= np.cos(np.radians(20))
    ]
    is_reference = set(target_from_face) == {face for pair in REFERENCE_GROUPS for face in pair}
    if is_reference and set(REFERENCE_GROUPS) <= set(visible_pairs):
        return list(REFERENCE_GROUPS)
    if not visible_pairs:
        fault = f"scene: no two faces of target {target.name} are 20° to 120° apart, so that one photograph shows both"
        raise DegenerateError("E-SCENE-FACES", f"{fault}; check the rough poses, or add a face")
    return visible_pairs


def made_group(pair, target, board, camera, target_from_face, circles, options, errors, rng) -> Group:
    """Returns a group; ``errors`` : of the places of the board's dots, mm, drawn here if None."""
    name, labels = group_name(pair), [target.face(face).labels() for face in pair]
    normals = [target_from_face[face].rotation[:, 2] for face in pair]
    axes = viewing_axes(normals[0], normals[1], f"group {name}")
    dots = np.pad(board.xy_mm(), ((0, 0), (0, 1)))
    centres = np.array([circles[label] for row in labels for label in row])
    plates = [target_from_face[face.id] @ _face_corners(face, options.margin_mm) for face in target.faces]
    faces = centres, np.repeat(normals, [len(row) for row in labels], axis=0), axes, np.vstack(plates)
    shape = GroupShape(f"group {name}", *faces, dots, _board_rectangle(board))
    target_from_board, views = place_group(
        shape, camera, options.images_per_group, options.distance_mm, np.radians(options.spread_deg), rng
    )
    errors = board.sigma_mm * rng.standard_normal(dots.shape) if errors is None else errors
    dots_target = target_from_board @ (dots + errors)
    return Group(name, tuple(pair), axes, target_from_board, dots_target, tuple(views))


def _rectangle(xy: np.ndarray, radius: np.ndarray, margin: float) -> np.ndarray:
    """Returns the corners (4, 3) of the smallest rectangle (to 3°) about circles, in their plane z = 0."""
    rectangles = []
    for angle in np.radians(np.arange(0, 90, 3)):
        turned_from_plane = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        turned = xy @ turned_from_plane.T
        (x0, y0), (x1, y1) = (turned - radius[:, None]).min(0) - margin, (turned + radius[:, None]).max(0) + margin
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        rectangles.append(((x1 - x0) * (y1 - y0), corners @ turned_from_plane))
    return frozen(np.column_stack([min(rectangles, key=lambda each: each[0])[1], np.zeros(4)]), (4, 3), "corners")


@lru_cache(maxsize=32)
def _face_corners(face: FaceDesign, margin_mm: float) -> np.ndarray:
    if face.outline_mm is not None:
        return frozen(np.pad(face.outline_mm, ((0, 0), (0, 1))), (None, 3), "outline")
    return _rectangle(face.xy_mm, face.radius_mm, margin_mm)


@lru_cache(maxsize=4)
def _board_rectangle(board: BoardDesign) -> np.ndarray:
    return _rectangle(board.xy_mm(), board.radii_mm(), BOARD_MARGIN_MM)


def _check_convex(target: TargetDesign, target_from_face: dict[str, Rigid], margin_mm: float) -> None:
    for front in target.faces:
        for face in target.faces:
            face_from_target = target_from_face[front.id].inverse()
            height = (face_from_target @ (target_from_face[face.id] @ _face_corners(face, margin_mm)))[:, 2].max()
            if height > CONVEX_TOLERANCE_MM:
                assumed = f"its plate is assumed to reach {margin_mm:g} mm beyond its circles"
                plate = f"{assumed}; state its outline_mm in the target file, or a smaller --margin-mm, or"
                plate = plate if face.outline_mm is None else "simulated targets must be convex;"
                fault = f"scene: face {face.id} reaches {height:.0f} mm in front of face {front.id} and may hide it"
                raise DegenerateError("E-SCENE-FACES", f"{fault}: {plate} check the rough poses")


PLACED_FOCAL = 0.39
"""Focal length, in image widths, of the perspective lens by which views are placed: 104° across."""
DISTORTION = (0.02, -0.008, 0.0, 0.0, 0.001, -0.0003, 0.0, 0.0)
PAST = (0.42, 0.24)
"""Largest turn of the axis away from the target, to either side and up or down, as a share of half the field."""


def _seen_wide(scene: Scene, field_deg: float, seed: int) -> Scene:
    """Returns the scene with cameras of COLMAP's OPENCV_FISHEYE at the same places, turned at random. ``field_deg``
    : field of view over the image's diagonal, without distortion."""
    original, rng = scene.camera, np.random.default_rng([seed, 9])
    half = np.radians(field_deg) / 2
    focal = np.hypot(original.width, original.height) / 2 / half
    camera = Camera(original.width, original.height, [focal, focal], original.centre, DISTORTION, True)
    groups = {}
    for name, group in scene.groups.items():
        angles = rng.uniform(-1, 1, (len(group.camera_from_target), 2)) * half * PAST
        turns = [Rigid.exp([up, aside, 0, 0, 0, 0]) for aside, up in angles]
        views = tuple(turn @ pose for turn, pose in zip(turns, group.camera_from_target, strict=True))
        groups[name] = replace(group, camera_from_target=views)
    return replace(scene, camera=Camera.of(camera, "OPENCV_FISHEYE"), groups=groups)


MAX_FOUND_TILT_RAD = np.radians(70)  # largest tilt at which a circle must be found, in rad
MAX_SHOWN_TILT_RAD = np.radians(89)
RIM_POINTS = 72
NEAR_BORDER = 3.0
"""Distance of a circle's centre from the image border at which no rim reaches it, in radii of its frontal image."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageCircles:
    """True values of the n circles that one image shows; camera frame, mm."""

    labels: tuple[Label, ...]
    xyz_camera: np.ndarray  # (n, 3)
    normal_camera: np.ndarray  # (n, 3) towards the camera
    radius_mm: np.ndarray
    tilt_rad: np.ndarray  # between normal and line of sight
    centre_px: np.ndarray  # (n, 2) image of the circle's centre
    must_find: np.ndarray  # True for circles of the group's faces or the board, tilted up to 70°, whole in the image

    def rows(self, index: np.ndarray) -> "ImageCircles":
        """Returns the circles of a mask, or of indices."""
        labels = [self.labels[i] for i in np.arange(len(self.labels))[index]]
        return ImageCircles(tuple(labels), *(getattr(self, part.name)[index] for part in fields(self)[1:]))


def image_circles(scene: Scene, group: str, image: int) -> ImageCircles:
    """Returns the circles that face the camera and whose centres lie in the image."""
    g = scene.groups[group]
    camera_from_target = g.camera_from_target[image]
    labels, xyz, normal, radius = zip(*scene.patterns(group), strict=True)
    count = [len(own) for own in labels]
    wanted = np.repeat([*(face.id in g.faces for face in scene.target.faces), True], count)
    xyz = camera_from_target @ np.vstack(xyz)
    normal = np.repeat(normal, count, axis=0) @ camera_from_target.rotation.T
    radius = np.concatenate(radius)
    cosine = -(xyz * normal).sum(1) / np.linalg.norm(xyz, axis=1)
    tilt = np.arccos(np.clip(cosine, -1, 1))
    size = np.array([scene.camera.width, scene.camera.height])
    centre = scene.camera.project(xyz)
    shown = (tilt <= MAX_SHOWN_TILT_RAD) & ((centre > -0.5) & (centre < size - 0.5)).all(1)
    reach = NEAR_BORDER * scene.camera.focal.max() * radius / np.maximum(xyz[:, 2], radius)
    whole = ((centre > reach[:, None]) & (centre < size - 1 - reach[:, None])).all(1)
    near = np.flatnonzero(~whole)  # the rims near the border alone are computed
    rim = scene.camera.project(rim_points(xyz[near], normal[near], radius[near]))
    whole[near] = ((rim > 0) & (rim < size - 1)).all((1, 2))
    findable = wanted & (tilt <= MAX_FOUND_TILT_RAD) & whole
    return ImageCircles(tuple(chain(*labels)), xyz, normal, radius, tilt, centre, findable).rows(shown)


def rim_points(xyz: np.ndarray, normal: np.ndarray, radius: np.ndarray, count: int = RIM_POINTS) -> np.ndarray:
    """Returns points on the rims of n circles, (n, count, 3), in the frame of the arguments (n, 3), (n, 3), (n,)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    e1 = np.cross(normal, helper)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(normal, e1)
    angle = 2 * np.pi * np.arange(count) / count
    circle = np.cos(angle)[:, None] * e1[:, None] + np.sin(angle)[:, None] * e2[:, None]
    return xyz[:, None] + radius[:, None, None] * circle
