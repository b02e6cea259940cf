"""Rendered circles lie where exact projection puts them; photographs look as the options say. Thin lens and rims:
circles equal rays traced through both, and are biased as optics says. Photographs exposed again."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.synthetic.dataset import TruthFile
from stcal.synthetic.designs import second_design
from stcal.synthetic.optics import FULL_WELL, READ_NOISE, Light, ThinLens, blur_evenly, expose
from stcal.synthetic.render import RenderOptions, _add_circles, check_lens, render
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene, rim_points
from tests.levels import FULL
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


def test_clutter_leaves_circles_alone_and_a_table_shows_dots_where_a_mirror_does(scene):
    plain, full = render(scene, "12", 0, PLAIN), render(scene, "12", 0, replace(PLAIN, clutter=True))
    assert 0.3 < (plain != full).mean() < 0.99
    assert (full > 100).sum() > 1.2 * (plain > 100).sum()
    seen = image_circles(scene, "12", 0)
    x, y = np.rint(seen.centre_px).astype(int).T
    np.testing.assert_array_equal(plain[y, x], full[y, x])
    # The dots of the board: each is seen mirrored at the table, 50 mm below all; nothing else changes.
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
def test_vignetting_gradient_blur_and_exposure_and_scenery_out_of_focus(second, optical):
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

    def steepest(lens):
        picture = render(optical, "12", 0, replace(DEEP, clutter=True, blur_px=0, bit_depth=8, lens=lens))
        return np.abs(np.diff(picture[:60].astype(float), axis=1)).max()  # the wall, above target and board

    assert steepest(ThinLens(1.4, 24.0, 700.0)) < 0.5 * steepest(None)


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


OPTICS = SceneOptions(seed=1, width=972, height=648, images_per_group=2, groups=(("1", "2"), ("1", "5")))
DEEP = RenderOptions(noise=0, vignetting=0, gradient=0, spread=0, bit_depth=16)
PUPIL = 150  # points of the lens of the traced rays


@pytest.fixture(scope="module")
def optical():
    return make_scene(OPTICS)


def _pupil(diameter_mm: float) -> np.ndarray:
    """A sunflower of points, in pairs on both sides of the centre."""
    i = np.arange(PUPIL // 2)
    radius = diameter_mm / 2 * np.sqrt((i + 0.5) / len(i))
    angle = i * np.pi * (3 - np.sqrt(5))
    half = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.vstack([half, -half])


def _traced(camera, box, centre, normal, radius, lens, rim_mm):
    """Share of light in each pixel of a box: rays from the lens through the plane of focus, one by one."""
    x0, y0, x1, y1 = box
    side = 40 if lens is None else 10  # rays per pixel's side; many points of the lens average, too
    step = (np.arange(side) + 0.5) / side - 0.5
    x = (np.arange(x0, x1)[:, None] + step).ravel()
    y = (np.arange(y0, y1)[:, None] + step).ravel()
    ideal = camera.normalised_from_pixel(np.stack(np.meshgrid(x, y), axis=-1))
    ideal = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=-1)
    pupil = np.zeros((1, 2)) if lens is None else _pupil(lens.focal_mm / lens.f_number)
    focus = 1000.0 if lens is None else lens.focus_mm
    top = centre + max(-rim_mm, 0) * normal
    light = np.zeros(ideal.shape[:2])
    for p in np.pad(pupil, ((0, 0), (0, 1))):
        ray = focus * ideal - p
        seen = np.ones(ideal.shape[:2], bool)
        for point in [top, top + rim_mm * normal] if rim_mm > 0 else [top]:
            hit = p + ((normal @ (point - p)) / (ray @ normal))[..., None] * ray
            seen &= ((hit - point) ** 2).sum(-1) <= radius**2
        light += seen
    return (light / len(pupil)).reshape(y1 - y0, side, x1 - x0, side).mean((1, 3))


def _moments(share, box):
    y, x = np.mgrid[box[1] : box[3], box[0] : box[2]]
    return np.array([share.sum(), (share * x).sum() / share.sum(), (share * y).sum() / share.sum()])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "rim_mm"),
    [
        (None, -0.4),
        pytest.param(None, 0.4, marks=FULL),
        pytest.param(ThinLens(1.4, 24.0, 850.0), 0.0, marks=FULL),
        (ThinLens(2.8, 24.0, 1200.0), 0.4),
    ],
)
def test_circles_equal_traced_rays(optical, lens, rim_mm):
    group, image = "15", 1
    seen = image_circles(optical, group, image)
    rendered = render(optical, group, image, replace(DEEP, blur_px=0.0, lens=lens, rim_mm=rim_mm)) / 65535 * 255
    on_faces = [i for i, label in enumerate(seen.labels) if seen.must_find[i] and not label.startswith("board:")]
    by_tilt = sorted(on_faces, key=lambda i: seen.tilt_rad[i])
    reach = 3 + (0 if lens is None else np.ceil(lens.confusion_px(optical.camera, seen.xyz_camera[:, 2]).max()))
    for i in (by_tilt[0], by_tilt[-1]):
        half = np.ceil(optical.camera.focal[0] * seen.radius_mm[i] / seen.xyz_camera[i, 2]) + reach
        low, high = (np.rint(seen.centre_px[i] + sign * half).astype(int) for sign in (-1, 1))
        box = (*low, *high)
        disc = seen.xyz_camera[i], seen.normal_camera[i], seen.radius_mm[i]
        exact = _traced(optical.camera, box, *disc, lens, rim_mm)
        window = rendered[low[1] : high[1], low[0] : high[0]]
        base = np.median(window[exact == 0])
        share = (window - base) / (180 - base)
        near = cv2.dilate((exact > 0).astype(np.uint8), np.ones((3, 3))) > 0  # neighbours are farther away
        ours, true = _moments(share * near, box), _moments(exact, box)
        assert np.abs(ours[1:] - true[1:]).max() < 1e-3
        assert abs(ours[0] / true[0] - 1) < 1e-3


def _gradient_px(camera, seen, lens):
    """Gradient (n, 2) of the variance c² / 4 of the blur, in px, on the plane of each circle; no distortion."""
    half_px = camera.focal.mean() * lens.focal_mm / lens.f_number / 2
    # On a plane n X = d is 1/Z = (n_x x + n_y y + n_z) / d.
    d = (seen.normal_camera * seen.xyz_camera).sum(1)
    slope = -seen.normal_camera[:, :2] / d[:, None] / camera.focal
    return half_px**2 / 2 * (1 / lens.focus_mm - 1 / seen.xyz_camera[:, 2])[:, None] * slope


@pytest.fixture(scope="module")
def straight():
    return make_scene(replace(OPTICS, width=1296, height=864, distortion=()))


def test_centroids_move_by_half_the_gradient_of_the_variance(straight):
    # Through each point of the lens the circle is moved and stretched; the mean of the moments is ½ ∇σ², of σ² = c²/4.
    lens, seen = ThinLens(1.4, 24.0, 1100.0), image_circles(straight, "15", 0)
    gradient = _gradient_px(straight.camera, seen, lens)
    dark = np.zeros((straight.camera.height, straight.camera.width), np.float32)
    none, shifts = np.zeros(1), []
    on_face = [i for i, label in enumerate(seen.labels) if not label.startswith("board:")]
    for i in on_face:
        one = seen.rows(np.array([i]))
        (x0, y0), (x1, y1) = (np.rint(seen.centre_px[i] + sign * 40).astype(int) for sign in (-1, 1))
        box = (max(x0, 0), max(y0, 0), min(x1, dark.shape[1]), min(y1, dark.shape[0]))
        pictures = (
            _add_circles(dark, straight.camera, one, none + 1, none, none[:, None], options)
            for options in (DEEP, replace(DEEP, lens=lens))
        )
        sharp, blurred = (_moments(picture[box[1] : box[3], box[0] : box[2]], box) for picture in pictures)
        shifts.append((blurred - sharp)[1:])
    shifts, gradient = np.array(shifts), gradient[on_face]
    assert np.abs(gradient).max() > 0.005
    assert (shifts * gradient).sum() / (gradient**2).sum() == pytest.approx(0.5, abs=0.02)
    # Edges on squares of ¼ px: their errors average out over a rim, least so over those of small circles.
    rest = shifts - gradient / 2
    assert np.sqrt((rest**2).mean()) < 5e-4
    assert np.abs(rest).max() < 1.5e-3


@pytest.mark.slow
def test_measured_centres_move_to_the_blurrier_side(straight):
    lens, seen = ThinLens(2.0, 24.0, 1000.0), image_circles(straight, "12", 0)

    def centres(lens):
        picture = render(straight, "12", 0, replace(DEEP, lens=lens))
        found = detect_image(picture, straight.camera, straight.target, straight.board, EllipseOptions()).centres
        distance = np.linalg.norm(found.centre_px[:, None] - seen.centre_px, axis=-1)
        return np.where(distance.min(0)[:, None] < 1, found.centre_px[distance.argmin(0)], np.nan)

    on_face = np.array([not label.startswith("board:") for label in seen.labels])
    shift, gradient = centres(lens) - centres(None), _gradient_px(straight.camera, seen, lens)
    use = on_face & np.isfinite(shift).all(1)
    assert use.sum() > 15
    slope = (shift * gradient)[use].sum() / (gradient**2)[use].sum()
    assert 0.8 < slope < 1.3  # of a fit with one blur for a whole ellipse
    rest = shift[use] - slope * gradient[use]
    assert np.sqrt((rest**2).mean()) < 0.5 * np.sqrt((shift[use] ** 2).mean())


def test_even_blur_has_the_variance_of_a_disc():
    point = np.zeros((41, 41), np.float32)
    point[20, 20] = 1
    x = np.arange(41) - 20.0
    for radius in (0.3, 1.0, 4.7):
        blurred = blur_evenly(point, radius).astype(float)
        # Shares of pixels add the variance of a pixel, 1/12 on average over the places of the disc's rim on pixels.
        assert blurred.sum() == pytest.approx(1, abs=1e-6)
        assert (blurred.sum(0) * x**2).sum() == pytest.approx(radius**2 / 4 + 1 / 12, abs=0.11)
    assert blur_evenly(point, 0.02) is point


@pytest.mark.parametrize("clutter", [False, True])
def test_all_in_focus_through_a_pinhole(optical, clutter):
    options = RenderOptions(clutter=clutter)
    closed = replace(options, lens=ThinLens(1e6, 24.0, 900.0))
    np.testing.assert_array_equal(render(optical, "12", 0, options), render(optical, "12", 0, closed))


def test_truth_states_lens_and_rim_and_impossible_ones_are_refused(optical):
    plain = TruthFile.of(optical).content()
    assert "optics" not in plain
    options = RenderOptions(lens=ThinLens(4.0, 24.0, 900.0), rim_mm=-0.2)
    stated = json.loads(json.dumps(TruthFile.of(optical, options=options).content()))
    lens = {"f_number": 4.0, "focal_mm": 24.0, "focus_mm": 900.0}
    assert stated.pop("optics") == {"lens": lens, "rim_mm": -0.2}
    assert stated == json.loads(json.dumps(plain))
    assert TruthFile.of(optical, options=RenderOptions(rim_mm=0.3)).content()["optics"] == {"rim_mm": 0.3}
    refuses("E-SIMULATE-OPTIONS … f_number … 0", ThinLens, 0.0, 24.0, 900.0)
    refuses("E-SIMULATE-OPTIONS … 20 mm … 24 mm", ThinLens, 4.0, 24.0, 20.0)
    refuses("E-FIELD-TYPE … rim_mm", RenderOptions, rim_mm=float("nan"))
    refuses("E-SIMULATE-OPTIONS … 100 mm … at most 20", check_lens, optical, ThinLens(2.0, 24.0, 100.0))
    wide = make_scene(replace(OPTICS, distance_mm=500, groups=(("1", "2"),), fisheye_deg=120.0))
    refuses("E-SIMULATE-OPTIONS … equidistant", check_lens, wide, ThinLens(4.0, 24.0, 500.0))


RAMP = np.tile(np.linspace(20, 200, 300).astype(np.uint8), (200, 1))


def test_brightness_follows_time_as_do_saturation_and_noise():
    once, twice = expose(RAMP, [1.0, 0.5])
    assert np.abs(once.astype(float).mean(0) - RAMP[0]).max() < 1.5
    assert np.abs(twice.astype(float).mean(0) - RAMP[0] / 2).max() < 1.5
    grey = np.full((300, 300), 128, np.uint8)
    dark, normal, bright = expose(grey, [0.1, 1.0, 4.0])
    assert (bright == 255).all()
    # Shot noise, read noise, and the steps of grey in the photograph (1/√12 of a grey level) and in the exposure.
    time, level = np.array([0.1, 1.0]), FULL_WELL / 256
    variance = FULL_WELL / 2 * time + READ_NOISE**2 + (time * level) ** 2 / 12 + level**2 / 12
    expected = np.sqrt(variance) / FULL_WELL * 255
    assert normal.std() == pytest.approx(expected[1], rel=0.05)
    assert dark.std() == pytest.approx(expected[0], rel=0.05)


def test_light_falls_off_and_glares_the_same_by_the_same_seed_and_what_cannot_be_exposed_is_refused():
    photograph = np.full((400, 200), 64, np.uint8)
    (graded,) = expose(photograph, [1.0], Light(stops=2.0))
    columns = graded.mean(0)  # noise of a grey level, of 400 rows
    assert columns[100] == pytest.approx(64.5 * 255 / 256, rel=0.005)
    assert columns[199] / columns[0] == pytest.approx(4, rel=0.02)
    (spot,) = expose(photograph, [1.0], Light(glare=0.5, glare_at=(0.25, 1.0), glare_radius=0.1))
    near = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 20.0**2)).mean() ** 2  # of the Gaussian's peak, over 11 × 11 px
    assert spot[195:206, 45:56].mean() - columns[100] == pytest.approx(127.5 * near, rel=0.01)
    assert spot[195:206, 145:156].mean() == pytest.approx(columns[100], rel=0.005)
    first, again, other = (expose(RAMP, [1.0], seed=seed)[0] for seed in (3, 3, 4))
    assert (first == again).all()
    assert (first != other).any()
    refuses("E-IMAGE-TYPE", expose, RAMP.astype(float), [1.0])
    refuses("E-EXPOSURES-VALUE", expose, RAMP, [0.0])
