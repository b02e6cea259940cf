"""The robot's poses at which images were taken."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses
from stcal.handeye.pairs import SIDES, read_side
from stcal.table_file import read_table


@dataclass(frozen=True, slots=True, eq=False)
class RobotPoses:
    """``images`` : name of each; ``base_from_flange`` : m, mm; ``covariance`` : (m, 6, 6) or None; ``lines`` : of the
    file ``where``."""

    images: tuple[str, ...]
    base_from_flange: Poses
    covariance: np.ndarray | None
    lines: tuple[int, ...]
    where: str

    def rows(self, names: list[str]) -> tuple[dict[str, int], tuple[str, ...]]:
        """Row by image, of those of ``names`` that have one, and the images of rows that have none.

        A row may give the name without its folder, as long as no other image has the same.
        """
        short: dict[str, list[str]] = {}
        for name in names:
            short.setdefault(name.rsplit("/", 1)[-1], []).append(name)
        found, missing = {}, []
        for row, image in enumerate(self.images):
            of = [image] if image in names else short.get(image, [])
            if len(of) > 1:
                raise InputError(
                    f"{self.where}: line {self.lines[row]}: {image} may be {of[0]} or {of[1]}; add the folder"
                )
            if of:
                found[of[0]] = row
            else:
                missing.append(image)
        return found, tuple(missing)


def read_robot_poses(path: str | Path) -> RobotPoses:
    """Read a CSV file with a column ``image`` and ``base_from_flange_x_mm`` … (or ``flange_from_base_…``).

    Raises
    ------
    InputError
        Missing columns, values that are not finite or quaternions that are not of unit length, named by line, or an
        image that has two rows.
    """
    table = read_table(path, "robot poses")
    images = table.text("image")
    first: dict[str, int] = {}
    for image, line in zip(images, table.lines, strict=True):
        if image in first:
            raise InputError(
                f"{table.where}: lines {first[image]} and {line}: both are of image {image!r}; one row needed"
            )
        first[image] = line
    poses, covariance = read_side(table, *SIDES[0])
    return RobotPoses(tuple(images), poses, covariance, tuple(table.lines), table.where)
