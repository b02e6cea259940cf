"""The robot's poses at images: from a file, at the times of the images, or by joint values of an arm to adjust."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import TWIST
from stcal.geometry.rigid import Order, Poses, Rigid
from stcal.handeye.data.pose_content import Said, require_each_once
from stcal.handeye.data.pose_files import partners, read_robot, require_own, trailing_number
from stcal.handeye.data.pose_pairs import SIDES, read_side
from stcal.handeye.data.stream import TOLERANCE_S, Stream, Timed, stamps_of, stem_of, taken_at, time_of
from stcal.io.table import LENGTHS, read_table
from stcal.robot import Robot
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import chain_jacobian, chain_parameters, flange_poses, moved_chain
from stcal.robot.kinematics.measurements import joint_values
from stcal.robot.kinematics.robot_model import Chain

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
        rows = {names[j]: i for i, j in matches[0]}
        used = set(rows.values())
        return rows, tuple(name for i, name in enumerate(self.images) if i not in used), matches[1]

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
    """Read the robot's poses in any format of :mod:`stcal.handeye.data.pose_files`.

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


@dataclass(frozen=True, slots=True)
class Timing:
    """``tolerance_s`` : within which the nearest sample replaces a pose that cannot be interpolated; ``image_times`` :
    file with ``image`` and ``time_s``, where names of images are not times; ``offset`` : whether the clocks' offset is
    estimated."""

    tolerance_s: float = TOLERANCE_S
    image_times: Path | None = None
    offset: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class AtImages:
    """``robot`` : its poses by image, unchanged if no times were needed; ``left_out`` : (image, why); ``stream``,
    ``seconds`` : the stream and the time of each remaining image, by name."""

    robot: RobotPoses
    left_out: tuple[tuple[str, str], ...] = ()
    stream: Stream | None = None
    seconds: dict[str, float] | None = None

    def timed(self, names: Sequence[str]) -> Timed | None:
        """Returns the stream and the times of these images; None if no times were needed."""
        if self.stream is None or self.seconds is None:
            return None
        return Timed(self.stream, np.array([self.seconds[name] for name in names]))


def robot_at_images(robot: RobotPoses, names: Sequence[str], timing: Timing | None) -> AtImages:
    """Returns poses at the times of images, where both have times that are not simply equal; as they are if ``timing``
    is None. Raises InputError: an option needs times, or no image lies within the stream."""
    if timing is None:
        return AtImages(robot)
    images = _times_of_images(names, timing)
    samples = [time_of(name) for name in robot.images] if robot.timed else stamps_of(robot.images)
    if images is None or samples is None or None in samples:
        if timing.offset or timing.image_times or robot.timed:
            _require_times(robot, images, samples, names)
        return AtImages(robot)
    if not robot.timed and any(stem_of(name) != name for name in robot.images):  # poses of images by their names
        return AtImages(robot)
    seen, times = list(images), [time for time in samples if time is not None]
    if not timing.offset and all(time in times for time in images.values()):
        rows = {name: times.index(time) for name, time in images.items()}
        if not len(images) < len(times) == len(set(times)):
            return AtImages(_of_rows(robot, rows))
        stream = Stream.of(times, robot.base_from_flange, robot.file)
        seconds = stream.after_origin(list(images.values())).tolist()
        return AtImages(_of_rows(robot, rows), (), stream, dict(zip(seen, seconds, strict=True)))
    stream = Stream.of(times, robot.base_from_flange, robot.file)
    seconds = stream.after_origin(list(images.values()))
    interpolated = taken_at(stream, seconds, timing.tolerance_s)
    if not interpolated.kept.any():
        raise InputError("E-POSES-UNMATCHED", f"{robot.where}: no image has a pose: {seen[0]}: {interpolated.why[0]}")
    kept = tuple(seen[i] for i in np.flatnonzero(interpolated.kept))
    note = "" if robot.covariance is None else "; its covariances are of other times and not used"
    robot_then = replace(
        robot,
        images=kept,
        base_from_flange=interpolated.base_from_flange,
        covariance=None,
        places=tuple(f"time of {name}" for name in kept),
        understood=f"{robot.understood}{note}; {interpolated.said}",
        own=False,
        timed=False,
    )
    left_out = [(name, why) for name, why in zip(seen, interpolated.why, strict=True) if why]
    left_out += [(name, f"no time in {timing.image_times}") for name in names if name not in images]
    return AtImages(robot_then, tuple(left_out), stream, dict(zip(seen, seconds.tolist(), strict=True)))


def _of_rows(robot: RobotPoses, rows: dict[str, int]) -> RobotPoses:
    """Returns the poses whose times are those of images: ``rows`` by image. Rows without an image are no mistake."""
    at = list(rows.values())
    return replace(
        robot,
        images=tuple(rows),
        base_from_flange=robot.base_from_flange[at],
        covariance=None if robot.covariance is None else robot.covariance[at],
        places=tuple(robot.places[i] for i in at),
        understood=f"{robot.understood}; {len(at)} of them at the times of images",
        own=False,
        timed=False,
    )


