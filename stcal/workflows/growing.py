"""Calibration that grows while photographs are taken, by hand or by itself, and reports circles, sharpness, σ and the
best next view after each."""

import math
import re
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from stcal.boards.file import run_board_of as board_of
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import CameraModel
from stcal.io.cameras.read import camera_model, read_camera
from stcal.io.design import target_of
from stcal.io.device import SATURATED, Source, checked_name, png
from stcal.io.files import CACHE, save
from stcal.io.images import Skipped, chosen_images, find_images
from stcal.parallel import Progress, kept_processes, one_thread
from stcal.sfm.detect.files import detect_files
from stcal.sfm.detect.labels import LabelledImage, label_images
from stcal.sfm.pipeline import ImageFiles, run_on_files
from stcal.sfm.planning.advise import Advice, advise, known_of
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.result import RunResult
from stcal.sfm.runs.saved import load_run

RELOAD_S = 5
"""Interval in s at which the report's page reloads itself."""


@dataclass(frozen=True, slots=True, eq=False)
class WatchOptions:
    """Options of watching a folder.

    Parameters
    ----------
    interval_s : float
        Interval at which the folder is looked at, s; a photograph counts when it has not changed between two looks.
    idle_s : float, optional
        Time without a new photograph after which watching ends, s; never if None.
    views : int
        Number of views to advise after each run; none where 0.
    run : RunOptions, optional
        Options of the runs; the defaults if None.

    Raises
    ------
    InputError
        A time is not positive, or a value of another type.
    """

    interval_s: float = 1.0
    idle_s: float | None = None
    views: int = 1
    run: RunOptions | None = None

    def __post_init__(self):
        require_fields(self, "watch")
        if not (0 < self.interval_s < 1e6 and (self.idle_s is None or 0 < self.idle_s < 1e9) and self.views >= 0):
            raise InputError(
                "E-OPTION-RANGE",
                f"watch: every {self.interval_s:g} s, idle {self.idle_s} s, {self.views} views; positive times needed",
            )


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """State after photographs were added or removed.

    ``images`` : number of photographs; ``new`` : labelled images among the added ones; ``left_out`` : added ones that
    cannot be used; ``gone`` : names of removed ones; ``result`` : of the run over all photographs, None where a run is
    not possible yet, for the ``reason``; ``advice`` : views to photograph next, None where advice was not requested, or
    is not possible, for the ``reason``; ``blur_px`` : median σ of the blur of edges, by name of the added photographs.
    """

    images: int
    new: tuple[LabelledImage, ...]
    left_out: tuple[Skipped, ...]
    gone: tuple[str, ...]
    result: RunResult | None
    reason: str
    advice: Advice | None
    blur_px: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class GrowingRun:
    """A run over a growing set of photographs, made by :meth:`of`.

    Parameters
    ----------
    images : Path
        Folder of the photographs, with a folder for each group.
    camera : path or CameraModel
        The camera's file, or what it states.
    out : Path
        The run's folder.
    target, board : TargetDesign, BoardDesign
        The designs.
    views : int
        Number of views to advise after each run.
    options : RunOptions
        Options of the run, with every default decided.
    """

    images: Path
    camera: str | Path | CameraModel
    out: Path
    target: TargetDesign
    board: BoardDesign
    views: int
    options: RunOptions

    @classmethod
    def of(
        cls,
        images: str | Path,
        camera: str | Path | Camera | CameraModel,
        out: str | Path,
        target: str | Path | TargetDesign | None = None,
        board: str | Path | BoardDesign | None = None,
        options: WatchOptions | None = None,
    ) -> "GrowingRun":
        """Returns the run for a user's input, whose files are read here; arguments as of :func:`watch`."""
        designs, options = (target_of(target), board_of(board)), options or WatchOptions()
        settled = (options.run or RunOptions()).settled(designs[0])
        model = camera_model(camera)
        given = camera if isinstance(camera, str | Path) else model
        return cls(Path(images), given, Path(out), *designs, options.views, settled)

    def update(
        self,
        images: int,
        came: Collection[str],
        gone: Sequence[str],
        progress: Progress | None = None,
        complete: Collection[str] | None = None,
    ) -> Update:
        """Returns the state after a run over all photographs, or the ``complete`` ones alone. Detections of earlier
        photographs are kept."""
        result, reason, advice = None, "", None
        with one_thread(), kept_processes(self.options.workers):  # those of the run also compare the views
            try:
                files = self._files(complete)
                given = self.images, self.camera, self.out, self.target, self.board, self.options
                result = run_on_files(files, *given, progress, RELOAD_S)
            except StcalError as error:
                if not (self.out / CACHE).is_dir():  # the run refused the folder itself
                    raise
                reason = str(error)
            if result is not None and self.views:
                try:
                    advice = advise(known_of(load_run(self.out)), self.views, progress)
                except StcalError as error:
                    reason = str(error)
        new, left_out, blur_px = self._found(came, result, complete)
        return Update(images, new, left_out, tuple(gone), result, reason, advice, blur_px)

    def _files(self, complete: Collection[str] | None) -> ImageFiles:
        """Returns the photographs whose files are complete."""
        files, skipped = chosen_images(self.images, self.options.exclude)
        return [file for file in files if complete is None or file.name in complete], skipped

    def _found(self, came: Collection[str], result: RunResult | None, complete: Collection[str] | None):
        """Returns labelled images, skipped images and blur of the added photographs, from the run, or from its
        cache."""
        if result is not None:
            detection, labelled, skipped = result.detection, result.labelled, result.detection.skipped
        else:
            model = self.camera if isinstance(self.camera, CameraModel) else read_camera(self.camera)
            cache, ellipses, workers = self.out / CACHE, self.options.ellipses, self.options.workers
            try:
                files, skipped_files = self._files(complete)
                detection = detect_files(files, model, self.target, self.board, ellipses, cache, workers)
                labelled = label_images(detection, self.target, self.board, ellipses, cache, workers)
                skipped = (*skipped_files, *detection.skipped)
            except StcalError:  # no photograph is usable, for the reason that the run has given
                return (), (), {}
        blur = {image.file.name: image.detection.centres.blur_px for image in detection.images}
        return (
            tuple(image for image in labelled if image.observations.name in came),
            tuple(image for image in skipped if image.name in came),
            {name: float(np.median(blurs)) for name, blurs in blur.items() if name in came and len(blurs)},
        )


