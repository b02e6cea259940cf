"""Design of a target for a box and of a board for it, at random and verified, with its forecast and files.

No face shares a pattern with another, also with circles hidden.
"""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from stcal.boards.board_file import load_dots, save_board
from stcal.boards.target_file import save_target
from stcal.design import BoardDesign, FaceDesign, Polarity, TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments, require_fields
from stcal.geometry.camera import COEFFICIENTS, Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.parallel import Progress
from stcal.sfm.data.patterns import MAX_TILT_RAD, Pattern, images_px
from stcal.sfm.detect.candidates import Candidates, EllipseOptions, Ellipses, diameter_limits_px
from stcal.sfm.detect.face_patterns import MIN_NAMING, find_faces, in_common
from stcal.sfm.planning.advise import expected_noise
from stcal.sfm.planning.session import Plan, PlanOptions, plan
from stcal.synthetic.designs import Body, face_of_drawing, tag_body
from stcal.synthetic.scene import FOCAL_PER_WIDTH

EDGE_SHARE = 0.06  # margin along a plate's rim without circles, to cut, fold and glue, over its shorter side


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    name: str
    width: float  # of its plate, mm
    height: float
    box_from_plate: Rigid  # origin lower left as seen from outside, Y upwards, Z outwards


NAMES = ("front", "right", "back", "left", "top")  # names of the sides that may have circles


def sides_of(size_mm: tuple[float, float, float], names: tuple[str, ...] = NAMES) -> list[Side]:
    """Returns the named sides of a box of this width, height and depth, whose middle is the origin, Z upwards."""
    w, h, d = size_mm
    x, y, z = np.eye(3)
    rows = (
        ("front", w, h, (x, z), (-w, -d, -h)),
        ("right", d, h, (y, z), (w, -d, -h)),
        ("back", w, h, (-x, z), (w, d, -h)),
        ("left", d, h, (-y, z), (-w, d, -h)),
        ("top", w, d, (x, y), (-w, -d, h)),
    )
    sides = {
        name: Side(name, width, height, Rigid(np.column_stack([x, y, np.cross(x, y)]), np.array(corner) / 2))
        for name, width, height, (x, y), corner in rows
    }
    return [sides[name] for name in names]


def faces_of(text: str) -> tuple[str, ...]:
    """Parses ``front,right,top`` into the names of sides; all of them if the text is empty."""
    return tuple(name.strip().lower() for name in text.split(",")) if text else NAMES


def size_of(text: str) -> tuple[float, float, float]:
    """Parses ``W,H,D``, or ``WxHxD``, into width, height and depth in mm."""
    try:
        width, height, depth = map(float, re.split("[,x×]", text))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--size {text}: W,H,D in mm needed, such as 120,120,100") from error
    require_size((width, height, depth))
    return width, height, depth


def require_size(size_mm: Sequence[float]) -> None:
    """Refuses sides outside 1 mm to 100 m."""
    if not all(1 <= side <= 1e5 for side in size_mm):
        size = ",".join(f"{side:g}" for side in size_mm)
        raise InputError("E-OPTION-RANGE", f"--size {size}: sides of 1 mm to 100 m needed, in mm")


HIDDEN = 3  # circles of a face that may be hidden: any set of the others identifies it
LEAST_CIRCLES = MIN_NAMING + HIDDEN
LARGE = 1.6  # larger radius over the smaller; detection takes radii up to a ratio of 1.3 for equal
GAP = 0.8  # least gap between the rims of two circles, in radii of the smaller circles
PLACES, TRIES = 40, 30  # numbers of candidate places for each circle, and of candidate patterns for each face
GRID_MM = 0.5  # grid of the coordinates of circles, so that they are round numbers that can be measured again
CORNER_SHARE = 0.15  # area at each corner in which a circle of the frame lies, over the plate's sides


