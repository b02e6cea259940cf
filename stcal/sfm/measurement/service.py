"""Poses of single images as JSON: answers by processes that hold the target."""

import json
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError
from dataclasses import dataclass, field, replace
from pathlib import Path

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, InputError
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.images import Skipped, decode, name_fault, stated_size
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.measurement.images import MeasureOptions, outcome, result_of
from stcal.sfm.measurement.own_process import LOOK_S, OwnProcess
from stcal.sfm.measurement.pose import PoseOptions
from stcal.sfm.measurement.report import poses_file
from stcal.sfm.measurement.target import TargetCircles
from stcal.sfm.measurement.tracker import Tracker

SEQUENCES = 1024
"""Number of sequences followed at a time. With more, the least recent is forgotten, and searched as a whole again."""
WAITING = 8
"""Number of images that may wait for each process, including those of a sequence. Further ones are refused."""
OTHERS_S = 10.0
"""Time, s, for which a client counts as active after it has sent an image. While another client is active, none may
occupy all processes."""
LONGEST_NAME = 255
DONE, NO_POSE, REFUSED, FAILED, BUSY = 200, 422, 400, 500, 503
"""Status codes of HTTP."""


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """The data that every process holds; see :class:`stcal.sfm.measurement.tracker.Tracker`."""

    target: TargetCircles
    camera: CameraModel
    board: BoardDesign | None = None
    pose: PoseOptions = field(default_factory=PoseOptions)
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer. ``code`` : status code of HTTP; ``text`` : JSON in one line."""

    code: int
    text: str


def refusal(code: int, kind: str, reason: str) -> Answer:
    """Returns the answer of an error. ``kind`` : code of the error, like ``E-IMAGE-SIZE``."""
    return Answer(code, json.dumps({"error": reason, "code": kind}, ensure_ascii=False))


class MeasureService:
    """Answers images with poses, by several processes.

    Each image goes to the process with the fewest waiting images, together with the previous poses of its sequence.
    Images of a sequence are measured in the order in which they came. Beside others no client has images in all
    processes: those that it sends more wait behind its own, so that an image of another one finds a process free.

    ``setting`` : target and camera; ``workers`` : number of processes.
    """

    def __init__(self, setting: Setting, workers: int):
        named = replace(setting, camera=replace(setting.camera, source=Path(setting.camera.source).name))
        self._processes = [OwnProcess(_begin, named) for _ in range(workers)]
        self._waiting, self._inside = [Counter[str]() for _ in range(workers)], 0
        self._seen: dict[str, float] = {}
        self._sequences: OrderedDict[str, _Sequence] = OrderedDict()
        self._guard = threading.Lock()

    def start(self) -> None:
        """Starts the processes now, not with the first images."""
        for process in self._processes:
            process.call(_ready)

    @property
    def most_waiting(self) -> int:
        """Number of images that may be measured or wait at a time."""
        return WAITING * len(self._processes)

    def answer(
        self,
        data: bytes,
        name: str = "image",
        sequence: str = "",
        left: Callable[[], bool] | None = None,
        client: str = "",
    ) -> Answer | None:
        """Returns the answer to one image.

        Parameters
        ----------
        data : content of an image file
        name : name of the image, for the answer
        sequence : name of the sequence whose next image it is; empty for a single image
        left : returns whether the client has gone, so that an image that still waits need not be measured
        client : the sender; while others are active, it cannot occupy all processes

        Returns
        -------
        Answer or None
            None for an image that was not measured as its client had gone. Else
            200 with the poses file of ``measure`` of this image. 422 with the same file if there is no pose; the reason
            is in ``left_out``. 400 if the data are no image of this camera, 503 if too many images wait, 500 if the
            process ended, with ``{"error": …, "code": …}``.
        """
        if fault := name_fault(name) or name_fault(sequence):
            return refusal(REFUSED, "E-SERVICE-NAME", f"name: {fault}; give that of the image alone")
        if not name or max(len(name), len(sequence)) > LONGEST_NAME:
            return refusal(
                REFUSED, "E-SERVICE-NAME", f"name: empty or longer than {LONGEST_NAME} characters; give a shorter one"
            )
        with self._guard:
            if self._inside >= self.most_waiting:
                reason = f"{WAITING} images wait for each of {len(self._processes)} processes; send it again later"
                return refusal(BUSY, "E-SERVICE-BUSY", f"{name}: {reason}")
            self._inside += 1
        try:
            if not sequence:
                return self._measured(data, name, (), left, client)[0]
            state = self._sequence(sequence)
            while not state.turn.acquire(timeout=LOOK_S):
                if left is not None and left():
                    return None
            try:
                answer, state.recent = self._measured(data, name, state.recent, left, client)
            finally:
                state.turn.release()
            return answer
        finally:
            with self._guard:
                self._inside -= 1

    def close(self) -> None:
        """Ends the processes."""
        for process in self._processes:
            process.close()

    def _sequence(self, name: str) -> "_Sequence":
        with self._guard:
            state = self._sequences.setdefault(name, _Sequence())
            self._sequences.move_to_end(name)
            while len(self._sequences) > SEQUENCES:
                self._sequences.popitem(last=False)
            return state

    def beside_others(self, client: str) -> bool:
        """Returns whether others than this client have sent images lately."""
        now = time.monotonic()
        return any(now - at < OTHERS_S for each, at in list(self._seen.items()) if each != client)

    def _place(self, client: str) -> int:
        """Returns the process for an image of a client."""
        now = time.monotonic()
        self._seen = {each: at for each, at in self._seen.items() if now - at < OTHERS_S} | {client: now}
        places = range(len(self._waiting))
        own = [place for place in places if self._waiting[place][client]]
        among = own if own and len(own) >= len(places) - 1 and self.beside_others(client) else places
        return min(among, key=lambda place: self._waiting[place].total())

    def _measured(
        self, data: bytes, name: str, recent: tuple[Rigid, ...], left: Callable[[], bool] | None, client: str
    ) -> tuple[Answer | None, tuple[Rigid, ...]]:
        with self._guard:
            place = self._place(client)
            self._waiting[place][client] += 1
        cancelling = {} if left is None else {"given_up": left}
        try:
            return self._processes[place].call(_answer, data, name, recent, **cancelling)
        except CancelledError:
            return None, recent
        except BrokenExecutor:
            reason = f"{name}: the process that measured it ended; send it again"
            return refusal(FAILED, "E-WORKER-DIED", reason), recent
        finally:
            with self._guard:
                self._waiting[place][client] -= 1


@dataclass(slots=True, eq=False)
class _Sequence:
    """State of a sequence of images.

    ``turn`` : held while one of its images is measured; ``recent`` : as in
    :class:`stcal.sfm.measurement.tracker.Tracker`.
    """

    turn: threading.Lock = field(default_factory=threading.Lock)
    recent: tuple[Rigid, ...] = ()


_tracker: Tracker | None = None
"""The tracker of this process, with target and camera."""


def _begin(setting: Setting) -> None:
    global _tracker
    _tracker = Tracker(setting.target, setting.camera, setting.board, setting.pose, setting.ellipses)


def _ready() -> bool:
    return _tracker is not None


def _answer(data: bytes, name: str, recent: tuple[Rigid, ...]) -> tuple[Answer, tuple[Rigid, ...]]:
    """Returns the answer, and the poses from which the next image of the sequence is predicted."""
    tracker = _tracker
    assert tracker is not None
    tracker.recent = recent
    try:
        width, height = stated_size(data, name)
        camera = tracker.model
        if (camera.width or width, camera.height or height) != (width, height):
            raise InputError(
                "E-IMAGE-SIZE",
                f"{name}: {width}×{height} px, camera {camera.width}×{camera.height} px; send it as the camera took it",
            )
        image = decode(data, name)
        try:
            labelled, pose = tracker.observe(image, name)
            measured = outcome(name, pose, labelled.notes)
        except ConvergenceError as error:
            measured = Skipped(name, str(error), "distortion")
    except InputError as error:
        return refusal(REFUSED, error.code, str(error)), recent
    result = result_of([measured], tracker.target, MeasureOptions(tracker.pose_options), tracker.prior)
    content = poses_file(result).content()
    text = json.dumps(content, ensure_ascii=False, allow_nan=False)
    return Answer(DONE if result.images else NO_POSE, text), tracker.recent
