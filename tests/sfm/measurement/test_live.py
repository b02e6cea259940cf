"""The live view and the app that answers images: poses, the page, who is refused, and sources without pictures."""

import base64
import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import zlib
from importlib import import_module

import cv2
import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from stcal.cli.main import app
from stcal.io.cameras.read import read_camera
from stcal.sfm import MeasureOptions, Tracker, measure, read_target
from stcal.sfm.measurement.live import WIDEST_PX, LiveService, line_of, served
from stcal.sfm.measurement.pose_report import poses_file
from tests.outcome import fails_with
from tests.support.image_poses import true_poses


@pytest.fixture
def tracker(small_run, small_scene):
    target = read_target(small_run / "faces.json", small_scene.target)
    object.__setattr__(target, "design", small_scene.target)
    return Tracker(target, read_camera(small_run / "inputs/cameras.txt"))


@pytest.fixture(scope="module")
def photograph(small_dataset):
    return cv2.imread(str(next((small_dataset / "images" / "12").iterdir())), cv2.IMREAD_GRAYSCALE)


def client(tracker, **options) -> TestClient:
    return TestClient(LiveService(tracker, **options).app, "http://127.0.0.1:8765")


def test_an_answer_is_that_of_measure_or_the_reason_why_there_is_none(tracker, small_dataset, tmp_path):
    photograph = min((small_dataset / "images" / "12").iterdir())
    (tmp_path / photograph.name).symlink_to(photograph)
    own = poses_file(measure(tmp_path, tracker.model, tracker.target, options=MeasureOptions(workers=1))).content()
    answer = client(tracker).post("/pose", content=photograph.read_bytes(), params={"name": photograph.name})
    assert answer.status_code == 200
    assert answer.json() == own
    assert tracker.recent == ()  # no image depends on another one
    grey = np.full((tracker.model.height, tracker.model.width), 90, np.uint8)
    answer = client(tracker).post("/pose?name=wall.png", content=png(grey))
    assert (answer.status_code, answer.json()["images"]) == (422, [])
    assert answer.json()["left_out"][0]["name"] == "wall.png"


def png(image) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def huge() -> bytes:
    """3.6 gigapixels in a hundred bytes."""
    data = bytearray(png(np.zeros((48, 64), np.uint8)))
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    return bytes(data)


def test_what_is_no_image_of_this_camera_is_refused_and_a_browser_has_the_token_in_its_address(tracker):
    for data, status, code in (
        (b"", 400, "E-IMAGE-UNREADABLE"),
        (png(np.zeros((480, 640), np.uint8))[:-9], 400, "E-IMAGE-TRUNCATED"),
        (png(np.zeros((48, 64), np.uint8)), 400, "E-IMAGE-SIZE"),
        (huge(), 400, "E-IMAGE-TOO-LARGE"),
        (bytes(1_100_000), 413, "E-SERVICE-REQUEST"),
    ):
        answer = client(tracker, max_megabytes=1.0).post("/pose", content=data)
        assert (answer.status_code, answer.json()["code"]) == (status, code)
    word = client(tracker, live=True, token="word")
    assert [word.get(place).status_code for place in ("/?token=word", "/?token=wor", "/")] == [200, 401, 401]
    assert [client(tracker).get("/").status_code, client(tracker).get("/pose").status_code] == [404, 405]


OWN, EVIL = "127.0.0.1:8765", "evil.example:8765"


