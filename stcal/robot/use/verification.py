"""Verification of a calibration: distances between measured positions are compared with the commanded distances.

This is the test of the stereo-target paper. Distances from the first position need no common frame of robot and
instrument. They all carry the error of the first position; the distances of all pairs depend less on any one position.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze
from stcal.io.json import Part, ResultFile, Texts, Vector
from stcal.io.table import LENGTHS, UNIT_WORDS, Table, read_table
from stcal.robot.descriptions import few
from stcal.robot.kinematics.conditions import unread
from stcal.robot.kinematics.measurements import within

WHAT = "measured positions"
SAME_MM = 1e-6
"""Distance below which two commanded positions count as the same command; it covers the rounding of printed numbers."""
MISSES, MISSES_MM = 0.05, 20.0
"""Largest RMS deviation of measured from commanded distances, as a share and in mm; arms err by under 1 %."""
MOST_ELSEWHERE, MOST_COMPARED = 0.3, 1000
"""Largest share of the poses that may be named as elsewhere, and number up to which all are compared."""
OFF, OFF_MM, LEAST_TO_COMPARE = 6.0, 0.1, 6
"""Ratio of a pose's typical error to that of most, its size, and number of poses, from which on the pose is named."""
NO_BETTER, WORSE = 0.8, 1.2
"""How many times as much as the first set another errs about as it does, and more than it does."""
MOST_OF_IT = 0.75
"""Share of the squared errors of distances from which on their scale is named."""
LEAST_SPREAD_MM = 20.0
"""Largest commanded distance below which the unit is doubted."""
SCALE_WITHIN = 0.005
"""Largest relative difference of scale; more is another unit, or other poses."""


BySet = Annotated[str, "set"]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPoses:
    """Rows of a file. ``sets``, ``names`` : (m,) set and pose of each; ``commanded``, ``measured`` : (m, 3) mm, each in
    a frame of its own; ``notes`` : on columns that were not read."""

    where: str
    lines: Sequence[int]
    sets: tuple[str, ...]
    names: tuple[str, ...]
    commanded: np.ndarray
    measured: np.ndarray
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        m = len(self.lines)
        freeze(self, "commanded", (m, 3), "commanded positions")
        freeze(self, "measured", (m, 3), "measured positions")


class SetResult(Part):
    """Distance errors of one set, mm."""

    name: str
    error_mm: Vector
    mean_mm: float
    std_mm: float
    max_mm: float
    pairs_rms_mm: float
    pairs_mm: float
    scale: float
    elsewhere: str = ""

    def doubt(self) -> str:
        """Returns why the measured positions may not belong to the commands; empty if they may."""
        allowed = max(MISSES * self.pairs_mm, MISSES_MM)
        if self.elsewhere:
            said = self.elsewhere
        elif abs(self.scale - 1) > SCALE_WITHIN:
            said = f"measured distances are {self.scale:.4g} times the commanded ones; {_remedy_of_scale(self.scale)}"
        elif self.pairs_rms_mm > allowed:
            said = (
                f"measured distances miss the commanded ones by {self.pairs_rms_mm:.4g} mm (RMS of all pairs), "
                f"{allowed:.3g} mm allowed; check the order of the poses, and the robot that commanded them"
            )
        else:
            return ""
        return f"set {self.name}: {said}"

    def figures(self) -> dict[str, float]:
        """Returns the figures that are compared between sets, mm."""
        return {"mean": self.mean_mm, "std": self.std_mm, "max": self.max_mm, "all pairs RMS": self.pairs_rms_mm}


