"""Default way of solving, where the user names none: the one with the smallest errors on held-out poses."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stcal.errors import DegenerateError, StcalError
from stcal.handeye.data.pairs import HandEyePoses, Setup
from stcal.handeye.data.views import Views
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.result import HandEye
from stcal.handeye.solve import HandEyeOptions, handeye
from stcal.handeye.validate import HeldOutPoses, errors_without, widened_by_scatter
from stcal.io.cameras.model import CameraPrior
from stcal.parallel import one_thread, run_parallel

FIRST_SPLITS = 5
"""Number of splits after which candidates that are surely worse than the best are given up."""
WORSE = 3.0
"""A candidate is surely worse if its mean error exceeds the best by so many standard errors of the difference."""
AS_GOOD = 1.0
"""Number of standard errors within which a candidate is as good as the best. Among these the one that trusts the files
most is taken (the one-standard-error rule of Breiman et al., "Classification and Regression Trees", 1984)."""
CONTRADICT = 0.01
"""Significance level: σ are widened if two answers differ so much that their σ explain it more rarely than this."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A way of solving: the ``method``, and whether intrinsics (``camera``) and the board's ``scale`` are unknowns."""

    method: str
    camera: bool = False
    scale: bool = False

    @property
    def name(self) -> str:
        """Name that is shown, such as ``reprojection + camera``."""
        return " + ".join([self.method, *["camera"] * self.camera, *["scale"] * self.scale])

    def in_words(self) -> str:
        """Returns the method, and what is solved for besides X and Z."""
        unknowns = [*["the intrinsics"] * self.camera, *["the board's size"] * self.scale]
        return f"{self.method} with {' and '.join(unknowns)} solved for" if unknowns else f"{self.method} as filed"

    def options(self, options: HandEyeOptions, prior: CameraPrior | None) -> HandEyeOptions:
        """Returns the options of this candidate. ``prior`` holds the intrinsics where they are solved for."""
        return replace(options, intrinsics=prior if self.camera else None, with_scale=self.scale)


BY_POSES = (Candidate("pose"), Candidate("pose", scale=True))
BY_VIEWS = (
    Candidate("reprojection"),
    Candidate("pose"),
    Candidate("reprojection", camera=True),
    Candidate("reprojection", scale=True),
    Candidate("pose", scale=True),
    Candidate("reprojection", camera=True, scale=True),
)
"""Candidates that are tried with corners; those that trust the files come first."""


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A candidate and its errors.

    ``error_mm`` : (s, k) errors on held-out poses, for the splits on which it was tried; ``reason`` : why it fails,
    empty if it does not; ``out`` : number of splits after which it was given up as surely worse, else 0; ``best_mm`` :
    mean error of the best candidate on these splits, NaN if it was not given up.
    """

    candidate: Candidate
    error_mm: np.ndarray
    reason: str = ""
    out: int = 0
    best_mm: float = float("nan")

    def mean_mm(self) -> float:
        """Returns the mean of all errors, or NaN if there are none."""
        return float(self.error_mm.mean()) if self.error_mm.size else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The candidates that were tried, and the one that was chosen.

    Parameters
    ----------
    tried : tuple of Tried
        All candidates, those that trust the files first.
    chosen : Candidate
        The candidate that was chosen.
    result : HandEye
        Its solution from all poses. Its σ are widened where another answer that predicts as well differs by more than
        the σ allow.
    held_out : HeldOutPoses
        Errors of the choice as a whole: in each split, of the candidate that the errors on all other poses choose.
    sentence : str
        The choice, what it gains, and what it says about camera file, board and robot.
    notes : tuple of str
        Notes on answers that contradict each other.
    """

    tried: tuple[Tried, ...]
    chosen: Candidate
    result: HandEye
    held_out: HeldOutPoses
    sentence: str
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class _Race:
    """The candidates while they are tried, split by split.

    ``errors`` : list of errors of each candidate, one entry per split; ``failed`` : reasons by candidate; ``out`` :
    candidates given up, with the number of splits and the mean error of the best candidate on these, mm.
    """

    pairs: HandEyePoses
    setup: Setup
    views: Views | None
    options: HandEyeOptions
    prior: CameraPrior | None
    rows: np.ndarray
    workers: int | None
    running: list[Candidate]
    errors: dict[Candidate, list[dict[str, np.ndarray]]] = field(default_factory=dict)
    failed: dict[Candidate, str] = field(default_factory=dict)
    out: dict[Candidate, tuple[int, float]] = field(default_factory=dict)

    @property
    def measure(self) -> str:
        """Name of the error of :class:`HeldOutPoses` that decides."""
        return "translation_mm" if self.views is None else "board_mm"

    def run(self, splits: range, progress: Callable[[int, int], None]) -> None:
        """Computes the errors of every running candidate on these splits. A candidate that fails leaves the race."""
        jobs, owners = [], []
        for candidate in self.running:
            options = candidate.options(self.options, self.prior)
            for k in splits:
                jobs.append((self.pairs, self.setup, candidate.method, self.views, options, self.rows[k]))
                owners.append((candidate, k))
        outcomes = {}
        for done, (i, errors) in enumerate(run_parallel(_tried, jobs, 1 if self.views is None else self.workers), 1):
            outcomes[owners[i]] = errors
            progress(done, len(jobs))
        for candidate in list(self.running):
            for k in splits:
                outcome = outcomes[candidate, k]
                if isinstance(outcome, str):
                    self.failed.setdefault(candidate, outcome)
                    break
                self.errors.setdefault(candidate, []).append(outcome)
        self.running = [candidate for candidate in self.running if candidate not in self.failed]

    def of(self, candidate: Candidate) -> np.ndarray:
        """Returns the candidate's errors so far, (s, k), mm."""
        return np.array([errors[self.measure] for errors in self.errors.get(candidate, [])])

    def give_up(self) -> None:
        """Gives up the candidates that are surely worse than the best."""
        if len(self.running) < 2:
            return
        rows = self.rows[: len(self.of(self.running[0]))]
        best = min(self.running, key=lambda running: self.of(running).mean())
        for candidate in [running for running in self.running if running != best]:
            mean, standard_error = _difference(self.of(candidate) - self.of(best), rows)
            if mean > WORSE * standard_error:
                self.out[candidate] = len(rows), float(self.of(best).mean())
        self.running = [candidate for candidate in self.running if candidate not in self.out]

    def best(self, but: np.ndarray | None = None) -> Candidate:
        """Returns the first candidate that is as good as the best, judged by the errors on all poses except ``but``."""
        rows = self.rows if but is None else np.where(np.isin(self.rows, but), -1, self.rows)
        if (rows < 0).all():  # a single split: no other poses were held out
            rows = self.rows
        mean = {each: float(self.of(each)[rows >= 0].mean()) for each in self.running}
        best = min(self.running, key=mean.__getitem__)
        for candidate in self.running:
            excess, standard_error = _difference(self.of(candidate) - self.of(best), rows)
            if excess <= AS_GOOD * standard_error:
                return candidate
        return best


