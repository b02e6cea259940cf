"""Images over HTTP: the answers of ``measure``, and one line of JSON for whatever else is sent."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import zlib
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from stcal.io.cameras.read import read_camera
from stcal.sfm import MeasureOptions, measure
from stcal.sfm.measurement.report import poses_file
from stcal.sfm.measurement.serve import (
    CONNECTIONS_EACH,
    DONE,
    NEWCOMERS,
    WAITING,
    Answer,
    MeasureServer,
    MeasureService,
    ServeOptions,
    Setting,
    _Connection,
    counts_text,
)
from stcal.sfm.measurement.target import read_target
from tests.levels import sampled
from tests.outcome import fails_with

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def known(small_run, small_scene):
    target = read_target(small_run / "faces.json", small_scene.target)
    object.__setattr__(target, "design", small_scene.target)
    return target, read_camera(small_run / "cameras.txt")


@pytest.fixture(scope="module")
def server(known):
    service = MeasureService(Setting(*known), 2)
    with MeasureServer(service, ServeOptions(port=0, max_megabytes=4)) as running:
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield running
        running.shutdown()
    service.close()


@pytest.fixture(scope="module")
def photographs(small_dataset):
    return {
        path.relative_to(small_dataset / "images").as_posix(): path.read_bytes()
        for path in sorted((small_dataset / "images" / "12").iterdir())
    }


def post(server, data, query="", **headers) -> tuple[int, dict]:
    line = http.client.HTTPConnection(*server.server_address[:2], timeout=PATIENCE_S)
    line.request("POST", f"/measure{query}", body=data, headers=headers)
    answer = line.getresponse()
    found = answer.status, json.loads(answer.read())
    line.close()
    return found


def said(server, raw: bytes) -> bytes:
    """Everything that is answered to bytes."""
    with socket.create_connection(server.server_address[:2], timeout=PATIENCE_S) as line:
        line.sendall(raw)
        line.shutdown(socket.SHUT_WR)
        parts = []
        while part := line.recv(1 << 16):
            parts.append(part)
    return b"".join(parts)


@pytest.mark.parametrize("sequence", sampled([False, True]))
def test_the_answers_are_those_of_measure(server, photographs, small_dataset, known, small_scene, sequence):
    options = MeasureOptions(sequence=sequence, workers=1)
    images = small_dataset / "images" / "12"
    own = poses_file(measure(images, known[1], known[0], small_scene.target, None, options)).content()
    wanted = {each["image"]: each for each in own["images"]}
    followed = "&sequence=twelve" * sequence
    for place, data in photographs.items():
        name = place.partition("/")[2]
        code, content = post(server, data, f"?name={name}{followed}")
        assert code == 200
        assert content["images"] == [wanted[name]]
        assert {key: content[key] for key in ("format", "unit", "sigma_factor", "intrinsics_held", "notes")} == {
            key: own[key] for key in ("format", "unit", "sigma_factor", "intrinsics_held", "notes")
        }


@pytest.mark.slow
def test_many_at_once_are_not_mixed_up(server, photographs):
    jobs = [(name, data, i) for i in range(3) for name, data in photographs.items()]
    with ThreadPoolExecutor(4) as clients:
        answers = list(clients.map(lambda job: post(server, job[1], f"?name={job[2]}/{job[0]}"), jobs))
    first = {}
    for (name, _, i), (code, content) in zip(jobs, answers, strict=True):
        assert code == 200
        (pose,) = content["images"]
        assert pose["image"] == f"{i}/{name}"
        assert first.setdefault(name, pose["camera_from_target"]) == pose["camera_from_target"]


def test_an_image_without_a_target_has_a_reason(server, known):
    camera = known[1]
    grey = cv2.imencode(".png", np.full((camera.height, camera.width), 90, np.uint8))[1].tobytes()
    code, content = post(server, grey, "?name=wall.png")
    assert (code, content["images"]) == (422, [])
    assert content["left_out"][0]["name"] == "wall.png"
    assert content["left_out"][0]["reason"]


def rubbish(photograph: bytes) -> dict[str, tuple[bytes, str, int, str]]:
    small = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
    huge = bytearray(small)
    huge[16:24] = (60_000).to_bytes(4, "big") * 2
    huge[29:33] = zlib.crc32(bytes(huge[12:29])).to_bytes(4, "big")
    return {
        "noise": (np.random.default_rng(0).bytes(10_000), "", 400, "not readable as an image"),
        "empty": (b"", "", 400, "not readable as an image"),
        "cut": (photograph[:5000], "", 400, "truncated"),
        "other size": (small, "", 400, "64×48 px, camera"),
        "3.6 gigapixels in a kilobyte": (bytes(huge), "", 400, "more pixels than any camera"),
        "a way out": (photograph, "?name=../../etc/passwd", 400, "leads out"),
        "a name without end": (photograph, f"?name={'x' * 300}", 400, "longer than 255"),
        "too large": (bytes(5_000_000), "", 413, "5.0 MB; 4 MB at most"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(rubbish(b"")))
def test_rubbish(server, photographs, kind):
    name, photograph = next(iter(photographs.items()))
    data, query, wanted, words = rubbish(photograph)[kind]
    code, content = post(server, data, query)
    assert (code, list(content)) == (wanted, ["error", "code"])
    assert words in content["error"]
    assert post(server, photograph, f"?name={name}")[0] == 200


SMUGGLED = b"POST /measure HTTP/1.1\r\nHost: x\r\n%b\r\n\r\n1;a=b\r\nx\r\n0\r\n\r\nGET / HTTP/1.1\r\nHost: x\r\n\r\n"
"""A body in chunks, with an extension, before a second request."""


@pytest.mark.parametrize(
    ("raw", "code"),
    [
        (b"POST /measure HTTP/1.1\r\nHost: x\r\n\r\n", 411),
        (b"POST /measure HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n", 411),
        (b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n", 411),
        (b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: " + b"9" * 40 + b"\r\n\r\n", 411),
        (b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: 999999999999\r\n\r\n", 413),
        (b"POST /elsewhere HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n", 404),
        (b"GET /elsewhere HTTP/1.1\r\nHost: x\r\n\r\n", 404),
        (b"DELETE /measure HTTP/1.1\r\nHost: x\r\n\r\n", 405),
        (b"GET / HTTP/9.9\r\n\r\n", 505),
        (b"\x00\x01\x02 rubbish\r\n\r\n", 400),
        (b"GET " + b"x" * 70_000 + b" HTTP/1.1\r\n\r\n", 414),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n", 431),
        (b"GET http://[x/ HTTP/1.1\r\nHost: x\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\n\r\nGET / HTTP/1.1\r\nHost: x\r\n\r\n", 400),
        (b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\nsixsix", 400),
        (b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length : 5\r\n\r\nshort", 400),
        (SMUGGLED % b"Transfer-Encoding: chunked\r\nContent-Length: 4", 411),
        (SMUGGLED % b"Content-Length: 4\r\nTransfer-Encoding: chunked", 411),
        (SMUGGLED % b"Transfer-Encoding:\r\n chunked\r\nContent-Length: 4", 411),
        (SMUGGLED % b"Transfer-Encoding : chunked\r\nContent-Length: 4", 400),
        (SMUGGLED % b"Transfer-Encoding: identity\r\nContent-Length: 4", 501),
        (SMUGGLED % b"Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked", 501),
        (SMUGGLED % b"Content-Length: 4, 5", 400),
        (SMUGGLED % b"Content-Length: 4\x00", 400),
        (SMUGGLED % b"Content-Length: +4", 411),
        (SMUGGLED % b"Content-Length: 0x4", 411),
        (SMUGGLED % b"Content-Length: \xb2", 411),
        (b"GET //[/ HTTP/1.1\r\nHost: x\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: x\r\nHost: y\r\n\r\n", 400),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 505),
    ],
)
def test_broken_requests(server, raw, code):
    answer = said(server, raw)
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.split(b" ")[1] == str(code).encode()
    assert json.loads(body)["code"] == "E-SERVICE-REQUEST"
    assert answer.count(b"HTTP/1.1 ") == 1  # a body is no second request
    assert b"Python" not in head


@pytest.mark.slow
def test_a_client_that_leaves_costs_nothing(server, photographs):
    name, photograph = next(iter(photographs.items()))
    assert said(server, b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: 500000\r\n\r\nshort") == b""
    assert post(server, photograph, f"?name={name}")[0] == 200


@pytest.mark.slow
def test_no_answer_holds_a_path(server, photographs, small_run, tmp_path):
    root = str(tmp_path.parent.parent)
    every = [json.dumps(post(server, *rubbish(next(iter(photographs.values())))[kind][:2])) for kind in rubbish(b"")]
    every += [json.dumps(post(server, data, f"?name={name}")) for name, data in photographs.items()]
    assert not [text for text in every if root in text or "/tmp" in text or "/home" in text]


def test_a_camera_file_is_named_without_its_folder(known, photographs):
    """One without an image size, whose principal point is outside of the image."""
    camera = known[1]
    for key, value in (("width", None), ("height", None)):
        camera = type(camera)(**{name: getattr(camera, name) for name in camera.__dataclass_fields__} | {key: value})
    camera = type(camera)(
        **{name: getattr(camera, name) for name in camera.__dataclass_fields__} | {"centre": camera.centre + 1e5}
    )
    service = MeasureService(Setting(known[0], camera), 1)
    answer = service.answer(next(iter(photographs.values())))
    service.close()
    assert answer.code == 400
    assert "camera file cameras.txt: principal point" in answer.text


def test_status(server):
    line = http.client.HTTPConnection(*server.server_address[:2], timeout=PATIENCE_S)
    line.request("GET", "/")
    content = json.loads(line.getresponse().read())
    line.close()
    assert content["format"] == "stcal service 1"
    assert content["max_megabytes"] == 4


@pytest.mark.slow
def test_a_process_that_is_ended_is_replaced(known, photographs):
    service = MeasureService(Setting(*known), 1)
    service.start()
    name, data = next(iter(photographs.items()))
    before = service.answer(data, name)
    (process,) = service._processes
    (pid,) = process._pool._processes
    os.kill(pid, signal.SIGKILL)
    answers = [service.answer(data, name) for _ in range(2)]
    service.close()
    assert before.code == answers[-1].code == DONE
    assert before.text == answers[-1].text
    assert "the process that measured it ended; send it again" in answers[0].text


def test_more_than_can_wait_are_sent_back(known):
    class Slow:
        def call(self, *_):
            time.sleep(0.5)
            return Answer(DONE, "{}"), ()

    service = MeasureService(Setting(*known), 1)
    service._processes = [Slow()]
    with ThreadPoolExecutor(WAITING + 4) as clients:
        answers = list(clients.map(lambda _: service.answer(b"", "image"), range(WAITING + 4)))
    assert sorted(answer.code for answer in answers) == [200] * WAITING + [503] * 4


def test_images_of_a_sequence_keep_their_order(known):
    """Each is handed over with what came of the one before, by whatever process."""
    seen = []

    class Slow:
        def call(self, _, data, name, recent):
            time.sleep(0.02)
            seen.append((name, recent))
            return Answer(DONE, "{}"), (name,)

    service = MeasureService(Setting(*known), 2)
    service._processes = [Slow(), Slow()]
    with ThreadPoolExecutor(8) as clients:
        list(clients.map(lambda i: service.answer(b"", f"{i % 2}/{i}", f"s{i % 2}"), range(12)))
    for which in "01":
        own = [(name, recent) for name, recent in seen if name[0] == which]
        assert [recent for _, recent in own] == [(), *((name,) for name, _ in own[:-1])]


class Waiting:
    """A process that measures nothing until it is told to, one image after the other."""

    def __init__(self):
        self.go, self.names, self._turn = threading.Event(), [], threading.Lock()

    def call(self, _, data, name, recent, given_up=lambda: False):
        while not self._turn.acquire(timeout=0.01):
            if given_up():
                raise CancelledError
        if given_up():
            self._turn.release()
            raise CancelledError
        self.go.wait(PATIENCE_S)
        self.names.append(name)
        self._turn.release()
        return Answer(DONE, json.dumps({"bytes": len(data)})), ()

    def close(self):
        self.go.set()


def test_beside_others_no_client_has_all_processes(known):
    """Alone it has; with another one about, what it sends more waits behind its own."""
    service = MeasureService(Setting(*known), 3)
    service._processes = processes = [Waiting() for _ in range(3)]

    def inside(count: int):
        until(lambda: sum(each.total() for each in service._waiting) == count)

    with ThreadPoolExecutor(20) as clients:
        jobs = [clients.submit(service.answer, b"x", str(i), client="greedy") for i in range(3)]
        inside(3)
        assert [each["greedy"] for each in service._waiting] == [1, 1, 1]
        for process in processes:
            process.go.set()
        wait(jobs)
        for process in processes:
            process.go.clear()
        jobs = [clients.submit(service.answer, b"x", "first", client="other")]
        inside(1)
        jobs += [clients.submit(service.answer, b"x", str(i), client="greedy") for i in range(6)]
        inside(7)
        assert sorted(each["greedy"] for each in service._waiting) == [0, 3, 3]
        assert [each["greedy"] for each in service._waiting if each["other"]] == [0]
        for process in processes:
            process.go.set()
        assert {job.result().code for job in jobs} == {200}


def test_newcomers_are_read_at_a_rate_beside_others(known):
    with held(known) as (server, process):
        process.go.set()
        newcomer = _Connection(server, None, FakeWriter())
        assert server.pause_s(newcomer, NEWCOMERS) == 0
        server.service.answer(b"x", client="another one")
        first, second = (server.pause_s(newcomer, NEWCOMERS // 10) for _ in range(2))
        assert first == pytest.approx(0.1, abs=0.02)
        assert second == pytest.approx(0.2, abs=0.02)
        newcomer._answers = 1
        assert server.pause_s(newcomer, NEWCOMERS) == 0


class FakeWriter:
    def get_extra_info(self, _):
        return "10.0.0.1", 5


def test_who_sends_an_image_and_leaves_at_once_has_none_measured_beside_others(known):
    """Also where a process is free, which would begin at once."""
    with held(known) as (server, process):
        process.go.set()
        server.service.answer(b"x", "other", client="another one")
        for i in range(3):
            sent(server, UPLOAD.format(i, 1), b"x").close()
        until(lambda: server.left == 3)
        assert process.names == ["other"]
        assert post(server, b"y", "?name=last") == (200, {"bytes": 1})


@contextmanager
def held(known, **options):
    """A server whose one process waits to be told."""
    service = MeasureService(Setting(*known), 1)
    service._processes = [process := Waiting()]
    with MeasureServer(service, ServeOptions(port=0, max_megabytes=4, **options)) as running:
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield running, process
        service.close()


def sent(server, head: str, body: bytes = b"") -> socket.socket:
    """A connection over which this was sent."""
    line = socket.create_connection(server.server_address[:2], timeout=PATIENCE_S)
    line.sendall(head.replace("\n", "\r\n").encode() + body)
    return line


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


UPLOAD = "POST /measure?name={} HTTP/1.1\nHost: x\nContent-Length: {}\n\n"


def test_images_of_clients_that_left_are_not_measured(known):
    with held(known) as (server, process):
        lines = [sent(server, UPLOAD.format(i, 1), b"x") for i in range(WAITING)]
        until(lambda: server.service._inside == WAITING)
        for line in lines[1:]:
            line.close()
        until(lambda: server.left == WAITING - 1)
        process.go.set()
        assert post(server, b"y", "?name=last") == (200, {"bytes": 1})
        assert process.names == ["0", "last"]
        lines[0].close()


@pytest.mark.slow
def test_idle_connections_make_room(known):
    """Those that were never answered go first: a client that keeps its connection does not lose it."""
    with held(known) as (server, process):
        process.go.set()
        kept = http.client.HTTPConnection(*server.server_address[:2], timeout=PATIENCE_S)
        kept.request("POST", "/measure", body=b"x")
        kept.getresponse().read()
        idle = [sent(server, "") for _ in range(2 * CONNECTIONS_EACH)]
        until(lambda: len(server._open) == CONNECTIONS_EACH)
        assert post(server, b"y")[0] == 200
        kept.request("POST", "/measure", body=b"x")
        assert kept.getresponse().status == 200
        for line in (*idle, kept):
            line.close()


def test_bytes_under_way_are_bounded(known):
    """Uploads that stall end, the stalest first, and an image that comes at once is answered."""
    with held(known) as (server, process):
        process.go.set()
        server.most_held = 10_000_000
        lines = [sent(server, UPLOAD.format(i, 4_000_000), bytes(3_900_000)) for i in range(6)]
        until(lambda: server.counts[503] == 4)
        until(lambda: server._held <= server.most_held)  # another thread adds a chunk, then ends an upload
        assert post(server, bytes(3_900_000)) == (200, {"bytes": 3_900_000})
        assert lines[0].recv(100).startswith(b"HTTP/1.1 503 ")
        for line in lines:
            line.close()
        until(lambda: server._held == 0)


def test_a_token_is_asked_for(known):
    with held(known, token="öffne") as (server, process):
        process.go.set()
        right = {"Authorization": "Bearer öffne".encode()}
        assert post(server, b"x", **right)[0] == 200
        for headers in ({}, {"Authorization": "Bearer other"}, {"Authorization": "öffne".encode()}):
            code, content = post(server, b"x", **headers)
            assert (code, content["code"]) == (401, "E-SERVICE-REQUEST")
            assert "öffne" not in content["error"]


@pytest.mark.parametrize(("host", "port"), [("256.1.1.1", 0), ("no.such.host.invalid", 0)])
def test_an_address_that_is_none(known, host, port):
    with fails_with("E-SERVICE-ADDRESS … --host"):
        MeasureServer(MeasureService(Setting(*known), 1), ServeOptions(host, port))


def test_a_port_that_is_taken(server, known):
    with fails_with("E-SERVICE-ADDRESS … Address already in use"):
        MeasureServer(MeasureService(Setting(*known), 1), ServeOptions(port=server.server_address[1]))


@pytest.mark.parametrize(("words", "other"), [(["images"], "IMAGES"), (["--previous"], "--previous")])
def test_what_belongs_to_a_folder_is_refused(small_run, stcal_sfm, words, other):
    files = ["--camera", small_run / "cameras.txt", "--faces", small_run / "faces.json"]
    code, _, err = stcal_sfm("measure", *words, *files, "--serve")
    assert (code, err) == (
        2,
        f"error: --serve and {other}: images come over HTTP, one answer each; leave {other} out\n",
    )


@pytest.mark.slow
def test_the_command_serves_this_machine_until_interrupted(small_run, photographs):
    words = ["measure", "--serve", "--port", 0, "--workers", 1, "--camera", small_run / "cameras.txt"]
    words += ["--faces", small_run / "faces.json", "--target", small_run / "target.toml"]
    program = [sys.executable, "-P", "-c", "from stcal.cli.entry import main_sfm; main_sfm()", *map(str, words)]
    with subprocess.Popen(program, stdout=-1, stderr=-1, text=True) as running:
        line = running.stdout.readline()
        assert line.startswith("answering POST http://127.0.0.1:")
        port = int(line.split("/measure")[0].rpartition(":")[2])
        name, data = next(iter(photographs.items()))
        client = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        client.request("POST", f"/measure?name={name}", body=data)
        with client.getresponse() as answer:
            assert answer.status == 200
        client.close()
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=PATIENCE_S)
    assert (running.returncode, out, err) == (130, "answered 1: 1 with a pose, 0 without, 0 refused\n", "interrupted\n")


def test_counts_are_told():
    assert counts_text({200: 5, 422: 2, 400: 3}) == "answered 10: 5 with a pose, 2 without, 3 refused"