class VerificationFile(ResultFile):
    """Result file of ``verify``."""

    format: Literal["stcal verification 1"] = Field(description="the file's form and its version")
    poses: list[str] = Field(description="names, the first being the one that distances start from")
    distance_mm: Vector = Field(description="commanded distances of the others from it")
    sets: list[SetResult] = Field(
        description="`name`; `error_mm` measured minus commanded; `mean_mm`, `std_mm` (sample), `max_mm` of their "
        "absolute values; `pairs_rms_mm`, `pairs_mm` RMS of errors and of commanded distances of all pairs, `scale` of "
        "measured over commanded ones; `elsewhere`: poses that alone are not where they were commanded"
    )
    missing: dict[BySet, list[str]] = Field(description="poses that a set lacks")
    warnings: Texts = Field(description="what to look at")
    notes: list[str] = Field(description="columns that were not read")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Verification(Brief):
    """Distance errors of several sets of measurements, over the poses that all sets have.

    ``poses`` : names, the first being the one that distances start from; ``sets`` : in order of the file; ``missing`` :
    by set, the poses that it lacks; they are left out of all sets; ``notes`` : on columns that were not read.
    """

    format: ClassVar = "stcal verification 1"
    where: str
    poses: tuple[str, ...]
    distance_mm: np.ndarray
    sets: tuple[SetResult, ...]
    missing: dict[str, tuple[str, ...]]
    notes: tuple[str, ...] = ()

    def reduction(self, index: int) -> dict[str, float]:
        """Returns the reduction of each figure of set ``index`` relative to the first set, per cent."""
        first, figures = self.sets[0].figures(), self.sets[index].figures()
        return {key: 100 * (1 - figures[key] / first[key]) if first[key] > 0 else float("nan") for key in first}

    def warnings(self) -> list[str]:
        """Returns warnings of missing poses and of doubtful sets."""
        found = [
            f"set {name}: missing poses, left out of all sets ({len(poses)}): {few(poses)}"
            for name, poses in self.missing.items()
            if poses
        ]
        found += [doubt for each in self.sets if (doubt := each.doubt())]
        first = self.sets[0]
        if (most := float(self.distance_mm.max())) < LEAST_SPREAD_MM:
            found.append(
                f"commanded positions lie within {most:.3g} mm of the first one; if lengths are in another unit than "
                "the names of their columns say, correct these"
            )
        for i, each in enumerate(self.sets):
            if each.doubt():
                continue
            by_scale = ((each.scale - 1) * each.pairs_mm) ** 2
            if by_scale > MOST_OF_IT * each.pairs_rms_mm**2 and each.pairs_rms_mm > OFF_MM:
                found.append(
                    f"set {each.name}: measured distances are {each.scale:.5f} times the commanded ones, which is most "
                    "of their error: check the instrument's scale"
                )
            against = f"{each.pairs_rms_mm:.3g} against {first.pairs_rms_mm:.3g} mm (RMS of all pairs)"
            if i and each.pairs_rms_mm > WORSE * first.pairs_rms_mm:
                found.append(
                    f"set {each.name} errs more than set {first.name}, the first in the file, {against}: were the sets "
                    "exchanged? The one before compensation comes first"
                )
            elif i and each.pairs_rms_mm > NO_BETTER * first.pairs_rms_mm:
                found.append(
                    f"set {each.name} errs as set {first.name} does, {against}: were these positions commanded with "
                    "compensated joint values, and was --robot of compensate the file of identify?"
                )
        return found


def _remedy_of_scale(scale: float) -> str:
    """Returns what to check where measured distances are ``scale`` times the commanded ones."""
    for unit, words in UNIT_WORDS.items():
        for times, side in ((LENGTHS[unit], "commanded"), (1 / LENGTHS[unit], "measured")):
            if abs(scale / times - 1) < SCALE_WITHIN:
                return f"check units, as if the {side} ones were {words}"
    near = abs(scale - 1) < MISSES
    return "check the instrument's scale" if near else "check units and the order of the poses"


def _also_late(commanded: np.ndarray, measured: np.ndarray) -> str:
    """Returns that the positions (n, 3) fit one row further, empty if they do not."""
    if len(commanded) < LEAST_TO_COMPARE:
        return ""

    def missed(first: np.ndarray, second: np.ndarray) -> float:
        apart = [np.linalg.norm(xyz[1:] - xyz[:-1], axis=1) for xyz in (first, second)]
        return float(np.median(np.abs(apart[0] - apart[1])))

    now = missed(commanded, measured)
    ways = {
        "low: they fit the commanded ones above": missed(commanded[:-1], measured[1:]),
        "high: they fit the commanded ones below": missed(commanded[1:], measured[:-1]),
    }
    way = min(ways, key=lambda each: ways[each])
    if now < MISSES_MM or ways[way] > now / OFF:
        return ""
    return f"measured positions stand one row too {way}; correct the order of the rows"