@pytest.mark.parametrize("place", ["/", "/events", "/pose"])
@pytest.mark.parametrize(
    ("headers", "token", "status"),
    [
        ({"Host": EVIL}, "", 403),  # a name that now points to this machine
        ({"Host": OWN, "Origin": f"http://{EVIL}"}, "", 403),
        ({"Host": OWN, "Origin": "null"}, "", 403),
        ({"Host": OWN, "Origin": f"http://{EVIL}", "Authorization": "Bearer word"}, "word", 403),
        ({"Host": OWN, "Authorization": "Bearer other"}, "word", 401),
        ({"Host": "lab:8765", "Origin": "http://lab:8765", "Authorization": "Bearer word"}, "word", 200),
        ({"Host": "[::1]:8765", "Origin": "http://[::1]:8765"}, "", 200),
        ({"Host": "localhost"}, "", 200),
    ],
)
def test_who_is_answered(tracker, place, headers, token, status):
    service = LiveService(tracker, live=True, token=token)
    assert list(service.follow([], tracker)) == []
    method = "POST" if place == "/pose" else "GET"
    answer = TestClient(service.app).request(method, place, headers=headers)
    assert answer.status_code == (400 if status == 200 and method == "POST" else status)  # an image of no bytes


@pytest.mark.slow
def test_each_message_has_a_picture_with_its_pose_or_the_reason_why_not(tracker, photograph):
    service, frames, contents = LiveService(tracker, live=True), [photograph, np.zeros_like(photograph), photograph], []
    for content, frame in zip(service.follow(frames, tracker), frames, strict=True):
        contents.append(content)
        assert {key: service.newest[key] for key in content} == content
        shown = cv2.imdecode(np.frombuffer(base64.b64decode(service.newest["jpeg"]), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert shown.shape[1] == WIDEST_PX
        assert (shown.max() > 100) == (content["status"] == "certain") == (frame.max() > 100)
    first, dark, _ = contents
    assert first["poses"]["images"][0]["image"] == "picture 1"
    assert len(first["poses"]["images"][0]["circles"]) == int(dict(first["shown"])["circles"])
    assert re.search(r"faces [\d,]+( +-?[\d.]+){3} mm( +-?[\d.]+){3}°  \([\d.]+ a second\)$", line_of(first))
    assert "face" in dark["reason"]
    assert (dark["reason"][:40] in line_of(dark), len(line_of(dark)) <= 100) == (True, True)
    last, end = TestClient(service.app, f"http://{OWN}").get("/events").text.split("\n\n")[:2]
    assert json.loads(last.removeprefix("data: ")) == service.newest
    assert end.startswith("event: ended")
    with fails_with("E-IMAGE-SIZE"):
        next(service.follow([photograph[::2, ::2]], tracker))


def test_the_extra_that_is_missing_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "stcal.sfm.measurement.live")
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    with fails_with("E-EXTRA-MISSING … --live, --serve … stereo-target-calibration[live]"):
        import_module("stcal.sfm.measurement.live")


def measured(small_run, *words):
    files = ["--camera", small_run / "inputs/cameras.txt", "--faces", small_run / "faces.json", "--port", "0"]
    return CliRunner().invoke(app, ["sfm", "measure", *map(str, [*files, *words])], catch_exceptions=False)


@pytest.mark.slow
def test_pictures_of_a_video_of_odd_size(small_run, small_dataset, tmp_path):
    """The camera has images of 1295 columns and 863 rows, of which a video drops one: poses stay where they are."""
    names = [path.name for path in sorted((small_dataset / "images/12").iterdir())][:2]
    width, height = 1295, 863
    pictures = [cv2.imread(str(small_dataset / "images/12" / name))[:height, :width] for name in names]
    line = (small_run / "inputs/cameras.txt").read_text().replace(" 1296 864 ", f" {width} {height} ")
    (tmp_path / "odd.txt").write_text(line)
    film = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (width, height))
    film.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
    for picture in pictures:
        film.write(picture)
    film.release()
    result = measured(small_run, "--live", tmp_path / "clip.avi", "--camera", tmp_path / "odd.txt", "--json", "-")
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [each["status"] for each in lines] == ["certain", "certain"]
    assert "taken as dropped" in result.stderr
    truth = true_poses(json.loads((small_dataset / "truth.json").read_text()))
    for name, each in zip(names, lines, strict=True):
        found = np.array(each["poses"]["images"][0]["camera_from_target"])
        off = found[:2, 3] - truth[f"12/{name}"].translation[:2]
        assert np.linalg.norm(off) < 0.2  # mm, at 1 m; a shift of the pictures by a pixel would be 0.7 mm


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--live"], "E-LIVE-SOURCE … --camera-index 0"),
        (["--live", "http://127.0.0.1:9/clip"], "E-LIVE-SOURCE … http://127.0.0.1:9/clip"),
        (["--live", "--strict"], "E-OPTION-CONFLICT … --strict"),
        (["--live", "--out", "clip.csv"], "E-OPTION-CONFLICT … --out … --json -"),
        (["--serve", "images"], "E-OPTION-CONFLICT … IMAGES: images come"),
        (["--serve", "--live"], "E-OPTION-CONFLICT … --serve: images come"),
        (["clip.avi"], "E-IMAGES-FOLDER … clip.avi: a file, and no image … --live --json -"),
    ],
)
def test_what_cannot_be_shown_ends_in_one_line(small_run, tmp_path, monkeypatch, words, code):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.avi").write_bytes(b"RIFF")
    with fails_with(code):
        measured(small_run, *words)


