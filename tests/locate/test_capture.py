"""Exposure series: a simulated camera, and drivers that are stood in for."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stcal.cli.main import app
from stcal.io import device as module
from stcal.io.device import OpenCVSource, SimulatedSource
from stcal.locate.scenes import capture, find_scenes, scene_folder
from tests.outcome import refuses


class Driver:
    """What OpenCV would open: exposures in steps of 3, two old frames after each change."""

    opened, takes_gain, takes_exposure, ends_after = True, True, True, 1000

    def __init__(self, place):
        self.place, self.exposure, self.manual, self.old, self.released = place, 1.0, None, [], False

    def isOpened(self):
        return self.opened

    def getBackendName(self):
        return "V4L2"

    def set(self, what, value):
        if what == cv2.CAP_PROP_AUTO_EXPOSURE:
            self.manual = value
        if what == cv2.CAP_PROP_EXPOSURE and self.takes_exposure:
            self.old = [self.exposure] * 2
            self.exposure = 3 * round(value / 3)
        return {cv2.CAP_PROP_GAIN: self.takes_gain, cv2.CAP_PROP_EXPOSURE: self.takes_exposure}.get(what, True)

    def get(self, what):
        return self.exposure

    def read(self):
        self.ends_after -= 1
        seen = self.old.pop(0) if self.old else self.exposure
        return self.ends_after >= 0, np.full((4, 6, 3), min(255, int(seen)), np.uint8)

    def release(self):
        self.released = True


@pytest.fixture
def driver(monkeypatch):
    class Own(Driver):
        pass

    monkeypatch.setattr(module.cv2, "VideoCapture", Own)
    return Own


def test_what_was_really_set_is_written(driver, tmp_path):
    source = OpenCVSource("/dev/video3", 2.0)
    found = capture(source, [10.0, 100.0], tmp_path / "scenes" / "a", 2.0, 0.0)
    assert [(row.exposure, row.exposure_set) for row in found.exposures] == [(10, 9), (100, 99)]
    # Old frames of the queue are passed over: each image is of its own exposure.
    for name, grey in (("10.png", 9), ("100.png", 99)):
        assert (cv2.imread(str(tmp_path / "scenes" / "a" / name), cv2.IMREAD_GRAYSCALE) == grey).all()
    kept = json.loads((tmp_path / "scenes" / "a" / "capture.json").read_text())
    assert kept["camera"] == "camera /dev/video3"
    assert kept["exposures"][0]["exposure_set"] == 9
    assert source._capture.manual == module.MANUAL_V4L2


def test_a_camera_that_refuses_says_so_and_nothing_is_written(driver, tmp_path):
    for said in ("E-DEVICE-SETTING … 10", "E-DEVICE-NO-IMAGE"):
        driver.takes_exposure, driver.ends_after = said == "E-DEVICE-NO-IMAGE", 4
        refuses(said, capture, OpenCVSource("0"), [10.0, 20.0], tmp_path / "a", None, 0.0)
        assert not (tmp_path / "a").exists()
    driver.takes_gain = False
    refuses("E-DEVICE-SETTING", OpenCVSource, "0", 3.0)
    driver.opened = False
    refuses("E-DEVICE-OPEN … camera 0", OpenCVSource, "0")
    refuses("E-IMAGE-UNREADABLE", SimulatedSource(tmp_path / "none.png").expose, 1.0, 0.0)


def test_the_command_writes_a_scene_that_run_reads(tmp_path):
    cv2.imwrite(str(tmp_path / "scene.png"), np.full((60, 80), 100, np.uint8))
    say = ["locate", "capture", str(tmp_path / "scenes"), "--simulate", str(tmp_path / "scene.png")]
    say += ["--shortest", "0.5", "--longest", "8", "--count", "3"]
    done = CliRunner().invoke(app, say)
    assert done.exit_code == 0, done.output
    assert "8.png: exposure 8 set for 8, 100.0 % saturated" in done.output
    (scene,) = find_scenes(tmp_path / "scenes")
    assert [file.name for file in scene.files] == [f"scene-1/{time}.png" for time in ("0.5", "2", "8")]
    assert (scene.name, scene.skipped) == ("scene-1", ())
    for name in ("", "../a", "a/b", ".hidden"):
        refuses("E-DEVICE-NAME", scene_folder, tmp_path, name)
