"""``measure --serve``: images over HTTP, one JSON each, measured by processes that hold the target."""

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


LOCALHOST, PORT = "127.0.0.1", 8765
MAX_MEGABYTES = 64.0
PATIENCE_S = 30.0
"""A client that sends nothing for so long is cut off."""
CONNECTIONS = 64
LINGER_S = 1.0
"""So long the rest of what was refused is read, so that the answer is not lost with it."""
MEASURE, STATUS = "/measure", "/"
NO_LENGTH, TOO_LARGE, NOT_FOUND, NOT_ALLOWED = 411, 413, 404, 405


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """Where and how to serve.

    Parameters
    ----------
    host : str
        Address to listen at; this machine alone by default.
    port : int
        A free one where 0.
    max_megabytes : float
        Of an image file.
    """

    host: str = LOCALHOST
    port: int = PORT
    max_megabytes: float = MAX_MEGABYTES


class MeasureServer(ThreadingHTTPServer):
    """Listens; a thread for each connection hands images to the service.

    Attributes
    ----------
    counts : Counter
        Answers by code of HTTP.

    Raises
    ------
    InputError
        The address cannot be listened at.
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
        """Where it listens."""
        host, port = self.server_address[:2]
        host = host.decode() if isinstance(host, bytes | bytearray) else host
        return f"http://{f'[{host}]' if ':' in host else host}:{port}"

    @property
    def local(self) -> bool:
        """Whether only this machine reaches it."""
        return ip_address(str(self.server_address[0]).partition("%")[0]).is_loopback

    def count(self, code: int) -> None:
        """One more answer of this code."""
        with self._guard:
            self.counts[code] += 1

    def process_request(self, request: Any, client_address) -> None:
        """In a thread of its own, if one is free."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        self.count(503)
        with suppress(OSError):
            request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
        self.shutdown_request(request)

    def process_request_thread(self, request, client_address) -> None:
        """One connection, to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request, client_address) -> None:
        """A client that went away is none of ours."""


class _Handler(BaseHTTPRequestHandler):
    """One connection; its images come one after the other."""

    protocol_version = default_request_version = "HTTP/1.1"
    server_version = f"stcal/{stcal.__version__}"
    sys_version = ""
    timeout = PATIENCE_S
    disable_nagle_algorithm = True
    server: MeasureServer

    def do_POST(self) -> None:
        """An image, or what else a client sends."""
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
        if len(data) < int(length):  # it went away
            self.close_connection = True
            return
        asked = parse_qs(parts.query)
        name, sequence = (asked.get(key, [default])[0] for key, default in (("name", "image"), ("sequence", "")))
        try:
            answer = self.server.service.answer(data, name, sequence)
        except Exception as error:  # a mistake of ours must not end the connection without an answer
            answer = refusal(500, "E-SERVICE-FAILED", f"{type(error).__name__}: not answered")
        self._send(answer)

    def do_GET(self) -> None:
        """What this is."""
        if urlsplit(self.path).path != STATUS:
            self._refuse(NOT_FOUND, f"POST an image to {MEASURE}; GET {STATUS} tells what this is")
            return
        counts = {str(code): n for code, n in sorted(self.server.counts.items())}
        own = {"format": "stcal service 1", "version": stcal.__version__, "measure": f"POST {MEASURE}?name=&sequence="}
        own |= {"max_megabytes": self.server.options.max_megabytes, "answers": counts}
        self._send(Answer(200, json.dumps(own)), counted=False)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """In place of a page, JSON: what the standard library refuses by itself."""
        self._refuse(NOT_ALLOWED if code == 501 else code, message or self.responses.get(code, ("refused",))[0])

    def log_message(self, *_) -> None:
        """Counts alone are kept."""

    def _refuse(self, code: int, reason: str) -> None:
        """And end the connection, whose rest is unknown."""
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
    """Answer until interrupted.

    ``ready`` : called with the server when images may come.
    """
    with MeasureServer(service, options) as server:
        try:
            service.start()
            ready(server)
            server.serve_forever(poll_interval=0.5)
        finally:
            service.close()


def counts_text(counts: Counter[int]) -> str:
    """What was answered, in a line."""
    every, poses, none = sum(counts.values()), counts[DONE], counts[NO_POSE]
    return f"answered {every}: {poses} with a pose, {none} without, {every - poses - none} refused"