@require_arguments
def watch(
    images: str | Path,
    camera: str | Path | Camera | CameraModel,
    out: str | Path,
    target: str | Path | TargetDesign | None = None,
    board: str | Path | BoardDesign | None = None,
    options: WatchOptions | None = None,
    progress: Progress | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Update]:
    """Repeats the run whenever photographs were added to a folder or removed from it.

    Detections of the other photographs are kept.

    Parameters
    ----------
    images : path
        Folder with one folder of images for each group; may be empty at first.
    camera : path, Camera or CameraModel
        The camera, or its file.
    out : path
        The run's folder: new, empty, or of an earlier run. Its page reloads itself, until another run is written there.
    target, board : paths or designs
        Designs, or files of them; the reference design if None.
    options : WatchOptions, optional
        The defaults if None.
    progress : callable, optional
        Called with (stage, done, total).
    sleep : callable, optional
        Waits between two looks.

    Yields
    ------
    Update
        State after each run, or attempt.

    Raises
    ------
    InputError
        There is no such folder, or it is gone while it is watched; a file is not of the kind that is expected, or the
        output folder is not a run's.
    """
    options = options or WatchOptions()
    growing = GrowingRun.of(images, camera, out, target, board, options)
    images = Path(images)
    if not images.is_dir():
        raise InputError(
            "E-IMAGES-FOLDER", f"image folder {images}: does not exist; give the folder that receives the photographs"
        )
    processed: dict[str, tuple] = {}
    last_stamps: dict[str, tuple] = {}
    idle_s = 0.0
    while options.idle_s is None or idle_s < options.idle_s:
        if not images.is_dir():
            raise InputError(
                "E-IMAGES-FOLDER",
                f"image folder {images}: it disappeared while it was watched; restore it, and watch it again",
            )
        stamps = _stamps(images)
        complete = {name: stamp for name, stamp in stamps.items() if last_stamps.get(name) == stamp}
        last_stamps = stamps
        removed = tuple(name for name in processed if name not in stamps)
        if complete == processed or not (complete or removed):
            sleep(options.interval_s)
            idle_s += options.interval_s
            continue
        added = {name for name, stamp in complete.items() if processed.get(name) != stamp}
        processed, idle_s = complete, 0.0
        yield growing.update(len(complete), added, removed, progress, complete)


def _stamps(images: Path) -> dict[str, tuple]:
    """Returns size and times of each image file; empty if there are no images yet.

    The time of a change of its inode is among them, so that a file that was renamed counts as new.
    """
    stamps = {}
    try:
        files, _ = find_images(images)
    except InputError:
        return {}
    for file in files:
        try:
            stat = file.path.stat()
        except OSError:
            continue  # removed meanwhile
        stamps[file.name] = stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino
    return stamps


