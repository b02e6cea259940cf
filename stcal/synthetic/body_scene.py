"""Photographs of a body held before a camera in changing poses, with its truth: printed faces, and faces of circles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import SQUARE, black_areas, clear_mm
from stcal.design import FaceDesign, Polarity, TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, align_rigid

BLACK, WHITE, BACKGROUND = 0.08, 0.85, 0.35
DRAWING_PX = 2000  # longer side of the drawing of a face, px
CIRCLE_CORNERS = 360  # corners of the polygon that a circle is drawn as
SAMPLES, LATTICE = 13, 8
"""Samples of a pixel: a Fibonacci lattice, shifted at random from pixel to pixel. An edge along the pixel rows is then
exactly in place; a grid of points would place it in steps."""
EDGE_SIGMA_PX = 0.1
"""σ of the shift that ink, light and the camera's response give the edges of all tags alike."""
BEND_MM = 0.02  # σ of a point of a printed face about its plane
LIGHT = np.array([0.3, -0.5, -0.8])
LEAST_FACES = 2
SHOWN_DEG, SQUARE_DEG = 60.0, 45.0
"""Largest angles of a face's normal to the line of sight: shown by a photograph, and shown squarely."""
ENOUGH_VIEWS, ENOUGH_SQUARE = 5, 2
"""Number of photographs that show each face, and of those that show it squarely, as far as there are enough of them."""
TRIALS, CHOICES = 2000, 24
"""Number of poses that are tried for a photograph, and number of suitable ones of which the best is taken."""
BORDER = 0.01  # free border of the image, in image widths: faces are not quite where the design has them


@dataclass(frozen=True, slots=True)
class BodyOptions:
    """Options of photographs of a body.

    Parameters
    ----------
    images : Number of photographs.
    distance_mm, depth_share : Distance of the camera from the middle of the body, mm, to ± this share of it.
    noise : Standard deviation of the sensor noise, fraction of full scale.
    blur_px : Sigma of the Gaussian point spread function, px.
    seed : Seed of everything random.
    pose_sigma_mm, pose_sigma_deg : σ of the faces about their rough poses, mm and degrees.
    print_errors : float
        Factor on the σ that the design states of printed faces, and on the bends of :data:`BEND_MM`; 0 for exact ones.
    body_seed : int, optional
        Draws the errors of the body, so that another ``seed`` photographs the same one again; ``seed`` by default.

    Raises InputError: a value is of another type, or out of range.
    """

    images: int = 24
    distance_mm: float = 400.0
    depth_share: float = 0.15
    noise: float = 0.01
    blur_px: float = 0.7
    seed: int = 0
    pose_sigma_mm: float = 0.3
    pose_sigma_deg: float = 0.5
    print_errors: float = 0.0
    body_seed: int | None = None

    def __post_init__(self):
        require_fields(
            self, "body", images=1, noise=0, blur_px=0, seed=0, body_seed=0, pose_sigma_mm=0, pose_sigma_deg=0
        )


@dataclass(frozen=True, slots=True, eq=False)
class BodyScene:
    """A body with its true poses, mm: ``target_from_face`` by face, ``camera_from_target`` by image. ``off_mm`` :
    (n, 3) by face, how far its points are from the design, without a shift or turn of the whole."""

    target: TargetDesign
    target_from_face: dict[str, Rigid]
    camera: Camera
    camera_from_target: tuple[Rigid, ...]
    options: BodyOptions = field(default_factory=BodyOptions)
    off_mm: dict[str, np.ndarray] = field(default_factory=dict)

    def drawings(self) -> dict[str, "FacePicture"]:
        """Returns the drawings of the faces, as they are printed."""
        polarity = self.target.polarity
        return {face.id: drawing_of(face, polarity, self.off_mm.get(face.id)) for face in self.target.faces}

    def circles_target(self) -> dict[str, np.ndarray]:
        """Returns the corners by label, target frame, mm."""
        places = {face.id: face.places_mm(face.ids) for face in self.target.faces}
        for face_id, off in self.off_mm.items():
            places[face_id] += off
        return {
            str(label): xyz
            for face in self.target.faces
            for label, xyz in zip(face.labels(), self.target_from_face[face.id] @ places[face.id], strict=True)
        }

    def faces_in_view(self, image: int) -> list[FaceDesign]:
        """Returns the faces that a photograph shows well."""
        shown = _shown_deg(self, self.camera_from_target[image])
        return [face for face in self.target.faces if face.id in shown]

    def hardly_seen(self) -> str:
        """Returns a sentence on the faces that, as designed, too few photographs show; empty if there is none."""
        design = replace(self, target_from_face=_in_first_face(self.target.rough_poses()))
        shown = [_shown_deg(design, pose) for pose in self.camera_from_target]
        named = []
        for face in self.target.faces:
            tilts = [tilt_deg for tilts_deg in shown for tilt_deg in tilts_deg.get(face.id, ())]
            if _lacking(tilts):
                best = f", at best {min(tilts):.0f}° from its normal" if tilts else ""
                named.append(f"{face.id} ({len(tilts)} of {len(shown)} images{best})")
        enough = f"{ENOUGH_VIEWS} of each, {ENOUGH_SQUARE} of them within {SQUARE_DEG:.0f}°: more --images needed"
        return f"hardly seen: face {', '.join(named)}; better {enough}" if named else ""


