"""Which way of solving a user gets who names none: the one with the smallest errors on poses held out."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stcal.errors import DegenerateError, StcalError
from stcal.handeye.data.loop import Setup
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import Views
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.result import HandEye
from stcal.handeye.scatter import widened_by_scatter
from stcal.handeye.solve import HandEyeOptions, handeye
from stcal.handeye.validate import HeldOutPoses, errors_without
from stcal.io.cameras.model import CameraPrior
from stcal.parallel import one_thread, run_parallel

FIRST_SPLITS = 5
"""Splits after which those that are surely worse than the best are given up."""
WORSE = 3.0
"""Standard errors of the difference, over poses, by which one is surely worse."""
AS_GOOD = 1.0
"""Within so many, the one that assumes what the files say is taken (the one-standard-error rule of Breiman et al.,
"Classification and Regression Trees", 1984)."""
CONTRADICT = 0.01
"""Chance of two answers as far apart, by their σ, below which σ are widened."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A way of solving: ``method``; with the intrinsics (``camera``) and the board's size (``scale``) solved for."""

    method: str
    camera: bool = False
    scale: bool = False

    @property
    def name(self) -> str:
        """As it is shown."""
        return " + ".join([self.method, *["camera"] * self.camera, *["scale"] * self.scale])

    def in_words(self) -> str:
        """What is solved for besides hand and eye."""
        more = [*["the intrinsics"] * self.camera, *["the board's size"] * self.scale]
        return f"{self.method} with {' and '.join(more)} solved for" if more else f"{self.method} as filed"

    def options(self, options: HandEyeOptions, prior: CameraPrior | None) -> HandEyeOptions:
        """Of its solution."""
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
"""What is tried with corners; those that assume what the files say come first."""


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A candidate with its errors.

    ``error_mm`` : on poses held out, (s, k), of the splits that it was tried on; ``reason`` : why it fails, empty where
    it does not; ``out`` : after how few splits it was surely worse, else 0; ``best_mm`` : mean error of the best on
    those, NaN without.
    """

    candidate: Candidate
    error_mm: np.ndarray
    reason: str = ""
    out: int = 0
    best_mm: float = float("nan")

    def mean_mm(self) -> float:
        """Of all errors; NaN without any."""
        return float(self.error_mm.mean()) if self.error_mm.size else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What was tried, and what was taken.

    Parameters
    ----------
    tried : tuple of Tried
        In order.
    chosen : Candidate
        Taken.
    result : HandEye
        Of all poses; its σ widened where another answer that predicts as well is farther away than they allow.
    held_out : HeldOutPoses
        Of the choice as a whole: in each split the candidate counts that errors on all other poses name.
    sentence : str
        What was chosen, what it gains, and what is the matter.
    notes : tuple of str
        Of answers that contradict each other.
    """

    tried: tuple[Tried, ...]
    chosen: Candidate
    result: HandEye
    held_out: HeldOutPoses
    sentence: str
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class _Race:
    """``errors`` : of each candidate that runs, by split number; ``failed`` : reasons by candidate; ``out`` : those
    given up, with the number of splits and the mean error of the best on them, mm."""

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
        """Of :class:`HeldOutPoses`, by which is chosen."""
        return "translation_mm" if self.views is None else "board_mm"

    def run(self, splits: range, progress: Callable[[int, int], None]) -> None:
        """These splits of all that still run."""
        jobs, owners = [], []
        for candidate in self.running:
            options = candidate.options(self.options, self.prior)
            for k in splits:
                jobs.append((self.pairs, self.setup, candidate.method, self.views, options, self.rows[k]))
                owners.append((candidate, k))
        found = {}
        for done, (i, errors) in enumerate(run_parallel(_tried, jobs, 1 if self.views is None else self.workers), 1):
            found[owners[i]] = errors
            progress(done, len(jobs))
        for candidate in list(self.running):
            for k in splits:
                each = found[candidate, k]
                if isinstance(each, str):
                    self.failed.setdefault(candidate, each)
                    break
                self.errors.setdefault(candidate, []).append(each)
        self.running = [candidate for candidate in self.running if candidate not in self.failed]

    def of(self, candidate: Candidate) -> np.ndarray:
        """(s, k) errors so far, mm."""
        return np.array([each[self.measure] for each in self.errors.get(candidate, [])])

    def give_up(self) -> None:
        """Those that are surely worse than the best."""
        if len(self.running) < 2:
            return
        seen = self.rows[: len(self.of(self.running[0]))]
        best = min(self.running, key=lambda each: self.of(each).mean())
        for candidate in [each for each in self.running if each != best]:
            mean, error = _difference(self.of(candidate) - self.of(best), seen)
            if mean > WORSE * error:
                self.out[candidate] = len(seen), float(self.of(best).mean())
        self.running = [candidate for candidate in self.running if candidate not in self.out]

    def best(self, but: np.ndarray | None = None) -> Candidate:
        """By errors on all poses but ``but``: the first that is as good as the best."""
        rows = self.rows if but is None else np.where(np.isin(self.rows, but), -1, self.rows)
        if (rows < 0).all():  # of one split, there are no others
            rows = self.rows
        mean = {each: float(self.of(each)[rows >= 0].mean()) for each in self.running}
        best = min(self.running, key=mean.__getitem__)
        for candidate in self.running:
            worse, error = _difference(self.of(candidate) - self.of(best), rows)
            if worse <= AS_GOOD * error:
                return candidate
        return best


