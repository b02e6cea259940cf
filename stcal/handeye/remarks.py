"""What the poses determine, remarks on poses and solutions, and the verdict that rests on the findings."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, StcalError
from stcal.geometry.arrays import freeze
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pose_pairs import FRAMES, Loop, Setup
from stcal.handeye.methods.closed_form import robust
from stcal.handeye.methods.pose_adjustment import Noise, adjust_poses
from stcal.io.table import LENGTHS, UNIT_WORDS
from stcal.report.document import Answer
from stcal.row_order import change_along

UNITS = {words: LENGTHS[unit] for unit, words in UNIT_WORDS.items()}
SAME_UNIT = 0.05  # largest difference of logarithms between a size and the ratio of two units that it is taken for
LARGEST_SCALE = 5.0
"""Largest plausible factor between a board's real and stated size; a larger one is an error of the unit."""
SCALE_SEEN = 36.0
"""Information on a scale, per pose, above which the scale counts as observed. Errors of the camera's translations alone
look like an information of three per pose; at this limit the scale is too small by that share, a twelfth."""
COMMON_RAD, COMMON_MM = 1e-3, 0.5
"""σ of the poses of a common camera at half a metre, by which the usefulness of a set of poses is judged."""
USELESS_RAD = np.radians(5)
"""σ of a hand-eye rotation from such poses beyond which the transform, then at least 44 mm off, is not worth having."""
WANTED_DEG = 30  # size of rotations between poses that makes σ of X's translation about that of a pose
LEAST_TURN = np.radians(5)  # smallest RMS rotation of a robot of four axes
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
        flange, base_from_flange = loop.stand_from_mount.rotation, loop.base_from_flange.rotation
        turns, axes = _principal(np.swapaxes(base_from_flange, 1, 2))  # flange_j_from_flange_i
        mount_axis = _principal(base_from_flange)[1][0] if loop.inverted else axes[0]
        # Σ over poses of the information on w_X in R_G w_X − w_Z, with w_Z eliminated; the same for translations with
        # the rotation known. It depends on how the robot turned, not on X.
        m, mean = len(flange), flange.mean(0)
        information = np.maximum(np.linalg.eigvalsh(m * (np.eye(3) - mean.T @ mean))[0], 0)
        size = np.sqrt(information) if information >= 1e-12 * m else 0.0
        sigma_rad, sigma_mm = (float(sigma / size) if size else np.inf for sigma in (COMMON_RAD, COMMON_MM))
        return cls(turns, axes, mount_axis, sigma_rad, sigma_mm)

    @property
    def useless(self) -> bool:
        """True if no estimate of X from these poses is worth having."""
        return self.sigma_rad > USELESS_RAD

    @property
    def one_axis(self) -> bool:
        """True if rotations about a second axis are missing."""
        return bool(self.turns_rad[1] < 0.1 * self.turns_rad[0])

    def missing(self) -> str:
        """Returns the motion that would help, in words."""
        turns, first = np.degrees(self.turns_rad), in_words(self.axes[0])
        if self.one_axis and self.turns_rad[0] > LEAST_TURN:
            said = f"all rotations of the flange are about its axis {first}, only {_list(turns[1:2])}° (RMS) about"
            return f"{said} others; rotate the flange about {in_words(self.axes[1])} too, by {WANTED_DEG}° or more"
        said = f"the flange turns by {np.linalg.norm(turns):.2g}° (RMS) between poses; rotate the flange about {first}"
        return f"{said} and about {in_words(self.axes[1])}, by {WANTED_DEG}° or more each"


