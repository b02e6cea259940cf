"""Rendered circles lie where exact projection puts them; photographs look as the options say."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.synthetic.designs import second_design
from stcal.synthetic.render import RenderOptions, render
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene, rim_points
from tests.outcome import refuses
from tests.support.areas import area_and_centroid

OPTIONS = SceneOptions(seed=1, width=648, height=432, images_per_group=2, groups=(("1", "2"), ("1", "5")))
PLAIN = RenderOptions(noise=0, vignetting=0, gradient=0, spread=0)
EDGE_PX = 3.6  # five sigma of the default blur


@pytest.fixture(scope="module")
def scene():
    return make_scene(OPTIONS)


@pytest.fixture(scope="module")
def second():
    return make_scene(replace(OPTIONS, groups=None), *second_design())


def _blobs(scene, group, image, options):
    """Measured and exact area and centroid (n, 3), and the images of the centres (n, 2), of free-standing circles."""
    picture = render(scene, group, image, options).astype(float)
    seen = image_circles(scene, group, image)
    rims = scene.camera.project(rim_points(seen.xyz_camera, seen.normal_camera, seen.radius_mm, 360))
    measured, exact, centres = [], [], []
    for i, rim in enumerate(rims):
        others = np.delete(rims[:, ::10], i, axis=0).reshape(-1, 2)
        room = np.sqrt(((others[:, None] - rim[::10]) ** 2).sum(-1).min())
        if not seen.must_find[i] or room < 2 * EDGE_PX:
            continue
        (x0, y0), (x1, y1) = np.floor(rim.min(0) - EDGE_PX).astype(int), np.ceil(rim.max(0) + EDGE_PX).astype(int) + 1
        y, x = np.mgrid[y0:y1, x0:x1]
        area, centroid = area_and_centroid(rim)
        window = picture[y0:y1, x0:x1]
        distance = np.sqrt((x[..., None] - rim[:, 0]) ** 2 + (y[..., None] - rim[:, 1]) ** 2).min(-1)
        bright = window - np.median(window[(distance > EDGE_PX - 1) & (distance < EDGE_PX)])
        # Far from the rim and outside: other circles and the edge of the plate.
        bright[(distance > EDGE_PX) & (np.hypot(x - centroid[0], y - centroid[1]) > np.sqrt(area / np.pi))] = 0
        level = 180 * 257 - np.median(window[(distance > EDGE_PX - 1) & (distance < EDGE_PX)])
        measured.append([bright.sum() / level, (bright * x).sum() / bright.sum(), (bright * y).sum() / bright.sum()])
        exact.append([area, *centroid])
        centres.append(seen.centre_px[i])
    return np.array(measured), np.array(exact), np.array(centres)


@pytest.mark.slow
def test_centroids_and_areas_agree_with_the_exact_rim():
    scene = make_scene(replace(OPTIONS, width=1296, height=864, distortion=(-0.15, 0.05, 1e-3, -5e-4)))
    measured, exact, centres = _blobs(scene, "12", 0, replace(PLAIN, bit_depth=16))
    assert len(measured) > 60
    # 16-bit rounding of about 150 pixels at 5 px from the middle: 1e-4 px.
    assert np.abs(measured[:, 1:] - exact[:, 1:]).max() < 2e-3
    assert np.sqrt(((measured[:, 1:] - exact[:, 1:]) ** 2).mean()) < 5e-4
    assert np.abs(measured[:, 0] / exact[:, 0] - 1).max() < 2e-3
    # The agreement is with the distorted ellipse, not with the image of the circle's centre.
    assert 0.02 < np.abs(centres - exact[:, 1:]).max() < 0.3


def test_determined_by_the_seeds_and_options_that_are_checked(scene):
    options = RenderOptions(clutter=True)
    first = render(scene, "12", 1, options)
    np.testing.assert_array_equal(first, render(scene, "12", 1, options))
    assert 0.3 < (first != render(scene, "12", 1, replace(options, seed=1))).mean() < 1
    refuses("E-SIMULATE-OPTIONS … 12", RenderOptions, bit_depth=12)
    refuses("E-SIMULATE-OPTIONS … reflectance 1.2", RenderOptions, reflectance=1.2)
    refuses("E-SIMULATE-OPTIONS … noise … -1", RenderOptions, noise=-1)


def test_circles_are_bright_or_dark_as_designed_and_noise_has_the_spread_asked_for(second, scene):
    quiet = render(second, "top-left", 0, PLAIN).astype(float)
    noisy = render(second, "top-left", 0, replace(PLAIN, noise=0.02)).astype(float)
    middle = (quiet > 20) & (quiet < 235)
    assert 0.98 < np.std((noisy - quiet)[middle]) / (0.02 * 255) < 1.02  # rounding adds 0.3 %
    for made, group, low, high in ((scene, "15", 170, 190), (second, "top-right", 15, 35)):
        picture, seen = render(made, group, 0, PLAIN), image_circles(made, group, 0)
        x, y = np.rint(seen.centre_px[seen.must_find]).astype(int).T
        big = seen.radius_mm[seen.must_find] > 4.5
        assert low < picture[y, x][big].min() <= picture[y, x][big].max() < high
        larger_mm = seen.radius_mm + 4000 / made.camera.focal[0]
        rim = made.camera.project(rim_points(seen.xyz_camera, seen.normal_camera, larger_mm, 12))
        x, y = np.rint(rim[seen.must_find]).astype(int).reshape(-1, 2).T
        around = np.median(picture[y, x])
        assert around < 20 if made is scene else around > 160


def test_clutter_adds_objects_behind_but_leaves_circles_alone(scene):
    plain, full = render(scene, "12", 0, PLAIN), render(scene, "12", 0, replace(PLAIN, clutter=True))
    assert 0.3 < (plain != full).mean() < 0.99
    assert (full > 100).sum() > 1.2 * (plain > 100).sum()
    seen = image_circles(scene, "12", 0)
    x, y = np.rint(seen.centre_px).astype(int).T
    np.testing.assert_array_equal(plain[y, x], full[y, x])


def test_a_table_shows_dots_where_a_mirror_does_and_as_bright_as_its_reflectance(scene):
    """The dots of the board: each is seen at its place mirrored at the table, 50 mm below all; nothing else changes."""
    plain = render(scene, "12", 0, PLAIN)
    shiny = render(scene, "12", 0, replace(PLAIN, reflectance=0.6))
    group = scene.groups["12"]
    up = group.axes[1]
    outlines = np.vstack([*(scene.face_outline(face.id) for face in scene.target.faces), scene.board_outline("12")])
    height = group.board_circles_target @ up - (outlines @ up).min() + 50
    mirrored = group.camera_from_target[0] @ (group.board_circles_target - 2 * height[:, None] * up)
    x, y = np.rint(scene.camera.project(mirrored)).astype(int).T
    shown = (x > 2) & (x < 645) & (y > 2) & (y < 429)
    new = shown & (plain[y.clip(0, 431), x.clip(0, 647)] < 4)  # the rest is hidden by target or board
    assert new.sum() >= 9
    assert 100 < np.median(shiny[y[new], x[new]]) < 125  # 27 + 0.6 · (180 − 27) = 119, less what blur takes off
    near_circles = np.abs(shiny.astype(int) - plain) > 0
    seen = np.rint(image_circles(scene, "12", 0).centre_px).astype(int)
    assert not near_circles[seen[:, 1], seen[:, 0]].any()


@pytest.mark.slow
def test_vignetting_gradient_blur_and_exposure(second):
    def picture(**changes):
        return render(second, "top-left", 1, replace(PLAIN, bit_depth=16, **changes)).astype(float)

    base = picture()
    corner = picture(vignetting=0.3)[0, 0] / base[0, 0]
    assert 0.69 < corner < 0.71
    ratio = picture(gradient=0.1) / base
    assert 0.88 < ratio.min() < 0.95 < 1.05 < ratio.max() < 1.12
    assert 1.99 < np.median(picture(exposure=2.0)[base < 30000] / base[base < 30000]) < 2.01
    assert picture(exposure=2.0).max() == 65535
    assert np.abs(np.diff(picture(blur_px=2.0), axis=1)).max() < 0.6 * np.abs(np.diff(base, axis=1)).max()


def test_rings_are_dots_with_a_hole_about_the_same_centre():
    """The hole has 0.4 of the radius and the plate's grey; the mean of the light is where the dot's centre is seen."""
    rings = ((1, 2), (2, 3))
    board = replace(second_design()[1], rings=rings, corner=None, corner_radius_mm=None)
    scene = make_scene(SceneOptions(seed=2, images_per_group=2, width=1296, height=864), board=board)
    plain = replace(scene, board=replace(board, rings=()))
    options = RenderOptions(noise=0, spread=0, blur_px=0.5)
    group = next(iter(scene.groups))
    off = render(scene, group, 0, options).astype(float) - render(plain, group, 0, options)
    circles = image_circles(scene, group, 0)
    y, x = np.nonzero(np.abs(off) > 0)
    near = {}
    seen = zip(circles.labels, circles.centre_px, circles.radius_mm, circles.xyz_camera, strict=True)
    for label, centre, radius, xyz in seen:
        inside = np.hypot(x - centre[0], y - centre[1]) < 1.2 * scene.camera.focal[0] * radius / xyz[2]
        if inside.any():
            light = off[y[inside], x[inside]]
            near[label] = np.hypot(*(light @ np.column_stack([x[inside], y[inside]]) / light.sum() - centre))
    assert set(near) == {f"board:{row}:{column}" for row, column in rings}
    assert max(near.values()) < 0.1  # px: perspective moves the centre of so small an ellipse by less