def make_pattern(
    sides: list[Side], circles: int, radius_mm: float, polarity: Polarity, seed: int | list[int], name: str
) -> tuple[TargetDesign, int]:
    """Returns a face for each side, named by its circles with any :data:`HIDDEN` of them hidden; and the most circles
    that a face has in common with another reading, 0 if under four."""
    if circles < LEAST_CIRCLES:
        fault = f"--circles {circles}: {LEAST_CIRCLES} needed"
        raise InputError("E-MAKE-CIRCLES", f"{fault}, {MIN_NAMING} name a face and {HIDDEN} may be hidden")
    rng = np.random.default_rng(seed)
    faces: list[FaceDesign] = []
    likeness = 0
    for side in sides:
        least, best = circles + 1, None
        for _ in range(TRIES):
            if (face := _strewn(side, circles, radius_mm, rng)) is not None:
                # With itself turned or mirrored, or another one or its mirror image.
                alike = max(in_common(face, other, mirrored) for other in (face, *faces) for mirrored in (False, True))
                least, best = (alike, face) if alike < least else (least, best)
            if least == 0:
                break
        if best is None:
            radii, plate = f"{radius_mm:.3g} and {LARGE * radius_mm:.3g} mm", f"{side.width:g} × {side.height:g} mm"
            fault = f"face {side.name}: no room for {circles} circles of {radii} on {plate}"
            raise InputError("E-MAKE-ROOM", f"{fault}; fewer --circles, a smaller --radius-mm, or a larger --size")
        if least > (most := circles - HIDDEN - 1):
            fault = (
                f"face {side.name}: {least} of {circles} circles also fit another interpretation, at most {most} may"
            )
            raise InputError("E-MAKE-CIRCLES", f"{fault}; more --circles, a smaller --radius-mm, or another --seed")
        faces.append(best)
        likeness = max(likeness, least)
    return TargetDesign(name, polarity, tuple(faces)), likeness


def _strewn(side: Side, count: int, radius_mm: float, rng: np.random.Generator) -> FaceDesign | None:
    """Returns one random pattern, or None if the last circles had no room."""
    size, large = np.array([side.width, side.height]), LARGE * radius_mm
    margin = EDGE_SHARE * size.min()
    low, high = np.full(2, margin + large), size - margin - large
    if (high <= low).any():
        return None
    corner = CORNER_SHARE * (high - low)
    first = low + rng.random(2) * corner
    second = np.array([high[0] - rng.random() * corner[0], first[1]])  # X runs along the plate's edge
    third = np.array([low[0], high[1]]) + rng.random(2) * corner * [1, -1]
    xy = list(np.rint(np.array([first, second, third]) / GRID_MM) * GRID_MM)
    radii = [large, large, large]
    for place in range(3, count):
        radius = large if place % 2 == 0 else radius_mm
        edge = margin + radius
        places = np.rint((edge + rng.random((PLACES, 2)) * (size - 2 * edge)) / GRID_MM) * GRID_MM
        gap = (cdist(places, xy) - radii - radius).min(1)
        if gap.max() < GAP * radius_mm:
            return None
        xy.append(places[int(gap.argmax())])
        radii.append(radius)
    if pdist(xy[:3]).min() < 2 * large + GAP * radius_mm:
        return None
    rows = [(str(i), *place.tolist(), radius) for i, (place, radius) in enumerate(zip(xy, radii, strict=True), 1)]
    face, plate_from_face = face_of_drawing(side.name, rows, "1", "2", "3")
    corners = [[0, 0, 0], [side.width, 0, 0], [side.width, side.height, 0], [0, side.height, 0]]
    outline = plate_from_face.inverse() @ np.array(corners, float)
    return replace(face, rough_target_from_face=side.box_from_plate @ plate_from_face, outline_mm=outline[:, :2])


TILT_RAD = np.radians(40.0)  # tilt of the face about an oblique axis in the simulated views
CONTRAST = 100.0


def unnamed_cases(
    target: TargetDesign, camera: Camera, distance_mm: float, hidden: int, progress: Callable[[int, int], None] | None
) -> tuple[list[tuple[str, tuple[str, ...]]], int]:
    """Cases (face, hidden circles) whose visible circles the finder does not read, and the number of all."""
    failed, cases = [], [(face, rows) for face in target.faces for rows in combinations(range(len(face.ids)), hidden)]
    ellipses = {face.id: _seen(face, target, camera, distance_mm) for face in target.faces}
    for done, (face, hidden_rows) in enumerate(cases, 1):
        visible = np.setdiff1d(np.arange(len(face.ids)), hidden_rows)
        readings, _ = find_faces(Candidates(ellipses[face.id].select(visible), camera), target)
        right = [reading for reading in readings if reading.face == face.id and len(readings) == 1]
        named = {pair for r in right for pair in zip(r.circles.tolist(), r.rows.tolist(), strict=True)}
        if named != {(circle, row) for row, circle in enumerate(visible.tolist())}:
            failed.append((face.id, tuple(face.ids[i] for i in hidden_rows)))
        if progress is not None and (done % 20 == 0 or done == len(cases)):
            progress(done, len(cases))
    return failed, len(cases)


