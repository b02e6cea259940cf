"""Pose pairs from the content of files: one direction, mm, and rows of both sides that belong together."""

import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Order, Poses
from stcal.handeye.data.pose_pairs import HandEyePoses, Setup, inverted
from stcal.handeye.data.recognise import read_columns, read_content, todays
from stcal.handeye.data.record import FRAMES, Known, PoseContent, PoseSide, Role, Said, inverse_name
from stcal.handeye.data.stream import LONGEST_S, TOLERANCE_S, Stream, Timed, stamps_of, stem_of, taken_at, time_of
from stcal.io.join import keys_of
from stcal.io.table import FARTHEST, LENGTHS, Table, read_table

METRES_UP_TO, MILLIMETRES_FROM = 5.0, 50.0
"""Lengths are metres if all are below the first limit, and millimetres if one is above the second. Flanges and boards
are farther from base and camera than 5 mm, and nearer than 50 m."""
MIXED = 100.0
"""Ratio of the farthest to the nearest pose above which poses are in two units."""
SHOWN = 3


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """Poses of one side in the direction that is needed, mm.

    ``names`` : image or timestamp of each pose, or none; ``places`` : place of each pose in its file; ``understood`` :
    how the file was read; ``guessed`` : the unit that was guessed from the size of lengths, empty where it is known;
    ``common`` : (m, 6, k) errors that the poses have in common.
    """

    poses: Poses
    names: tuple[str, ...]
    places: tuple[str, ...]
    covariance: np.ndarray | None
    where: str
    understood: str
    guessed: str = ""
    common: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: Sequence[int]) -> "Posed":
        """Returns these rows alone."""
        at = list(rows)
        names, places = (tuple(every[i] for i in at) if every else () for every in (self.names, self.places))
        covariance, common = (None if each is None else each[at] for each in (self.covariance, self.common))
        return replace(self, poses=self.poses[at], names=names, places=places, covariance=covariance, common=common)

    def called(self) -> tuple[str, ...]:
        """Returns the names of the rows, or their places."""
        return self.names or self.places


@dataclass(frozen=True, slots=True, eq=False)
class ToldPairs:
    """Pose pairs; ``understood`` : a line for each input; ``setup`` : where a file states it; ``left_out`` :
    (name, why); ``timed`` : where the robot's poses were taken by time."""

    pairs: HandEyePoses
    understood: tuple[str, ...]
    setup: Setup | None = None
    left_out: tuple[tuple[str, str], ...] = ()
    timed: Timed | None = None

    @classmethod
    def of(cls, robot: Posed, camera: Posed, names: Sequence[str], where: str, **more: Any) -> "ToldPairs":
        """Returns the rows of both sides, which belong together; ``lines`` : further ones on how they were read."""
        covariances = robot.covariance, camera.covariance
        pairs = HandEyePoses(robot.poses, camera.poses, *covariances, tuple(names), where, camera.common)
        lines = (f"robot: {robot.understood}", f"camera: {camera.understood}", *more.pop("lines", ()))
        return cls(pairs, lines, **more)


def read_pairs(path: Path, statements: Said, key: str = "image", quaternions: Order = "wxyz") -> ToldPairs | None:
    """Returns the pose pairs of one file; None where it is one of the package's own tables.

    Raises InputError: the message says what is wrong with the file, or that it holds poses of one side only.
    """
    content = read_content(path, statements, key, quaternions)
    if content is None:
        return None
    if len(content.sides) == 1:
        frames = content.sides[0].frames
        held = f"{frames.name} alone" if frames is not None else "poses of one side, robot or camera"
        said = f"{path}: {content.form} with {held}"
        raise InputError("E-POSES-MIXED", f"{said}; give the robot's file as --a and the camera's as --b")
    robot, camera = (settled(content, role, path, statements) for role in FRAMES)
    if robot.guessed != camera.guessed and robot.guessed and camera.guessed:
        said = f"{path}: by their size the robot's lengths are in {robot.guessed} and the camera's in {camera.guessed}"
        raise InputError("E-POSES-UNITS", f"{said}; write both in one unit, or to two files for --a and --b")
    return ToldPairs.of(robot, camera, robot.names or camera.called(), path.name, setup=content.setup)