def check(loop: Loop, where: str, four_dof: bool) -> Observability:
    """Returns the observability of a loop. Raises DegenerateError: fewer than three poses, rotations about one axis
    only (unless ``four_dof``), or none."""
    if len(loop) < LEAST_POSES:
        said = f"{where}: {len(loop)} poses, {LEAST_POSES} needed and 10 wanted; rotate the flange about two axes of "
        said += f"its own, by {WANTED_DEG}° or more, and take more"
        raise DegenerateError("E-HANDEYE-FEW-POSES", said)
    seen, fault = Observability.of(loop), ""
    if not four_dof and seen.useless:
        slides = "; a robot with four axes cannot: with --four-dof (in Python four_dof) all but "
        slides += f"{FRAMES[loop.setup].camera} along that axis is determined"
        raise DegenerateError("E-HANDEYE-AXES", f"{where}: {seen.missing()}{slides if seen.one_axis else ''}")
    if four_dof and seen.turns_rad[0] < LEAST_TURN:
        fault = f"; rotate it about {in_words(seen.axes[0])} by {WANTED_DEG}° or more"
    elif four_dof and not seen.one_axis:
        fault = ", but a robot with four axes turns about one axis only; leave --four-dof (in Python four_dof) out"
    if fault:
        turns = f"{_list(np.degrees(seen.turns_rad))}° (RMS)"
        raise DegenerateError("E-HANDEYE-AXES", f"{where}: the flange turns by {turns} about principal axes{fault}")
    return seen


def motions_missing(base_from_flange: Poses, setup: Setup) -> list[str]:
    """Returns a line on the motions that are missing, where the poses cannot determine the transform."""
    try:
        check(Loop(base_from_flange, base_from_flange, setup), "motions", False)
    except DegenerateError as error:
        return [str(error)]
    return []


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
    place = loop.base_from_flange.translation
    moved = float(np.sqrt(((place - place.mean(0)) ** 2).sum(1).mean()))
    said = f"{where}: the board's size is {scale:.2g} ± {sigma:.2g} times as stated by the motions of the flange, "
    said += f"which moves by {moved:.3g} mm (RMS): too little to tell; move it by a tenth of the board's distance or "
    said += "more, or solve without the scale"
    raise DegenerateError("E-HANDEYE-BOARD-SCALE", said)


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


def in_words(axis: np.ndarray) -> str:
    """Returns a direction in words, to two digits."""
    return f"({_list(axis + 0.0)})"


def _list(values: np.ndarray) -> str:
    return ", ".join(f"{v:.2g}" if abs(v) >= 0.005 else "0" for v in values)


Word = Literal["good", "use with care", "do not use"]
GOOD, CARE, BAD = get_args(Word)


@dataclass(frozen=True, slots=True)
class Finding:
    """Verdict on one matter.

    Parameters
    ----------
    title : name of the matter
    word : {"good", "use with care", "do not use"}, the verdict
    said : what was found, in words
    value, limit : what was measured, and the limit of ``good``; empty where there is none
    remedy : what to do; empty where nothing has to be done
    """

    title: str
    word: Word
    said: str
    value: str = ""
    limit: str = ""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a calibration.

    Parameters
    ----------
    findings : in the order in which they were made
    """

    findings: tuple[Finding, ...]

    @property
    def word(self) -> Word:
        """The worst word of all findings."""
        return max(self.findings, key=lambda each: get_args(Word).index(each.word)).word

    def reasons(self) -> list[Finding]:
        """Returns the findings behind the word: all that are not good, the worst first; or all if all are good."""
        doubts = [each for each in self.findings if each.word != GOOD]
        return sorted(doubts, key=lambda each: each.word != BAD) or list(self.findings)

    def failed(self) -> list[str]:
        """Returns the reasons against use of the calibration."""
        return [each.said for each in self.findings if each.word == BAD]

    def remedies(self) -> list[str]:
        """Returns what to do against the reasons for a doubt, each once."""
        return list(dict.fromkeys(each.remedy for each in self.reasons() if each.remedy))

    def sentence(self) -> str:
        """Returns the word and its reasons in one line."""
        return f"{self.word}: {self._why()}"

    def doubt(self) -> str:
        """Returns the answer that is not yes; empty for a good calibration."""
        return "" if self.word == GOOD else self.answer().lines()[0]

    def answer(self) -> Answer:
        """Returns the answer at the head of a report; the first finding alone where all are good."""
        why = self.findings[0].said if self.word == GOOD else self._why()
        return Answer(dict(zip(get_args(Word), ("yes", "with care", "no"), strict=True))[self.word], why)

    def _why(self) -> str:
        return "; ".join(each.said for each in self.reasons())


Remarks = tuple[str, ...]  # notes on a result, one line each


class Grave(str):
    """A note that says that the result is wrong, or answers another question."""


class Aside(str):
    """A note that does not weaken the result, or whose subject the verdict judges itself."""


class SizeDoubt(Grave):
    """A note that the board's size differs from the stated one, which an offset of the clocks can also cause."""