@require_arguments
def body_camera(width: int) -> Camera:
    """Returns a camera of medium focal length with a lens that distorts a little, and images of 3:2.

    Parameters
    ----------
    width : Width of its images, px.
    """
    height, distortion = round(width * 2 / 3), [-0.12, 0.05, 4e-4, -3e-4, 0, 0, 0, 0]
    centre = width / 2 + 0.006 * width, height / 2 - 0.004 * width
    return Camera(width, height, [1.1 * width] * 2, centre, distortion, False, "OPENCV")


@require_arguments
def make_body_scene(target: TargetDesign, camera: Camera, options: BodyOptions | None = None) -> BodyScene:
    """Returns a body with faces near their rough poses, in random poses in which it shows two faces at least.

    The poses follow from the design alone, so that a forecast and a simulation of the same options have the same. As
    soon as the photographs left may just be enough, they show what lacks most: each face is to be in five photographs,
    and within 45° of its normal in two of them. :meth:`BodyScene.hardly_seen` says which faces are not.

    Parameters
    ----------
    target : Design of the body, with a rough pose of each face, mm.
    camera : The camera before which it is held, such as :func:`stcal.synthetic.body_camera` returns.
    options : The defaults if None.

    Raises InputError: a face has no rough pose, or the camera is too near for the image to hold the body.
    """
    options, rough = options or BodyOptions(), target.rough_poses()
    for face in target.faces:
        if face.id not in rough:
            raise InputError("E-SIMULATE-BODY", f"face {face.id}: no rough_pose; each face needs one in target.toml")
    rng = np.random.default_rng(options.seed)
    made = rng if options.body_seed is None else np.random.default_rng(options.body_seed)
    moved = {}
    for face_id, pose in rough.items():
        turn = Rotation.from_rotvec(np.radians(options.pose_sigma_deg) * made.normal(size=3)).as_matrix()
        shift = options.pose_sigma_mm * made.normal(size=3)
        moved[face_id] = Rigid(pose.rotation @ turn, pose.translation + shift)
    design = _in_first_face(rough)
    scene = BodyScene(target, design, camera, (), options)
    poses: list[Rigid] = []
    tilts_deg: dict[str, tuple[float, ...]] = dict.fromkeys(design, ())
    for left in range(options.images, 0, -1):
        choices = CHOICES if left <= 2 * sum(map(_lacking, tilts_deg.values())) else 1
        tried = _poses(scene, choices, tilts_deg, rng)  # squares: the face that lacks most counts most
        pose, tilts_deg = min(tried, key=lambda each: sum(_lacking(tilts) ** 2 for tilts in each[1].values()))
        poses.append(pose)
    off_mm = _print_errors(target, camera, options)
    return replace(scene, target_from_face=_in_first_face(moved), camera_from_target=tuple(poses), off_mm=off_mm)


def _in_first_face(poses: Mapping[str, Rigid]) -> dict[str, Rigid]:
    first = next(iter(poses.values())).inverse()
    return {face_id: first @ pose for face_id, pose in poses.items()}