def _seen(face: FaceDesign, target: TargetDesign, camera: Camera, distance_mm: float) -> Ellipses:
    """Returns the ellipses of all circles of a face that is tilted and turned, with its middle on the optical axis."""
    axis = np.array([0.6, 0.8, 0.0])
    front = np.diag([1.0, -1.0, -1.0])  # Z of the face to the camera
    turn = Rotation.from_rotvec(TILT_RAD * axis).as_matrix() @ front
    middle = np.append((face.xy_mm.min(0) + face.xy_mm.max(0)) / 2, 0.0)
    pose = Rigid(turn, np.array([0, 0, distance_mm]) - turn @ middle)
    pattern = Pattern(face.id, face.labels(), face.xy_mm, face.radius_mm, target.polarity, 1)
    centre, shape = images_px(pattern, pose, camera)
    return Ellipses(centre, shape, np.full(len(centre), CONTRAST))


FARTHER = 1.1  # largest distance of a camera, as a multiple of the stated distance
WELL_SEEN = 1.5  # least ratio of the smallest diameter, farthest and most tilted, to that which detection looks for
RADIUS_SHARE = 1 / 30  # default radius of the smaller circles, as a share of the box's shortest side
RADIUS_STEP_MM = 0.25
PITCH_SHARE = 0.23  # of the board, over the box's longest side: it then reaches beyond the box on all sides
FIELD_SHARE = 0.8  # of the width in view at the stated distance, in which box and board stand side by side
PITCH_STEP_MM = 5.0
ATTEMPTS = 8  # largest number of patterns drawn until one is identified in all cases
ROWS, COLUMNS = 7, 9
BOARD_SIGMA_MM = 0.02  # of dots that a good printer prints; a milled or photographic plate states its own


@dataclass(frozen=True, slots=True, repr=False)
class DesignOptions(Brief):
    """A target of circles to be designed for a box.

    Parameters
    ----------
    size_mm : Width, height and depth of the box, mm.
    circles : Number of circles on each face.
    radius_mm : Radius of the smaller circles, mm; one that suits box and camera if None.
    distance_mm : Distance of the cameras from the target, mm.
    width : Width of the images, px; 3:2 images of a 24 mm lens, if no ``camera`` is given.
    camera : Camera, whose file must state the image size.
    polarity : Dark circles on bright plates, or the reverse.
    seed : Seed of the random pattern.
    faces : Sides with circles, of ``front``, ``right``, ``back``, ``left`` and ``top``; the reference face first.

    Raises
    ------
    InputError
        A value is of another type, a side of the box is below 1 mm or above 100 m, or no two faces are neighbours.
    """

    size_mm: tuple[float, float, float]
    circles: int = 10
    radius_mm: float | None = None
    distance_mm: float = 1000.0
    width: int = 5184
    camera: Camera | CameraModel | None = None
    polarity: Polarity = "dark"
    seed: int = 0
    faces: tuple[str, ...] = NAMES

    def __post_init__(self):
        require_fields(self, "design", circles=1, radius_mm=0, distance_mm=0, width=1, seed=0)
        require_size(self.size_mm)
        text = ",".join(self.faces)
        for name in self.faces:
            if name not in NAMES:
                raise InputError(
                    "E-OPTION-VALUE", f"--faces {text}: {name!r} is no side; use some of {', '.join(NAMES)}"
                )
            if self.faces.count(name) > 1:
                raise InputError("E-OPTION-REPEATED", f"--faces {text}: {name} occurs twice; name each side once")
        if len(self.faces) < 2 or set(self.faces) in ({"front", "back"}, {"left", "right"}):
            fault = f"--faces {text}: two sides with a common edge needed, so that one photograph shows both"
            raise InputError("E-OPTION-VALUE", f"{fault}; use such as front,right,top")

    def ideal_camera(self) -> Camera:
        """Returns the camera without its distortion, or a default camera if none is given."""
        width, height, focal = self.width, round(self.width * 2 / 3), np.full(2, FOCAL_PER_WIDTH * self.width)
        if self.camera is not None:
            model = camera_model(self.camera)
            width, height, focal = model.width, model.height, model.focal
            if not (width and height):
                fault = f"camera file {model.source} states no image size"
                raise InputError("E-CAMERA-SIZE", f"{fault}; add it to the file")
        return Camera(width, height, focal, [(width - 1) / 2, (height - 1) / 2], np.zeros(COEFFICIENTS))


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """The designed target and board."""

    options: DesignOptions
    target: TargetDesign
    likeness: int  # of :func:`make_pattern`
    board: BoardDesign
    radius_mm: float  # of the smaller circles
    least_mm: float  # smallest radius that the camera sees well
    cases: int  # of hidden circles that were tried, in all of which the faces were identified


