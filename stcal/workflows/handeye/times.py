"""The robot's poses at the times of images, and the offset between the clocks of both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.robot_poses import RobotPoses
from stcal.handeye.data.stream import TOLERANCE_S, Stream, Timed, stamps_of, stem_of, taken_at, time_of
from stcal.io.table import read_table


@dataclass(frozen=True, slots=True)
class Timing:
    """``tolerance_s`` : within which the nearest sample stands for a pose that cannot be interpolated;
    ``image_times`` : file with ``image`` and ``time_s``, where names of images are no times; ``offset`` : whether
    the clocks' offset is wanted."""

    tolerance_s: float = TOLERANCE_S
    image_times: Path | None = None
    offset: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class AtImages:
    """``robot`` : its poses by image, as they were where no times were needed; ``left_out`` : (image, why); ``timed`` :
    stream and the time of each image that is left, by name."""

    robot: RobotPoses
    left_out: tuple[tuple[str, str], ...] = ()
    stream: Stream | None = None
    seconds: dict[str, float] | None = None

    def timed(self, names: Sequence[str]) -> Timed | None:
        """Of these images."""
        if self.stream is None or self.seconds is None:
            return None
        return Timed(self.stream, np.array([self.seconds[name] for name in names]))


def robot_at_images(robot: RobotPoses, names: Sequence[str], timing: Timing | None) -> AtImages:
    """Poses of the robot at the times of images, where both have times that are not the same; never where ``timing`` is
    None, as of joint values, which belong to images by name.

    Raises
    ------
    InputError
        No times where an option needs them, or no image within the stream.
    """
    if timing is None:
        return AtImages(robot)
    images = _times_of_images(names, timing)
    samples = [time_of(name) for name in robot.images] if robot.timed else stamps_of(robot.images)
    if images is None or samples is None or None in samples:
        if timing.offset or timing.image_times or robot.timed:
            _require_times(robot, images, samples, names)
        return AtImages(robot)
    if not robot.timed and any(stem_of(name) != name for name in robot.images):  # of images by their names
        return AtImages(robot)
    if not timing.offset and all(time in samples for time in images.values()):
        rows = {name: samples.index(time) for name, time in images.items()}
        return AtImages(_of_rows(robot, rows))
    times = [time for time in samples if time is not None]
    stream = Stream.of(times, robot.base_from_flange, robot.file)
    known = list(images)
    seconds = stream.after_origin([images[name] for name in known])
    taken = taken_at(stream, seconds, timing.tolerance_s)
    if not taken.kept.any():
        raise InputError("E-POSES-UNMATCHED", f"{robot.where}: no image has a pose: {known[0]}: {taken.why[0]}")
    kept = [known[i] for i in np.flatnonzero(taken.kept)]
    more = "" if robot.covariance is None else "; its covariances are of other times and not used"
    found = replace(
        robot,
        images=tuple(kept),
        base_from_flange=taken.base_from_flange,
        covariance=None,
        places=tuple(f"time of {name}" for name in kept),
        understood=f"{robot.understood}{more}; {taken.said}",
        own=False,
        timed=False,
    )
    left_out = [(name, why) for name, why in zip(known, taken.why, strict=True) if why]
    left_out += [(name, f"no time in {timing.image_times}") for name in names if name not in images]
    return AtImages(found, tuple(left_out), stream, dict(zip(known, seconds.tolist(), strict=True)))


def _of_rows(robot: RobotPoses, rows: dict[str, int]) -> RobotPoses:
    """Times that are those of samples: rows by image, of which others are no mistake."""
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
    """By image, as the file of times says, or as the names are."""
    if timing.image_times is None:
        times = stamps_of(names)
        return None if times is None else dict(zip(names, times, strict=True))
    table = read_table(timing.image_times, "image times")
    stated = dict(zip(table.text("image"), table.text("time_s"), strict=True))
    if len(stated) < len(table):
        raise InputError("E-TABLE-ROW-REPEATED", f"{table.where}: an image in two rows; one each needed")
    found = {}
    for name in names:
        alone = name.rsplit("/", 1)[-1]
        text = next((stated[key] for key in (name, alone, alone.rsplit(".", 1)[0]) if key in stated), None)
        if text is None:
            continue
        time = time_of(text)
        if time is None:
            raise InputError(
                "E-TABLE-NUMBER", f"{table.where}: time_s of {name} is {text!r}, a number of seconds needed"
            )
        found[name] = time
    if not found:
        raise InputError(
            "E-POSES-UNMATCHED",
            f"{table.where}: no row is of an image: {next(iter(stated))} … there, {names[0]} … here",
        )
    return found


def _require_times(robot: RobotPoses, images: dict[str, Decimal] | None, samples: object, names: Sequence[str]) -> None:
    """Say which side has none."""
    if images is None:
        raise InputError(
            "E-IMAGE-NAME-TIME",
            f"image {names[0]}: its name is no time, for poses of the robot by time ({robot.file}); name images by "
            "seconds (1689.25.png), or give --image-times",
        )
    if samples is None or not isinstance(samples, list) or None in samples:
        first = f", but {robot.images[0]} …" if robot.images else ""
        raise InputError(
            "E-POSES-UNTIMED", f"{robot.where}: no times of its poses{first}; give a column time_s, or a TUM trajectory"
        )