SIZE_SIGMAS, SIZE_SHARE = 4.0, 1e-3
"""Number of σ, and relative deviation, beyond which a board's size is doubted; the latter is 0.5 mm at half a metre."""
HINTED = 2.0
"""Number of σ by which one step must change the scale before it is solved for. The limit is low, since a wrong size
inflates these σ, and with few poses all of them."""
MANY = 0.25  # share of bad poses above which something else is suspected
LEAST_IN_GROUPS, APART = 10, 0.9
"""Least number of poses, and the share of their scatter along its main direction that two groups must explain. Two
halves of normal errors explain 0.64 (2/π), and at most 0.8 of a dozen of them."""
MOVED_LEVEL, MOVED_SHARE = 0.01, 0.5
SURE_LEVEL, SURE_SHARE = 1e-6, 0.25
"""Probability that a move along the order of sound poses is named, and least share of the squares that it explains;
the same where each pose is at a place of its own, so that errors common to a place are no move."""
HALL_MM = 5e4
"""Distance from base to flange, or from camera to board, in mm, beyond which lengths are in too small a unit."""
NEAR_MM = 20.0  # distance, in mm, below which no camera sees a board


def spoken(name: str) -> str:
    """Returns the name of a pose for a sentence: ``pose 2`` for a bare number."""
    return f"pose {name}" if name.isdigit() else name


def of_outliers(names: tuple[str, ...], outliers: np.ndarray, residuals: np.ndarray) -> Remarks:
    """Returns a note on each pose that was left out, by residuals (m, 6)."""
    notes: list[str] = []
    for i in np.flatnonzero(outliers):
        turn, shift = np.degrees(np.linalg.norm(residuals[i, :3])), np.linalg.norm(residuals[i, 3:])
        said = f"{spoken(names[i])} contradicts the others, by {turn:.2g}° and {shift:.2g} mm, and was left out"
        notes.append(Aside(said))
    return tuple(notes)


