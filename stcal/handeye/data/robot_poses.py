"""Reader of the robot's poses at which images were taken."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Order, Poses
from stcal.handeye.data.formats.record import Said, require_each_once
from stcal.handeye.data.inputs import partners, read_robot, require_own, trailing_number
from stcal.handeye.data.pairs import SIDES, read_side
from stcal.io.table import LENGTHS, read_table

TIME = "time_s"
"""Column of a stream of poses, in place of ``image``."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotPoses:
    """``images`` : image of each pose; ``base_from_flange`` : m, mm; ``covariance`` : (m, 6, 6) or None; ``places`` :
    place of each pose in ``where``, for messages; ``understood`` : how the file was read; ``own`` : whether it is a
    table of the package; ``timed`` : whether ``images`` are times by the name of their column. Without ``images``, the
    poses belong to the images in their order."""

    images: tuple[str, ...]
    base_from_flange: Poses
    covariance: np.ndarray | None
    places: tuple[str, ...]
    where: str
    understood: str = ""
    own: bool = True
    timed: bool = False

    @property
    def file(self) -> str:
        """Name of the file, without its folders."""
        return Path(self.where.removeprefix("robot poses ")).name

    def pairing(self, names: list[str]) -> tuple[dict[str, int], tuple[str, ...], str]:
        """Returns the row by image, the images of rows without a partner, and how they were matched.

        The first two are those of :meth:`rows`. Where no name fits, images are matched by times or by the numbers at
        the ends of names; poses without names, by order. The last result is empty where images are matched by name.
        """
        if not self.images:
            if len(names) != len(self.base_from_flange):
                raise InputError(
                    "E-NAMES-COUNT",
                    f"{self.where}: {len(self.base_from_flange)} poses without names for {len(names)} images; as many, "
                    "or a name for each, needed",
                )
            numbers = [trailing_number(name) for name in names]
            order = list(range(len(names)))
            if None not in numbers and len(set(numbers)) == len(numbers):
                order.sort(key=lambda i: numbers[i] or 0)
            description = f"by order, for the poses have no names: {self.places[0]} is of {names[order[0]]}"
            return {names[i]: row for row, i in enumerate(order)}, (), description
        rows, missing = self.rows(names)
        if rows or (matches := partners(self.images, names)) is None:
            return rows, missing, ""
        pairs, description = matches
        used = {i for i, _ in pairs}
        return (
            {names[j]: i for i, j in pairs},
            tuple(n for i, n in enumerate(self.images) if i not in used),
            description,
        )

    def rows(self, names: list[str]) -> tuple[dict[str, int], tuple[str, ...]]:
        """Returns the row of each of ``names`` that has one, and the images of rows that are not among them. Names may
        lack folder and ending where that leaves one image."""
        short: dict[str, list[str]] = {}
        for name in names:
            file_name = name.rsplit("/", 1)[-1]
            for key in {file_name, file_name.rsplit(".", 1)[0]}:
                short.setdefault(key, []).append(name)
        row_of_image, missing = {}, []
        for row, image in enumerate(self.images):
            fitting = [image] if image in names else short.get(image, [])
            if len(fitting) > 1:
                raise InputError(
                    "E-IMAGE-NAME-AMBIGUOUS",
                    f"{self.where}: {self.places[row]}: {image} may be {fitting[0]} or {fitting[1]}; give its path",
                )
            if fitting and fitting[0] in row_of_image:
                both = f"{self.places[row_of_image[fitting[0]]]} and {self.places[row]}"
                raise InputError(
                    "E-POSE-REPEATED", f"{self.where}: {both}: both are of image {fitting[0]!r}; one row needed"
                )
            if fitting:
                row_of_image[fitting[0]] = row
            else:
                missing.append(image)
        return row_of_image, tuple(missing)


def read_robot_poses(path: str | Path, quaternions: Order = "wxyz", statements: Said | None = None) -> RobotPoses:
    """Read the robot's poses in any format of :mod:`stcal.handeye.data.formats`, or CSV with columns ``image`` or
    ``time_s``, and ``base_from_flange_x_mm`` … (or ``flange_from_base_…``).

    A CSV file may have a column ``image``, or ``time_s``, and ``base_from_flange_x_mm`` … (or ``flange_from_base_…``).

    ``quaternions`` : ``xyzw`` where the columns hold x, y, z, w in the order in which they stand;
    ``statements`` : the user's statements about what a file of another program does not state itself.
    """
    path, statements = Path(path), statements or Said()
    poses = read_robot(path, statements, "image", quaternions)
    where = f"robot poses {path}"
    if poses is not None:
        return RobotPoses(poses.names, poses.poses, poses.covariance, poses.places, where, poses.understood, own=False)
    if statements.options():
        require_own(path, quaternions)
        raise InputError(
            "E-OPTION-NEEDS",
            f"{where}: the names of its columns state unit and rotation; leave {', '.join(statements.options())} out, "
            "and rename those that are wrong (x_m in place of x_mm)",
        )
    table = read_table(path, "robot poses", quaternions)
    timed = "image" not in table and TIME in table
    images, places = table.text(TIME if timed else "image"), tuple(f"line {line}" for line in table.lines)
    require_each_once(images, places, table.where, "image ")
    poses, covariance, _ = read_side(table, *SIDES[0])
    frame = next(name for name in SIDES[0] if any(column.startswith(f"{name}_") for column in table.columns))
    understood = f"{path.name}: table; {len(images)} poses; {frame} by its columns; {table.unit(f'{frame}_x', LENGTHS)}"
    return RobotPoses(tuple(images), poses, covariance, places, table.where, understood, timed=timed)
