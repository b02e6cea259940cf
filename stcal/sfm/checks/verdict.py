"""What a check is, and how chance is told from fault: every verdict is a test of significance.

A check tests one or many things against what their σ allow. The probability of the worst by chance, times the number of
things tested (Bonferroni), gives the verdict. A report makes some fifteen checks, so that with the limits below one
honest run in seventy shows something suspicious, and one in seven thousand a failure.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtrc

from stcal.geometry.robust import ratio_limit
from stcal.sfm.report.checks import ORDER

Verdict = Literal["passed", "suspicious", "failed", "not possible"]
SUSPICIOUS = 1e-3
FAILED = 1e-5
"""Probability, over all things that one check tests, of as much or more by chance."""
BY_CHANCE = f"a check is suspicious by chance in one run in {1 / SUSPICIOUS:,.0f}, failed in one in {1 / FAILED:,.0f}"
KNOWN = 1e9
"""Degrees of freedom of a σ that is stated, not estimated."""
SHOWN = 8
"""Measurements that a check lists, the worst first."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One thing tested: ``name`` (image, label, face, group, row …), ``value`` and ``limit`` in ``unit``, beyond which
    it is suspicious; ``probability`` of as much or more by chance, None for what is no test."""

    name: str
    value: float
    limit: float | None
    unit: str
    probability: float | None

    def words(self) -> str:
        """Value and limit."""
        unit = f" {self.unit}" if self.unit else ""
        limit = "" if self.limit is None else f", limit {self.limit:.3g}"
        return f"{self.value:.3g}{unit}{limit}"


@dataclass(frozen=True, slots=True)
class Check:
    """``reason`` : the verdict in words; ``measured`` : the worst first; ``tested`` : how many things; ``names`` of
    what is beyond its limit, the worst first; ``remedy`` : what to do about it, empty where nothing is."""

    key: str
    title: str
    verdict: Verdict
    reason: str
    measured: tuple[Measured, ...]
    tested: int
    names: tuple[str, ...]
    remedy: str


@dataclass(frozen=True, slots=True)
class Trial:
    """A thing to test: ``value`` in ``unit`` for people, which grows with the root of ``statistic`` (its logarithm does
    where ``ratio``), that is χ² with ``freedom`` degrees by chance; its σ come from ``redundancy`` others (F test)."""

    name: str
    value: float
    unit: str
    statistic: float
    freedom: int
    redundancy: float = KNOWN
    ratio: bool = False

    def limit(self, count: int) -> float | None:
        """The value beyond which one of ``count`` things is suspicious."""
        if self.statistic <= 0:
            return None
        limit = self.freedom * ratio_limit(SUSPICIOUS / count, self.freedom, self.redundancy)
        grown = float(np.sqrt(limit / self.statistic))
        return float(self.value**grown) if self.ratio else abs(self.value) * grown


def judge(key: str, title: str, trials: Sequence[Trial], what: str, remedy: str, worst: Verdict = "failed") -> Check:
    """The verdict over all trials.

    ``what`` : the thing tested, for the reason; ``worst`` : the verdict that is not exceeded, for faults that do no
    harm.
    """
    if not trials:
        return impossible(key, title, f"no {what} to test", "")
    count = len(trials)
    statistic, freedom, redundancy = np.array([(t.statistic, t.freedom, t.redundancy) for t in trials], float).T
    probability = fdtrc(freedom, redundancy, statistic / freedom)
    order = np.lexsort([-statistic / freedom, probability])
    found = [i for i in order if probability[i] * count < SUSPICIOUS]
    verdict: Verdict = "passed"
    if found:
        verdict = worst if probability[found[0]] * count < FAILED else "suspicious"
    measured = tuple(
        Measured(trials[i].name, trials[i].value, trials[i].limit(count), trials[i].unit, float(probability[i]))
        for i in order[:SHOWN]
    )
    largest = f"{measured[0].name} at {measured[0].words()}"
    if found:
        reason = f"{largest}" if count == 1 else f"{len(found)} of {count} {what} beyond chance, first {largest}"
    else:
        reason = f"{largest}" if count == 1 else f"{count} {what} within chance, largest {largest}"
    names = tuple(trials[i].name for i in found)
    return Check(key, title, verdict, reason, measured, count, names, remedy if found else "")


def without_image(name: str) -> str:
    """The option that takes an image out of a run; one at a time, the worst, as it may be why others stand out."""
    return f"--exclude {shlex.quote(name)}"


def ranked(checks: Sequence[Check], images: frozenset[str]) -> list[Check]:
    """The order in which to read them: the worst first, and of the failed ones those that name an image, which may be
    why the others fail."""
    return sorted(checks, key=lambda check: (ORDER.index(check.verdict), images.isdisjoint(check.names)))


def impossible(key: str, title: str, reason: str, remedy: str) -> Check:
    """A check that this run cannot make."""
    return Check(key, title, "not possible", reason, (), 0, (), remedy)