def read_measured(path: str | Path | Table) -> MeasuredPoses:
    """Reads commanded and measured positions.

    Parameters
    ----------
    path : table (CSV; form: ``data_layout.md``).

    Returns
    -------
    MeasuredPoses : positions, mm, commanded ones in the robot's base and measured ones in the instrument's frame.

    Raises
    ------
    InputError : missing columns, bad rows, or a pose twice in one set; the message names the line.
    """
    table = read_table(path, WHAT)
    commanded, measured = table.points("commanded_"), table.points()
    within(table, "commanded position", commanded, "mm")
    within(table, "position", measured, "mm")
    sets = tuple(table.text("set")) if "set" in table else ("measured",) * len(table)
    names = _names(table, sets, commanded)
    return MeasuredPoses(table.where, table.lines, sets, names, commanded, measured, unread(table))


def _names(table: Table, sets: tuple[str, ...], commanded: np.ndarray) -> tuple[str, ...]:
    """Returns the names of poses from column ``pose``, or else by equal commanded positions, counted within a set."""
    if "pose" in table:
        names = tuple(table.text("pose"))
        seen: dict[tuple[str, str], int] = {}
        for line, key in zip(table.lines, zip(sets, names, strict=True), strict=True):
            if seen.setdefault(key, line) != line:
                raise InputError(
                    "E-TABLE-ROW-REPEATED",
                    f"{table.where}: line {line}: pose {key[1]} of set {key[0]} stands on line {seen[key]} already; "
                    "give the sets different names",
                )
        return names
    places, numbers, times = {}, [], Counter()
    for name, xyz in zip(sets, np.round(commanded / SAME_MM).astype(np.int64).tolist(), strict=True):
        times[name, *xyz] += 1
        numbers.append(places.setdefault((*xyz, times[name, *xyz]), len(places) + 1))
    return tuple(map(str, numbers))


def verify(data: MeasuredPoses) -> Verification:
    """Returns the distance errors of each set, over the poses that all sets have.

    Distances from the first position need no common frame of robot and instrument (Zhang & Wei 2017, section 4.3).

    Parameters
    ----------
    data : commanded and measured positions of one or more sets, mm.

    Returns
    -------
    Verification : mean, standard deviation and maximum of each set's distance errors, mm.

    Raises
    ------
    InputError : fewer than three poses in common, or one pose commanded to different places.
    """
    rows: dict[str, dict[str, int]] = {}
    for i, (group, name) in enumerate(zip(data.sets, data.names, strict=True)):
        rows.setdefault(group, {})[name] = i
    every = list(dict.fromkeys(data.names))
    common = [name for name in every if all(name in rows_of_set for rows_of_set in rows.values())]
    missing = {group: tuple(name for name in every if name not in rows_of_set) for group, rows_of_set in rows.items()}
    if len(common) < 3:
        raise InputError(
            "E-VERIFY-FEW",
            f"{data.where}: {len(common)} poses in {'all of the sets ' if len(rows) > 1 else ''}{', '.join(rows)}; "
            "at least 3 needed; are the commanded positions of the sets the same?",
        )
    index = {group: np.array([rows_of_set[name] for name in common]) for group, rows_of_set in rows.items()}
    first = next(iter(index.values()))
    for group, rows_of_set in index.items():
        apart = np.abs(data.commanded[rows_of_set] - data.commanded[first]).max(axis=1)
        if apart.max() > SAME_MM:
            k = int(apart.argmax())
            raise InputError(
                "E-VERIFY-COMMANDED",
                f"{data.where}: pose {common[k]} is commanded {apart[k]:.4g} mm apart in sets {next(iter(index))} and "
                f"{group} (line {data.lines[rows_of_set[k]]}); the same commands needed",
            )
    sets = [_set_result(data, group, rows_of_set, common) for group, rows_of_set in index.items()]
    for k, rows_of_set in enumerate(list(index.values())[1:], 1):
        if (data.measured[rows_of_set] == data.measured[first]).all():
            same = "measured positions are those of the first set to the last digit; give those of the instrument"
            sets[k] = sets[k].model_copy(update={"elsewhere": same})
    at = data.commanded[first]
    distances = np.linalg.norm(at[1:] - at[0], axis=1)
    return Verification(data.where, tuple(common), distances, tuple(sets), missing, data.notes)