FIRST = 1
NUMBERED = re.compile(r"IMG_(\d{4,})\.png")


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A photograph.

    ``name`` : as in the run; ``exposure`` : the one that was actually set, in the driver's unit; ``update`` : the
    calibration so far; ``circles`` : number of named circles in it; ``saturated`` : number of these whose middle is
    saturated; ``saturated_share`` : share of saturated pixels.
    """

    name: str
    exposure: float
    update: Update
    circles: int
    saturated: int
    saturated_share: float

    def light(self) -> str:
        """Returns exposure and saturation in words."""
        message = f"exposure {self.exposure:g}, {100 * self.saturated_share:.1f} % of the pixels saturated"
        if self.circles:
            message += f", {self.saturated} of {self.circles} circles"
        if self.circles and self.saturated > self.circles / 2:
            message += ": expose less, saturated circles grow and their centres move"
        return message


class Trigger:
    """Trigger of photographs: at each Enter, or at fixed intervals.

    ``count`` : number of photographs after which it ends; ``every_s`` : interval; if None, a photograph is taken at
    each line of ``keys``; ``keys`` : the trigger ends with this stream; ``say`` : called with the text that prompts the
    user.
    """

    def __init__(self, count: int | None, every_s: float | None, keys: TextIO, say: Callable[[str], object]):
        self._left = math.inf if count is None else count
        self._every_s, self._keys, self._say = every_s, keys, say
        self._last: float | None = None

    def ready(self, number: int) -> bool:
        """Waits for photograph ``number``. Returns False if there will be none."""
        if self._left < 1:
            return False
        self._left -= 1
        if self._every_s is None:
            self._say(f"Enter: take photograph {number} (Ctrl-D: end)")
            return bool(self._keys.readline())
        if self._last is not None:
            time.sleep(max(0.0, self._last + self._every_s - time.monotonic()))
        self._last = time.monotonic()
        return True


@require_arguments
def capture(
    source: Source,
    growing: GrowingRun,
    group: str,
    ready: Callable[[int], bool],
    exposure: float | None = None,
    settle_s: float = 0.3,
    progress: Progress | None = None,
) -> Iterator[Taken]:
    """Takes photographs of a group, ``IMAGES/<group>/IMG_0001.png`` …, and after each run over all photographs so far.

    Parameters
    ----------
    source : OpenCVSource or SimulatedSource
        The camera; or anything else with a ``name`` and their methods.
    growing : GrowingRun
        The run, with the folder that the photographs are written to.
    group : str
        Name of the group, in which only the camera moves. Its folder may hold earlier photographs, which stay.
    ready : callable
        Waits for the photograph of this number in the group; returns False at the end.
    exposure : float, optional
        Exposure in the driver's unit; unchanged if None.
    settle_s : float
        Time that the camera is given before each photograph, s.
    progress : callable, optional
        Called with (stage, done, total).

    Yields
    ------
    Taken
        The photograph, with the state of the run.

    Raises
    ------
    InputError
        The name cannot be a folder's, the camera gives no image, or an input is not of the kind that is expected.
    """
    folder = growing.images / checked_name(group, "group")
    number = _next(folder)
    while ready(number):
        image, really = source.expose(exposure, settle_s)
        name = f"{group}/IMG_{number:04d}.png"
        folder.mkdir(parents=True, exist_ok=True)
        save(growing.images / name, png(image))
        images = sum(1 for path in growing.images.glob("*/*") if path.is_file())
        update = growing.update(images, {name}, (), progress)
        inside = [_middle(image, labelled.observations.centre_px) for labelled in update.new]
        grey = np.concatenate(inside) if inside else np.zeros(0)
        saturated = int((grey >= SATURATED).sum())
        yield Taken(name, really, update, len(grey), saturated, float((image >= SATURATED).mean()))
        number += 1


def _next(folder: Path) -> int:
    paths = folder.iterdir() if folder.is_dir() else ()
    numbers = [int(match[1]) for path in paths if (match := NUMBERED.fullmatch(path.name))]
    return max(numbers, default=FIRST - 1) + 1


def _middle(image: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Returns the grey values (n,) at circles' centres (n, 2), px."""
    column, row = np.clip(np.rint(centre_px).astype(int), 0, np.array(image.shape)[::-1] - 1).T
    return image[row, column]
