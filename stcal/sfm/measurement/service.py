"""Poses for images that come over time: processes that hold the target, and who gets which image."""

import json
import threading
from collections import OrderedDict
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, InputError
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.images import Skipped, decode, name_fault, stated_size
from stcal.parallel import OwnProcess
from stcal.sfm.detect.circles.ellipses import EllipseOptions
from stcal.sfm.measurement.images import MeasureOptions, outcome, result_of
from stcal.sfm.measurement.output import poses_file
from stcal.sfm.measurement.pose import PoseOptions
from stcal.sfm.measurement.target import TargetCircles
from stcal.sfm.measurement.tracker import Tracker

SEQUENCES = 1024
"""Followed at a time; of more, the one that has waited longest is searched for as a whole again."""
WAITING = 8
"""Images for each process that may wait; more are refused."""
LONGEST_NAME = 255
DONE, NO_POSE, REFUSED, FAILED, BUSY = 200, 422, 400, 500, 503
"""Codes of HTTP."""


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What every process holds; see :class:`stcal.sfm.measurement.tracker.Tracker`."""

    target: TargetCircles
    camera: CameraModel
    board: BoardDesign | None = None
    pose: PoseOptions = field(default_factory=PoseOptions)
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)


@dataclass(frozen=True, slots=True)
class Answer:
    """``code`` of HTTP, and the ``text``: JSON of one line."""

    code: int
    text: str


def refusal(code: int, kind: str, reason: str) -> Answer:
    """The answer that says why there is none; ``kind`` is the code of the error, like ``E-IMAGE-SIZE``."""
    return Answer(code, json.dumps({"error": reason, "code": kind}, ensure_ascii=False))


class MeasureService:
    """Answers images with poses, by several processes.

    Each image goes to the process that has least to do, with the poses before it, if it is one of a sequence. Images of
    a sequence are measured in the order in which they came.

    Parameters
    ----------
    setting : Setting
        Target and camera.
    workers : int
        Processes.
    """

    def __init__(self, setting: Setting, workers: int):
        held = replace(setting, camera=replace(setting.camera, source=Path(setting.camera.source).name))
        self._processes = [OwnProcess(_begin, held) for _ in range(workers)]
        self._waiting = [0] * workers
        self._sequences: OrderedDict[str, _Sequence] = OrderedDict()
        self._guard = threading.Lock()

    def start(self) -> None:
        """Start the processes now, not with the first images."""
        for process in self._processes:
            process.call(_ready)

    def answer(self, data: bytes, name: str = "image", sequence: str = "") -> Answer:
        """Of one image.

        Parameters
        ----------
        data : bytes
            Content of an image file.
        name : str
            Of the image, for the answer.
        sequence : str
            Name of the sequence that it is the next image of; none where empty.

        Returns
        -------
        Answer
            200 and the poses file of ``measure`` of this image; 422 and the same where it gives no pose, with the
            reason among those left out; 400 for what is no image of this camera, 503 where too many wait, 500 where
            the process ended: ``{"error": …, "code": …}``.
        """
        if fault := name_fault(name) or name_fault(sequence):
            return refusal(REFUSED, "E-SERVICE-NAME", f"name: {fault}; give that of the image alone")
        if not name or max(len(name), len(sequence)) > LONGEST_NAME:
            return refusal(
                REFUSED, "E-SERVICE-NAME", f"name: empty or longer than {LONGEST_NAME} characters; give a shorter one"
            )
        if not sequence:
            return self._measured(data, name, ())[0]
        own = self._sequence(sequence)
        with own.turn:
            answer, own.recent = self._measured(data, name, own.recent)
        return answer

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            process.close()

    def _sequence(self, name: str) -> "_Sequence":
        with self._guard:
            own = self._sequences.setdefault(name, _Sequence())
            self._sequences.move_to_end(name)
            while len(self._sequences) > SEQUENCES:
                self._sequences.popitem(last=False)
            return own

    def _measured(self, data: bytes, name: str, recent: tuple[Rigid, ...]) -> tuple[Answer, tuple[Rigid, ...]]:
        with self._guard:
            place = min(range(len(self._waiting)), key=self._waiting.__getitem__)
            if self._waiting[place] >= WAITING:
                reason = f"{WAITING} images wait for each of {len(self._waiting)} processes; send it again later"
                return refusal(BUSY, "E-SERVICE-BUSY", f"{name}: {reason}"), recent
            self._waiting[place] += 1
        try:
            return self._processes[place].call(_answer, data, name, recent)
        except BrokenExecutor:
            return refusal(
                FAILED, "E-WORKER-DIED", f"{name}: the process that measured it ended; send it again"
            ), recent
        finally:
            with self._guard:
                self._waiting[place] -= 1


@dataclass(slots=True, eq=False)
class _Sequence:
    """``turn`` : of its images, one at a time; ``recent`` : as of :class:`stcal.sfm.measurement.tracker.Tracker`."""

    turn: threading.Lock = field(default_factory=threading.Lock)
    recent: tuple[Rigid, ...] = ()


_tracker: Tracker | None = None
"""In a process: what holds target and camera."""


def _begin(setting: Setting) -> None:
    global _tracker
    _tracker = Tracker(setting.target, setting.camera, setting.board, setting.pose, setting.ellipses)


def _ready() -> bool:
    return _tracker is not None


def _answer(data: bytes, name: str, recent: tuple[Rigid, ...]) -> tuple[Answer, tuple[Rigid, ...]]:
    """The answer, and the poses from which the next image of the sequence is predicted."""
    tracker = _tracker
    assert tracker is not None
    tracker.recent = recent
    try:
        width, height = stated_size(data, name)
        own = tracker.model
        if (own.width or width, own.height or height) != (width, height):
            raise InputError(
                "E-IMAGE-SIZE",
                f"{name}: {width}×{height} px, camera {own.width}×{own.height} px; send it as the camera took it",
            )
        image = decode(data, name)
        try:
            seen, pose = tracker.observe(image, name)
            found = outcome(name, pose, seen.notes)
        except ConvergenceError as error:
            found = Skipped(name, str(error), "distortion")
    except InputError as error:
        return refusal(REFUSED, error.code, str(error)), recent
    result = result_of([found], tracker.target, MeasureOptions(tracker.pose_options), tracker.prior)
    content = poses_file(result).content()
    text = json.dumps(content, ensure_ascii=False, allow_nan=False)
    return Answer(DONE if result.images else NO_POSE, text), tracker.recent
