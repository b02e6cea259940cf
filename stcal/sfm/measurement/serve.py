"""HTTP service of ``measure --serve``: one JSON answer per image, within limits that no client can use up alone."""

import asyncio
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from email.utils import formatdate
from hmac import compare_digest
from http.client import responses
from ipaddress import ip_address
from urllib.parse import parse_qs, urlsplit

import h11

import stcal
from stcal.errors import InputError
from stcal.sfm.measurement.live import LiveView
from stcal.sfm.measurement.own_process import LOOK_S
from stcal.sfm.measurement.service import BUSY, DONE, FAILED, NO_POSE, REFUSED, Answer, MeasureService, refusal
from stcal.sfm.measurement.service import WAITING as WAITING
from stcal.sfm.measurement.service import Setting as Setting

LOCALHOST, PORT = "127.0.0.1", 8765
MAX_MEGABYTES = 64.0
PATIENCE_S = 30.0
"""Time for the head of a request, during which a client may be silent, and fixed part of the time for its body, s."""
SLOWEST = 100_000
"""Least rate at which a body comes, bytes a second."""
CONNECTIONS, CONNECTIONS_EACH = 256, 64
"""Number of connections in all, and from one address. A new one takes the place of the one that is idle longest."""
HELD_BYTES = 256_000_000
"""Bytes of images that are received, wait or are measured; two images at least. Beyond, the stalest uploads end."""
NEWCOMERS = 50_000_000
"""Rate at which all connections that never got an answer are read together while other clients send images, bytes/s."""
HEAD_BYTES, HEAD_FIELDS = 32_768, 100
CHUNK_BYTES = 65_536
CROWDED_S = 1.0
"""Time for which an image tries to join those that wait, where they are too many, s."""
LINGER_S = 1.0
"""Time for which the rest of a refused request is read, s. Else the client could lose the answer."""
MEASURE, STATUS = "/measure", "/"
LIVE_PAGE, LIVE_JSON, LIVE_PICTURES = "/", "/live.json", "/live.mjpg"
"""Places of a live view. Its page takes the place of the status."""
BOUNDARY = "picture"
JSON, HTML = "application/json; charset=utf-8", "text/html; charset=utf-8"
LIVE_LOOK_S = 0.01
"""Interval at which a stream looks for a newer picture, s."""
NO_TOKEN, NOT_FOUND, NOT_ALLOWED, NO_LENGTH, TOO_LARGE, LONG_TARGET, MANY_FIELDS, OTHER_HTTP = (
    *(401, 404, 405, 411, 413, 414, 431, 505),
)


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """Options of the HTTP service.

    ``host`` : address to listen on; reachable from this machine only by default; ``port`` : port to listen on; any free
    one if 0; ``max_megabytes`` : largest size of an image file; ``token`` : word that each request must carry as
    ``Authorization: Bearer``; none is needed if empty.
    """

    host: str = LOCALHOST
    port: int = PORT
    max_megabytes: float = MAX_MEGABYTES
    token: str = ""


class _Refused(Exception):
    """A request that is answered with a status code and a reason, and ends its connection."""

    def __init__(self, code: int, reason: str, kind: str = "E-SERVICE-REQUEST"):
        super().__init__(code, reason)
        self.answer = refusal(code, kind, reason)