def read_two(
    first: Path,
    second: Path,
    statements: Said,
    key: str,
    quaternions: Order = "wxyz",
    tolerance_s: float = TOLERANCE_S,
    timed: bool = False,
) -> ToldPairs | None:
    """Returns the robot's poses and the camera's, from two files, as pairs; None where both are the package's own
    tables.

    The rows are joined by image or time, or by their order where neither file has names. Where times are not equal,
    and for all rows where ``timed``, the robot's poses are those at the camera's times, within ``tolerance_s``.
    """
    files = tuple(zip(FRAMES, (first, second), keys_of(key), strict=True))
    contents = [read_content(path, statements.of(role), own, quaternions) for role, path, own in files]
    if contents[0] is None and contents[1] is None:
        return None
    sides = []
    for (role, path, own), content in zip(files, contents, strict=True):
        if content is None:
            table = read_table(path, "table", quaternions)
            content = read_columns(table, own, statements)
            if content is None:
                raise _no_poses(table)
        sides.append(settled(content, role, path, statements))
    (robot, camera), where = sides, f"{first.name} with {second.name}"
    setup: Setup | None = next((each.setup for each in contents if each is not None and each.setup), None)
    times, wanted = (stamps_of(side.names) if side.names else None for side in sides)
    if timed and (times is None or wanted is None):
        untimed = (robot if times is None else camera).where
        raise InputError("E-POSES-UNTIMED", f"{untimed}: no times of its poses; with --time-offset both need them")
    if times is not None and wanted is not None and (timed or not set(wanted) <= set(times)):
        return _by_time(robot, camera, times, wanted, setup, where, tolerance_s)
    rows, how = matched(robot, camera, key)
    a, b = [i for i, _ in rows], [j for _, j in rows]
    stamped = None
    if times is not None and wanted is not None and len(set(times)) >= max(len(times), len(rows) + 1):
        stream = Stream.of(times, robot.poses, first.name)
        if stream.spacing_s() <= LONGEST_S:
            stamped = Timed(stream, stream.after_origin([wanted[j] for j in b]))
    alone = [(robot.called(), first, a)] if stamped is None else []  # samples between images are no mistake
    left_out = [
        (name, f"in {path.name} alone")
        for names, path, used in (*alone, (camera.called(), second, b))
        for i, name in enumerate(names)
        if i not in used
    ]
    lines = (f"rows joined {how}",) if how else ()
    more = {"lines": lines, "setup": setup, "left_out": tuple(left_out), "timed": stamped}
    return ToldPairs.of(robot[a], camera[b], robot[a].called(), where, **more)


def read_robot(path: Path, statements: Said, key: str = "image", quaternions: Order = "wxyz") -> Posed | None:
    """Returns the robot's poses of a file; None where it is one of the package's own tables."""
    content = read_content(path, statements.of("robot"), key, quaternions)
    return None if content is None else settled(content, "robot", path, statements)


def own_told(source: Path | Table, quaternions: Order = "wxyz") -> list[str]:
    """Returns lines that describe a table of pose pairs of the package's own."""
    table = read_table(source, "pose file", quaternions)
    lines = []
    for role, names in FRAMES.items():
        frame = next((name for name in names if any(column.startswith(f"{name}_") for column in table.columns)), "")
        unit = table.unit(f"{frame}_x", LENGTHS)
        with_covariances = ", with covariances" if f"{frame}_cov_rx_rx" in table else ""
        turned = "quaternions by name" if quaternions == "wxyz" else "quaternions x, y, z, w by their order"
        held = f"{len(table)} poses; {frame} by its columns; {turned}; {unit}{with_covariances}"
        lines.append(f"{role}: {table.where.removeprefix('pose file ')}: table; {held}")
    return lines


def require_own(path: Path, quaternions: Order = "wxyz") -> None:
    """Refuse a table without poses in its columns."""
    table = read_table(path, "table", quaternions)
    if not todays(table):
        raise _no_poses(table)


