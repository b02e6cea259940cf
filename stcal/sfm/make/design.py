"""Design of a target for a box and of a board for it, at random and verified, with circles that the camera sees
well."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign, Polarity
from stcal.errors import InputError
from stcal.geometry.camera import COEFFICIENTS, Camera
from stcal.io.cameras.model import CameraModel
from stcal.sfm.data.patterns import MAX_TILT_RAD
from stcal.sfm.detect.circles.candidates import EllipseOptions, diameter_limits_px
from stcal.sfm.make.box import NAMES, sides_of
from stcal.sfm.make.pattern import HIDDEN, LARGE, MadeTarget, make_pattern, unnamed_cases
from stcal.synthetic.scene import FOCAL_PER_WIDTH

FARTHER = 1.1
"""Largest distance of a camera, as a multiple of the stated distance."""
WELL_SEEN = 1.5
"""Least ratio of the smallest circle's diameter, where it is most tilted and farthest away, to the smallest diameter
that detection looks for."""
RADIUS_SHARE = 1 / 30
"""Default radius of the smaller circles, as a share of the box's shortest side."""
RADIUS_STEP_MM = 0.25
PITCH_SHARE = 0.23
"""Pitch of the board, as a share of the box's longest side. The board then reaches beyond the box on all sides."""
FIELD_SHARE = 0.8
"""Share of the width that the camera sees at the stated distance, in which box and board stand side by side."""
PITCH_STEP_MM = 5.0
ATTEMPTS = 8
"""Largest number of patterns drawn until one is identified in all cases."""
ROWS, COLUMNS = 7, 9
BOARD_SIGMA_MM = 0.02
"""Position error of dots that a good printer prints. A milled or photographic plate states its own."""


@dataclass(frozen=True, slots=True)
class MakeOptions:
    """Options of the design.

    ``size_mm`` : width, height, depth of the box; ``circles`` : number of circles per face; ``radius_mm`` : radius of
    the smaller circles, None to choose a suitable one; ``distance_mm`` : distance from the cameras; ``width`` : image
    width in px, for 3:2 images of a 24 mm lens; used only without ``camera``; ``faces`` : names of the sides with
    circles, the reference face first.
    """

    size_mm: tuple[float, float, float]
    circles: int = 10
    radius_mm: float | None = None
    distance_mm: float = 1000.0
    width: int = 5184
    camera: CameraModel | None = None
    polarity: Polarity = "dark"
    seed: int = 0
    faces: tuple[str, ...] = NAMES

    def ideal_camera(self) -> Camera:
        """Returns the camera without its distortion, or a default camera if none is given.

        Raises InputError if the camera file states no image size.
        """
        width, height = self.width, round(self.width * 2 / 3)
        focal = np.full(2, FOCAL_PER_WIDTH * width)
        if self.camera is not None:
            width, height, focal = self.camera.width, self.camera.height, self.camera.focal
        if not (width and height):
            raise InputError(
                "E-CAMERA-SIZE",
                f"camera file {self.camera and self.camera.source} states no image size; add it to the file",
            )
        return Camera(width, height, focal, [(width - 1) / 2, (height - 1) / 2], np.zeros(COEFFICIENTS))

    def least_radius_mm(self) -> float:
        """Returns the least radius of circles that are found even where they are farthest away and most tilted, with a
        margin."""
        camera = self.ideal_camera()
        least, _ = diameter_limits_px(camera.width * camera.height, EllipseOptions())
        px_per_mm = np.sqrt(camera.focal.prod()) / (FARTHER * self.distance_mm)
        return float(WELL_SEEN * least / (2 * px_per_mm * np.sqrt(np.cos(MAX_TILT_RAD))))


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """The designed target and board.

    ``radius_mm`` : radius of the smaller circles; ``least_mm`` : smallest radius that the camera sees well; ``cases`` :
    number of cases of hidden circles that were tried; the faces were identified in all of them.
    """

    options: MakeOptions
    pattern: MadeTarget
    board: BoardDesign
    radius_mm: float
    least_mm: float
    cases: int


