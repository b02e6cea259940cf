"""What checks are made of: the evidence of a run; verdicts, each a test of significance (the probability of the worst
value by chance, times the number of values tested, after Bonferroni: one sound run in seventy shows something
suspicious); and culprits, named only if leaving them out cures the result, and leaving out another one does not.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtrc

from stcal.design import POINT_RADIUS_MM, BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.arrays import require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import by_pose
from stcal.geometry.robust import ratio_limit
from stcal.io.cameras.camera_model import CameraPrior
from stcal.labels import CircleLabel, Label
from stcal.sfm.adjust.calibration import AdjustOptions, Calibration, image_sigma_factors, with_sigma
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.adjust.refine import Network, ScoreTest, adjust, eccentricity_px, find_scale, free_network, solve_score
from stcal.sfm.adjust.rims import Rim, find_rims
from stcal.sfm.data.group_model import GroupModel, ImageObservations, Outlier, WorldModel
from stcal.sfm.report.check import CHECKS, FAILED, SUSPICIOUS, Check, TestedValue, Verdict

KNOWN = 1e9  # degrees of freedom of a σ that is stated, not estimated
MOST_ENLARGED = 3.0
"""Factor on σ up to which contradictions of parts of the photographs are errors that σ can cover, as differences
between laboratories are (Birge 1932, Phys. Rev. 40); beyond it something is wrong."""
MOST_SIGMAS = 4.0  # residuals over the centres' own σ from which the model does not describe the images
FREE = "free poses and points explain the images, whatever they show"  # why too few images test nothing
SHOWN = 8  # number of measurements that a check lists, the worst first
MICRO = 1e3


@dataclass(frozen=True, eq=False)
class Evidence:
    """Input of the checks."""

    models: tuple[WorldModel, ...]  # adjusted models of the single groups, without unit
    outliers: tuple[Outlier, ...]
    images: tuple[ImageObservations, ...]
    camera: Camera  # as given
    target: TargetDesign
    board: BoardDesign
    options: AdjustOptions
    calibration: Calibration
    prior: CameraPrior | None  # of the intrinsics if they were refined
    blur_px: dict[str, float]
    rim: bool = False  # whether rims are estimated for the result
    camera_given: bool = True  # False if the camera was found from the photographs
    cause: Check | None = None  # of the whole set if it is known already

    @cached_property
    def radius_mm(self) -> dict[Label, float]:
        """Radii of all circles and dots, without the corners of printed faces."""
        radius: dict[Label, float] = {**self.target.radius_of(), **self.board.radius_of()}
        return {label: value for label, value in radius.items() if value > POINT_RADIUS_MM}

    @cached_property
    def networks(self) -> list[Network]:
        """Free networks of all groups, mm, at the intrinsics of the result."""
        camera, models, scales = self.calibration.camera, self.models, self.calibration.scales
        if not camera.same_as(self.camera):
            models = tuple(adjust(model, camera) for model in models)
        factors = image_sigma_factors(models, camera, self.target.printed_ids())
        return [free_network(with_sigma(m.metric(scales[m.group].group_from_world()), factors), camera) for m in models]

    @property
    def joint(self) -> JointResult | None:
        """Result of the joint adjustment."""
        return self.calibration.joint

    @property
    def linked(self) -> list[Network]:
        """Free networks of the groups that the joint adjustment holds."""
        groups = {model.group for model in self.joint.models} if self.joint else ()
        return [network for network in self.networks if network.model.group in groups]

    @cached_property
    def rims(self) -> dict[str, Rim]:
        """Rims by kind of circle, as radii show them."""
        return find_rims(self.calibration.models, self.images, self.radius_mm, self.calibration.camera)

    @property
    def allowed_mm(self) -> Mapping[str, float | None]:
        """Heights of rims that the result allows for, by kind; None: the estimated one."""
        faces = list(self.target.rim_of().values())
        stated = {"circles": float(np.mean(faces)) if faces else 0.0, "dots": self.board.rim_mm}
        return dict.fromkeys(self.rims) if self.rim else stated

    @property
    def face_sigma_mm(self) -> float | None:
        """Largest σ of a face's position."""
        known = [np.sqrt(np.diag(c)[3:].max()) for c in self.calibration.target.face_covariance.values()]
        return float(max(known)) if known else None