def _no_poses(table: Table) -> InputError:
    return InputError(
        "E-POSES-NOT-FOUND",
        f"{table.where}: no poses in its columns; a place (x, y, z or x_mm …) and a rotation (qw … qz, rx, ry, rz, "
        f"a, b, c …) needed; the header is {table.header()}; rename them",
    )


def _by_time(
    robot: Posed,
    camera: Posed,
    times: Sequence[Decimal],
    wanted: Sequence[Decimal],
    setup: Setup | None,
    where: str,
    tolerance_s: float,
) -> ToldPairs:
    """Returns the robot's poses at the camera's times."""
    stream = Stream.of(times, robot.poses, Path(robot.where).name)
    seconds = stream.after_origin(wanted)
    taken = taken_at(stream, seconds, tolerance_s)
    if not taken.kept.any():
        first = f"{camera.names[0]}, {taken.why[0]}"
        raise InputError("E-POSES-UNMATCHED", f"{camera.where}: no pose has one of the robot: first {first}")
    rows, lines = np.flatnonzero(taken.kept), (taken.said,)
    if robot.covariance is not None:
        lines += ("covariances of the robot's poses are not used: they are of other times",)
    at_images, seen = replace(robot, poses=taken.base_from_flange, covariance=None), camera[rows.tolist()]
    left_out = tuple((name, why) for name, why in zip(camera.names, taken.why, strict=True) if why)
    more = {"lines": lines, "setup": setup, "left_out": left_out, "timed": Timed(stream, seconds[rows])}
    return ToldPairs.of(at_images, seen, seen.names, where, **more)


def settled(content: PoseContent, role: Role, path: Path, statements: Said) -> Posed:
    """Returns poses of a role, or of the only side where nothing states its role, in the direction that is needed, mm,
    with a line on how they were read."""
    wanted, first, statements = FRAMES[role][0], content.sides[0], statements.of(role)
    side = content.of(role) or (first if len(content.sides) == 1 and first.frames is None else None)
    if side is None:
        held = first.frames.name if first.frames else "poses"
        raise InputError("E-POSES-MIXED", f"{path}: {content.form} of {held}, {wanted} needed here; give another file")
    far = np.flatnonzero(np.abs(side.translation).max(axis=1) > FARTHEST)
    if len(far):
        measured = np.abs(side.translation[far[0]]).max()
        raise InputError(
            "E-VALUE-TOO-FAR", f"{path}: {side.places[far[0]]}: length {measured:.3g}, at most {FARTHEST:g}"
        )
    frames = _direction(side, role, path, statements)
    factor, unit, guessed = _unit(side, frames.name, path, statements)
    poses = Poses(side.rotation, factor * side.translation)
    covariance, common = side.covariance, side.common
    if frames.name != wanted:
        poses, covariance, common = inverted(poses, covariance, common)
    parts = [f"{path.name}: {content.form}", f"{len(side)} poses", f"{frames.name} {frames.by}", side.turned, unit]
    if content.passed_over:
        ellipsis = " …" if len(content.passed_over) > SHOWN else ""
        parts.append(f"passed over: {', '.join(content.passed_over[:SHOWN])}{ellipsis}")
    return Posed(poses, side.names, side.places, covariance, str(path), "; ".join(parts), guessed, common)


def _direction(side: PoseSide, role: Role, path: Path, statements: Said) -> Known:
    """Returns the direction that the user or the file states; by default that of the method, or of a trajectory."""
    option = statements.frames_of(role)
    if option is not None:
        if side.frames is not None and side.frames.stated and side.frames.name != option:
            name = inverse_name(side.frames.by.rpartition(" ")[2])
            raise InputError(
                "E-OPTION-CONTRADICTS",
                f"{path}: {side.frames.name} {side.frames.by}, --poses-are {option}; if the name is wrong, change it "
                f"in the file{f', to {name}' if name else ''}; else leave the option out",
            )
        return Known(option, "as you say")
    if side.frames is not None:
        return side.frames
    if side.trajectory and role == "camera":
        return Known("board_from_camera", "by default, the camera's trajectory")
    return Known(FRAMES[role][0], "by default")