PATIENCE_S = 60.0


def asked(port, method, place, body=None) -> tuple[int, dict]:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    line.request(method, place, body)
    with line.getresponse() as answer:
        found = answer.status, json.loads(answer.read())
    line.close()
    return found


@pytest.mark.slow
def test_the_command_answers_this_machine_until_interrupted(small_run, small_dataset):
    photograph = min((small_dataset / "images" / "12").iterdir())
    files = ["--camera", small_run / "inputs/cameras.txt", "--faces", small_run / "faces.json"]
    files += ["--target", small_run / "inputs/target.toml"]
    words = ["measure", "--serve", "--port", 0, "--max-megabytes", 4, *files]
    program = [sys.executable, "-P", "-c", "from stcal.cli.entry import main_sfm; main_sfm()", *map(str, words)]
    with subprocess.Popen(program, stdout=-1, stderr=-1, text=True) as running:
        line = running.stdout.readline()
        assert line.startswith("answering POST http://127.0.0.1:")
        port = int(line.partition("/pose")[0].rpartition(":")[2])
        code, content = asked(port, "POST", f"/pose?name={photograph.name}", photograph.read_bytes())
        assert asked(port, "POST", "/pose", iter([bytes(4_000_001)]))[0] == 413
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=PATIENCE_S)
    assert (running.returncode, out, err.splitlines()[-1]) == (130, "", "interrupted")
    assert (code, content["images"][0]["image"]) == (200, photograph.name)


def test_pages_get_the_newest_picture_and_addresses_at_which_none_listens_are_refused():
    """And the last one before the end; other machines with a token."""
    service = LiveService(None, live=True)
    service.newest = {"picture": 1}
    with served(service, port=0) as url:
        line = http.client.HTTPConnection(url.removeprefix("http://"), timeout=PATIENCE_S)
        line.request("GET", "/events")
        stream = line.getresponse()
        assert stream.readline() == b'data: {"picture": 1}\n'
        service.newest = {"picture": 2}
    assert stream.read() == b'\ndata: {"picture": 2}\n\nevent: ended\ndata: {}\n\n'
    line.close()
    needs, unknown = "E-OPTION-NEEDS … --host 0.0.0.0 … --token", "E-SERVICE-ADDRESS … --host 999.1.1.1"
    for host, code in (("0.0.0.0", needs), ("999.1.1.1", unknown)):
        with fails_with(code), served(LiveService(None), host, 0):
            pass
    with served(LiveService(None, token="word"), "0.0.0.0", 0) as url:
        port = int(url.rpartition(":")[2])
        assert asked(port, "POST", "/pose", b"x")[0] == 401
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with fails_with("E-SERVICE-ADDRESS … Address already in use"), served(LiveService(None), port=port):
            pass