def _times_of_images(names: Sequence[str], timing: Timing) -> dict[str, Decimal] | None:
    """Returns times by image, as the file of times states them, or as the names state them."""
    if timing.image_times is None:
        times = stamps_of(names)
        return None if times is None else dict(zip(names, times, strict=True))
    table = read_table(timing.image_times, "image times")
    stated = dict(zip(table.text("image"), table.text("time_s"), strict=True))
    if len(stated) < len(table):
        raise InputError("E-TABLE-ROW-REPEATED", f"{table.where}: an image in two rows; one each needed")
    time_of_image = {}
    for name in names:
        file_name = name.rsplit("/", 1)[-1]
        text = next((stated[key] for key in (name, file_name, file_name.rsplit(".", 1)[0]) if key in stated), None)
        if text is None:
            continue
        time = time_of(text)
        if time is None:
            raise InputError(
                "E-TABLE-NUMBER", f"{table.where}: time_s of {name} is {text!r}, a number of seconds needed"
            )
        time_of_image[name] = time
    if not time_of_image:
        raise InputError(
            "E-POSES-UNMATCHED",
            f"{table.where}: no row is of an image: {next(iter(stated))} … there, {names[0]} … here",
        )
    return time_of_image


def _require_times(robot: RobotPoses, images: dict[str, Decimal] | None, samples: object, names: Sequence[str]) -> None:
    """Raise an error that says which side has no times."""
    if images is None:
        raise InputError(
            "E-IMAGE-NAME-TIME",
            f"image {names[0]}: its name is not a time, but the robot's poses are matched by time ({robot.file}); name "
            "images by seconds (1689.25.png), or give --image-times",
        )
    if not isinstance(samples, list) or None in samples:
        first = f", but {robot.images[0]} …" if robot.images else ""
        raise InputError(
            "E-POSES-UNTIMED", f"{robot.where}: no times of its poses{first}; give a column time_s, or a TUM trajectory"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """A robot at joint values (m, n) moved by small motions of its axes, as
    :class:`stcal.handeye.methods.bundle.ArmModel`; X and Z absorb errors of its base and flange."""

    robot: Robot
    q: np.ndarray

    @property
    def angles(self) -> np.ndarray:
        """Boolean array (k,): True for parameters in rad."""
        return np.array([component < 3 for _, component in chain_parameters(self._chain())])

    def poses(self, parameters: np.ndarray) -> Poses:
        """Returns base_from_flange, m poses."""
        return flange_poses(moved_chain(self._chain(), parameters), self.q)

    def slope(self, parameters: np.ndarray) -> np.ndarray:
        """Returns the derivative (m, 6, k) of :meth:`poses` by a step of the parameters."""
        chain = moved_chain(self._chain(), parameters)
        return chain_jacobian(chain, self.q, flange_poses(chain, self.q))

    def __getitem__(self, rows) -> "Arm":
        """Returns the arm at these joint values alone."""
        return Arm(self.robot, self.q[rows])

    def identified(self, parameters: np.ndarray) -> Robot:
        """Returns the robot with these parameters, as D-H rows; base and tools stay as they were."""
        moved = robot_from_chain(moved_chain(self._chain(), parameters), dict(self.robot.tools), self.robot)
        return replace(moved, world_from_base=self.robot.world_from_base)

    def names(self) -> tuple[str, ...]:
        """Returns the names (k,) of the parameters: J2 rx in rad, J2 x in mm, in the frame of the joint."""
        return tuple(f"J{joint + 1} {TWIST[c]}" for joint, c in chain_parameters(self._chain()))

    def _chain(self) -> Chain:
        return replace(self.robot, world_from_base=Rigid()).chain()


def read_arm(path: Path, robot: Robot, quaternions: Order = "wxyz") -> tuple[RobotPoses, Arm]:
    """Returns the robot's poses by its file, from columns ``image`` and ``q1_deg`` … (CSV); ``understood`` says how far
    base_from_flange_… beside them are off.

    Raises InputError: missing columns, values that are not numbers, or an image that has two rows.
    """
    table = read_table(path, "robot poses", quaternions)
    arm = Arm(robot, joint_values(table, robot))
    images, places = tuple(table.text("image")), tuple(f"line {line}" for line in table.lines)
    require_each_once(images, places, table.where, "image ")
    flange = arm.poses(np.zeros(len(arm.angles)))
    understood = f"{path.name}: joint values of {len(images)} images; poses by the file of {robot.name}"
    if any(name.startswith(side) for side in SIDES[0] for name in table.columns):
        reported, *_ = read_side(table, *SIDES[0])
        apart = (reported.inverse() @ flange).difference((reported.inverse() @ flange)[[0] * len(flange)])
        understood += (
            f"; its flange moves against the one reported by up to {np.linalg.norm(apart[:, 3:], axis=1).max():.3g} mm "
            f"and {np.degrees(np.linalg.norm(apart[:, :3], axis=1).max()):.2g}°"
        )
    return RobotPoses(images, flange, None, places, table.where, understood, own=False), arm