def _tried(*job) -> dict[str, np.ndarray] | str:
    """Returns the errors by name, or the message if the solution fails."""
    try:
        return errors_without(*job)
    except StcalError as error:
        return str(error)


def _difference(off: np.ndarray, rows: np.ndarray) -> tuple[float, float]:
    """Returns the mean over poses of the differences ``off``, (s, k), and its standard error.

    ``rows`` : (s, k) numbers of the poses; entries below 0 are ignored.
    """
    valid = rows >= 0
    poses = np.unique(rows[valid])
    means = np.array([off[valid & (rows == pose)].mean() for pose in poses])
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means))) if len(means) > 1 else 0.0


@one_thread()
def choose(
    pairs: HandEyePoses,
    setup: Setup,
    views: Views | None,
    options: HandEyeOptions,
    prior: CameraPrior | None,
    rows: np.ndarray,
    workers: int | None = 1,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Choice:
    """Solves with camera and board as filed and with either as unknown, by poses and by corners; chooses the best.

    Errors on held-out poses decide: the 3-D error at the board if there are corners, else that of the board's origin.
    Candidates that are surely worse are given up after a few splits. Among the candidates that are as good as the best
    within one standard error, the one that trusts the files most is chosen.

    Parameters
    ----------
    pairs, setup, views, options
        See :func:`~stcal.handeye.handeye`; the scale and the intrinsics of ``options`` are overwritten.
    prior : CameraPrior, optional
        Prior of the intrinsics; they are never solved for if None.
    rows : (s, k) int array
        Poses to hold out in each split.
    workers : int or None
        Number of processes; as many as cores if None.
    progress : callable, optional
        Called with the number of solutions done, and the number of all solutions of the stage.

    Returns
    -------
    Choice

    Raises
    ------
    StcalError
        The first candidate, which trusts all files, fails; see :func:`~stcal.handeye.handeye`.
    """
    if options.symmetries:
        repaired = repair(pairs, setup, options.symmetries, views)
        pairs, views, options = repaired.pairs, repaired.views, replace(options, symmetries=())
    candidates = [each for each in (BY_POSES if views is None else BY_VIEWS) if prior is not None or not each.camera]
    plain = handeye(pairs, setup, candidates[0].method, views, candidates[0].options(options, prior))
    race = _Race(pairs, setup, views, options, prior, rows, workers, candidates)
    race.run(range(min(FIRST_SPLITS, len(rows))), progress)
    if race.running:
        race.give_up()
        race.run(range(min(FIRST_SPLITS, len(rows)), len(rows)), progress)
    if not race.running:
        raise DegenerateError("E-HANDEYE-NO-METHOD", race.failed[candidates[0]])
    chosen = race.best()
    errors_of_split = [race.errors[race.best(but=out)][k] for k, out in enumerate(rows)]
    held_out = HeldOutPoses(
        rows, **{name: np.array([each[name] for each in errors_of_split]) for name in errors_of_split[0]}
    )
    results = {candidates[0]: plain}
    for each in race.running:
        if each not in results:
            results[each] = handeye(pairs, setup, each.method, views, each.options(options, prior))
    not_given_up = (0, float("nan"))
    tried = tuple(
        Tried(each, race.of(each), race.failed.get(each, ""), *race.out.get(each, not_given_up)) for each in candidates
    )
    rivals = {each: results[each] for each in race.running if each != chosen and _as_good(race, each, chosen)}
    result, notes = _widened(widened_by_scatter(results[chosen], held_out), chosen, rivals)
    return Choice(tried, chosen, result, held_out, _sentence(tried, chosen, result, race.measure), notes)


def _as_good(race: _Race, candidate: Candidate, chosen: Candidate) -> bool:
    """True if the candidate predicts as well as the chosen one, within one standard error."""
    excess, standard_error = _difference(race.of(candidate) - race.of(chosen), race.rows)
    return excess <= AS_GOOD * standard_error


def _widened(result: HandEye, chosen: Candidate, rivals: dict[Candidate, HandEye]) -> tuple[HandEye, tuple[str, ...]]:
    """Widens σ until they cover the rivals, which predict as well. Returns the result, and notes on distant rivals."""
    if result.covariance is None:
        return result, ()
    factor, notes = 1.0, []
    for candidate, rival in rivals.items():
        if rival.covariance is None:
            continue
        pose, rival_pose = result.mount_from_camera, rival.mount_from_camera
        turn = Rotation.from_matrix(rival_pose.rotation @ pose.rotation.T).as_rotvec()
        gap = np.concatenate([turn, rival_pose.translation - pose.translation])
        squared = float(gap @ np.linalg.lstsq(result.covariance + rival.covariance, gap)[0])
        if squared > chi2.ppf(1 - CONTRADICT, 6):
            ratio = np.sqrt(squared / 6)
            factor = max(factor, ratio)
            notes.append(
                f"{candidate.name} predicts as well as {chosen.name} and is {np.degrees(np.linalg.norm(turn)):.2g}° "
                f"and {np.linalg.norm(gap[3:]):.2g} mm off, {ratio:.2g} times what their σ allow: σ are widened by that"
            )
    return result.widened(factor), tuple(notes)


def _sentence(tried: tuple[Tried, ...], chosen: Candidate, result: HandEye, measure: str) -> str:
    """Returns the choice, its gain, and what it says about camera file, board and robot, in one sentence."""
    by_candidate = {each.candidate: each for each in tried}
    chosen_mm, plain = by_candidate[chosen].mean_mm(), tried[0]
    where = "at the board" if measure == "board_mm" else "of the board's origin"
    parts = [f"of {len(tried)} ways {chosen.in_words()} is taken: {chosen_mm:.3g} mm {where} on poses held out"]
    if plain.candidate != chosen:
        parts[0] += f", {plain.candidate.in_words()} {plain.mean_mm():.3g} mm" if plain.error_mm.size else ""
    filed_mm = [each.mean_mm() for each in tried if chosen.camera and not each.candidate.camera and each.error_mm.size]
    if filed_mm:
        parts.append(f"the camera file costs {min(filed_mm) - chosen_mm:.2g} mm")
    if chosen.scale and result.sigma_scale is not None:
        percent = 100 * (result.scale - 1)
        size = "larger" if percent > 0 else "smaller"
        parts.append(f"the board is {abs(percent):.2g} ± {100 * result.sigma_scale:.1g} % {size} than stated")
    rad, mm = (result.sigma.get(name) for name in ("robot_rad", "robot_mm"))
    if rad is not None and mm is not None and {"robot_rad", "robot_mm"} & set(result.estimated):
        parts.append(f"the robot's poses err by {np.degrees(rad):.2g}° and {mm:.2g} mm an axis")
    return "; ".join(parts)