def make_target(options: MakeOptions, progress: Callable[[int, int], None] | None = None) -> Made:
    """Returns a board, and a pattern for each side of the box that is to have one.

    ``options`` : MakeOptions; ``progress`` : called with (done, total), numbers of cases of hidden circles.

    Raises InputError if circles are too small or too large for the camera, too few, or without room, or if a face is
    not identified with some of its circles hidden.
    """
    least = options.least_radius_mm()
    radius = options.radius_mm
    if radius is None:
        suitable = max(least, RADIUS_SHARE * min(options.size_mm))
        radius = float(np.ceil(suitable / RADIUS_STEP_MM - 1e-9) * RADIUS_STEP_MM)
    if radius < least:
        raise InputError(
            "E-MAKE-RADIUS",
            f"--radius-mm {radius:g}: at {options.distance_mm:g} mm this camera sees circles well from {least:.2f} mm "
            "on; larger circles, a nearer camera or more pixels needed",
        )
    camera = options.ideal_camera()
    most = diameter_limits_px(camera.width * camera.height, EllipseOptions())[1]
    largest = 2 * LARGE * radius * float(np.sqrt(camera.focal.prod())) / options.distance_mm
    if largest * FARTHER > most:
        raise InputError(
            "E-MAKE-RADIUS",
            f"radius {LARGE * radius:g} mm is {largest:.0f} px in the image, at most {most / FARTHER:.0f} px are "
            "sought; smaller circles or a camera farther away needed",
        )
    pattern, cases = _named(options, radius, progress)
    return Made(options, pattern, _board(options, least), radius, least, cases)


def _named(
    options: MakeOptions, radius_mm: float, progress: Callable[[int, int], None] | None
) -> tuple[MadeTarget, int]:
    """Returns the first pattern whose faces are all identified in every case of hidden circles, and the number of
    cases."""
    name, sides = "box {:g} x {:g} x {:g} mm".format(*options.size_mm), sides_of(options.size_mm, options.faces)
    failed, cases = [], 0
    for attempt in range(ATTEMPTS):
        seed = [options.seed, attempt] if attempt else options.seed
        pattern = make_pattern(sides, options.circles, radius_mm, options.polarity, seed, name)
        failed, cases = unnamed_cases(pattern.target, options.ideal_camera(), options.distance_mm, HIDDEN, progress)
        if not failed:
            return pattern, cases
    face, hidden_ids = failed[0]
    raise InputError(
        "E-MAKE-UNNAMED",
        f"face {face}: not named with circles {', '.join(hidden_ids)} hidden, as in {len(failed)} of {cases} cases; "
        f"{ATTEMPTS} patterns tried; another --seed or more --circles needed",
    )


def _board(options: MakeOptions, least_mm: float) -> BoardDesign:
    pitch = max(PITCH_SHARE * max(options.size_mm), 4 * least_mm)
    pitch = float(np.ceil(pitch / PITCH_STEP_MM - 1e-9) * PITCH_STEP_MM)
    camera, (width, _, depth) = options.ideal_camera(), options.size_mm
    beside = FIELD_SHARE * options.distance_mm * camera.width / camera.focal[0] - np.hypot(width, depth)
    while pitch * COLUMNS > beside and pitch - PITCH_STEP_MM >= 4 * least_mm:
        pitch -= PITCH_STEP_MM
    plain = BoardDesign(ROWS, COLUMNS, pitch, pitch / 4, options.polarity, BOARD_SIGMA_MM)
    return replace(plain, corner=(0, COLUMNS - 1), corner_radius_mm=1.5 * pitch / 4)


def made_text(made: Made) -> str:
    """Returns a text that describes the target and how well its faces are told apart."""
    options, target = made.options, made.pattern.target
    large, alike = LARGE * made.radius_mm, made.pattern.likeness
    common = f"at most {alike} of its circles" if alike else "never four circles"
    return "\n".join(
        [
            f"{target.name}: {len(target.faces)} faces of {options.circles} circles, radius {made.radius_mm:g} and "
            f"{large:g} mm, {target.polarity}",
            f"smallest radius that is seen well at {options.distance_mm:g} mm: {made.least_mm:.2f} mm",
            f"a face has {common} in common with another face, a mirror image or itself turned",
            f"named with any {HIDDEN} circles hidden: {made.cases} of {made.cases} cases",
        ]
    )
