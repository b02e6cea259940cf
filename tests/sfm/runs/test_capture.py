"""A calibration that takes its photographs itself: names, light, what triggers, and what is refused."""

import io

import numpy as np
import pytest

import stcal
from stcal import workflows
from stcal.io.device import SimulatedSource
from stcal.workflows.growing import GrowingRun, Trigger, Update, WatchOptions, capture
from tests.outcome import fails_with
from tests.shared import own_copy

AT_ONCE = {"exposure": None, "settle_s": 0.0}


def growing(data, root):
    files = data / "cameras.txt", root / "run", data / "target.toml", data / "board.toml"
    return GrowingRun.of(root / "images", *files, WatchOptions(views=0))


@pytest.mark.slow
def test_photographs_become_a_run(small_dataset, tmp_path):
    own, source = growing(small_dataset, tmp_path), SimulatedSource(small_dataset / "images" / "12")
    (tmp_path / "images" / "12").mkdir(parents=True)
    earlier = tmp_path / "images" / "12" / "IMG_0007.png"
    own_copy(next((small_dataset / "images" / "12").iterdir()), earlier)
    before = earlier.read_bytes()
    trigger = Trigger(2, 0.0, io.StringIO(), print)
    taken = list(capture(source, own, "12", ready=trigger.ready, **AT_ONCE))
    assert [each.name for each in taken] == ["12/IMG_0008.png", "12/IMG_0009.png"]
    assert earlier.read_bytes() == before
    last = taken[-1].update
    assert last.images == 3
    assert last.result is not None
    assert len(last.result.labelled) == 3
    assert [each.observations.name for each in last.new] == ["12/IMG_0009.png"]
    assert 0.3 < last.blur_px["12/IMG_0009.png"] < 2
    assert taken[-1].circles == len(last.new[0].observations)


@pytest.mark.slow
def test_saturated_circles_are_said(small_dataset, tmp_path):
    own, source = growing(small_dataset, tmp_path), SimulatedSource(small_dataset / "images" / "12", gain=1.6)
    (taken,) = capture(source, own, "12", ready=Trigger(1, 0.0, io.StringIO(), print).ready, **AT_ONCE)
    assert taken.saturated > taken.circles / 2
    assert "expose less, saturated circles grow" in taken.light()
    assert taken.update.result is None
    assert "2 needed" in taken.update.reason


def test_the_command_and_the_function_take_the_same(stcal_sfm, small_dataset, tmp_path, monkeypatch):
    """The runs themselves are those of the slow tests above."""
    monkeypatch.setattr(GrowingRun, "update", lambda *_: Update(1, (), (), (), None, "2 needed", None, {}))
    files = [small_dataset / name for name in ("cameras.txt", "target.toml", "board.toml")]
    words = "--camera", files[0], "--target", files[1], "--board", files[2], "--out", tmp_path / "run"
    shown = "--group", "12", "--simulate", small_dataset / "images" / "12", "--every", "0", "--count", "2"
    assert stcal_sfm("capture", tmp_path / "one", *words, *shown)[0] == 0
    source = stcal.SimulatedSource(small_dataset / "images" / "12")
    growing = workflows.GrowingRun.of(tmp_path / "two", files[0], tmp_path / "run", *files[1:])
    taken = list(workflows.capture(source, growing, "12", lambda number: number <= 2))
    assert [each.name for each in taken] == ["12/IMG_0001.png", "12/IMG_0002.png"]
    for each in taken:
        assert (tmp_path / "two" / each.name).read_bytes() == (tmp_path / "one" / each.name).read_bytes()
    with fails_with("E-FIELD-TYPE … source … Source"):
        workflows.capture("0", growing, "12", lambda _: False)


def test_enter_takes_one_and_the_end_of_input_ends():
    said = []
    trigger = Trigger(None, None, io.StringIO("\n\n"), said.append)
    assert [trigger.ready(k) for k in (1, 2, 3)] == [True, True, False]
    assert said[1] == "Enter: take photograph 2 (Ctrl-D: end)"

    once = Trigger(1, None, io.StringIO("\n\n"), said.append)
    assert [once.ready(1), once.ready(2)] == [True, False]


def test_a_camera_without_further_images_and_a_name_that_is_none(small_dataset, tmp_path):
    source = SimulatedSource(small_dataset / "images" / "12")
    count = len(list((small_dataset / "images" / "12").iterdir()))
    for _ in range(count):
        image, really = source.expose(None, 0.0)
        assert (image.dtype, really) == (np.uint8, 1.0)
    with fails_with("E-DEVICE-NO-IMAGE"):
        source.expose(None, 0.0)
    with fails_with("E-DEVICE-NAME … group … '../x'"):
        next(capture(source, growing(small_dataset, tmp_path), "../x", ready=lambda _: True, **AT_ONCE))
    assert not (tmp_path / "images").exists()
