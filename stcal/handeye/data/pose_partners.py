"""Rows of the robot and of the camera, or of images, that belong together: by names, times, numbers, or order."""

import re
from collections.abc import Callable, Hashable, Sequence

from stcal.errors import InputError
from stcal.handeye.data.pose_content import PoseSide
from stcal.handeye.data.stream import stem_of, time_of


def matched(robot: PoseSide, camera: PoseSide, key: str) -> tuple[list[tuple[int, int]], str]:
    """Returns the rows of both sides that belong together, in the robot's order, and how they match if not by name."""
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
    """Returns the places of names in both lists that mean the same, and how they were matched: as they are, as times,
    without folder and ending, or by the number at their ends, where no number occurs twice. None where none match."""
    ways: tuple[tuple[Callable[[str], Hashable | None], str], ...] = (
        (str, ""),
        (time_of, "by their times as numbers"),
        (stem_of, "by names without folder and ending"),
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


def rows_of_images(robot: PoseSide, names: Sequence[str]) -> tuple[dict[str, int], tuple[str, ...], str]:
    """Returns the row by image, the images of rows without a partner, and how they were matched, empty if by name.
    Names may lack folder and ending where that leaves one image; where none fits, times or the numbers at their ends
    match, and poses without names by order."""
    where, places = f"robot poses {robot.where}", robot.places
    if not robot.names:
        if len(names) != len(robot):
            said = f"{len(robot)} poses without names for {len(names)} images; as many, or a name for each, needed"
            raise InputError("E-NAMES-COUNT", f"{where}: {said}")
        numbers, order = [trailing_number(name) for name in names], list(range(len(names)))
        if None not in numbers and len(set(numbers)) == len(numbers):
            order.sort(key=lambda i: numbers[i] or 0)
        how = f"by order, for the poses have no names: {places[0]} is of {names[order[0]]}"
        return {names[i]: row for row, i in enumerate(order)}, (), how
    short: dict[str, list[str]] = {}
    for name in names:
        file_name = name.rsplit("/", 1)[-1]
        for key in {file_name, file_name.rsplit(".", 1)[0]}:
            short.setdefault(key, []).append(name)
    rows: dict[str, int] = {}
    missing = []
    for row, image in enumerate(robot.names):
        fitting = [image] if image in names else short.get(image, [])
        if len(fitting) > 1:
            said = f"{where}: {places[row]}: {image} may be {fitting[0]} or {fitting[1]}; give its path"
            raise InputError("E-IMAGE-NAME-AMBIGUOUS", said)
        if fitting and (first := rows.setdefault(fitting[0], row)) != row:
            said = f"{where}: {places[first]} and {places[row]}: both are of image {fitting[0]!r}; one row needed"
            raise InputError("E-POSE-REPEATED", said)
        missing += [] if fitting else [image]
    if rows or (found := partners(robot.names, names)) is None:
        return rows, tuple(missing), ""
    rows = {names[j]: i for i, j in found[0]}
    return rows, tuple(name for i, name in enumerate(robot.names) if i not in rows.values()), found[1]
