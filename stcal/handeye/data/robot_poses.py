"""The robot's poses at which images were taken."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.rigid import UNIT_WITHIN, Poses
from stcal.handeye.data.pairs import SIDES, read_side
from stcal.io.files import SETTINGS_BYTES, read_bytes
from stcal.io.plain_yaml import load_yaml
from stcal.io.quaternions import Order
from stcal.io.table import LENGTHS, read_table

YAML = (".yaml", ".yml")


@dataclass(frozen=True, slots=True, eq=False)
class RobotPoses:
    """``images`` : name of each; ``base_from_flange`` : m, mm; ``covariance`` : (m, 6, 6) or None; ``places`` : where
    each stands in ``where``, for messages."""

    images: tuple[str, ...]
    base_from_flange: Poses
    covariance: np.ndarray | None
    places: tuple[str, ...]
    where: str

    def rows(self, names: list[str]) -> tuple[dict[str, int], tuple[str, ...]]:
        """Row by image, of those of ``names`` that have one, and the images of rows that have none.

        A row may give the name without its folder, or without its ending too, as long as no other image has the same.
        """
        short: dict[str, list[str]] = {}
        for name in names:
            alone = name.rsplit("/", 1)[-1]
            for key in {alone, alone.rsplit(".", 1)[0]}:
                short.setdefault(key, []).append(name)
        found, missing = {}, []
        for row, image in enumerate(self.images):
            of = [image] if image in names else short.get(image, [])
            if len(of) > 1:
                raise InputError(f"{self.where}: {self.places[row]}: {image} may be {of[0]} or {of[1]}; give its path")
            if of and of[0] in found:
                both = f"{self.places[found[of[0]]]} and {self.places[row]}"
                raise InputError(f"{self.where}: {both}: both are of image {of[0]!r}; one row needed")
            if of:
                found[of[0]] = row
            else:
                missing.append(image)
        return found, tuple(missing)


def read_robot_poses(path: str | Path, quaternions: Order = "wxyz") -> RobotPoses:
    """Read a CSV file with a column ``image`` and ``base_from_flange_x_mm`` … (or ``flange_from_base_…``).

    Or ROS-Industrial's calibration data: a folder of YAML files, one for each image, of the same name, with ``x, y, z``
    in metres and ``qx, qy, qz, qw``; or a YAML list of such files, each a ``pose`` with its ``image``.
    ``quaternions`` : ``xyzw`` where the columns hold x, y, z, w in the order in which they stand.

    Raises
    ------
    InputError
        Missing columns, values that are not finite or quaternions that are not of unit length, named by line, or an
        image that has two rows; another order of quaternions than their names say, in YAML.
    """
    path = Path(path)
    if quaternions != "wxyz" and (path.is_dir() or path.suffix.lower() in YAML):
        raise InputError(
            f"robot poses {path}: --quaternions {quaternions} is of a CSV file's columns; YAML gives each "
            "of qx, qy, qz, qw by its name; correct the names"
        )
    if path.is_dir():
        files = sorted(path.glob("*.yaml")) + sorted(path.glob("*.yml"))
        if not files:
            raise InputError(f"robot poses {path}: a folder without *.yaml; a CSV file, or a YAML file for each image")
        return _from_yaml([(file.stem, file) for file in files], f"robot poses {path}")
    if path.suffix.lower() in YAML:
        return _from_yaml(_listed(path), f"robot poses {path}")
    table = read_table(path, "robot poses", quaternions)
    images, places = table.text("image"), tuple(f"line {line}" for line in table.lines)
    _one_each(images, places, table.where)
    poses, covariance = read_side(table, *SIDES[0])
    return RobotPoses(tuple(images), poses, covariance, places, table.where)


def _one_each(images: Sequence[str], places: Sequence[str], where: str) -> None:
    first: dict[str, str] = {}
    for image, place in zip(images, places, strict=True):
        if image in first:
            raise InputError(f"{where}: {first[image]} and {place}: both are of image {image!r}; one row needed")
        first[image] = place


def _listed(path: Path) -> list[tuple[str, Path]]:
    """Images and pose files of a list of both, alone or under ``data``."""
    content = _yaml(path, f"robot poses {path}")
    rows = content.get("data") if isinstance(content, dict) else content
    form = f"robot poses {path}: no list of pairs `image:` and `pose:`; give these, or the folder of the poses"
    if not isinstance(rows, list) or not rows:
        raise InputError(form)
    for row in rows:
        if not (isinstance(row, dict) and isinstance(row.get("image"), str) and isinstance(row.get("pose"), str)):
            raise InputError(form)
    return [(Path(row["image"]).name, path.parent / row["pose"]) for row in rows]


def _from_yaml(files: list[tuple[str, Path]], where: str) -> RobotPoses:
    """One pose from each file, by the name of its image."""
    names, values = [file.name for _, file in files], []
    _one_each([image for image, _ in files], names, where)
    for _, file in files:
        pose = _yaml(file, f"{where}: {file.name}")
        keys = ("x", "y", "z", "qw", "qx", "qy", "qz")
        row = [pose.get(key) if isinstance(pose, dict) else None for key in keys]
        for key, value in zip(keys, row, strict=True):
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError(f"{where}: {file.name}: {key} is {value!r}, a finite number needed")
        length = float(np.linalg.norm(np.array(row[3:], float)))
        if abs(length - 1) > UNIT_WITHIN:
            raise InputError(f"{where}: {file.name}: quaternion of length {length:.4g}, 1 ± {UNIT_WITHIN:g} needed")
        values.append(row)
    flat = np.array(values, float)
    poses = Poses.from_quaternions(flat[:, 3:], LENGTHS["m"] * flat[:, :3])
    return RobotPoses(tuple(image for image, _ in files), poses, None, tuple(names), where)


def _yaml(path: Path, where: str):
    try:
        return load_yaml(read_bytes(path, SETTINGS_BYTES).decode("utf-8"))
    except OSError as error:
        raise InputError(f"{where}: {error.strerror or error}; give a readable file") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{where}: not YAML ({' '.join(str(error).split())[:100]}); correct it") from error