def make_target(options: DesignOptions, progress: Callable[[int, int], None] | None = None) -> Made:
    """Returns a board, and a pattern for each side of the box that is to have one. ``progress`` : of hidden circles."""
    camera, radius = options.ideal_camera(), options.radius_mm
    least_px, most_px = diameter_limits_px(camera.width * camera.height, EllipseOptions())
    focal_px, farthest_mm = float(np.sqrt(camera.focal.prod())), FARTHER * options.distance_mm
    # of circles that are found even where they are farthest away and most tilted, with a margin
    least = float(WELL_SEEN * least_px / (2 * (focal_px / farthest_mm) * np.sqrt(np.cos(MAX_TILT_RAD))))
    if radius is None:
        radius = _up_to(RADIUS_STEP_MM, max(least, RADIUS_SHARE * min(options.size_mm)))
    if radius < least:
        seen = f"at {options.distance_mm:g} mm this camera sees circles well from {least:.2f} mm on"
        remedy = "larger circles, a nearer camera or more pixels needed"
        raise InputError("E-MAKE-RADIUS", f"--radius-mm {radius:g}: {seen}; {remedy}")
    largest_px = 2 * LARGE * radius * focal_px / options.distance_mm
    if largest_px * FARTHER > most_px:
        allowed = f"at most {most_px / FARTHER:.0f} px are sought"
        fault = f"radius {LARGE * radius:g} mm is {largest_px:.0f} px in the image, {allowed}"
        raise InputError("E-MAKE-RADIUS", f"{fault}; smaller circles or a camera farther away needed")
    name, sides = "box {:g} x {:g} x {:g} mm".format(*options.size_mm), sides_of(options.size_mm, options.faces)
    failed, cases = [], 0
    for attempt in range(ATTEMPTS):
        seed = [options.seed, attempt] if attempt else options.seed
        target, likeness = make_pattern(sides, options.circles, radius, options.polarity, seed, name)
        failed, cases = unnamed_cases(target, camera, options.distance_mm, HIDDEN, progress)
        if not failed:
            return Made(options, target, likeness, _board(options, least), radius, least, cases)
    face, hidden_ids = failed[0]
    fault = f"face {face}: not named with circles {', '.join(hidden_ids)} hidden, as in {len(failed)} of {cases} cases"
    raise InputError("E-MAKE-UNNAMED", f"{fault}; {ATTEMPTS} patterns tried; another --seed or more --circles needed")


def _up_to(step: float, value: float) -> float:
    """Returns the next multiple of ``step``."""
    return float(np.ceil(value / step - 1e-9) * step)


def _board(options: DesignOptions, least_mm: float) -> BoardDesign:
    pitch = _up_to(PITCH_STEP_MM, max(PITCH_SHARE * max(options.size_mm), 4 * least_mm))
    camera, (width, _, depth) = options.ideal_camera(), options.size_mm
    beside = FIELD_SHARE * options.distance_mm * camera.width / camera.focal[0] - np.hypot(width, depth)
    while pitch * COLUMNS > beside and pitch - PITCH_STEP_MM >= 4 * least_mm:
        pitch -= PITCH_STEP_MM
    plain = BoardDesign(ROWS, COLUMNS, pitch, pitch / 4, options.polarity, BOARD_SIGMA_MM)
    return replace(plain, corner=(0, COLUMNS - 1), corner_radius_mm=1.5 * pitch / 4)


def made_text(made: Made) -> str:
    """Returns a text that describes the target and how well its faces are told apart."""
    options, target, alike = made.options, made.target, made.likeness
    radii = f"radius {made.radius_mm:g} and {LARGE * made.radius_mm:g} mm"
    return (
        f"{target.name}: {len(target.faces)} faces of {options.circles} circles, {radii}, {target.polarity}\n"
        f"smallest radius that is seen well at {options.distance_mm:g} mm: {made.least_mm:.2f} mm\n"
        f"a face has {f'at most {alike} of its circles' if alike else 'never four circles'} in common with another "
        "face, a mirror image or itself turned\n"
        f"named with any {HIDDEN} circles hidden: {made.cases} of {made.cases} cases"
    )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DesignedTarget(Brief):
    """A target that was designed.

    ``target``, ``board`` : the designs, no board of a body of tags; ``forecast`` : the σ to expect, None where a group
    is not linked with so few images, for the ``reason``; ``source`` : of the σ of its centres; ``made`` : how the
    circles were chosen, None of tags; ``files`` : those that were written.
    """

    target: TargetDesign
    board: BoardDesign | None
    forecast: Plan | None
    reason: str
    source: str
    made: Made | None
    files: tuple[Path, ...]