@dataclass(frozen=True, slots=True)
class Trial:
    """One value to be tested.

    Parameters
    ----------
    name : Image, label, face, group …
    value : Value to show. It grows with the root of ``statistic`` (if ``ratio``, its logarithm does).
    unit : Of ``value``.
    statistic : By chance it follows χ² with ``freedom`` degrees of freedom: the square of a value over its σ, with 1.
    freedom : Degrees of freedom of ``statistic``.
    redundancy : Degrees of freedom with which its σ is estimated (F test); a stated σ if not given. If there are none,
        which is where images are so few that free poses and points explain them, nothing can be tested.
    ratio : Whether ``value`` is a ratio.
    """

    name: str
    value: float
    unit: str
    statistic: float
    freedom: int
    redundancy: float = KNOWN
    ratio: bool = False

    def __post_init__(self):
        require_fields(self, f"trial {self.name}", statistic=0, freedom=1)

    def limit(self, count: int) -> float | None:
        """Returns the value beyond which one of ``count`` values is suspicious."""
        if self.statistic <= 0:
            return None
        limit = self.freedom * ratio_limit(SUSPICIOUS / count, self.freedom, self.redundancy)
        grown = float(np.sqrt(limit / self.statistic))
        return float(self.value**grown) if self.ratio else abs(self.value) * grown


@require_arguments
def judge(
    key: str,
    title: str,
    trials: Sequence[Trial],
    what: str,
    remedy: str,
    worst: Verdict = "failed",
    covered: bool = False,
) -> Check:
    """Returns the check with its verdict over all trials.

    Parameters
    ----------
    key, title : As of :class:`Check`.
    trials : What is tested. The probability of the worst one by chance, times their number (Bonferroni), gives the
        verdict.
    what : Kind of thing tested, in the plural, for the reason.
    remedy : What to do if it is not passed.
    worst : Worst possible verdict, for faults that do no harm.
    covered : Whether σ of the result that are up to :data:`MOST_ENLARGED` times as large cover what is found. It is
        then suspicious, and enlarges them by the ratio of all values to their σ (Birge's), or of the worst to its
        limit.

    Returns
    -------
    Check : "not possible" without trials.
    """
    usable = [trial for trial in trials if trial.redundancy > 0]
    if not usable:
        reason, advice = (FREE, "add images") if trials else (f"no {what} to test", "")
        return Check(key, title, "not possible", reason, (), 0, (), advice)
    trials, count = usable, len(usable)
    statistic, freedom, redundancy = np.array([(t.statistic, t.freedom, t.redundancy) for t in trials], float).T
    probability = fdtrc(freedom, redundancy, statistic / freedom)
    order = np.lexsort([-statistic / freedom, probability])
    significant = [i for i in order if probability[i] * count < SUSPICIOUS]
    verdict: Verdict = "suspicious" if significant else "passed"
    if probability[order[0]] * count < FAILED:
        verdict = worst
    enlarges = 1.0
    if covered and significant:
        beyond = [abs(trials[i].value) / (trials[i].limit(count) or np.inf) for i in significant]
        ratio = max(float(np.sqrt(statistic.sum() / freedom.sum())), *beyond)
        verdict, enlarges = ("suspicious", ratio) if ratio <= MOST_ENLARGED else ("failed", 1.0)
    measured = tuple(
        TestedValue(trials[i].name, trials[i].value, trials[i].limit(count), trials[i].unit, float(probability[i]))
        for i in order[:SHOWN]
    )
    reason = f"{measured[0].name} at {measured[0].words()}"
    if count > 1 and significant:
        reason = f"{len(significant)} of {count} {what} beyond chance, first {reason}"
    elif count > 1:
        reason = f"{count} {what} within chance, largest {reason}"
    names = tuple(trials[i].name for i in significant)
    return Check(key, title, verdict, reason, measured, count, names, remedy if significant else "", enlarges)


def assess(key: str, trials: Sequence[Trial], what: str, remedy: str, *more: Verdict, covered: bool = False) -> Check:
    """Returns :func:`judge` of a check that the package makes, by its title in :data:`CHECKS`."""
    return judge(key, CHECKS[key][0], trials, what, remedy, *more, covered=covered)


MOST = 0.5  # share of the suspects from which they are no culprits: either part may be the wrong one
MIN_REDUNDANCY = 30.0
"""Smallest redundancy of the circles of the faces, and of the dots, whose residuals tell whether they agree."""
MOVED = "the target moved relative to the board"
MOVED_REMEDY = "sort the images into groups in which nothing moved, or take them again"


@dataclass(frozen=True, slots=True)
class Guilt:
    """Result of a search among suspects, which are the images of a group, or groups."""

    where: str  # what the suspects are in, for sentences
    # smallest set without which the result is sound; empty if another set cures it too, or half are needed
    culprits: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()  # suspects of which leaving out any one cures the result

    def words(self) -> str:
        """Returns why no culprit is named, empty if one is."""
        why = "less than half of them does not cure it"
        if self.rivals:
            why = f"{' or '.join(self.rivals)} cures it as well"
        return "" if self.culprits else f"{self.where}: leaving out {why}"


