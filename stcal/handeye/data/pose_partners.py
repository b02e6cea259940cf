"""Which of the robot's poses belongs to each of the camera's poses or images: by names, by times, or by their order."""

import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

from stcal.errors import InputError
from stcal.handeye.data.pose_content import PoseSide
from stcal.handeye.data.stream import LONGEST_S, TOLERANCE_S, Stream, Timed, stamps_of, stem_of, taken_at, time_of


@dataclass(frozen=True, slots=True, eq=False)
class Paired:
    """``robot`` : its poses for the ``rows`` of the camera's names; ``left_out`` : other names of both, and why;
    ``timed`` : times of the rows in the robot's poses, if these are a stream; ``lines`` : how they were found, if not
    by equal names."""

    robot: PoseSide
    rows: list[int]
    left_out: tuple[tuple[str, str], ...]
    timed: Timed | None = None
    lines: tuple[str, ...] = ()


def times_of(side: PoseSide) -> dict[str, Decimal] | None:
    """Returns the times of all poses by their names; None where names are no times."""
    times = [time_of(name) for name in side.names] if side.timed else stamps_of(side.names)
    known = {name: time for name, time in zip(side.names, times or (), strict=False) if time is not None}
    return known if known and len(known) == len(side.names) else None


def paired(
    robot: PoseSide,
    names: Sequence[str],
    where: str,
    times: Mapping[str, Decimal] | None = None,
    *,
    named: bool = True,
    in_order: bool = False,
    by_times: bool = False,
    at_times: bool = False,
    tolerance_s: float = TOLERANCE_S,
) -> Paired:
    """Returns the robot's pose for each of the camera's poses or images.

    Where both have times that are not simply equal, the robot's poses are those at the camera's times.

    ``names`` : of the camera's poses, or their places where they are not ``named``; ``where`` : their file or folder;
    ``times`` : by name, if there are any; ``in_order`` : whether a robot's poses without names belong to names in their
    order; ``by_times`` : whether times are needed; ``at_times`` : whether poses at the times are, also of equal ones;
    ``tolerance_s`` : distance of a sample from a time at which none can be interpolated.

    Raises InputError: poses without names or times that are needed, or none that belongs to another.
    """
    own, stream = times_of(robot), None
    if (by_times or at_times or robot.timed) and (own is None or times is None):
        lacking, first = (robot.where, robot.called()[0]) if own is None else (where, names[0])
        said = f"{lacking}: no times of its poses or images, like {first}; give a column time_s, a TUM trajectory, "
        said += "images named by seconds (1689.25.png), or --image-times"
        raise InputError("E-POSES-UNTIMED", said)
    of_files = not robot.timed and any(stem_of(name) != name for name in robot.names)
    if own and times and not of_files:
        row_of = {time: i for i, time in enumerate(own.values())}
        if at_times or not row_of.keys() >= set(times.values()):
            return _interpolated(robot, list(own.values()), names, where, times, tolerance_s)
        rows, how = [(row_of[times[name]], j) for j, name in enumerate(names) if name in times], "by their times"
        if len(row_of) == len(robot) > len(rows):
            stream = Stream.of(list(own.values()), robot.poses, Path(robot.where).name)
            stream = stream if stream.spacing_s() <= LONGEST_S else None
    else:
        rows, how = _by_names(robot, names, where, named, in_order)
    a, b = ([row[k] for row in rows] for k in (0, 1))
    exact = bool(robot.names) and all(robot.names[i] == names[j] for i, j in rows)
    alone = []
    for every, used, file in ((robot.called(), set(a), robot.where), (names, set(b), where)):
        if not (stream and file == robot.where):  # samples between images are no mistake
            alone += [(name, f"in {Path(file).name} alone") for i, name in enumerate(every) if i not in used]
    timed = Timed(stream, stream.after_origin([times[names[j]] for j in b])) if stream and times else None
    return Paired(robot[a], b, tuple(alone), timed, () if exact else (f"rows joined {how}",))