class MeasureServer:
    """HTTP server that passes images to the service. One thread holds all connections; h11 reads and writes HTTP.

    With a ``view`` it also shows the pictures of that, as a page.

    Attributes
    ----------
    counts : Counter
        Number of answers by status code.
    left : int
        Number of images that were not measured because their clients had gone.

    Raises
    ------
    InputError
        If it cannot listen on the address.
    """

    def __init__(self, service: MeasureService, options: ServeOptions, view: LiveView | None = None):
        self.service, self.options, self.view = service, options, view
        self.most_bytes = int(options.max_megabytes * 1e6)
        self.most_held = max(HELD_BYTES, 2 * self.most_bytes)
        self.counts: Counter[int] = Counter()
        self.left = 0
        self.threads = ThreadPoolExecutor(service.most_waiting + 4)  # more than may wait, so that refusals do not
        self._open: dict[_Connection, None] = {}
        self._held, self._read_until = 0, 0.0
        self._ended = threading.Event()
        self._stop: Callable[[], object] | None = None
        family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
        try:
            self._socket = socket.create_server((options.host, options.port), family=family, backlog=512)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                "E-SERVICE-ADDRESS",
                f"--host {options.host} --port {options.port}: cannot be opened: {reason}; give another",
            ) from error
        self.server_address: tuple = self._socket.getsockname()

    def __enter__(self) -> "MeasureServer":
        return self

    def __exit__(self, *_) -> None:
        self.shutdown()
        self._socket.close()
        self.threads.shutdown(wait=False, cancel_futures=True)

    @property
    def url(self) -> str:
        """URL of the server."""
        host, port = self.server_address[:2]
        return f"http://{f'[{host}]' if ':' in host else host}:{port}"

    @property
    def local(self) -> bool:
        """Whether only this machine can reach the server."""
        return ip_address(str(self.server_address[0]).partition("%")[0]).is_loopback

    def serve_forever(self) -> None:
        """Answers requests until :meth:`shutdown`, which another thread calls."""
        asyncio.run(self._serve())

    def shutdown(self) -> None:
        """Ends :meth:`serve_forever`, and with it all connections."""
        self._ended.set()
        if self._stop is not None:
            with suppress(RuntimeError):  # it has ended already
                self._stop()

    async def _serve(self) -> None:
        ended, loop = asyncio.Event(), asyncio.get_running_loop()
        self._stop = lambda: loop.call_soon_threadsafe(ended.set)
        if self._ended.is_set():
            return
        server = await asyncio.start_server(self._connected, sock=self._socket.dup(), limit=CHUNK_BYTES)
        await ended.wait()
        server.close()
        for connection in list(self._open):
            connection.abort()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = _Connection(self, reader, writer)
        if not self._has_room(connection.address):
            connection.refuse_at_once(f"{CONNECTIONS_EACH} connections from one address, {CONNECTIONS} in all")
            return
        self._open[connection] = None
        try:
            await connection.run()
        finally:
            del self._open[connection]

    def _has_room(self, address: str) -> bool:
        """Returns whether one more connection may be open, after the one that was idle longest has made room."""
        every = [each for each in self._open if not each.ended]
        own = [each for each in every if each.address == address]
        if len(own) < CONNECTIONS_EACH and len(every) < CONNECTIONS:
            return True
        idle = [each for each in (own if len(own) >= CONNECTIONS_EACH else every) if not each.complete]
        if idle:
            min(idle, key=_Connection.staleness).abort()
        return bool(idle)

    def hold(self, connection: "_Connection", count: int) -> None:
        """Counts bytes that a connection has received. The stalest uploads end if all hold more than is allowed."""
        self._held += count
        connection.held += count
        while self._held > self.most_held:
            uploads = [each for each in self._open if each.held and not each.complete]
            stalest = min(uploads, key=_Connection.staleness)
            reason = f"{self.most_held / 1e6:.0f} MB of images are under way; send it again later"
            if stalest is connection:
                raise _Refused(BUSY, reason, "E-SERVICE-BUSY")
            stalest.refuse_at_once(reason)

    def pause_s(self, connection: "_Connection", count: int) -> float:
        """Returns how long to wait before more is read from a connection that has sent this many bytes."""
        if connection.known or not self.service.beside_others(connection.client):
            return 0.0
        now = time.monotonic()
        self._read_until = max(self._read_until, now) + count / NEWCOMERS
        return self._read_until - now

    def release(self, connection: "_Connection") -> None:
        """Counts the bytes of a connection as no longer held."""
        self._held -= connection.held
        connection.held = 0


