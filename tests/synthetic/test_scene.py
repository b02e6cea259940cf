"""Scenes: the truth is consistent, what must be seen is seen, and the same seed gives the same scene."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.design import TargetDesign, reference_target
from stcal.geometry.rigid import Rigid
from stcal.synthetic.designs import second_design
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene, rim_points
from tests.outcome import fails_with, refuses
from tests.support.circle_images import area_and_centroid, simulate_centres

OPTIONS = SceneOptions(seed=3, width=1296, height=864, images_per_group=4)


@pytest.fixture(scope="module", params=["reference", "second"])
def scene(request):
    return make_scene(OPTIONS) if request.param == "reference" else make_scene(OPTIONS, *second_design())


def test_poses_are_three_point_frames_of_the_circles(scene):
    for face in scene.target.faces:
        origin, on_x, on_y = (scene.circles_target[f"{face.id}:{c}"] for c in (face.origin, face.x, face.y))
        local = scene.target_from_face[face.id].inverse() @ np.array([origin, on_x, on_y])
        # Origin at 0, X circle on the X axis, Y circle in the XY plane above it: to rounding at 200 mm.
        assert np.abs([*local[0], *local[1, 1:], local[2, 2]]).max() < 1e-12
        assert local[1, 0] > 0
        assert local[2, 1] > 0
    np.testing.assert_allclose(scene.target_from_face[scene.target.faces[0].id].matrix(), np.eye(4), atol=1e-12)


def test_made_differs_from_design_as_much_as_asked(scene):
    off = []
    for face in scene.target.faces:
        local = scene.target_from_face[face.id].inverse() @ scene.face_circles(face.id)
        assert np.abs(local[:, 2]).max() < 1e-9  # the faces are flat
        off.append(local[:, :2] - face.xy_mm)
    rms = np.sqrt((np.vstack(off) ** 2).mean())
    # σ = 0.02 mm, up to doubled by the frame circles' own errors, whose lever is up to 1.3 frame lengths.
    assert 0.012 < rms < 0.06
    g = next(iter(scene.groups.values()))
    local = g.target_from_board.inverse() @ g.board_circles_target
    rms = np.sqrt(((local[:, :2] - scene.board.xy_mm()) ** 2).mean())
    assert scene.board.sigma_mm * 0.7 < rms < scene.board.sigma_mm * 1.3  # 4 standard errors of 96 numbers


def test_true_poses_are_near_nominal():
    scene, nominal = make_scene(OPTIONS), reference_target().rough_poses()
    for face, pose in scene.target_from_face.items():
        difference = nominal[face].inverse() @ pose
        # 0.5° of the face and 0.5° of the reference face, whose lever is 200 mm: 1.7 mm; four times that at most.
        assert difference.angle_rad() < np.radians(3)
        assert np.linalg.norm(difference.translation) < 8
    assert max((nominal[f].inverse() @ p).angle_rad() for f, p in scene.target_from_face.items()) > np.radians(0.1)


def test_every_view_shows_both_faces_and_the_board_beside_them(scene):
    size = [scene.camera.width, scene.camera.height]
    angle = np.radians(np.arange(0, 360, 5))
    direction = np.array([np.cos(angle), np.sin(angle)])
    for name, g in scene.groups.items():
        wanted = {label for face in g.faces for label in scene.target.face(face).labels()} | set(scene.board.labels())
        for i in range(len(g.camera_from_target)):
            seen = image_circles(scene, name, i)
            must = {label for label, must in zip(seen.labels, seen.must_find, strict=True) if must}
            assert must == wanted
            rim = scene.camera.project(rim_points(seen.xyz_camera, seen.normal_camera, seen.radius_mm))
            assert (rim.min((0, 1)) > 0).all()
            assert (rim.max((0, 1)) < size).all()
            board = np.array([label.startswith("board:") for label in seen.labels])
            assert 0 <= seen.tilt_rad[board].min() <= seen.tilt_rad[board].max() <= np.radians(50)
            gap = (rim[board].reshape(-1, 2) @ direction).min(0) - (rim[~board].reshape(-1, 2) @ direction).max(0)
            assert gap.max() > 10, name  # px; a line separates the two


def test_views_spread_widely(scene):
    for name, g in scene.groups.items():
        middle = np.vstack([scene.face_circles(face) for face in g.faces]).mean(0)
        away = np.array([pose.inverse().translation - middle for pose in g.camera_from_target])
        distance = np.linalg.norm(away, axis=1)
        assert 700 < distance.min() < distance.max() < 1300, name
        direction = away / distance[:, None]
        widest = np.degrees(np.arccos((direction @ direction.T).min()))
        assert 40 < widest < 115, name


def test_same_seed_same_scene_and_other_seed_another(scene):
    again = make_scene(OPTIONS) if scene.target.name == "reference target" else make_scene(OPTIONS, *second_design())
    other = make_scene(replace(OPTIONS, seed=4))
    np.testing.assert_equal(again.circles_target, scene.circles_target)
    for name, g in scene.groups.items():
        for a, b in zip(g.camera_from_target, again.groups[name].camera_from_target, strict=True):
            np.testing.assert_array_equal(a.matrix(), b.matrix())
    assert not np.allclose(other.camera.centre, scene.camera.centre)


@pytest.mark.parametrize("one_board", [True, False])
def test_groups_show_one_board_or_each_its_own(one_board):
    """Distances of the dots tell boards apart, wherever they stand."""
    scene = make_scene(replace(OPTIONS, one_board=one_board))
    first, second = (g.board_circles_target for g in list(scene.groups.values())[:2])
    lengths = [np.linalg.norm(dots - dots[0], axis=1) for dots in (first, second)]
    assert np.allclose(*lengths, atol=1e-9, rtol=0) == one_board


@pytest.mark.parametrize(
    ("distortion", "tolerance_px"),
    # Without distortion the 720-gon's centroid is the ellipse's centre. With it the lens bends the rim, which a
    # distorted centre does not follow: 0.01 px at this k1 and size (up to 0.06 px at k1 = -0.15).
    [((), 1e-4), ((-0.06, 0.045), 1e-2)],
)
def test_simulated_centres_are_ellipse_centres(distortion, tolerance_px):
    scene = make_scene(replace(OPTIONS, distortion=distortion))
    seen = image_circles(scene, "12", 1)
    exact = simulate_centres(scene, "12", 1, 0.0, np.random.default_rng(0))
    assert len(exact) == seen.must_find.sum()
    rim = scene.camera.project(rim_points(seen.xyz_camera, seen.normal_camera, seen.radius_mm, 720))
    centroid = {label: area_and_centroid(points)[1] for label, points in zip(seen.labels, rim, strict=True)}
    assert max(np.abs(exact[label] - centroid[label]).max() for label in exact) < tolerance_px
    truth = dict(zip(seen.labels, seen.centre_px, strict=True))
    offset = np.array([exact[label] - truth[label] for label in exact])
    assert 0.01 < np.linalg.norm(offset, axis=1).max() < 0.3


def test_errors_say_what_to_do():
    refuses("E-SCENE-FACES", make_scene, replace(OPTIONS, groups=(("1", "3"),)))
    refuses("E-TARGET-NO-FACE … 9", make_scene, replace(OPTIONS, groups=(("1", "9"),)))
    refuses("E-SCENE-GROUP … 12", make_scene, replace(OPTIONS, groups=(("1", "2"), ("1", "2"))))
    target = reference_target()
    with fails_with("E-TARGET-ROUGH-POSE … 5"):
        make_scene(OPTIONS, target, nominal={f: p for f, p in reference_target().rough_poses().items() if f != "5"})
    pair = TargetDesign("pair", "bright", target.faces[:2])
    with fails_with("E-SCENE-FACES"):
        make_scene(OPTIONS, pair, nominal={"1": Rigid(), "2": Rigid(reference_target().rough_poses()["2"].rotation)})
    refuses("E-SIMULATE-OPTIONS … images_per_group … 0", SceneOptions, images_per_group=0)


@pytest.mark.slow  # thousands of poses are tried
def test_a_target_too_near_is_refused():
    refuses("E-SCENE-VIEWS … a larger distance_mm", make_scene, replace(OPTIONS, distance_mm=350, groups=(("1", "2"),)))


def test_a_plate_of_which_nothing_is_stated_says_what_is_assumed():
    """Plates of two faces at a right angle, circles 20 mm from the edge: 30 mm about them reach over it by 10 mm."""
    target = reference_target()
    front, right = target.faces[:2]
    pair = TargetDesign("pair", "bright", (front, right))
    across = (front.xy_mm[:, 0] + front.radius_mm).max() + 20.0
    inward = (right.xy_mm[:, 0] - right.radius_mm).min() - 20.0
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    nominal = {"1": Rigid(), "2": Rigid(turn, np.array([across, 0, 0]) - turn @ np.array([inward, 0, 0]))}
    exact = replace(OPTIONS, face_shift_mm=0.0, face_turn_deg=0.0, circle_sigma_mm=0.0, width=5184, height=3456)
    with fails_with("E-SCENE-FACES … 10 mm … 30 mm … outline_mm … --margin-mm"):
        make_scene(replace(exact, margin_mm=30.0), pair, nominal=nominal)
    scene = make_scene(replace(exact, margin_mm=20.0), pair, nominal=nominal)
    assert scene.face_outline("1")[:, 0].max() == pytest.approx(across)
