"""A process of its own that answers images, and addresses at which none listens."""

import http.client
import json
import signal
import socket
import subprocess
import sys

import pytest

from stcal.sfm.measurement.live import LiveService, served
from tests.outcome import fails_with

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


def test_pages_get_the_newest_picture_and_the_last_one_before_the_end():
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


@pytest.mark.parametrize(
    ("host", "code"),
    [("0.0.0.0", "E-OPTION-NEEDS … --host 0.0.0.0 … --token"), ("999.1.1.1", "E-SERVICE-ADDRESS … --host 999.1.1.1")],
)
def test_addresses_at_which_none_listens(host, code):
    with fails_with(code), served(LiveService(None), host, 0):
        pass


def test_a_port_that_is_taken_and_other_machines_with_a_token():
    with served(LiveService(None, token="word"), "0.0.0.0", 0) as url:
        port = int(url.rpartition(":")[2])
        assert asked(port, "POST", "/pose", b"x")[0] == 401
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with fails_with("E-SERVICE-ADDRESS … Address already in use"), served(LiveService(None), port=port):
            pass


@pytest.mark.parametrize(
    ("words", "other"),
    [
        (["images"], "IMAGES"),
        (["--previous"], "--previous"),
        (["--workers", "2"], "--workers"),
        (["--live"], "--serve"),
    ],
)
def test_what_belongs_to_a_folder_is_refused(small_run, stcal_sfm, words, other):
    files = ["--camera", small_run / "inputs/cameras.txt", "--faces", small_run / "faces.json"]
    ended = stcal_sfm("measure", *words, *files, "--serve")
    assert (ended[0], ended.error) == (2, "E-OPTION-CONFLICT")
    assert f"{other}: images come" in ended[2]
