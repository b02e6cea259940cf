"""The live view: poses as pictures come, the page that shows them, and sources that give none."""

import http.client
import json
import threading
import time
from itertools import cycle

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stcal.cli.main import app
from stcal.io.cameras.read import read_camera
from stcal.io.device import pictures_of
from stcal.sfm.measurement.live import WIDEST_PX, LiveView, drawn, follow, line_of
from stcal.sfm.measurement.pose import TargetPose
from stcal.sfm.measurement.serve import MeasureService, ServeOptions, Setting, show_live
from stcal.sfm.measurement.target import read_target
from stcal.sfm.measurement.tracker import Tracker
from tests.outcome import fails_with
from tests.report.browser import faults
from tests.report.browser import opened as browser
from tests.sfm.truth import true_poses

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def setting(small_run, small_scene):
    target = read_target(small_run / "faces.json", small_scene.target)
    object.__setattr__(target, "design", small_scene.target)
    return Setting(target, read_camera(small_run / "cameras.txt"))


@pytest.fixture(scope="module")
def photograph(small_dataset):
    return cv2.imread(str(next((small_dataset / "images" / "12").iterdir())), cv2.IMREAD_GRAYSCALE)


@pytest.fixture
def service(setting):
    return MeasureService(setting, 1)


def tracker_of(setting) -> Tracker:
    return Tracker(setting.target, setting.camera)


def got(server, place: str) -> tuple[int, str, bytes]:
    line = http.client.HTTPConnection(*server.server_address[:2], timeout=PATIENCE_S)
    line.request("GET", place)
    answer = line.getresponse()
    found = answer.status, answer.headers["Content-Type"], answer.read()
    line.close()
    return found


@pytest.mark.slow
def test_each_picture_has_its_pose_or_the_reason_why_not(setting, photograph):
    view, pictures = LiveView(), []
    assert follow([photograph, np.zeros_like(photograph), photograph], tracker_of(setting), view, pictures.append) == 3
    assert [picture.content["status"] for picture in pictures] == ["certain", "no pose", "certain"]
    first, dark, _ = (picture.content for picture in pictures)
    assert first["poses"]["images"][0]["image"] == "picture 1"
    assert len(first["poses"]["images"][0]["circles"]) == int(dict(first["shown"])["circles"])
    assert "face" in dark["reason"]
    assert "mm" in line_of(pictures[0])
    assert dark["reason"] in line_of(pictures[1])
    assert view.ended
    assert json.loads(view.json())["picture"] == 3


@pytest.mark.slow
def test_faces_and_centres_are_drawn_where_they_are(setting, photograph):
    tracker = tracker_of(setting)
    labelled, pose = tracker.observe(photograph)
    assert isinstance(pose, TargetPose)
    centres = labelled.observations.centre_px
    picture = drawn(photograph, centres, pose, tracker)
    scale = picture.shape[1] / photograph.shape[1]
    for x, y in (centres + 0.5) * scale - 0.5:
        near = picture[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3]
        assert (near[..., 1].astype(int) - near[..., 2] > 100).any()  # green over grey
    assert drawn(photograph, centres[:0], None, tracker).shape == picture.shape


def test_pictures_of_another_size_end_it(setting, photograph):
    with fails_with("E-IMAGE-SIZE"):
        follow([photograph[::2, ::2]], tracker_of(setting), LiveView())


@pytest.mark.slow
def test_places_of_the_view(service, setting, photograph):
    view = LiveView()
    with show_live(service, ServeOptions(port=0, token="word"), view) as server:
        assert got(server, "/live.json")[0] == 401
        assert json.loads(got(server, "/live.json?token=word")[2])["status"] == "waiting"
        follow([photograph], tracker_of(setting), view)
        assert json.loads(got(server, "/live.json?token=word")[2])["status"] == "certain"
        _, kind, page = got(server, "/?token=word")
        assert kind == "text/html; charset=utf-8"
        assert b"live.mjpg" in page
        _, kind, pictures = got(server, "/live.mjpg?token=word")
        kind, _, boundary = kind.partition("; boundary=")
        assert kind == "multipart/x-mixed-replace"
        head, _, rest = pictures.partition(b"\r\n\r\n")
        assert head.startswith(f"--{boundary}\r\n".encode())
        assert view.newest is not None
        assert rest.removesuffix(f"\r\n--{boundary}\r\n".encode()) == view.newest.jpeg
        assert got(server, "/elsewhere?token=word")[0] == 404


def test_every_picture_of_a_video_is_read(tmp_path):
    path = tmp_path / "clip.avi"
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for grey in (0, 100, 200):
        film.write(np.full((48, 64, 3), grey, np.uint8))
    film.release()
    with pictures_of(str(path)) as frames:
        assert [round(float(frame.mean()), -1) for frame in frames] == [0, 100, 200]