def culprits(names: Sequence[str], worst: Callable[[Collection[int]], int | None], where: str) -> Guilt:
    """Culprits; ``worst`` gives whom the others contradict most if some are left out, None if all is sound."""
    out: list[int] = []
    while (next_one := worst(out)) is not None:
        out.append(next_one)
        if len(out) >= MOST * len(names):
            return Guilt(where)
    for i in list(out):  # one that was taken first may be innocent
        if len(out) > 1 and worst([k for k in out if k != i]) is None:
            out.remove(i)
    others = [j for j in range(len(names)) if j not in out]
    cures = [(i, j) for i in out for j in others if worst([j if k == i else k for k in out]) is None]
    if cures:
        return Guilt(where, rivals=tuple(names[k] for k in sorted({k for pair in cures for k in pair})))
    return Guilt(where, tuple(names[i] for i in out))


def weight_beside(covariance: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Returns the weight matrix (k, k) of values in which ``free`` (k, f), directions of further unknowns, weigh 0."""
    inverse = np.linalg.inv(covariance)
    along = inverse @ free
    return inverse - along @ np.linalg.solve(free.T @ along, along.T)


def on_face(model: GroupModel) -> np.ndarray:
    """Returns which points of a model are those of faces, (p,)."""
    return np.array([isinstance(label, CircleLabel) for label in model.labels])


def by_motion(network: Network, centre: np.ndarray) -> np.ndarray:
    """Returns the derivatives (n, 2, 6) over σ by a motion of all faces together about a ``centre`` (3,)."""
    model = network.model
    of_faces = network.by_point * on_face(model)[model.point_index][:, None, None]
    return by_pose(of_faces, model.xyz_model[model.point_index] - centre)


NO_ELLIPSES = (
    "centres do not move as those of ellipses: check radii, polarity and exposure; centroids need another method"
)


def by_eccentricity(network: Network) -> np.ndarray:
    """Returns the derivatives (n, 2, 1) over σ by a factor on the eccentricity."""
    return network.model.whiten(network.model.shift_px[:, :, None])


def apart(network: Network, columns: np.ndarray) -> np.ndarray:
    """Returns columns (n, 2, q) of parameters with separate ones for each image, (n, 2, mq)."""
    n, _, q = columns.shape
    by_image = np.zeros((n, 2, len(network.model.images), q))
    by_image[np.arange(n), :, network.model.image_index] = columns
    return by_image.reshape(n, 2, -1)


def culprits_by_score(network: Network, columns: np.ndarray, suspects: Sequence[int], count: int, where: str) -> Guilt:
    """Returns the images that further parameters, ``columns`` (n, 2, q) over σ, cure, of ``count`` values tested."""
    q = columns.shape[2]
    normal, right = network.score(apart(network, columns))
    redundancy, square = float(network.redundancy.sum()), float((network.residual**2).sum())

    def explained(out: Collection[int]) -> ScoreTest:
        own = (q * np.array(sorted(out), int)[:, None] + np.arange(q)).ravel()
        return solve_score(normal[np.ix_(own, own)], right[own])

    def worst(out: Collection[int]) -> int | None:
        taken, gains = explained(out), {}
        for i in (i for i in suspects if i not in out):
            both = explained([*out, i])
            gain, free = both.statistic - taken.statistic, both.freedom - taken.freedom
            if free > 0:
                rest = max(redundancy - both.freedom, 1.0)
                noise = max((square - both.statistic) / rest, 1.0)
                if fdtrc(free, rest, gain / noise / free) * count < SUSPICIOUS:
                    gains[i] = gain
        return max(gains, key=lambda i: gains[i], default=None)

    return culprits(network.model.images, worst, where)


def moved_apart(model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign) -> bool:
    """Whether contradicting observations of a group agree if faces and board are taken by themselves: then the camera
    is right, and target and board moved relative to each other."""
    of_faces = on_face(model)[model.point_index]
    radius = {**target.radius_of(), **board.radius_of()}
    try:
        shift = eccentricity_px(model, camera, radius, find_scale(model, board).mm_per_unit)
        corrected = replace(model, shift_px=shift)
        parts = [free_network(adjust(corrected.without(drop), camera), camera) for drop in (of_faces, ~of_faces)]
    except (StcalError, ValueError):
        return False
    return all(n.redundancy.sum() > MIN_REDUNDANCY and n.noise() < MOST_SIGMAS**2 for n in parts)