def _interpolated(
    robot: PoseSide,
    own: Sequence[Decimal],
    names: Sequence[str],
    where: str,
    times: Mapping[str, Decimal],
    tolerance_s: float,
) -> Paired:
    """Returns the robot's poses at the times of names."""
    timed_rows = [j for j, name in enumerate(names) if name in times]
    stream = Stream.of(own, robot.poses, Path(robot.where).name)
    seconds = stream.after_origin([times[names[j]] for j in timed_rows])
    taken = taken_at(stream, seconds, [names[j] for j in timed_rows], tolerance_s)
    if not taken.rows:
        said = f"{where}: none has a pose of the robot: first {', '.join(taken.left_out[0])}"
        raise InputError("E-POSES-UNMATCHED", said)
    rows = [timed_rows[k] for k in taken.rows]
    unused = "covariances of the robot's poses are not used: they are of other times"
    lines = (taken.said, *([] if robot.covariance is None else [unused]))
    at = tuple(names[j] for j in rows)
    found = replace(robot, poses=taken.base_from_flange, names=at, places=at, covariance=None)
    left_out = (*taken.left_out, *((name, "no time") for name in names if name not in times))
    return Paired(found, rows, left_out, Timed(stream, seconds[taken.rows]), lines)


def _by_names(
    robot: PoseSide, names: Sequence[str], where: str, named: bool, in_order: bool
) -> tuple[list[tuple[int, int]], str]:
    """Returns rows of both that have one name, or in their order, and how they were joined."""
    if not robot.names and (in_order or not named):
        return _by_order(robot, names, where)
    if not robot.names or not named:
        without, other = (where, robot.names[0]) if robot.names else (robot.where, names[0])
        said = f"{without}: no names or times of its poses, the other side has: {other} …"
        raise InputError("E-POSES-UNNAMED", f"{said}; name both, like with a column image")
    if (joined := partners(robot.names, names)) is None:
        said = f"{robot.where}, {where}: no name or time in common: {robot.names[0]} … in the one, {names[0]} … in the "
        raise InputError("E-POSES-UNMATCHED", f"{said}other; correct them")
    return joined


def _by_order(robot: PoseSide, names: Sequence[str], where: str) -> tuple[list[tuple[int, int]], str]:
    """Returns rows in the order of the numbers at the end of names, if each has one of its own."""
    if len(names) != len(robot):
        said = f"{robot.where}, {where}: {len(robot)} and {len(names)} poses or images"
        raise InputError("E-POSES-COUNT", f"{said}, the robot's without names; as many of each, or names, needed")
    numbers, order = [trailing_number(name) for name in names], list(range(len(names)))
    if None not in numbers and len(set(numbers)) == len(numbers):
        order.sort(key=lambda j: numbers[j] or 0)
    how = f"by their order, for the robot's have no names: {robot.places[0]} with {names[order[0]]}"
    return list(enumerate(order)), how


def partners(first: Sequence[str], second: Sequence[str]) -> tuple[list[tuple[int, int]], str] | None:
    """Returns the places of names in both lists that mean the same, and how they were matched: without folder and
    ending, as they are, as times, or by the number at their ends, of which none occurs twice. None where none match."""
    ways: tuple[tuple[Callable[[str], Hashable | None], str], ...] = (
        (stem_of, "by names without folder and ending"),
        (str, "by their names"),
        (time_of, "by their times as numbers"),
        (trailing_number, "by the number at the end of each name, like"),
    )
    for way, description in ways:
        one, other = ([way(name) for name in names] for names in (first, second))
        known = [[key for key in keys if key is not None] for keys in (one, other)]
        if not all(keys and len(set(keys)) == len(keys) for keys in known):
            continue
        place = {key: j for j, key in enumerate(other)}
        rows = [(i, place[key]) for i, key in enumerate(one) if key is not None and key in place]
        if rows:
            i, j = rows[0]
            return rows, f"{description} {first[i]} and {second[j]}" if description.endswith("like") else description
    return None


def trailing_number(name: str) -> int | None:
    """Returns the number at the end of a name: 7 for ``img07.png``; None where there is none, or for a time."""
    match = re.fullmatch(r"(?:.*[^\d.])?(\d{1,9})", stem_of(name))
    return int(match[1]) if match else None