class _Connection:
    """One connection, whose requests come one after the other.

    ``complete`` : whether a request has come and its answer is due; ``held`` : bytes of its image; ``left`` : whether
    the client has closed its side; ``ended`` : whether this side has ended it.
    """

    def __init__(self, server: MeasureServer, reader: asyncio.StreamReader, writer: asyncio.StreamWriter):
        self.server, self.reader, self.writer = server, reader, writer
        self.address = str((writer.get_extra_info("peername") or ("",))[0])
        self.http = h11.Connection(h11.SERVER, max_incomplete_event_size=HEAD_BYTES)
        self.complete, self.held, self.left, self.ended = False, 0, False, False
        self._answers, self._last, self._method = 0, time.monotonic(), b""

    @property
    def known(self) -> bool:
        """Whether it has got an answer."""
        return self._answers > 0

    @property
    def client(self) -> str:
        """Who sends: this connection, or all of one address that never got an answer."""
        return f"{self.address} {id(self)}" if self.known else self.address

    def staleness(self) -> tuple[bool, float]:
        """Returns a sort key: those that never got an answer first, then by the time of their last byte."""
        return self.known, self._last

    def abort(self) -> None:
        """Ends the connection at once."""
        self.ended = True
        self.server.release(self)
        self.writer.transport.abort()

    def refuse_at_once(self, reason: str) -> None:
        """Answers that the service is busy, if the client can still receive an answer, and ends the connection."""
        self.server.counts[BUSY] += 1
        with suppress(h11.LocalProtocolError, OSError):
            self._write(refusal(BUSY, "E-SERVICE-BUSY", reason), closing=True)
        self.ended = True
        self.server.release(self)
        self.writer.close()

    async def run(self) -> None:
        """Answers requests until either side ends the connection."""
        try:
            while await self._one():
                self.http.start_next_cycle()
        except h11.RemoteProtocolError as error:
            await self._refuse(_fault(error, self.http).answer)
        except _Refused as refused:
            await self._refuse(refused.answer)
        except (OSError, EOFError, h11.LocalProtocolError, asyncio.CancelledError):  # it went away, or took too long
            pass
        finally:
            self.server.release(self)
            self.writer.close()

    async def _one(self) -> bool:
        """Answers one request; returns whether another one may follow."""
        async with asyncio.timeout(PATIENCE_S):
            request = await self._event()
        if not isinstance(request, h11.Request):
            return False
        self._method = request.method
        place, asked, length = _checked(request, self.server)
        async with asyncio.timeout(PATIENCE_S + length / SLOWEST):
            data = await self._body()
        if place == LIVE_PICTURES:
            return await self._stream()
        self.complete = True
        until = time.monotonic() + CROWDED_S
        answer = await self._measured(data, asked) if place == MEASURE else self._shown(place)
        while answer is not None and answer.code == BUSY and time.monotonic() < until:
            await asyncio.sleep(LOOK_S)
            answer = await self._measured(data, asked)
        self.server.release(self)
        if answer is None:
            self.server.left += 1
            return False
        if place == MEASURE:
            self.server.counts[answer.code] += 1
        self._write(answer, kind=HTML if self.server.view and place == LIVE_PAGE else JSON)
        async with asyncio.timeout(PATIENCE_S):
            await self.writer.drain()
        self.complete, self._answers = False, self._answers + 1
        return self.http.our_state is h11.DONE and self.http.their_state is h11.DONE

    async def _event(self):
        """Returns the next event of the connection."""
        while (event := self.http.next_event()) is h11.NEED_DATA:
            if self.http.they_are_waiting_for_100_continue:
                self.writer.write(self.http.send(h11.InformationalResponse(status_code=100, headers=[])) or b"")
            data = await self.reader.read(CHUNK_BYTES)
            if self.ended or not data:
                raise EOFError
            self._last = time.monotonic()
            if self.http.their_state is h11.IDLE and data.partition(b"\r\n\r\n")[0].count(b"\n") > HEAD_FIELDS:
                raise _Refused(MANY_FIELDS, f"more than {HEAD_FIELDS} header fields")
            self.http.receive_data(data)
        return event

    async def _body(self) -> bytes:
        parts: list[bytes] = []
        while isinstance(event := await self._event(), h11.Data):
            self.server.hold(self, len(event.data))
            parts.append(bytes(event.data))
            await asyncio.sleep(self.server.pause_s(self, len(event.data)))
        if not isinstance(event, h11.EndOfMessage):
            raise EOFError
        return b"".join(parts)

    async def _measured(self, data: bytes, asked: dict[str, str]) -> Answer | None:
        """Returns the answer to an image; None if the client goes away while the image waits."""
        named = asked.get("name", "image"), asked.get("sequence", "")
        watch = asyncio.ensure_future(self.reader.read(CHUNK_BYTES))
        if not self.known and self.server.service.beside_others(self.client):  # many send and leave at once
            await asyncio.wait((watch,), timeout=LOOK_S)
            self.left = watch.done() and (watch.exception() is not None or not watch.result())
        work = asyncio.get_running_loop().run_in_executor(
            self.server.threads, self.server.service.answer, data, *named, lambda: self.left, self.client
        )
        await asyncio.wait((work, watch), return_when=asyncio.FIRST_COMPLETED)
        watch.cancel()  # without effect if it is done
        await asyncio.wait((watch,))
        if not watch.cancelled():
            data = b"" if watch.exception() else watch.result()
            self.left = not data
            if data:  # the beginning of its next request
                self.http.receive_data(data)
        try:
            return await work
        except Exception as error:  # a fault of the program must not end the connection without an answer
            return refusal(FAILED, "E-SERVICE-FAILED", f"{type(error).__name__}: not answered")

    async def _stream(self) -> bool:
        """Sends the pictures of the view as they come, until the client goes away or the view ends."""
        view, number, boundary = self.server.view, 0, f"--{BOUNDARY}\r\n".encode()
        assert view is not None
        self._send(DONE, f"multipart/x-mixed-replace; boundary={BOUNDARY}", None, closing=True)
        while not (self.ended or self.writer.transport.is_closing()):
            picture = view.newest
            if picture is None or picture.number == number:
                if view.ended:
                    self.writer.write(self.http.send(h11.EndOfMessage()) or b"")
                    break
                await asyncio.sleep(LIVE_LOOK_S)
                continue
            head = f"Content-Type: image/jpeg\r\nContent-Length: {len(picture.jpeg)}\r\n\r\n".encode()
            # The next boundary comes at once: browsers show a picture when they have seen its end.
            part = (b"" if number else boundary) + head + picture.jpeg + b"\r\n" + boundary
            number = picture.number
            self.writer.write(self.http.send(h11.Data(data=part)) or b"")
            async with asyncio.timeout(PATIENCE_S):
                await self.writer.drain()
            self._last = time.monotonic()
        return False

    def _shown(self, place: str) -> Answer:
        """Returns the answer to a GET."""
        view = self.server.view
        if view is None:
            return self._status()
        return Answer(DONE, view.page() if place == LIVE_PAGE else view.json())

    def _status(self) -> Answer:
        description = {
            "format": "stcal service 1",
            "version": stcal.__version__,
            "measure": f"POST {MEASURE}?name=&sequence=",
            "max_megabytes": self.server.options.max_megabytes,
            "answers": {str(code): count for code, count in sorted(self.server.counts.items())},
            "left": self.server.left,
        }
        return Answer(DONE, json.dumps(description))

    async def _refuse(self, answer: Answer) -> None:
        """Refuses the request and ends the connection, as the rest of its data is unknown."""
        with suppress(h11.LocalProtocolError, OSError, TimeoutError):
            self.server.counts[answer.code] += 1
            self._write(answer, closing=True)
            self.server.release(self)
            async with asyncio.timeout(LINGER_S):
                await self.writer.drain()
                self.writer.write_eof()
                while await self.reader.read(CHUNK_BYTES):
                    pass

    def _write(self, answer: Answer, closing: bool = False, kind: str = JSON) -> None:
        self._send(answer.code, kind, answer.text.encode() + b"\n", closing)

    def _send(self, code: int, kind: str, body: bytes | None, closing: bool) -> None:
        """Sends the head of an answer, and its body; with None for the body, that follows in parts."""
        headers = [
            ("Server", f"stcal/{stcal.__version__}"),
            ("Date", formatdate(usegmt=True)),
            ("Content-Type", kind),
            *([] if body is None else [("Content-Length", str(len(body)))]),
            *([("Cache-Control", "no-store")] if self.server.view else []),
            *([("Connection", "close")] if closing else []),
            *([("WWW-Authenticate", "Bearer")] if code == NO_TOKEN else []),
        ]
        self.writer.write(
            self.http.send(h11.Response(status_code=code, headers=headers, reason=responses.get(code, ""))) or b""
        )
        if body is not None:
            content = [] if self._method == b"HEAD" else [h11.Data(data=body)]
            for event in (*content, h11.EndOfMessage()):
                self.writer.write(self.http.send(event) or b"")


