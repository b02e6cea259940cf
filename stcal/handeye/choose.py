"""Default way of solving, where the user names none: the one with the smallest errors on held-out poses."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.special import chdtri

from stcal.errors import StcalError
from stcal.geometry.camera import intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.handeye.handeye_problem import HandEye, HandEyeProblem
from stcal.handeye.methods.closed_form import AX_XB, AX_ZB
from stcal.handeye.validate import (
    HeldOutPoses,
    deciding_error,
    errors_of,
    naming_held_out,
    with_common_errors,
    with_jackknife,
)
from stcal.io.cameras.camera_model import CameraPrior
from stcal.parallel import one_thread, run_parallel

AS_GOOD = 1.0
"""Number of standard errors of the difference within which another candidate predicts as well as the chosen one."""
SHOWN = 0.01
"""Significance level at which the data must contradict a file before the file's content is solved for. An unknown that
the data do not show costs more than it gains: the transform takes its σ, which errors on few poses held out hide."""
BY_CHANCE = 0.3
"""Number of standard errors by which the best candidate must be ahead of those before it, which trust the files more
and know their σ. It is less than the one of Breiman et al. ("Classification and Regression Trees", 1984), since what
such a candidate solves for is also significant by itself (:data:`SHOWN`)."""
WITHOUT_WEIGHTS = 2.0
"""The same for closed forms against adjustments. Closed forms are many, so that one of them is often ahead by chance,
and they know neither σ nor outliers; an adjustment is left only where its weights are clearly wrong."""
TINY_MM = 1e-9  # least standard error of a difference: differences of exact data are rounding
CONTRADICT = 0.01
"""Significance level: σ are widened if two answers differ so much that their σ explain it more rarely than this."""


@dataclass(frozen=True, slots=True)
class Way:
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

    def of(self, problem: HandEyeProblem, prior: CameraPrior | None) -> HandEyeProblem:
        """Returns the problem with the unknowns of this candidate. ``prior`` : of the intrinsics."""
        options = replace(problem.options, intrinsics=prior if self.camera else None, with_scale=self.scale)
        return replace(problem, options=options)


CLOSED_FORMS = tuple(Way(method) for method in (*AX_ZB, *AX_XB))
"""They weigh nothing, so that nothing is wrong with their weights: with few poor images they may be the best."""
BY_POSES = (Way("pose"), Way("pose", scale=True), *CLOSED_FORMS)
BY_VIEWS = (
    Way("reprojection"),
    Way("pose"),
    Way("reprojection", camera=True),
    Way("reprojection", scale=True),
    Way("pose", scale=True),
    Way("reprojection", camera=True, scale=True),
    *CLOSED_FORMS,
)
"""Candidates that are tried with corners; those that trust the files come first."""


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A way of solving that was tried.

    ``error_mm`` : (s, k) its errors on held-out poses, (0, 0) if it fails by its ``error``; ``result`` : from all
    poses; ``partial`` : results without the poses of each split; ``shown`` : whether all poses contradict each file
    whose content is solved for; ``shown_without`` : (s,) whether the poses besides those of each split do.
    """

    candidate: Way
    error_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    result: HandEye | None = None
    partial: tuple[HandEye, ...] = ()
    shown: bool = False
    shown_without: tuple[bool, ...] = ()
    error: StcalError | None = None
    KEYS: ClassVar = "candidate mean_mm reason"

    @property
    def mean_mm(self) -> float:
        """Mean of all errors, or NaN if there are none."""
        return float(self.error_mm.mean()) if self.error_mm.size else float("nan")

    @property
    def reason(self) -> str:
        """Why the way fails; empty if it does not."""
        return str(self.error or "")


@dataclass(frozen=True, slots=True, eq=False)
class ChosenWay:
    """The candidates that were tried, and the one that was chosen.

    ``tried`` : all candidates, those that trust the files first; ``chosen`` : the candidate that was chosen; ``result``
    : its solution from all poses. Its σ are widened where another answer that predicts as well differs by more than the
    σ allow; ``held_out`` : errors of the choice as a whole: in each split, of the candidate that the errors on all
    other poses choose; ``sentence`` : the choice, what it gains, and what it says about camera file, board and robot;
    ``notes`` : notes on answers that contradict each other.
    """

    tried: tuple[Tried, ...]
    chosen: Way
    result: HandEye
    held_out: HeldOutPoses
    sentence: str
    notes: tuple[str, ...] = ()