def _print_errors(target: TargetDesign, camera: Camera, options: BodyOptions) -> dict[str, np.ndarray]:
    """Returns the errors of printed faces' points, (n, 3) mm by face, with one of size and one of edges for all."""
    if not options.print_errors:
        return {}
    rng = np.random.default_rng([options.seed if options.body_seed is None else options.body_seed, 3])
    size, shift_px = options.print_errors * rng.normal(size=2) * [1.0, EDGE_SIGMA_PX]
    shift_mm = float(shift_px * options.distance_mm / (np.mean(camera.focal) * np.sqrt(0.5)))
    off = {}
    for face in target.faces:
        if face.printed is None:
            continue
        moved = face.xy_mm * (1 + size * face.size_sigma)
        if face.of_tags:
            tags = moved.reshape(-1, 4, 2)
            sides = np.roll(tags, -1, axis=1) - tags
            sides = sides / np.linalg.norm(sides, axis=2, keepdims=True)
            tags += shift_mm * (np.roll(sides, 1, axis=1) - sides)
        sigma_mm = options.print_errors * np.array([face.sigma_mm or 0.0, face.sigma_mm or 0.0, BEND_MM])
        design = face.places_mm(face.ids)
        printed = np.pad(moved, ((0, 0), (0, 1))) + sigma_mm * rng.normal(size=design.shape)
        off[face.id] = align_rigid(design, printed) @ printed - design
    return off


def _poses(
    scene: BodyScene, count: int, tilts_deg: Mapping[str, tuple[float, ...]], rng: np.random.Generator
) -> list[tuple[Rigid, dict[str, tuple[float, ...]]]]:
    """Returns up to ``count`` random poses that show two faces or more, with all ``tilts_deg`` so far."""
    found: list[tuple[Rigid, dict[str, tuple[float, ...]]]] = []
    points = np.array(list(scene.circles_target().values()))
    middle = (points.min(0) + points.max(0)) / 2
    options, camera = scene.options, scene.camera
    size, border_px = np.array([camera.width, camera.height]), BORDER * camera.width
    for _ in range(TRIALS):
        quaternion = rng.normal(size=4)  # of a turn that favours no direction
        turn = Rotation.from_quat(quaternion / np.linalg.norm(quaternion)).as_matrix()
        depth = options.distance_mm * (1 + options.depth_share * rng.uniform(-1, 1))
        place = np.append(rng.uniform(-0.3, 0.3, 2) * size / camera.focal * depth, depth)
        pose = Rigid(turn, place - turn @ middle)
        xyz = pose @ points
        if (xyz[:, 2] < 0.1 * depth).any():
            continue
        pixels = camera.project(xyz)
        if (pixels < border_px).any() or (pixels > size - 1 - border_px).any():
            continue
        shown = _shown_deg(scene, pose)
        if len(shown) >= LEAST_FACES:
            found.append((pose, {each: (*tilts, *shown.get(each, ())) for each, tilts in tilts_deg.items()}))
        if len(found) == count:
            break
    if found:
        return found
    half_field_rad = float(np.arctan((size / 2 - border_px) / camera.focal).min())
    reach_mm = float(np.linalg.norm(points - middle, axis=1).max())
    enough_mm = reach_mm / np.sin(half_field_rad) / (1 - options.depth_share)
    shown = f"no pose at {options.distance_mm:g} mm in which it is in the image and shows two faces"
    remedy = f"give another --distance: from {enough_mm:.0f} mm on it is in the image"
    raise InputError("E-SIMULATE-BODY", f"target {scene.target.name}: {shown}; {remedy}")


def _shown_deg(scene: BodyScene, pose: Rigid) -> dict[str, tuple[float, ...]]:
    """Returns the angle between normal and line of sight, (1,) degrees, of each face that a photograph shows."""
    tilts: dict[str, tuple[float, ...]] = {}
    for face in scene.target.faces:
        camera_from_face = pose @ scene.target_from_face[face.id]
        middle = camera_from_face @ np.append(face.xy_mm.mean(0), 0.0)
        inward = -face.outward * camera_from_face.rotation[:, 2]
        tilt_deg = float(np.degrees(np.arccos(np.clip(inward @ middle / np.linalg.norm(middle), -1, 1))))
        if tilt_deg < SHOWN_DEG:
            tilts[face.id] = (tilt_deg,)
    return tilts