@require_arguments
def design_target(
    options: DesignOptions, images: int = 10, out: str | Path | None = None, progress: Progress | None = None
) -> DesignedTarget:
    """Returns a target of circles for a box, whose faces are told apart with any three circles hidden, and its σ.

    Parameters
    ----------
    options : Box, circles and camera.
    images : Number of images of each group in the forecast.
    out : Folder for ``target.toml`` and ``board.toml``. A ``board.toml`` that is there is kept, and forecast with.
        Nothing is written if None.
    progress : Called with (stage, done, total).

    Returns
    -------
    DesignedTarget : ``target`` and ``board``, mm; ``forecast`` with the σ to expect of every face, mm and rad.

    Raises
    ------
    InputError
        Circles are too small or too large for the camera, too few or without room, a face is not told apart, or
        ``target.toml`` exists.
    """
    folder = _free(out)
    kept = folder / "board.toml" if folder and os.path.lexists(folder / "board.toml") else None
    board = load_dots(kept) if kept else None
    made = make_target(options, progress and partial(progress, "patterns"))  # type: ignore[arg-type]
    noise, source = expected_noise()
    same = {name: getattr(options, name) for name in ("distance_mm", "width", "camera", "seed")}
    session = PlanOptions(images=images, noise=noise, **same)
    forecast = plan(session, made.target, board or made.board, made.target.rough_poses())
    files = _saved(folder, made.target, None if kept else made.board)
    return DesignedTarget(made.target, board or made.board, forecast, "", source, made, files)


@require_arguments
def design_tag_body(
    kind: Body,
    size_mm: float,
    dictionary: str = "APRILTAG_36h11",
    first_id: int = 0,
    session: PlanOptions | None = None,
    out: str | Path | None = None,
    faces: str = "",
) -> DesignedTarget:
    """Returns a cube or dodecahedron with a tag on each face, or on some, and its σ.

    Parameters
    ----------
    kind : The body.
    size_mm : Width between opposite faces, mm.
    dictionary : Dictionary of the tags.
    first_id : Id of the first tag, from which they count up.
    session : Photographs of the forecast: ``images``, ``distance_mm``, ``width`` or ``camera``, and ``seed``.
    out : Folder for ``target.toml``; nothing is written if None.
    faces : Ids of the faces with a tag, such as ``1,2,3,4,5``; all of them if empty.

    Returns
    -------
    DesignedTarget : ``target``, mm; ``forecast`` with the σ to expect of every face, mm and rad, or the ``reason`` why
        there is none.

    Raises
    ------
    InputError
        The size is not within 1 mm and 100 m, a tag or a face does not exist, ``target.toml`` exists, or the body does
        not fit into the image.
    """
    require_size([size_mm])
    folder = _free(out)
    target, (noise, source) = tag_body(kind, size_mm, dictionary, first_id, faces), expected_noise(of_corners=True)
    forecast, reason = None, ""
    try:
        forecast = plan(replace(session or PlanOptions(), noise=noise), target, None, target.rough_poses())
    except InputError as error:
        if error.code != "E-PLAN-UNLINKED":
            raise
        reason = str(error)
    return DesignedTarget(target, None, forecast, reason, source, None, _saved(folder, target, None))


def _free(out: str | Path | None) -> Path | None:
    """Returns the folder for the files, in which there must be no target yet."""
    if out is not None and os.path.lexists(Path(out) / "target.toml"):
        fault = f"{Path(out) / 'target.toml'}: exists"
        raise InputError("E-OUTPUT-EXISTS", f"{fault}; move it away, or give another folder")
    return None if out is None else Path(out)


def _saved(folder: Path | None, target: TargetDesign, board: BoardDesign | None) -> tuple[Path, ...]:
    if folder is None:
        return ()
    save_target(folder / "target.toml", target)
    if board is None:
        return (folder / "target.toml",)
    save_board(folder / "board.toml", board)
    return folder / "target.toml", folder / "board.toml"
