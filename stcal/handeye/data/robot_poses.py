"""Reader of the robot's poses at which images were taken."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.rigid import Order, Poses
from stcal.handeye.data.formats.recognise import SUFFIXES, NotToldError
from stcal.handeye.data.formats.record import Said, require_each_once
from stcal.handeye.data.inputs import partners, read_robot, require_own, trailing_number
from stcal.handeye.data.pairs import SIDES, read_side
from stcal.io.files import SETTINGS_BYTES, read_bytes
from stcal.io.quaternions import require_unit
from stcal.io.table import LENGTHS, read_table
from stcal.io.toml import load_yaml

YAML = (".yaml", ".yml")
TIME = "time_s"
"""Column of a stream of poses, in place of ``image``."""
INDUSTRIAL = "poses of ROS-Industrial; base_from_flange by default; quaternions by name; m as in ROS"


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
        """Name of the file or folder, without its parent folders."""
        return Path(self.where.removeprefix("robot poses ")).name

    def pairing(self, names: list[str]) -> tuple[dict[str, int], tuple[str, ...], str]:
        """Returns the row by image, the images of rows without a partner, and how they were matched.

        The first two are those of :meth:`rows`. Where no name fits, images are matched by times or by the numbers at
        the ends of names; poses without names, by order. The last result is empty where images are matched by name.

        Raises InputError: a name fits two images, or poses without names are not as many as the images.
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
        """Returns the row of each of ``names`` that has one, and the images of rows that are not in ``names``.

        A row may give the name without its folder, or without its ending too, as long as no other image has the same
        name.
        """
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
    """Read the robot's poses in any format of :mod:`stcal.handeye.data.formats`.

    A CSV file may have a column ``image``, or ``time_s``, and ``base_from_flange_x_mm`` … (or ``flange_from_base_…``).

    ROS-Industrial's calibration data are read too: a folder of YAML files, one for each image, of the same name, with
    ``x, y, z`` in metres and ``qx, qy, qz, qw``; or a YAML list of such files, each a ``pose`` with its ``image``.
    ``quaternions`` : ``xyzw`` where the columns hold x, y, z, w in the order in which they stand;
    ``statements`` : the user's statements about what a file of another program does not state itself.

    Raises InputError: missing columns, values that are not finite or quaternions that are not of unit length, named by
    line, or an image that has two rows; another order of quaternions than their names say, in YAML.
    """
    path, statements = Path(path), statements or Said()
    if (poses_of_others := _of_others(path, statements, quaternions)) is not None:
        return poses_of_others
    if statements.options():
        if path.is_file() and path.suffix.lower() not in YAML:
            require_own(path, quaternions)
        raise InputError(
            "E-OPTION-NEEDS",
            f"robot poses {path}: the names of its columns or keys state unit and rotation; leave "
            f"{', '.join(statements.options())} out, and rename those that are wrong (x_m in place of x_mm)",
        )
    if quaternions != "wxyz" and (path.is_dir() or path.suffix.lower() in YAML):
        raise InputError(
            "E-OPTION-NEEDS",
            f"robot poses {path}: --quaternions {quaternions} is of a CSV file's columns; YAML gives each "
            "of qx, qy, qz, qw by its name; correct the names",
        )
    if path.is_dir():
        files = sorted(path.glob("*.yaml")) + sorted(path.glob("*.yml"))
        if not files:
            raise InputError(
                "E-ROBOT-POSES-FORM",
                f"robot poses {path}: a folder without *.yaml; a CSV file, or a YAML file for each image",
            )
        read = _from_yaml([(file.stem, file) for file in files], f"robot poses {path}")
        return replace(read, understood=f"{path.name}: folder of {len(files)} {INDUSTRIAL}", own=False)
    if path.suffix.lower() in YAML:
        read = _from_yaml(_listed(path), f"robot poses {path}")
        return replace(read, understood=f"{path.name}: list of {len(read.images)} {INDUSTRIAL}", own=False)
    table = read_table(path, "robot poses", quaternions)
    timed = "image" not in table and TIME in table
    images, places = table.text(TIME if timed else "image"), tuple(f"line {line}" for line in table.lines)
    require_each_once(images, places, table.where, "image ")
    poses, covariance, _ = read_side(table, *SIDES[0])
    frame = next(name for name in SIDES[0] if any(column.startswith(f"{name}_") for column in table.columns))
    understood = f"{path.name}: table; {len(images)} poses; {frame} by its columns; {table.unit(f'{frame}_x', LENGTHS)}"
    return RobotPoses(tuple(images), poses, covariance, places, table.where, understood, timed=timed)