def _try(problem: HandEyeProblem, candidate: Way, rows: np.ndarray) -> Tried:
    try:
        solution = problem.solved(candidate.method)
        partial = tuple(solution.without(out) for out in rows)
    except StcalError as error:
        return Tried(candidate, error=error)
    errors = np.array([deciding_error(part, problem[out]) for part, out in zip(partial, rows, strict=True)])
    share = 1 - rows.shape[1] / len(problem)
    shown_without = tuple(_shown(part, problem, share) for part in partial)
    return Tried(candidate, errors, solution.result, partial, _shown(solution.result, problem), shown_without)


def _shown(result: HandEye, problem: HandEyeProblem, share: float = 1.0) -> bool:
    """True if board and intrinsics, solved for from this ``share`` of the poses, differ from files beyond chance."""
    tests, found, intrinsics = [], result.reprojection, problem.options.intrinsics
    if problem.options.with_scale and result.sigma_scale:
        tests.append((((result.scale - 1) / result.sigma_scale) ** 2, 1))
    if intrinsics is not None and problem.views is not None and found is not None:
        basis = intrinsic_basis(intrinsics.colmap_model)
        off = basis.T @ (found.camera.parameters() - problem.views.camera.parameters()) / basis.sum(0)
        if found.camera_covariance is not None:
            tests.append((float(off @ generalised_inverse(found.camera_covariance) @ off), len(off)))
    return all(share * squared > chdtri(dof, SHOWN) for squared, dof in tests)


def _best(tried: list[Tried], rows: np.ndarray, split: int | None = None) -> Tried:
    """Returns the first of the tried that is behind the best by chance only, with poses held out (s, k) as ``rows``."""
    if split is not None:
        others = np.where(np.isin(rows, rows[split]), -1, rows)
        rows = rows if (others < 0).all() else others  # a single split: no other poses were held out
    shown = [each for each in tried if (each.shown if split is None else each.shown_without[split])]
    adjusted, closed = ([e for e in shown if (e.candidate in CLOSED_FORMS) == kind] for kind in (False, True))
    chosen = _first_of(adjusted or closed, rows)
    rival = _first_of(closed, rows) if adjusted and closed else chosen
    return rival if _behind(chosen, rival, rows) > WITHOUT_WEIGHTS else chosen


def _first_of(tried: list[Tried], rows: np.ndarray) -> Tried:
    best = min(tried, key=lambda each: float(each.error_mm[rows >= 0].mean()))
    return next(each for each in tried if _behind(each, best, rows) <= BY_CHANCE)


def _behind(one: Tried, other: Tried, rows: np.ndarray) -> float:
    """Returns by how many standard errors one's mean error of held-out poses (s, k) exceeds the other's; at least 0."""
    off, valid = one.error_mm - other.error_mm, rows >= 0
    means = np.array([off[valid & (rows == pose)].mean() for pose in np.unique(rows[valid])])
    standard_error = float(means.std(ddof=1) / np.sqrt(len(means))) if len(means) > 1 else 0.0
    return max(float(means.mean()), 0.0) / max(standard_error, TINY_MM)