def _checked(request: h11.Request, server: MeasureServer) -> tuple[str, dict[str, str], int]:
    """Returns path, query and length of the body of a request; raises if it is refused before its body is read."""
    fields = {name.decode(): value.decode("latin-1") for name, value in request.headers}
    if request.http_version not in (b"1.0", b"1.1"):
        raise _Refused(OTHER_HTTP, "version 1.1 of HTTP needed")
    try:
        parts = urlsplit(request.target.decode())
    except ValueError:
        parts = None
    asked = {key: values[0] for key, values in parse_qs(parts.query).items()} if parts else {}
    given, wanted = fields.get("authorization", "").encode("latin-1"), f"Bearer {server.options.token}".encode()
    if server.view and request.method == b"GET" and "token" in asked:  # a browser sends no such header
        given = f"Bearer {asked['token']}".encode()
    if server.options.token and not compare_digest(given, wanted):
        raise _Refused(NO_TOKEN, "Authorization: Bearer with the token of the service needed")
    if parts is None:
        raise _Refused(REFUSED, "the request's target is no URL")
    seen = (LIVE_PAGE, LIVE_JSON, LIVE_PICTURES) if server.view else (STATUS,)
    places = {b"POST": (MEASURE,), b"GET": seen}.get(request.method)
    if places is None:
        raise _Refused(NOT_ALLOWED, f"POST an image to {MEASURE}; GET {STATUS} tells what this is")
    if parts.path not in places:
        raise _Refused(NOT_FOUND, f"POST an image to {MEASURE}; GET {STATUS} tells what this is")
    place = parts.path
    stated = fields.get("content-length", "" if place == MEASURE else "0")
    if "transfer-encoding" in fields or not stated:
        raise _Refused(NO_LENGTH, "Content-Length needed, in bytes")
    length = int(stated)  # digits alone: h11 has looked
    if place != MEASURE and length:
        raise _Refused(REFUSED, "a GET with a body; leave the body out")
    if length > server.most_bytes:
        limit = server.options.max_megabytes
        raise _Refused(TOO_LARGE, f"{length / 1e6:.1f} MB; {limit:g} MB at most, see --max-megabytes")
    return place, asked, length


