"""Observability of X from a set of poses: the axes about which the flange turned, and the motion that is missing."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.arrays import freeze
from stcal.handeye.data.pose_pairs import FRAMES, Loop, Setup
from stcal.io.table import LENGTHS, UNIT_WORDS

UNITS = {words: LENGTHS[unit] for unit, words in UNIT_WORDS.items()}
SAME_UNIT = 0.05
"""Largest difference of logarithms between a size and the ratio of two units that it is taken for."""
LARGEST_SCALE = 5.0
"""Largest plausible factor between a board's real and stated size; a larger one is an error of the unit."""
SCALE_SEEN = 36.0
"""Information on a scale, per pose, above which the scale counts as observed. Errors of the camera's translations alone
look like an information of three per pose; at this limit the scale is too small by that share, a twelfth."""
COMMON_RAD, COMMON_MM = 1e-3, 0.5
"""σ of the poses of a common camera at half a metre, by which the usefulness of a set of poses is judged."""
USELESS_RAD, USELESS_MM = np.radians(5), 50.0
"""σ of a hand-eye transform from such poses, beyond which the transform is not worth having."""
WANTED_DEG = 30
"""Size of rotations between poses that makes σ of X's translation about that of a pose."""
LEAST_TURN = np.radians(5)
"""Smallest RMS rotation of a robot of four axes."""
LEAST_POSES = 3
MOST_PAIRS = 100_000
"""Number of pairs of poses from which the principal axes are computed, drawn at random from 450 poses on."""


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Measures of how well a loop of m poses determines X.

    ``turns_rad`` : (3,) RMS rotations between poses about ``axes``, in descending order: singular values of the stacked
    log R_A over √(number of motions). The second one is 0 where all axes are parallel: X then slides along the axis.
    ``axes`` : (3, 3) rows: the principal axes of all rotations, in the flange's frame; ``mount_axis`` : (3,) the first
    principal axis in the mount's frame; ``sigma_rad``, ``sigma_mm`` : σ of the worst direction of X from poses of a
    common camera (:data:`COMMON_RAD`, :data:`COMMON_MM`); infinite where it is not determined.
    """

    turns_rad: np.ndarray
    axes: np.ndarray
    mount_axis: np.ndarray
    sigma_rad: float
    sigma_mm: float

    def __post_init__(self):
        for name, shape in (("turns_rad", (3,)), ("axes", (3, 3)), ("mount_axis", (3,))):
            freeze(self, name, shape, name)

    @classmethod
    def of(cls, loop: Loop) -> "Observability":
        """Returns the observability of a loop of at least two poses. X itself is not needed."""
        flange = loop.stand_from_mount.rotation
        base_from_flange = np.swapaxes(flange, 1, 2) if loop.inverted else flange
        turns, axes = _principal(np.swapaxes(base_from_flange, 1, 2))  # flange_j_from_flange_i
        mount_axis = _principal(base_from_flange)[1][0] if loop.inverted else axes[0]
        sigma_rad, sigma_mm = _worst(loop)
        return cls(turns, axes, mount_axis, sigma_rad, sigma_mm)

    @property
    def useless(self) -> bool:
        """True if no estimate of X from these poses is worth having."""
        return self.sigma_rad > USELESS_RAD or self.sigma_mm > USELESS_MM

    @property
    def one_axis(self) -> bool:
        """True if rotations about a second axis are missing."""
        return bool(self.turns_rad[1] < 0.1 * self.turns_rad[0])

    def missing(self) -> str:
        """Returns the motion that would help, in words."""
        turns, first = np.degrees(self.turns_rad), in_words(self.axes[0])
        if self.one_axis and self.turns_rad[0] > LEAST_TURN:
            return (
                f"all rotations of the flange are about its axis {first}, only {_list(turns[1:2])}° (RMS) about "
                f"others; rotate the flange about {in_words(self.axes[1])} too, by {WANTED_DEG}° or more"
            )
        return (
            f"the flange turns by {np.linalg.norm(turns):.2g}° (RMS) between poses; "
            f"rotate the flange about {first} and about {in_words(self.axes[1])}, by {WANTED_DEG}° or more each"
        )


def check(loop: Loop, setup: Setup, where: str, four_dof: bool) -> Observability:
    """Returns the observability of a loop. Raises DegenerateError: fewer than three poses, rotations about one axis
    only (unless ``four_dof``), or none."""
    if len(loop) < LEAST_POSES:
        raise DegenerateError(
            "E-HANDEYE-FEW-POSES",
            f"{where}: {len(loop)} poses, {LEAST_POSES} needed and 10 wanted; rotate the flange about two axes of its "
            f"own, by {WANTED_DEG}° or more, and take more",
        )
    observability = Observability.of(loop)
    if four_dof:
        fault = ""
        if observability.turns_rad[0] < LEAST_TURN:
            fault = f"; rotate it about {in_words(observability.axes[0])} by {WANTED_DEG}° or more"
        elif not observability.one_axis:
            fault = ", but a robot with four axes turns about one axis only; leave --four-dof (in Python four_dof) out"
        if fault:
            turns = f"{_list(np.degrees(observability.turns_rad))}° (RMS)"
            raise DegenerateError("E-HANDEYE-AXES", f"{where}: the flange turns by {turns} about principal axes{fault}")
    elif observability.useless:
        slides = "; a robot with four axes cannot: with --four-dof (in Python four_dof) all but "
        slides += f"{FRAMES[setup].camera} along that axis is determined"
        raise DegenerateError(
            "E-HANDEYE-AXES", f"{where}: {observability.missing()}{slides if observability.one_axis else ''}"
        )
    return observability


def scale_is_seen(scale: float, sigma: float, poses: int) -> bool:
    """True if a scale that was solved for with this σ is larger than noise alone would make it."""
    return scale > 0 and (scale / sigma) ** 2 > SCALE_SEEN * poses


def require_scale(scale: float, sigma: float, loop: Loop, where: str) -> None:
    """Refuse a scale that is implausible or that the motions leave open; the DegenerateError says how far to move."""
    if scale_is_seen(scale, sigma, len(loop)):
        if not 1 / LARGEST_SCALE < scale < LARGEST_SCALE:
            said = f"{where}: the board would be {scale:.4g} times as large as stated{unit_of(scale)}"
            raise DegenerateError("E-HANDEYE-BOARD-SCALE", f"{said}; correct the unit of its size, or of the poses")
        return
    place = (loop.stand_from_mount.inverse() if loop.inverted else loop.stand_from_mount).translation
    moved = float(np.sqrt(((place - place.mean(0)) ** 2).sum(1).mean()))
    raise DegenerateError(
        "E-HANDEYE-BOARD-SCALE",
        f"{where}: the board's size is {scale:.2g} ± {sigma:.2g} times as stated by the motions of the flange, which "
        f"moves by {moved:.3g} mm (RMS): too little to tell; move it by a tenth of the board's distance or more, or "
        "solve without the scale",
    )


def unit_of(scale: float) -> str:
    """Returns the words for a scale that looks like the ratio of two units; empty for any other scale."""
    for unit, factor in UNITS.items():
        if abs(np.log(scale / factor)) < SAME_UNIT:
            return f", as if its lengths were in {unit}"
        if abs(np.log(scale * factor)) < SAME_UNIT:
            return f", as if the robot's were in {unit}"
    return ""


def _principal(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns RMS angles (3,) about principal axes (3, 3), in rows, of R_j R_iᵀ of all pairs of rotations (m, 3, 3)."""
    i, j = np.triu_indices(len(rotations), 1)
    if len(i) > MOST_PAIRS:
        some = np.random.default_rng(0).choice(len(i), MOST_PAIRS, replace=False)
        i, j = i[some], j[some]
    logs = Rotation.from_matrix(rotations[j] @ np.swapaxes(rotations[i], 1, 2)).as_rotvec()
    square, axes = np.linalg.eigh(logs.T @ logs / len(logs))
    turns, axes = np.sqrt(np.maximum(square[::-1], 0)), axes.T[::-1]
    largest = np.abs(axes).argmax(1)
    return turns, axes * np.sign(axes[np.arange(3), largest])[:, None]


def _worst(loop: Loop) -> tuple[float, float]:
    """Returns the largest σ of X's rotation (rad), from rotations alone, and of its translation (mm) with the rotation
    known, from poses of a common camera. Both depend on how the robot turned, not on X."""
    turn = loop.stand_from_mount.rotation
    m, mean = len(turn), turn.mean(0)
    # Σ over poses of the information on w_X in R_G w_X − w_Z, with w_Z eliminated; the same for translations.
    information = np.maximum(np.linalg.eigvalsh(m * (np.eye(3) - mean.T @ mean))[0], 0)
    if information < 1e-12 * m:
        return np.inf, np.inf
    return float(COMMON_RAD / np.sqrt(information)), float(COMMON_MM / np.sqrt(information))


def in_words(axis: np.ndarray) -> str:
    """Returns a direction in words, to two digits."""
    return f"({_list(axis + 0.0)})"


def _list(values: np.ndarray) -> str:
    return ", ".join(f"{v:.2g}" if abs(v) >= 0.005 else "0" for v in values)
