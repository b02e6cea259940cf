"""HTTP service of ``measure --serve``: one JSON answer per image, measured by processes that hold the target."""

import json
import socket
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import stcal
from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, InputError
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.images import Skipped, decode, name_fault, stated_size
from stcal.parallel import OwnProcess
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.measurement.images import MeasureOptions, outcome, result_of
from stcal.sfm.measurement.pose import PoseOptions
from stcal.sfm.measurement.report import poses_file
from stcal.sfm.measurement.target import TargetCircles
from stcal.sfm.measurement.tracker import Tracker

SEQUENCES = 1024
"""Number of sequences followed at a time. With more, the least recent is forgotten, and searched as a whole again."""
WAITING = 8
"""Number of images that may wait for each process. More are refused."""
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
    Images of a sequence are measured in the order in which they came.

    Parameters
    ----------
    setting : Setting
        Target and camera.
    workers : int
        Number of processes.
    """

    def __init__(self, setting: Setting, workers: int):
        named = replace(setting, camera=replace(setting.camera, source=Path(setting.camera.source).name))
        self._processes = [OwnProcess(_begin, named) for _ in range(workers)]
        self._waiting = [0] * workers
        self._sequences: OrderedDict[str, _Sequence] = OrderedDict()
        self._guard = threading.Lock()

    def start(self) -> None:
        """Starts the processes now, not with the first images."""
        for process in self._processes:
            process.call(_ready)

    def answer(self, data: bytes, name: str = "image", sequence: str = "") -> Answer:
        """Returns the answer to one image.

        Parameters
        ----------
        data : bytes
            Content of an image file.
        name : str
            Name of the image, for the answer.
        sequence : str
            Name of the sequence whose next image it is; empty for a single image.

        Returns
        -------
        Answer
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
        if not sequence:
            return self._measured(data, name, ())[0]
        state = self._sequence(sequence)
        with state.turn:
            answer, state.recent = self._measured(data, name, state.recent)
        return answer

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


LOCALHOST, PORT = "127.0.0.1", 8765
MAX_MEGABYTES = 64.0
PATIENCE_S = 30.0
"""Time without data after which a client is disconnected, s."""
CONNECTIONS = 64
LINGER_S = 1.0
"""Time for which the rest of a refused request is read, s. Else the client could lose the answer."""
MEASURE, STATUS = "/measure", "/"
NO_LENGTH, TOO_LARGE, NOT_FOUND, NOT_ALLOWED = 411, 413, 404, 405


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """Options of the HTTP service.

    Parameters
    ----------
    host : str
        Address to listen on; reachable from this machine only by default.
    port : int
        Port to listen on; any free one if 0.
    max_megabytes : float
        Largest size of an image file.
    """

    host: str = LOCALHOST
    port: int = PORT
    max_megabytes: float = MAX_MEGABYTES