def live(small_run, *words):
    """What the command printed, which ends with the pictures."""
    files = ["--camera", small_run / "cameras.txt", "--faces", small_run / "faces.json", "--port", "0"]
    result = CliRunner().invoke(app, ["sfm", "measure", "--live", *map(str, [*files, *words])], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


@pytest.mark.slow
@pytest.mark.parametrize("cut", [(0, 0), (1, 0), (0, 1), (1, 1)])
@pytest.mark.parametrize("kind", ["folder", "video"])
def test_pictures_of_a_folder_or_a_video_of_odd_size(small_run, small_dataset, tmp_path, kind, cut):
    """The camera has images of 1295 columns or 863 rows, of which a video drops one: poses stay where they are."""
    names = [path.name for path in sorted((small_dataset / "images/12").iterdir())][:2]
    width, height = 1296 - cut[0], 864 - cut[1]
    pictures = [cv2.imread(str(small_dataset / "images/12" / name))[:height, :width] for name in names]
    line = (small_run / "cameras.txt").read_text().replace(" 1296 864 ", f" {width} {height} ")
    (tmp_path / "odd.txt").write_text(line)
    place = tmp_path / ("images" if kind == "folder" else "clip.avi")
    if kind == "folder":
        place.mkdir()
        for name, picture in zip(names, pictures, strict=True):
            cv2.imwrite(str(place / f"{name}.png"), picture)
    else:
        film = cv2.VideoWriter(str(place), cv2.VideoWriter.fourcc(*"MJPG"), 10, (width, height))
        film.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
        for picture in pictures:
            film.write(picture)
        film.release()
    result = live(small_run, place, "--camera", tmp_path / "odd.txt", "--json", "-")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [each["status"] for each in lines] == ["certain", "certain"]
    assert ("taken as dropped" in result.stderr) == (kind == "video" and cut != (0, 0))
    truth = true_poses(json.loads((small_dataset / "truth.json").read_text()))
    for name, each in zip(names, lines, strict=True):
        found = np.array(each["poses"]["images"][0]["camera_from_target"])
        off = found[:2, 3] - truth[f"12/{name}"].translation[:2]
        assert np.linalg.norm(off) < 0.2  # mm, at 1 m; a shift of the pictures by a pixel would be 0.7 mm


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ([], "E-LIVE-SOURCE … --camera-index 0"),
        (["http://127.0.0.1:9/clip"], "E-LIVE-SOURCE … http://127.0.0.1:9/clip"),
        (["--strict"], "E-OPTION-CONFLICT … --strict"),
        (["--json", "poses.json"], "E-OPTION-CONFLICT … --json -"),
        (["--out", "clip.csv"], "E-OPTION-CONFLICT … --out … --json -"),
    ],
)
def test_what_cannot_be_shown_ends_in_one_line(small_run, words, code):
    faces = ["--camera", small_run / "cameras.txt", "--faces", small_run / "faces.json"]
    with fails_with(code):
        CliRunner().invoke(
            app, ["sfm", "measure", "--live", *map(str, faces), "--port", "0", *words], catch_exceptions=False
        )


def test_a_video_without_live_is_told_how_it_is_measured(small_run, tmp_path):
    (clip := tmp_path / "clip.avi").write_bytes(b"RIFF")
    faces = ["--camera", small_run / "cameras.txt", "--faces", small_run / "faces.json"]
    with fails_with("E-IMAGES-FOLDER … clip.avi: a file, and no image … --live --json -"):
        CliRunner().invoke(app, ["sfm", "measure", str(clip), *map(str, faces)], catch_exceptions=False)


@pytest.mark.slow
def test_a_browser_and_other_programs_see_picture_and_pose(service, setting, photograph):
    view, stop = LiveView(), threading.Event()

    def device():
        for frame in cycle([photograph]):
            if stop.is_set():
                return
            yield frame

    with show_live(service, ServeOptions(port=0), view) as server, browser() as chrome:
        thread = threading.Thread(target=follow, args=(device(), tracker_of(setting), view))
        thread.start()
        try:
            chrome.get(server.url)
            until = time.monotonic() + PATIENCE_S
            while chrome.find_element("id", "status").text.strip() != "certain" and time.monotonic() < until:
                time.sleep(0.1)
            assert chrome.find_element("id", "status").text.strip() == "certain"
            with pictures_of(f"{server.url}/live.mjpg") as streamed:  # the newest ones, as of any stream
                first, second = next(streamed), next(streamed)
            assert first.shape[1] == second.shape[1] == WIDEST_PX
            assert "mm" in chrome.find_element("id", "rows").text
            assert chrome.execute_script("return document.getElementById('picture').naturalWidth") > 0
            assert [fault for fault in faults(chrome) if "favicon" not in fault] == []
        finally:
            stop.set()
            thread.join()