def _unit(side: PoseSide, name: str, path: Path, statements: Said) -> tuple[float, str, str]:
    """Returns the factor to mm, how the unit is known, and the unit if it was guessed from the size of lengths."""
    unit, option = side.unit, statements.length_unit
    if option is not None and not (unit is not None and unit.stated):
        unit = Known(option, "as you say", False)
    if unit is not None:
        return LENGTHS[unit.name], f"{unit.name} {unit.by}", ""
    distances = np.linalg.norm(side.translation, axis=1)
    farthest, nearest = float(distances.max()), float(distances.min())
    if 0 < nearest < farthest / MIXED:
        near, far = side.places[int(distances.argmin())], side.places[int(distances.argmax())]
        said = f"{path}: {name}: {near} is {nearest:.3g} away and {far} {farthest:.3g}, as if in two units"
        raise InputError("E-POSES-UNITS", f"{said}; write all in the same unit and give --length-unit mm or m")
    if METRES_UP_TO < farthest < MILLIMETRES_FROM or farthest == 0:
        raise InputError(
            "E-POSES-UNITS",
            f"{path}: {name}: lengths up to {farthest:.3g}, {METRES_UP_TO:g} or less for metres and "
            f"{MILLIMETRES_FROM:g} or more for mm needed to tell the unit; give --length-unit mm, cm or m",
        )
    guess = "m" if farthest <= METRES_UP_TO else "mm"
    return LENGTHS[guess], f"{guess} by their size, up to {farthest:.4g}", guess


def matched(robot: Posed, camera: Posed, key: str) -> tuple[list[tuple[int, int]], str]:
    """Returns the rows of both sides that belong together, in the order of the robot's rows, and how they were matched.

    The description of the match is empty where the names are the same.
    """
    if not robot.names and not camera.names:
        if len(robot) == len(camera):
            return [(i, i) for i in range(len(robot))], "by their order, for neither file has names or times"
        counts = f"{robot.where}, {camera.where}: {len(robot)} and {len(camera)} poses without names or times"
        raise InputError("E-POSES-COUNT", f"{counts}; as many of each, or names, needed")
    if not robot.names or not camera.names:
        without, other = (robot, camera) if not robot.names else (camera, robot)
        said = f"{without.where}: no names or times of its poses, {other.where} has: {other.names[0]} …"
        raise InputError("E-POSES-UNNAMED", f"{said}; name both, like with a column {key}")
    rows = partners(robot.names, camera.names)
    if rows is None:
        said = f"{robot.where}, {camera.where}: no name or time in common: {robot.names[0]} … in the one"
        raise InputError("E-POSES-UNMATCHED", f"{said}, {camera.names[0]} … in the other; correct them")
    return rows


def partners(first: Sequence[str], second: Sequence[str]) -> tuple[list[tuple[int, int]], str] | None:
    """Returns the places of names in both lists that mean the same, and how they were matched.

    The result is None where no names match. Names are compared as they are, then as times, then without folder and
    ending, then by the number at their ends, where no number occurs twice.
    """
    ways: tuple[tuple[Callable[[str], Hashable | None], str], ...] = (
        (str, ""),
        (time_of, "by their times as numbers"),
        (stem_of, "by names without folder and ending"),
        (trailing_number, "by the number at the end of each name, like"),
    )
    for way, description in ways:
        keys = [[way(name) for name in names] for names in (first, second)]
        known = [[key for key in own if key is not None] for own in keys]
        if not all(own and len(set(own)) == len(own) for own in known):
            continue
        place = {key: j for j, key in enumerate(keys[1])}
        rows = [(i, place[key]) for i, key in enumerate(keys[0]) if key is not None and key in place]
        if rows:
            i, j = rows[0]
            return rows, f"{description} {first[i]} and {second[j]}" if description.endswith("like") else description
    return None


def trailing_number(name: str) -> int | None:
    """Returns the number at the end of a name: 7 for ``img07.png``; None where there is none, or for a time."""
    match = re.fullmatch(r"(?:.*[^\d.])?(\d{1,9})", stem_of(name))
    return int(match[1]) if match else None