def _lacking(tilts_deg: Sequence[float]) -> int:
    """Returns how many more photographs are to show a face that is seen at these angles; 0 if there are enough."""
    squarely = sum(tilt_deg <= SQUARE_DEG for tilt_deg in tilts_deg)
    return max(ENOUGH_VIEWS - len(tilts_deg), 0) + max(ENOUGH_SQUARE - squarely, 0)


@dataclass(frozen=True, slots=True, eq=False)
class FacePicture:
    """A face as a picture."""

    grey: np.ndarray  # (h, w) brightness
    solid: np.ndarray  # (h, w) where the plate is
    px_mm: float  # pixels in a mm
    origin: np.ndarray  # (2,) of the first pixel, mm
    bend: np.ndarray | None = None  # (h, w) mm along Z, None of a plane


def drawing_of(face: FaceDesign, polarity: Polarity = "bright", off_mm: np.ndarray | None = None) -> FacePicture:
    """Returns the drawing of a face with the plate about it; ``off_mm`` : (n, 3) how far printed points are off."""
    if face.printed is None:
        around = 2 * np.pi * np.arange(CIRCLE_CORNERS) / CIRCLE_CORNERS
        unit = np.column_stack([np.cos(around), np.sin(around)])
        areas = [[xy + radius * unit] for xy, radius in zip(face.xy_mm, face.radius_mm, strict=True)]
        margin, dark = float(face.radius_mm.max()), polarity == "dark"
    else:
        areas, margin, dark = black_areas(face.printed), clear_mm(face.printed), True  # type: ignore[arg-type]
    if off_mm is not None:
        areas = [[line + _off_at(line, face.xy_mm, off_mm[:, :2]) for line in area] for area in areas]
    every = np.concatenate([line for area in areas for line in area])
    plate = face.outline_mm
    if plate is None:
        plate = every.min(0) - margin + SQUARE * (np.ptp(every, axis=0) + 2 * margin)
    low, high = plate.min(0), plate.max(0)
    px_mm = DRAWING_PX / float((high - low).max())
    width, height = np.ceil((high - low) * px_mm).astype(int).tolist()
    ground, ink = (WHITE, BLACK) if dark else (BLACK, WHITE)
    size = height, width
    grey = ground + (ink - ground) * covered_share([[(line - low) * px_mm for line in area] for area in areas], size)
    solid = covered_share([[(plate - low) * px_mm]], size)
    if off_mm is None:
        return FacePicture(grey, solid, px_mm, low)
    x, y = (low[k] + (np.arange(n) + 0.5) / px_mm for k, n in ((0, width), (1, height)))
    bend = _off_at(np.stack(np.meshgrid(x, y), axis=-1), face.xy_mm, off_mm[:, 2])
    return FacePicture(grey, solid, px_mm, low, bend.astype(np.float32))


def _off_at(places: np.ndarray, xy_mm: np.ndarray, off_mm: np.ndarray) -> np.ndarray:
    """Returns how far places (…, 2) are off: linear between the points ``xy_mm``, beyond them as the nearest one."""
    off = LinearNDInterpolator(xy_mm, off_mm)(places)
    beyond = np.isnan(off).reshape(*places.shape[:-1], -1).any(-1)
    off[beyond] = NearestNDInterpolator(xy_mm, off_mm)(places[beyond])
    return off


def covered_share(areas: list[list[np.ndarray]], size: tuple[int, int]) -> np.ndarray:
    """Returns the share of each pixel (height, width) of a picture that areas cover, exactly. ``areas`` : lists of
    closed lines (k, 2), px: the outline, then holes in the other direction. Each piece of a line within one pixel
    adds what is between it and the picture's right side."""
    height, width = size
    added = np.zeros((height, width + 1))
    for area in areas:
        following = np.roll(area[0], -1, axis=0)
        turn = np.sign((area[0][:, 0] * following[:, 1] - area[0][:, 1] * following[:, 0]).sum())
        for line in area:
            for start, end in zip(line, np.roll(line, -1, axis=0), strict=True):
                cuts = [np.array([0.0, 1.0])]
                for k in (0, 1):
                    low, high = sorted((start[k], end[k]))
                    if low < high:
                        cuts.append((np.arange(np.ceil(low), np.floor(high) + 1) - start[k]) / (end[k] - start[k]))
                at = np.sort(np.concatenate(cuts).clip(0, 1))[:, None]
                points = start + at * (end - start)
                rise = turn * np.diff(points[:, 1])
                x, y = ((points[1:] + points[:-1]) / 2).T
                row, x = np.floor(y).astype(int), x.clip(0, width)
                column = np.floor(x).astype(int).clip(0, width - 1)
                used = (row >= 0) & (row < height)
                row, column, rise, part = row[used], column[used], rise[used], (x - column)[used]
                np.add.at(added, (row, column), rise * (1 - part))
                np.add.at(added, (row, column + 1), rise * part)
    # A line that goes down leaves the area on its right side, where rows go down.
    return (-added.cumsum(1)[:, :-1]).clip(0, 1).astype(np.float32)