def _of_others(path: Path, statements: Said, quaternions: Order) -> RobotPoses | None:
    """Returns poses from formats of other programs. Returns None for tables, and for data of ROS-Industrial, whose
    readers follow."""
    if path.is_dir() and _industrial(path):
        return None
    try:
        poses = read_robot(path, statements, "image", quaternions)
    except NotToldError:
        if path.suffix.lower() in YAML:  # a list of images and files
            return None
        raise
    if poses is None:
        return None
    where = f"robot poses {path}"
    return RobotPoses(poses.names, poses.poses, poses.covariance, poses.places, where, poses.understood, own=False)


def _industrial(folder: Path) -> bool:
    """True if a file of the folder has a pose as ROS-Industrial writes it, and all files are YAML."""
    files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in SUFFIXES]
    if any(file.suffix.lower() not in YAML for file in files):
        return False
    for file in files:
        try:
            content = load_yaml(read_bytes(file, SETTINGS_BYTES).decode("utf-8"))
        except (OSError, yaml.YAMLError, ValueError, RecursionError):
            continue
        if isinstance(content, dict) and {"x", "y", "z"} <= content.keys():
            return True
    return False


def _listed(path: Path) -> list[tuple[str, Path]]:
    """Returns the images and pose files in a list of both, alone or under ``data``."""
    content = _yaml(path, f"robot poses {path}")
    rows = content.get("data") if isinstance(content, dict) else content
    form = f"robot poses {path}: no list of pairs `image:` and `pose:`; give these, or the folder of the poses"
    if not isinstance(rows, list) or not rows:
        raise InputError("E-ROBOT-POSES-FORM", form)
    for row in rows:
        if not (isinstance(row, dict) and isinstance(row.get("image"), str) and isinstance(row.get("pose"), str)):
            raise InputError("E-ROBOT-POSES-FORM", form)
    return [(Path(row["image"]).name, path.parent / row["pose"]) for row in rows]


def _from_yaml(files: list[tuple[str, Path]], where: str) -> RobotPoses:
    """Returns one pose from each file, by the name of its image."""
    names, values = [file.name for _, file in files], []
    require_each_once([image for image, _ in files], names, where, "image ")
    for _, file in files:
        pose = _yaml(file, f"{where}: {file.name}")
        keys = ("x", "y", "z", "qw", "qx", "qy", "qz")
        row = [pose.get(key) if isinstance(pose, dict) else None for key in keys]
        for key, value in zip(keys, row, strict=True):
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError("E-POSE-VALUE", f"{where}: {file.name}: {key} is {value!r}, a finite number needed")
        values.append(row)
    flat = np.array(values, float)
    require_unit(flat[:, 3:], names.__getitem__, where, "correct it")
    poses = Poses.from_quaternions(flat[:, 3:], LENGTHS["m"] * flat[:, :3])
    return RobotPoses(tuple(image for image, _ in files), poses, None, tuple(names), where)


def _yaml(path: Path, where: str):
    try:
        return load_yaml(read_bytes(path, SETTINGS_BYTES).decode("utf-8"))
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; give a readable file") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(
            "E-YAML-INVALID", f"{where}: not YAML ({' '.join(str(error).split())[:100]}); correct it"
        ) from error