def _fault(error: h11.RemoteProtocolError, http: h11.Connection) -> _Refused:
    """Returns the refusal of a request that is no HTTP."""
    if "bad Content-Length" in str(error):
        return _Refused(NO_LENGTH, "Content-Length needed, in bytes")
    if error.error_status_hint == MANY_FIELDS and b"\r\n" not in http.trailing_data[0]:
        return _Refused(LONG_TARGET, f"more than {HEAD_BYTES} bytes of a request line")
    return _Refused(error.error_status_hint, f"no request of HTTP: {error}")


def serve(service: MeasureService, options: ServeOptions, ready: Callable[[MeasureServer], None]) -> None:
    """Answers requests until interrupted.

    ``ready`` : called with the server as soon as it accepts images.
    """
    with MeasureServer(service, options) as server:
        try:
            service.start()
            thread = threading.Thread(target=server.serve_forever, daemon=True)  # signals come to this one
            thread.start()
            ready(server)
            while thread.is_alive():
                thread.join(0.5)
        finally:
            server.shutdown()
            service.close()


@contextmanager
def show_live(service: MeasureService, options: ServeOptions, view: LiveView) -> Iterator[MeasureServer]:
    """Shows a live view, and answers images, within the context."""
    with MeasureServer(service, options, view) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            service.close()


def counts_text(counts: Counter[int]) -> str:
    """Returns one line with the counts of answers."""
    total, poses, without_pose = sum(counts.values()), counts[DONE], counts[NO_POSE]
    return f"answered {total}: {poses} with a pose, {without_pose} without, {total - poses - without_pose} refused"