def of_groups(names: tuple[str, ...], residuals: np.ndarray) -> Remarks:
    """Returns a note if poses with residuals (m, 6) fall into two groups, as when a board is moved in between."""
    if len(names) < LEAST_IN_GROUPS:
        return ()
    for columns, unit, word in ((slice(0, 3), np.degrees(1.0), "°"), (slice(3, 6), 1.0, " mm")):
        centred = residuals[:, columns] - residuals[:, columns].mean(0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        order, m = np.argsort(along), len(along)
        first = np.arange(max(3, m // 5), m - max(3, m // 5) + 1)
        between = np.cumsum(along[order])[first - 1] ** 2 * (1 / first + 1 / (m - first))
        if between.max() > APART * (along @ along):
            k = int(first[between.argmax()])
            one, two = sorted((sorted(order[:k].tolist()), sorted(order[k:].tolist())))
            gap = abs(along[one].mean() - along[two].mean()) * unit
            said = f"the poses fall into two groups that are {gap:.2g}{word} apart, {len(one)} with {names[0]} and "
            said += f"{len(two)} with {names[two[0]]}: was board or camera moved in between? solve each separately"
            return (said,)
    return ()


def of_order(names: tuple[str, ...], residuals: np.ndarray, jacobian: np.ndarray, apart: bool) -> Remarks:
    """Returns a note if camera or board moved or drifted, by residuals (m, 6) of all in order, and their jacobian (m,
    6, 12). A move must explain most of the residuals, or be beyond chance where the poses are ``apart``."""
    sigma = np.repeat(np.median(np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2), axis=0), 3)
    if not (sigma > 0).all():
        return ()
    white = jacobian / sigma[:, None]
    moves = {"the camera": white[:, :, :6], "the board": white[:, :, 6:]}
    changes = ((what, change_along(residuals / sigma, white, motions)) for what, motions in moves.items())
    found = [(what, change) for what, change in changes if change is not None]
    if not found:
        return ()
    what, change = min(found, key=lambda each: each[1].log_p)
    level, share = (SURE_LEVEL, SURE_SHARE) if apart and change.share < MOVED_SHARE else (MOVED_LEVEL, MOVED_SHARE)
    if len(moves) * change.p > level or change.share < share:
        return ()
    turn, shift = np.degrees(np.linalg.norm(change.motion[:3])), np.linalg.norm(change.motion[3:])
    size = f"{shift:.2g} mm and {turn:.2g}° ({change.share:.0%} of the squared residuals)"
    if change.kind == "drift":
        return (f"{what} drifts from the first pose to the last, by {size}: fasten it, and take the poses again",)
    likely = f" ({names[change.first]} to {names[change.last]} as likely)" if change.first < change.last else ""
    before = f"{what} moved before {names[change.row]}{likely}, by {size}"
    return (f"{before}: solve the poses before it, and those from it on, separately",)


def of_size(loop: Loop, hint: tuple[float, float], noise: Noise) -> Remarks:
    """Returns a note if the board is of another size than stated. ``hint`` is the scale after one step, with its σ."""

    def other(scale: float, sigma: float, sigmas: float) -> bool:
        return abs(scale - 1) > max(sigmas * sigma, SIZE_SHARE)

    if not other(*hint, HINTED):
        return ()
    try:  # the hint comes from one large step, so the scale is solved for
        solution = adjust_poses(loop, robust(loop, with_scale=True), noise, with_scale=True)
    except StcalError:
        return ()
    scale, sigma = solution.state.scale, float(np.sqrt(generalised_inverse(solution.normal)[12, 12]))
    if not (other(scale, sigma, SIZE_SIGMAS) and scale_is_seen(scale, sigma, len(loop))):
        return ()
    unit = unit_of(scale)
    said = f"by the robot's motion the board is {scale:.4f} ± {sigma:.2g} times as large as stated{unit}: "
    said += "name the columns so, x_in …, or give --length-unit; if not, " if unit else ""
    return (SizeDoubt(f"{said}check its size and the camera file, or solve with the scale"),)


def of_distance(loop: Loop) -> Remarks:
    """Returns a note if all lengths are in another unit, which no equation shows."""
    away = float(np.median(np.linalg.norm(loop.camera_from_board.translation, axis=1)))
    if NEAR_MM <= away <= HALL_MM:
        return ()
    said, remedy = f"{away:.0f}", "lengths are in mm, name the columns x_mm …, or give the unit mm"
    if away < NEAR_MM:
        said, remedy = f"{away:.2g}", "lengths are in metres or inches, name the columns x_m … or x_in …, or give "
        remedy += "--length-unit m where none states a unit"
    return (Grave(f"the board is {said} mm from the camera (median): if {remedy}"),)


FAR_MM, TOO_FAR_MM = 600.0, 1000.0
"""Distances of a camera from its flange that are doubted, and called wrong unless the setup is stated."""
LONG_MM, NEARER = 250.0, 0.5
"""Distance of a camera from the flange, and share of it within which the board lies of the base's origin, from which
on the two seem to be exchanged: a board stands farther from the robot's base than a camera from its flange."""


def of_setup(x: Rigid, z: Rigid, setup: Setup, stated: bool = False) -> Remarks:
    """Returns a note if the camera is where no flange carries it, unless the setup was ``stated``, or if X and Z seem
    to be exchanged. Poses of the other setup, or exchanged or inverted sides, fit as well."""
    away, board = float(np.linalg.norm(x.translation)), float(np.linalg.norm(z.translation))
    exchanged = away > LONG_MM and board < NEARER * away
    if setup != "eye-in-hand" or not (exchanged or (away >= FAR_MM and not stated)):
        return ()
    why = f"and the board only {board:.0f} mm off the base's origin" if exchanged else "farther than brackets reach"
    said = (
        f"the camera is {away:.0f} mm off the flange, {why}, and residuals are the same in both setups: "
        f"{'name the columns x_mm … if lengths are mm that stand in columns of metres; ' if away > HALL_MM else ''}"
        "give --setup eye-to-hand if the camera stood beside the robot, --setup eye-in-hand if the flange carried it"
        + "; or the two sides are exchanged, or both are the inverses of what they are named: rename both, or give "
        "--poses-are" * exchanged
    )
    return (Grave(said) if away > TOO_FAR_MM and not stated else said,)