def _elsewhere(commanded: np.ndarray, measured: np.ndarray, names: Sequence[str]) -> str:
    """Returns which few poses (n, 3) miss most others by more than allowed, while these fit one another; else ""."""

    def off(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distances, own = (np.linalg.norm(xyz[:, None] - xyz, axis=2) for xyz in (commanded, places))
        missed = np.abs(own - distances)
        return missed, np.flatnonzero(np.median(missed, axis=1) > max(MISSES * np.median(distances), MISSES_MM))

    if late := _also_late(commanded, measured):
        return late
    if (measured == commanded).all():
        return "measured positions are the commanded ones to the last digit; give those of the instrument"
    missed, wrong = off(measured)
    if not len(wrong) and len(names) >= LEAST_TO_COMPARE:
        typical = np.median(missed, axis=1)
        far = np.flatnonzero(typical > max(OFF * float(np.median(typical)), OFF_MM)).tolist()
        if 0 < len(far) <= MOST_ELSEWHERE * len(names):
            listed = ", ".join(f"{names[i]} ({typical[i]:.2g} mm)" for i in far)
            most = f"{np.median(typical):.2g} mm"
            return f"pose{'s' * (len(far) > 1)} {listed}: far worse than the others, {most} (median); measure again"
    good = np.setdiff1d(np.arange(len(names)), wrong)
    if not len(wrong) or len(wrong) > MOST_ELSEWHERE * len(names) or missed[np.ix_(good, good)].max() > MISSES_MM:
        return ""
    listed = few([name for i, name in enumerate(names) if i in wrong])
    if len(wrong) == 2:
        exchanged = measured.copy()
        exchanged[wrong] = measured[wrong[::-1]]
        if not len(off(exchanged)[1]):
            return f"poses {listed} are exchanged; correct the order of the rows"
    return f"pose{'s' * (len(wrong) > 1)} {listed}: not where commanded, the others are; correct or remove"


def _set_result(data: MeasuredPoses, name: str, rows: np.ndarray, names: Sequence[str]) -> SetResult:
    commanded, measured = data.commanded[rows], data.measured[rows]
    error = np.linalg.norm(measured[1:] - measured[0], axis=1) - np.linalg.norm(commanded[1:] - commanded[0], axis=1)
    sums = np.zeros(4)  # row by row: all pairs of thousands at once are gigabytes
    for i in range(1, len(measured)):
        seen, wanted = (np.linalg.norm(xyz[:i] - xyz[i], axis=1) for xyz in (measured, commanded))
        sums += ((seen - wanted) ** 2).sum(), seen @ wanted, wanted @ wanted, i
    squares, product, commanded_squares, pairs = sums.tolist()
    if commanded_squares == 0:
        raise InputError(
            "E-VERIFY-ALIKE", f"{data.where}: set {name}: all commanded positions are the same; different ones needed"
        )
    size = np.abs(error)
    return SetResult(
        name=name,
        error_mm=error,
        mean_mm=float(size.mean()),
        std_mm=float(size.std(ddof=1)),
        max_mm=float(size.max()),
        pairs_rms_mm=float(np.sqrt(squares / pairs)),
        pairs_mm=float(np.sqrt(commanded_squares / pairs)),
        scale=product / commanded_squares,
        elsewhere=_elsewhere(commanded, measured, names) if len(names) <= MOST_COMPARED else "",
    )
