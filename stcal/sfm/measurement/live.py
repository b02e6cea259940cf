"""Live view and HTTP service of ``measure``: poses in a camera's pictures, on a page, and in images that are sent."""

import asyncio
import json
import re
import socket
import threading
import time
from base64 import b64encode
from collections import deque
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from hmac import compare_digest
from ipaddress import ip_address

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.io.images import decode, stated_size
from stcal.parallel import one_thread
from stcal.report.document import environment
from stcal.report.svg import AXIS_COLOURS, COLOURS
from stcal.sfm.measurement.measure_images import Tracker, measured_by
from stcal.sfm.measurement.pose import TargetPose
from stcal.sfm.measurement.pose_report import poses_file

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, JSONResponse, StreamingResponse
    from starlette.routing import Route
except ImportError as error:
    needed = "--live, --serve: need Starlette and uvicorn; install stereo-target-calibration[live]"
    raise InputError("E-EXTRA-MISSING", needed) from error

WIDEST_PX = 1280  # largest width of the picture that is sent
OWN_HOST = re.compile(r"(localhost|127\.[\d.]+|\[::1\])(:\d+)?")
"""Host of a request to this machine. Without a token, any other name could be one that a page of another origin has
pointed to this machine (DNS rebinding)."""


class LiveService:
    """App that answers images with poses; if ``live``, also a page with the pictures that :meth:`follow` measures.
    ``token``: word that each request must carry, as ``Authorization: Bearer`` or as ``?token=``."""

    def __init__(self, tracker: Tracker, live: bool = False, token: str = "", max_megabytes: float = 64.0):
        self.tracker, self.token, self.max_megabytes = tracker, token, max_megabytes
        self.newest: dict | None = None
        self.ended = False
        self._measuring = threading.Lock()  # decoders and limits of threads are shared
        shown = [Route("/", self._page), Route("/events", self._events)] if live else []
        self.app = Starlette(
            routes=[Route("/pose", self._pose, methods=["POST"]), *shown], exception_handlers={HTTPException: _refused}
        )

    def follow(self, frames: Iterable[np.ndarray], tracker: Tracker) -> Iterator[dict]:
        """Measures grey pictures (height, width), uint8, puts each on the page, and yields its content."""
        times: deque[float] = deque(maxlen=20)
        for number, frame in enumerate(frames, 1):
            began = time.monotonic()
            with self._measuring, one_thread():
                result, centres = measured_by(tracker, frame, f"picture {number}")
            times.append(time.monotonic())
            pose = result.images[0].pose if result.images else None
            content = {
                "picture": number,
                "status": pose.status if pose else "no pose",
                "reason": "" if pose else result.left_out[0].reason,
                "rate": (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0,
                "measured_in_s": times[-1] - began,
                "shown": rows_of(pose) if pose else [],
                "poses": poses_file(result).content(),
            }
            picture = drawn(frame, centres, pose, tracker)
            jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
            self.newest = content | {"jpeg": b64encode(jpeg).decode()}
            yield content
        self.ended = True

    def answer(self, data: bytes, name: str) -> tuple[int, dict]:
        """Returns status and JSON for one image: 200 with a pose; 422 without; 400 if it is no image of the camera."""
        try:
            stated_size(data, name)  # refuses a small file of a huge image
            with self._measuring, one_thread():
                result, _ = measured_by(copy(self.tracker), decode(data, name), name)
        except InputError as error:
            return 400, {"error": str(error), "code": error.code}
        return 200 if result.images else 422, poses_file(result).content()

    async def _pose(self, request: Request) -> JSONResponse:
        self._require_allowed(request)
        data = bytearray()
        async for part in request.stream():
            data += part
            if len(data) > 1e6 * self.max_megabytes:
                raise HTTPException(413, f"more than {self.max_megabytes:g} MB, see --max-megabytes")
        code, content = await asyncio.to_thread(self.answer, bytes(data), request.query_params.get("name", "image"))
        return JSONResponse(content, code)

    async def _page(self, request: Request) -> HTMLResponse:
        self._require_allowed(request)
        page = environment().get_template("report/templates/live.html.jinja").render()
        return HTMLResponse(page, headers={"Content-Security-Policy": "frame-ancestors 'none'"})

    async def _events(self, request: Request) -> StreamingResponse:
        """Sends picture and pose in one message, the newest that there is, until no further one comes."""
        self._require_allowed(request)

        async def messages() -> AsyncIterator[str]:
            sent = 0
            while True:
                ended, newest = self.ended, self.newest
                if newest and newest["picture"] != sent:
                    sent = newest["picture"]
                    yield f"data: {json.dumps(newest, allow_nan=False)}\n\n"
                elif ended:
                    yield "event: ended\ndata: {}\n\n"
                    return
                await asyncio.sleep(0.01)

        return StreamingResponse(messages(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    def _require_allowed(self, request: Request) -> None:
        """Refuses pages of other origins, which would read the live picture, and requests without the token."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        own = self.token or OWN_HOST.fullmatch(host)
        if not own or origin not in (None, f"http://{host}"):
            raise HTTPException(403, f"Host {host}, Origin {origin}: not that of this service")
        given = request.headers.get("authorization", f"Bearer {request.query_params.get('token', '')}")
        if self.token and not compare_digest(given.encode(), f"Bearer {self.token}".encode()):
            raise HTTPException(401, "Authorization: Bearer, or ?token=, with the token of the service needed")


def _refused(_, error) -> JSONResponse:
    return JSONResponse({"error": error.detail, "code": "E-SERVICE-REQUEST"}, error.status_code)


@contextmanager
def served(service: LiveService, host: str = "127.0.0.1", port: int = 8765) -> Iterator[str]:
    """Answers requests to the port, any free one if 0, within the context, in a thread; returns the URL."""
    try:
        listening = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        reason = f"--host {host} --port {port}: cannot be opened: {error.strerror or error}; give another"
        raise InputError("E-SERVICE-ADDRESS", reason) from error
    with listening:
        address, port = listening.getsockname()[:2]
        if not (ip_address(address.partition("%")[0]).is_loopback or service.token):
            raise InputError("E-OPTION-NEEDS", f"--host {host}: other machines reach it; give a --token")
        config = uvicorn.Config(service.app, lifespan="off", ws="none", log_config=None, log_level="error")
        config.limit_concurrency = 16  # each connection may hold an image of the largest size
        config.timeout_graceful_shutdown = 2  # s in which pages receive the last picture
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)  # signals come to this one
        thread.start()
        try:
            yield f"http://{f'[{address}]' if ':' in address else address}:{port}"
        finally:
            service.ended = server.should_exit = True
            thread.join()


def rows_of(pose: TargetPose) -> list[list[str]]:
    """Returns the rows of the page for a pose: names and values with their σ, camera_from_target in mm and degrees."""
    pose_sigma = pose.camera_from_target.log_sigma(pose.covariance)
    turn, turn_sigma = np.degrees([pose.camera_from_target.log()[:3], pose_sigma[:3]])
    rows = [["faces", ", ".join(pose.faces)], ["circles", str(len(pose.labels))]]
    for axis, value, sigma in zip("xyz", pose.camera_from_target.translation, pose_sigma[3:], strict=True):
        rows.append([axis, f"{value:.3f} ± {sigma:.3f} mm"])
    for axis, value, sigma in zip("xyz", turn, turn_sigma, strict=True):
        rows.append([f"turn about {axis}", f"{value:.3f} ± {sigma:.3f}°"])
    return [*rows, ["residuals", f"{pose.rms_px():.3f} px RMS"]]


def line_of(content: dict) -> str:
    """Returns one line for the terminal: number, status, pose and rate of a picture; the page has σ."""
    values = {name: value.partition(" ± ")[0] for name, value in content["shown"]}
    what = content["reason"]
    if values:
        place, turn = (
            " ".join(f"{float(values[f'{kind}{axis}']):.2f}" for axis in "xyz") for kind in ("", "turn about ")
        )
        what = f"faces {content['shown'][0][1].replace(' ', '')}  {place} mm  {turn}°"
    line = f"picture {content['picture']}: {content['status']}: {what}"
    return f"{line[:80]}{' …' * (len(line) > 80)}  ({content['rate']:.1f} a second)"


def drawn(frame: np.ndarray, centres_px: np.ndarray, pose: TargetPose | None, tracker: Tracker) -> np.ndarray:
    """Returns a grey picture in colour with centres (n, 2), px, faces, and axes of the target, ≤ ``WIDEST_PX`` wide."""
    scale = min(1.0, WIDEST_PX / frame.shape[1])
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else frame
    picture = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    unit = max(picture.shape[1] / 640, 1.0)

    def places(xy_px: np.ndarray) -> np.ndarray:
        return np.rint((xy_px + 0.5) * scale - 0.5).astype(np.int32)

    if pose is not None and tracker.camera is not None:
        target, project = tracker.target, tracker.camera.project
        names = []
        for face in pose.faces:
            of_face = np.array([label.face == face for label in target.labels])
            hull = cv2.convexHull(places(project(pose.camera_from_target @ target.xyz[of_face])))
            colour = _bgr(COLOURS[[*target.target_from_plane].index(face) % len(COLOURS)])
            cv2.polylines(picture, [hull], True, colour, round(1.5 * unit), cv2.LINE_AA)
            corner = hull[:, 0].min(0) - round(6 * unit)
            names.append((f"face {face}", np.maximum(corner, [0, round(14 * unit)]), colour))
        length = 0.4 * float(np.linalg.norm(np.ptp(target.xyz, axis=0)))
        ends = pose.camera_from_target @ np.vstack([np.zeros(3), length * np.eye(3)])
        if (ends[:, 2] > 0).all():
            origin, *tips = places(project(ends)).tolist()
            for tip, colour in zip(tips, AXIS_COLOURS, strict=False):
                cv2.arrowedLine(picture, origin, tip, _bgr(colour), round(2 * unit), cv2.LINE_AA, tipLength=0.12)
        font, height = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit
        for words, corner, colour in names:  # over all else, each above its face
            for ink, width in (((0, 0, 0), 4), (colour, 1.5)):
                cv2.putText(picture, words, corner, font, height, ink, round(width * unit), cv2.LINE_AA)  # type: ignore[call-overload]
    for place in places(centres_px).tolist():
        cv2.drawMarker(picture, place, (0, 255, 0), cv2.MARKER_CROSS, round(7 * unit), round(unit), cv2.LINE_AA)
    return picture


def _bgr(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))[::-1]