class MeasureServer(ThreadingHTTPServer):
    """HTTP server that passes images to the service, with a thread for each connection.

    Attributes
    ----------
    counts : Counter
        Number of answers by status code.

    Raises
    ------
    InputError
        If it cannot listen on the address.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, service: MeasureService, options: ServeOptions):
        self.service, self.options = service, options
        self.most_bytes = int(options.max_megabytes * 1e6)
        self.counts: Counter[int] = Counter()
        self._guard = threading.Lock()
        self._free = threading.BoundedSemaphore(CONNECTIONS)
        if ":" in options.host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((options.host, options.port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                "E-SERVICE-ADDRESS",
                f"--host {options.host} --port {options.port}: cannot be listened at: {reason}; give another",
            ) from error

    @property
    def url(self) -> str:
        """URL of the server."""
        host, port = self.server_address[:2]
        host = host.decode() if isinstance(host, bytes | bytearray) else host
        return f"http://{f'[{host}]' if ':' in host else host}:{port}"

    @property
    def local(self) -> bool:
        """Whether only this machine can reach the server."""
        return ip_address(str(self.server_address[0]).partition("%")[0]).is_loopback

    def count(self, code: int) -> None:
        """Counts one more answer with this code."""
        with self._guard:
            self.counts[code] += 1

    def process_request(self, request: Any, client_address) -> None:
        """Handles a request in a thread of its own, or answers 503 if none is free."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        self.count(503)
        with suppress(OSError):
            request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
        self.shutdown_request(request)

    def process_request_thread(self, request, client_address) -> None:
        """Handles one connection to its end, and frees its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request, client_address) -> None:
        """Ignores the error of a client that went away."""


class _Handler(BaseHTTPRequestHandler):
    """One connection, whose images come one after the other."""

    protocol_version = default_request_version = "HTTP/1.1"
    server_version = f"stcal/{stcal.__version__}"
    sys_version = ""
    timeout = PATIENCE_S
    disable_nagle_algorithm = True
    server: MeasureServer

    def do_POST(self) -> None:
        """Answers an image, or refuses any other data."""
        parts = urlsplit(self.path)
        if parts.path != MEASURE:
            self._refuse(NOT_FOUND, f"POST an image to {MEASURE}")
            return
        length = self.headers.get("Content-Length", "")
        if self.headers.get("Transfer-Encoding") or not length.isdecimal() or len(length) > 18:
            self._refuse(NO_LENGTH, "Content-Length needed, in bytes")
            return
        if int(length) > self.server.most_bytes:
            limit = self.server.options.max_megabytes
            self._refuse(TOO_LARGE, f"{int(length) / 1e6:.1f} MB; {limit:g} MB at most, see --max-megabytes")
            return
        data = self.rfile.read(int(length))
        if len(data) < int(length):  # the client went away
            self.close_connection = True
            return
        asked = parse_qs(parts.query)
        name, sequence = (asked.get(key, [default])[0] for key, default in (("name", "image"), ("sequence", "")))
        try:
            answer = self.server.service.answer(data, name, sequence)
        except Exception as error:  # a fault of the program must not end the connection without an answer
            answer = refusal(500, "E-SERVICE-FAILED", f"{type(error).__name__}: not answered")
        self._send(answer)

    def do_GET(self) -> None:
        """Answers with a description of the service and its counts."""
        if urlsplit(self.path).path != STATUS:
            self._refuse(NOT_FOUND, f"POST an image to {MEASURE}; GET {STATUS} tells what this is")
            return
        counts = {str(code): n for code, n in sorted(self.server.counts.items())}
        description = {
            "format": "stcal service 1",
            "version": stcal.__version__,
            "measure": f"POST {MEASURE}?name=&sequence=",
        }
        description |= {"max_megabytes": self.server.options.max_megabytes, "answers": counts}
        self._send(Answer(200, json.dumps(description)), counted=False)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Sends JSON in place of a page for a request that the standard library refuses."""
        self._refuse(NOT_ALLOWED if code == 501 else code, message or self.responses.get(code, ("refused",))[0])

    def log_message(self, *_) -> None:
        """Writes no log, as only counts are kept."""

    def _refuse(self, code: int, reason: str) -> None:
        """Refuses the request and ends the connection, as the rest of its data is unknown."""
        self.close_connection = True
        self._send(refusal(code, "E-SERVICE-REQUEST", reason))
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(LINGER_S)
            end = time.monotonic() + LINGER_S
            while time.monotonic() < end and self.connection.recv(1 << 16):
                pass

    def _send(self, answer: Answer, counted: bool = True) -> None:
        if counted:
            self.server.count(answer.code)
        body = answer.text.encode() + b"\n"
        self.send_response(answer.code)
        self.send_header("Content-Type", "application/json; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if getattr(self, "command", None) != "HEAD":
            self.wfile.write(body)


def serve(service: MeasureService, options: ServeOptions, ready: Callable[[MeasureServer], None]) -> None:
    """Answers requests until interrupted.

    ``ready`` : called with the server as soon as it accepts images.
    """
    with MeasureServer(service, options) as server:
        try:
            service.start()
            ready(server)
            server.serve_forever(poll_interval=0.5)
        finally:
            service.close()


def counts_text(counts: Counter[int]) -> str:
    """Returns one line with the counts of answers."""
    total, poses, without_pose = sum(counts.values()), counts[DONE], counts[NO_POSE]
    return f"answered {total}: {poses} with a pose, {without_pose} without, {total - poses - without_pose} refused"