@one_thread()
def choose(
    problem: HandEyeProblem,
    prior: CameraPrior | None,
    rows: np.ndarray,
    workers: int | None = 1,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> ChosenWay:
    """Solves with camera and board as filed and with either as unknown, by poses, by corners and in closed form;
    held-out poses decide (:func:`~stcal.handeye.validate.deciding_error`). A candidate with unknown board or camera
    takes part where they differ from their files by more than chance. ``problem`` : its scale and intrinsics are
    overwritten; ``prior`` : of the intrinsics, which are never solved for if None; ``rows`` : (s, k) poses to hold out
    in each split. Raises StcalError: the first candidate, which trusts all files, fails."""
    problem = problem.mended()
    for out in rows:
        with naming_held_out(problem, out):
            _ = problem.without(out).seen
    every, four_dof = BY_POSES if problem.views is None else BY_VIEWS, problem.options.four_dof
    candidates = [way for way in every if (prior or not way.camera) and not (four_dof and way in CLOSED_FORMS)]
    jobs = [(candidate.of(problem, prior), candidate, rows) for candidate in candidates]
    finished: dict[int, Tried] = {}
    for i, found in run_parallel(_try, jobs, 1 if problem.views is None else workers):
        if i == 0 and found.error:  # what the first one cannot use, the others should not
            raise found.error
        finished[i] = found
        progress(len(finished), len(jobs))
    tried = [finished[i] for i in range(len(jobs))]
    able = [each for each in tried if not each.error]
    chosen = _best(able, rows)
    try:  # of a closed form the σ cost a solution for each pose: they are made for the chosen one alone
        result = _with_sigma(chosen, chosen.candidate.of(problem, prior))
    except StcalError as error:
        tried[tried.index(chosen)] = Tried(chosen.candidate, error=error)
        able = [each for each in able if each.candidate not in CLOSED_FORMS]
        chosen = _best(able, rows)
        result = _with_sigma(chosen, problem)
    best_of_splits = (_best(able, rows, k).partial[k] for k in range(len(rows)))
    errors = [errors_of(part, problem[out]) for part, out in zip(best_of_splits, rows, strict=True)]
    held_out = HeldOutPoses.of_splits(rows, errors)
    others = (each for each in able if each is not chosen and each.candidate not in CLOSED_FORMS)
    rivals = [each for each in others if _behind(each, chosen, rows) <= AS_GOOD]
    # The scatter is that of one way of solving: where splits choose another, the answers jump, which no σ predicts.
    of_splits = np.array([part.mount_from_camera.matrix() for part in chosen.partial])
    result = replace(held_out, mount_from_camera=of_splits).widened(result)
    result, notes = widened(result, chosen.candidate, rivals)
    where = "of the board's origin" if problem.views is None else "at the board"
    sentence = _sentence(tried, chosen, result, where)
    return ChosenWay(tuple(tried), chosen.candidate, result, held_out, sentence, notes)


def _with_sigma(tried: Tried, problem: HandEyeProblem) -> HandEye:
    """Returns the result of a closed form with covariances by the jackknife, or any other as it is."""
    if tried.result is not None and tried.result.covariance is not None:
        return tried.result
    solution = problem.solved(tried.candidate.method)
    without_one = [solution.without(np.array([i])) for i in range(len(problem))]
    return with_common_errors(with_jackknife(solution.result, without_one), problem)


def widened(result: HandEye, chosen: Way, rivals: list[Tried]) -> tuple[HandEye, tuple[str, ...]]:
    """Widens σ until they cover the rivals, which predict as well. Returns the result, and notes on distant rivals."""
    factor, notes = 1.0, []
    for each in rivals:
        if (rival := each.result) is None or result.covariance is None or rival.covariance is None:
            continue
        gap = rival.mount_from_camera.difference(result.mount_from_camera)
        squared = float(gap @ np.linalg.lstsq(result.covariance + rival.covariance, gap)[0])
        if squared > chdtri(6, CONTRADICT):
            ratio, turn, shift = np.sqrt(squared / 6), np.degrees(np.linalg.norm(gap[:3])), np.linalg.norm(gap[3:])
            factor = max(factor, ratio)
            off = f"{each.candidate.name} predicts as well as {chosen.name} and is {turn:.2g}° and {shift:.2g} mm off"
            notes.append(f"{off}, {ratio:.2g} times what their σ allow: σ are widened by that")
    return result.widened(factor), tuple(notes)


def _sentence(tried: list[Tried], chosen: Tried, result: HandEye, where: str) -> str:
    """Returns the choice, its gain, and what it says about camera file, board and robot, in one sentence."""
    way, plain = chosen.candidate, tried[0]
    first = f"{len(tried)} ways of solving were compared by poses held out; the best, {way.in_words()}, errs by "
    parts = [f"{first}{chosen.mean_mm:.3g} mm {where}"]
    if plain.candidate != way:
        parts[0] += f", {plain.candidate.in_words()} by {plain.mean_mm:.3g} mm" if plain.error_mm.size else ""
    filed_mm = [each.mean_mm for each in tried if way.camera and not each.candidate.camera and each.error_mm.size]
    if filed_mm:
        parts.append(f"the camera file costs {min(filed_mm) - chosen.mean_mm:.2g} mm")
    if way.scale and result.sigma_scale is not None:
        percent = 100 * (result.scale - 1)
        size = f"{abs(percent):.2g} ± {100 * result.sigma_scale:.1g} % {'larger' if percent > 0 else 'smaller'} than"
        parts.append(f"the board is {size} stated")
    rad, mm = (result.sigma.get(name) for name in ("robot_rad", "robot_mm"))
    if rad is not None and mm is not None and {"robot_rad", "robot_mm"} & set(result.estimated):
        parts.append(f"the robot's poses err by {np.degrees(rad):.2g}° and {mm:.2g} mm an axis")
    return "; ".join(parts)