def render_body(scene: BodyScene, image: int, drawings: dict[str, FacePicture]) -> np.ndarray:
    """Returns one photograph, 8 bit. Each sample of a pixel is the point at which its ray meets a face."""
    camera, pose, options = scene.camera, scene.camera_from_target[image], scene.options
    lattice = np.column_stack([np.arange(SAMPLES), LATTICE * np.arange(SAMPLES)]) / SAMPLES
    moved = np.random.default_rng([options.seed, 2, image]).random((camera.height, camera.width, 2), np.float32)
    total = np.full((SAMPLES, camera.height, camera.width), BACKGROUND, np.float32)
    for face in scene.target.faces:
        camera_from_face = pose @ scene.target_from_face[face.id]
        drawing = drawings[face.id]
        extent = np.array(drawing.grey.shape[::-1]) / drawing.px_mm
        corners = drawing.origin + SQUARE * extent
        xyz = camera_from_face @ np.pad(corners, ((0, 0), (0, 1)))
        middle = xyz.mean(0)
        inward = -face.outward * camera_from_face.rotation[:, 2]
        if inward @ middle <= 0 or (xyz[:, 2] <= 0).any():
            continue
        box = camera.project(xyz)
        low, high = np.floor(box.min(0) - 3).astype(int), np.ceil(box.max(0) + 4).astype(int)
        low, high = np.maximum(low, 0), np.minimum(high, [camera.width, camera.height])
        if (high <= low).any():
            continue
        columns, rows = slice(low[0], high[0]), slice(low[1], high[1])
        pixels = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), axis=-1)
        ideal = camera.normalised_from_pixel(pixels)
        along = [camera.normalised_from_pixel(pixels + step) - ideal for step in np.eye(2)]
        start = -camera_from_face.rotation.T @ camera_from_face.translation
        light = 0.75 + 0.25 * float(inward @ (LIGHT / np.linalg.norm(LIGHT)) * -1)
        for part, point in zip(total, lattice, strict=True):
            offset = (point + moved[rows, columns]) % 1 - 0.5  # within a pixel, the lens is linear
            ray = ideal + offset[..., :1] * along[0] + offset[..., 1:] * along[1]
            rays = np.concatenate([ray, np.ones((*ray.shape[:2], 1))], axis=2) @ camera_from_face.rotation
            towards = np.where(np.abs(rays[..., 2]) > 1e-9, rays[..., 2], 1e-9)
            depth = -start[2] / towards
            at = start[:2] + depth[..., None] * rays[..., :2]
            place = ((at - drawing.origin) * drawing.px_mm - 0.5).astype(np.float32)
            if drawing.bend is not None:
                bend = cv2.remap(drawing.bend, place[..., 0], place[..., 1], cv2.INTER_LINEAR)
                at += (bend / towards)[..., None] * rays[..., :2]
                place = ((at - drawing.origin) * drawing.px_mm - 0.5).astype(np.float32)
            inside = ((at >= drawing.origin) & (at <= drawing.origin + extent)).all(2)
            value, solid = (
                cv2.remap(picture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                for picture in (drawing.grey, drawing.solid)
            )
            inside &= solid > 0.5
            part[rows, columns][inside] = light * value[inside]
    grey = total.mean(0)
    if options.blur_px:
        grey = cv2.GaussianBlur(grey, (0, 0), options.blur_px)
    rng = np.random.default_rng([options.seed, 1, image])
    noisy = grey + options.noise * rng.normal(size=grey.shape)
    return np.clip(np.rint(255 * noisy), 0, 255).astype(np.uint8)