def _tried(*job) -> dict[str, np.ndarray] | str:
    """Errors by name, or why there are none."""
    try:
        return errors_without(*job)
    except StcalError as error:
        return str(error)


def _difference(off: np.ndarray, rows: np.ndarray) -> tuple[float, float]:
    """Mean over poses of differences (s, k) on the poses ``rows``, those below 0 left out, and its standard error."""
    kept = rows >= 0
    poses = np.unique(rows[kept])
    each = np.array([off[kept & (rows == pose)].mean() for pose in poses])
    return float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each))) if len(each) > 1 else 0.0


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
    """Solve with camera and board as filed and with either solved for, by poses and corners; take what predicts best.

    Errors on poses held out decide: 3-D at the board with corners, else of the board's origin. After a few splits those
    that are surely worse are given up. Of those as good as the best within a standard error the one is taken that
    trusts the files most.

    Parameters
    ----------
    pairs, setup, views, options
        As of :func:`~stcal.handeye.handeye`; the scale and the intrinsics of ``options`` are set here.
    prior : CameraPrior, optional
        Of the intrinsics; they are not solved for where None.
    rows : (s, k) int array
        Poses to hold out in each split.
    workers : int or None
        Processes; as many as cores where None.
    progress : callable, optional
        Called with the number of solutions done, and that of all of a stage.

    Returns
    -------
    Choice

    Raises
    ------
    StcalError
        As of :func:`~stcal.handeye.handeye`, where the plain way fails.
    """
    if options.symmetries:
        mended = repair(pairs, setup, options.symmetries, views)
        pairs, views, options = mended.pairs, mended.views, replace(options, symmetries=())
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
    parts = [race.errors[race.best(but=out)][k] for k, out in enumerate(rows)]
    held_out = HeldOutPoses(rows, **{name: np.array([each[name] for each in parts]) for name in parts[0]})
    results = {candidates[0]: plain}
    for each in race.running:
        if each not in results:
            results[each] = handeye(pairs, setup, each.method, views, each.options(options, prior))
    still = (0, float("nan"))
    tried = tuple(
        Tried(each, race.of(each), race.failed.get(each, ""), *race.out.get(each, still)) for each in candidates
    )
    rivals = {each: results[each] for each in race.running if each != chosen and _as_good(race, each, chosen)}
    result, notes = _widened(widened_by_scatter(results[chosen], held_out), chosen, rivals)
    return Choice(tried, chosen, result, held_out, _sentence(tried, chosen, result, race.measure), notes)


def _as_good(race: _Race, candidate: Candidate, chosen: Candidate) -> bool:
    """Whether it predicts as well as the chosen one, within a standard error."""
    worse, error = _difference(race.of(candidate) - race.of(chosen), race.rows)
    return worse <= AS_GOOD * error


def _widened(result: HandEye, chosen: Candidate, rivals: dict[Candidate, HandEye]) -> tuple[HandEye, tuple[str, ...]]:
    """With σ that reach the answers of others that predict as well; and which these are."""
    if result.covariance is None:
        return result, ()
    factor, notes = 1.0, []
    for candidate, rival in rivals.items():
        if rival.covariance is None:
            continue
        x, other = result.mount_from_camera, rival.mount_from_camera
        turn = Rotation.from_matrix(other.rotation @ x.rotation.T).as_rotvec()
        off = np.concatenate([turn, other.translation - x.translation])
        squared = float(off @ np.linalg.lstsq(result.covariance + rival.covariance, off)[0])
        if squared > chi2.ppf(1 - CONTRADICT, 6):
            own = np.sqrt(squared / 6)
            factor = max(factor, own)
            notes.append(
                f"{candidate.name} predicts as well as {chosen.name} and is {np.degrees(np.linalg.norm(turn)):.2g}° "
                f"and {np.linalg.norm(off[3:]):.2g} mm off, {own:.2g} times what their σ allow: σ are widened by that"
            )
    return result.widened(factor), tuple(notes)


def _sentence(tried: tuple[Tried, ...], chosen: Candidate, result: HandEye, measure: str) -> str:
    """What was chosen, what it gains, and what is the matter."""
    by = {each.candidate: each for each in tried}
    mine, plain = by[chosen].mean_mm(), tried[0]
    where = "at the board" if measure == "board_mm" else "of the board's origin"
    parts = [f"of {len(tried)} ways {chosen.in_words()} is taken: {mine:.3g} mm {where} on poses held out"]
    if plain.candidate != chosen:
        parts[0] += f", {plain.candidate.in_words()} {plain.mean_mm():.3g} mm" if plain.error_mm.size else ""
    filed = [each.mean_mm() for each in tried if chosen.camera and not each.candidate.camera and each.error_mm.size]
    if filed:
        parts.append(f"the camera file costs {min(filed) - mine:.2g} mm")
    if chosen.scale and result.sigma_scale is not None:
        off = 100 * (result.scale - 1)
        size = "larger" if off > 0 else "smaller"
        parts.append(f"the board is {abs(off):.2g} ± {100 * result.sigma_scale:.1g} % {size} than stated")
    rad, mm = (result.sigma.get(name) for name in ("robot_rad", "robot_mm"))
    if rad is not None and mm is not None and {"robot_rad", "robot_mm"} & set(result.estimated):
        parts.append(f"the robot's poses err by {np.degrees(rad):.2g}° and {mm:.2g} mm an axis")
    return "; ".join(parts)
