"""Which exposure of a scene the page shows large."""

from dataclasses import replace

import cv2
import pytest

from stcal.boards.tags import Tags
from stcal.io.cameras.model import CameraModel
from stcal.locate.exposures import find_scenes
from stcal.locate.page import best_exposure, run_report
from stcal.locate.pipeline import run
from stcal.synthetic.optics import expose
from tests.locate.drawn_target import CAMERA, LAYOUT, photo, tilted

MODEL = CameraModel(CAMERA.focal, CAMERA.centre, CAMERA.distortion, "PINHOLE", CAMERA.width, CAMERA.height, "test")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    for k, image in enumerate(expose(photo(tilted(30)), [1 / 6, 1, 4])):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return folder


def test_the_best_exposure_is_shown_not_the_darkest(scene):
    scenes = list(find_scenes(scene))
    (located,) = run(scenes, LAYOUT, MODEL)
    shown = located.tags.readable()
    assert [len(each.tags) for each in shown] == [6, 6, 6]
    best = best_exposure(shown, LAYOUT)
    assert best.name.endswith("1.png")
    page = run_report([located], scenes, LAYOUT, MODEL).page()
    assert page.split("<figcaption>")[1].startswith(f"{best.name}: 6 of 6 tags")


def test_more_tags_of_the_layout_come_before_sharper_ones(scene):
    (located,) = run(list(find_scenes(scene)), LAYOUT, MODEL)
    dark, sharp, _ = located.tags.readable()
    own = sharp.tags
    fewer = replace(sharp, tags=Tags(own.tags[1:], own.corners_px[1:], own.covariance_px2[1:]))
    assert best_exposure([fewer, dark], LAYOUT) is dark
    assert best_exposure([dark, sharp], LAYOUT) is sharp
    assert best_exposure([], LAYOUT) is None
