"""Depth of field: the blur of an image as a function of depth, and the shifts of centres that follow."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.sfm.camera.calibrate import calibrate_camera
from stcal.sfm.data.patterns import patterns_of
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.labelling import label_single
from stcal.synthetic import SceneOptions, ThinLens, make_scene
from stcal.synthetic.render import RenderOptions, encode, render
from stcal.workflows.board_views import find_board

LENS = ThinLens(f_number=1.8, focal_mm=24.0, focus_mm=1150.0)
GROUP = "12"


def picture(scene, image, lens=None):
    return render(scene, GROUP, image, RenderOptions(seed=3, noise=0.0, lens=lens, clutter=False))


def shifts_px(blurred, sharp):
    place = {label: i for i, label in enumerate(sharp.labels)}
    own = [i for i, label in enumerate(blurred.labels) if label in place]
    return blurred.centre_px[own] - sharp.centre_px[[place[blurred.labels[i]] for i in own]], own


@pytest.mark.slow
def test_centres_through_a_lens_are_those_of_the_pinhole_twin_which_is_left_alone():
    """Off by up to 0.03 px before; after it by what the correction's σ, 15 % of it, allows, and the pixels' squares."""
    scene = make_scene(SceneOptions(seed=4, width=1944, height=1296, images_per_group=2, groups=(("1", "2"),)))
    patterns, images = patterns_of(scene.target, None), (picture(scene, 0, lens) for lens in (LENS, None))
    seen = (detect_image(image, scene.camera, scene.target, None, EllipseOptions()) for image in images)
    blurred, sharp = (label_single("", GROUP, each, scene.target).observations for each in seen)
    (corrected,), (focus,) = correct_defocus([blurred], scene.camera, patterns)
    before, own = shifts_px(blurred, sharp)
    after, _ = shifts_px(corrected, sharp)
    assert focus.shift_px > 0.008
    assert focus.focused_mm == pytest.approx(LENS.focus_mm, rel=0.03)
    assert (after**2).sum() < 0.15 * (before**2).sum()
    added = corrected.covariance_px2[own] - blurred.covariance_px2[own]
    sigma = np.sqrt(np.trace(added, axis1=1, axis2=2) / 2)
    assert (np.linalg.norm(after, axis=1) < 4 * sigma + 0.002).all()
    (same,), (even,) = correct_defocus([sharp], scene.camera, patterns)
    assert (even.shift_px, even.focused_mm) == (0, None)
    np.testing.assert_array_equal(same.centre_px, sharp.centre_px)
    np.testing.assert_array_equal(same.covariance_px2, sharp.covariance_px2)


LEFT_PX = 0.0035
"""RMS that the correction of dots may leave: on these images of a camera calibration 0.0013 to 0.0015 px."""


@pytest.mark.slow
def test_the_dots_of_a_camera_calibration_and_of_single_views_are_corrected(tmp_path):
    """Of target and board, out of focus, and of the pinhole twin."""
    options = SceneOptions(seed=9, width=1080, height=720, images_per_group=3, groups=(("1", "2"),), spread_deg=60)
    scene, lenses = make_scene(options), {"blurred": replace(LENS, f_number=1.2, focus_mm=1250.0), "sharp": None}
    images = {name: [picture(scene, i, lens) for i in range(3)] for name, lens in lenses.items()}
    for name, of_lens in images.items():
        (tmp_path / name).mkdir()
        for i, image in enumerate(of_lens):
            (tmp_path / name / f"{i}.png").write_bytes(encode(image, ".png"))
    blurred, sharp = (calibrate_camera(tmp_path / name, scene.target, scene.board, workers=1).views for name in images)
    for view, twin in zip(blurred, sharp, strict=True):
        assert np.sqrt((shifts_px(view, twin)[0] ** 2).mean()) < LEFT_PX
    view, twin = (find_board(own[0], "", scene.camera, scene.board)[0] for own in images.values())
    np.testing.assert_array_equal(view.ids, twin.ids)
    assert np.sqrt(((view.xy_px - twin.xy_px) ** 2).mean()) < LEFT_PX
