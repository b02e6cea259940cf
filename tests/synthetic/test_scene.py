"""Scenes and bodies: the truth is consistent, what must be seen is seen, and the same seed gives the same scene. Data
sets on disk: complete, readable by the package itself, and in the form of the shared data."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stcal.boards.board_designs import CharucoDesign
from stcal.boards.board_file import load_board
from stcal.boards.finders import find_on_faces
from stcal.boards.target_file import load_target, printed_face
from stcal.design import TargetDesign, reference_target
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.cameras.read import read_camera
from stcal.synthetic.body_scene import (
    BLACK,
    WHITE,
    BodyOptions,
    body_camera,
    covered_share,
    drawing_of,
    make_body_scene,
    render_body,
)
from stcal.synthetic.dataset import TruthFile, write_dataset
from stcal.synthetic.designs import second_design, tag_cube
from stcal.synthetic.render import RenderOptions, render
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene, rim_points
from tests.outcome import fails_with, refuses
from tests.support.areas import area_and_centroid, simulate_centres

OPTIONS = SceneOptions(seed=3, width=1296, height=864, images_per_group=4)


@pytest.fixture(scope="module", params=["reference", "second"])
def scene(request):
    return make_scene(OPTIONS) if request.param == "reference" else make_scene(OPTIONS, *second_design())


def test_poses_are_three_point_frames_of_circles_that_differ_from_design_as_much_as_asked(scene):
    for face in scene.target.faces:
        origin, on_x, on_y = (scene.circles_target[f"{face.id}:{c}"] for c in (face.origin, face.x, face.y))
        local = scene.target_from_face[face.id].inverse() @ np.array([origin, on_x, on_y])
        # Origin at 0, X circle on the X axis, Y circle in the XY plane above it: to rounding at 200 mm.
        assert np.abs([*local[0], *local[1, 1:], local[2, 2]]).max() < 1e-12
        assert local[1, 0] > 0
        assert local[2, 1] > 0
    np.testing.assert_allclose(scene.target_from_face[scene.target.faces[0].id].matrix(), np.eye(4), atol=1e-12)
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


def test_views_spread_widely_and_are_the_same_of_the_same_seed(scene):
    for name, g in scene.groups.items():
        middle = np.vstack([scene.face_circles(face) for face in g.faces]).mean(0)
        away = np.array([pose.inverse().translation - middle for pose in g.camera_from_target])
        distance = np.linalg.norm(away, axis=1)
        assert 700 < distance.min() < distance.max() < 1300, name
        direction = away / distance[:, None]
        widest = np.degrees(np.arccos((direction @ direction.T).min()))
        assert 40 < widest < 115, name
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


def test_errors_say_what_to_do_and_a_plate_of_which_nothing_is_stated_what_is_assumed():
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
    # Plates of two faces at a right angle, circles 20 mm from the edge: 30 mm about them reach over it by 10 mm.
    front, right = target.faces[:2]
    across = (front.xy_mm[:, 0] + front.radius_mm).max() + 20.0
    inward = (right.xy_mm[:, 0] - right.radius_mm).min() - 20.0
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    nominal = {"1": Rigid(), "2": Rigid(turn, np.array([across, 0, 0]) - turn @ np.array([inward, 0, 0]))}
    exact = replace(OPTIONS, face_shift_mm=0.0, face_turn_deg=0.0, circle_sigma_mm=0.0, width=5184, height=3456)
    with fails_with("E-SCENE-FACES … 10 mm … 30 mm … outline_mm … --margin-mm"):
        make_scene(replace(exact, margin_mm=30.0), pair, nominal=nominal)
    scene = make_scene(replace(exact, margin_mm=20.0), pair, nominal=nominal)
    assert scene.face_outline("1")[:, 0].max() == pytest.approx(across)


@pytest.mark.slow  # thousands of poses are tried
def test_a_target_too_near_is_refused():
    refuses("E-SCENE-VIEWS … a larger distance_mm", make_scene, replace(OPTIONS, distance_mm=350, groups=(("1", "2"),)))


SMALL = SceneOptions(seed=5, width=324, height=216, images_per_group=2)


@pytest.fixture(scope="module")
def small():
    return make_scene(SMALL)


def _keys(value):
    """The form of a JSON value: keys, types, and lengths of arrays; names that data choose become ``*``."""
    if isinstance(value, dict):
        fixed = {key: _keys(v) for key, v in value.items() if not any(c in key for c in ":/") and not key.isdigit()}
        free = [_keys(v) for key, v in value.items() if key not in fixed]
        return fixed | ({"*": free[0]} if free else {})
    if isinstance(value, list):
        return [_keys(value[0]), len(value)]
    return type(value).__name__


@pytest.mark.parametrize("name", ["sample", "clean", "clutter"])
def test_truth_has_the_form_of_the_rendered_sets(small, sample, shared_data, name):
    folder = sample if name == "sample" else shared_data(f"stereo_target/{name}")
    shared, ours = (
        json.loads((folder / "truth.json").read_text()),
        json.loads(json.dumps(TruthFile.of(small).content())),
    )
    assert _keys(ours) == _keys(shared)
    assert list(ours["circles"]) == list(shared["circles"])
    assert list(ours["target_from_face"]) == list(shared["target_from_face"])
    image, other = (data["groups"]["12"]["images"]["12/IMG_1001.jpg"]["circles"] for data in (ours, shared))
    assert list(image)[-63:] == list(other)[-63:]


def test_truth_predicts_its_own_pixels(small):
    data = TruthFile.of(small).content()
    name, image = next(iter(data["groups"]["15"]["images"].items()))
    assert name == "15/IMG_1000.jpg"
    camera_from_target = np.array(image["camera_from_target"])
    focal, centre, d = small.camera.focal[0], small.camera.centre, small.camera.distortion
    known = data["circles"] | {f"board:{i}": xyz for i, xyz in enumerate(data["groups"]["15"]["board_circles_target"])}
    for label, circle in image["circles"].items():
        x, y, z = (camera_from_target @ [*known[label], 1])[:3]
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + d[0] * r2 + d[1] * r2**2
        u = x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x)
        v = y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y
        # The file rounds to 1e-5 px.
        np.testing.assert_allclose(circle["centre_px"], focal * np.array([u, v]) + centre, atol=1.1e-5)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_data_set_on_disk(tmp_path, workers):
    small = make_scene(SMALL, *second_design())
    finished = []
    paths = write_dataset(
        tmp_path / "new", small, RenderOptions(), workers=workers, progress=lambda *count: finished.append(count)
    )
    folder = tmp_path / "new"
    assert [str(p.relative_to(folder / "images")) for p in paths] == [
        f"{group}/IMG_100{i}.jpg" for group in ("top-left", "top-right", "left-right") for i in (0, 1)
    ]
    assert finished == [(done, 6) for done in range(1, 7)]
    picture = cv2.imread(str(paths[3]), cv2.IMREAD_GRAYSCALE).astype(float)
    rendered = render(small, "top-right", 1).astype(float)
    assert 0.1 < np.sqrt(((picture - rendered) ** 2).mean()) < 3  # JPEG at quality 95
    camera = read_camera(folder / "cameras.txt")
    assert camera.colmap_model == "OPENCV"
    np.testing.assert_allclose(camera.centre, small.camera.centre, atol=1e-9)
    np.testing.assert_array_equal(camera.distortion, small.camera.distortion)
    target, board = load_target(folder / "target.toml"), load_board(folder / "board.toml")
    assert target.polarity == "dark"
    for read, made in zip(target.faces, small.target.faces, strict=True):
        assert read.ids == made.ids
        np.testing.assert_allclose(read.xy_mm, made.xy_mm, atol=1e-8)
    assert (board.corner, board.corner_radius_mm, board.columns) == ((0, 7), 7.5, 8)
    assert json.loads((folder / "truth.json").read_text()) == TruthFile.of(small).content()


def test_png_holds_the_image_exactly_and_another_seed_photographs_the_same_body_again(tmp_path):
    small = make_scene(SceneOptions(seed=5, width=324, height=216, images_per_group=1, groups=(("1", "2"),)))
    (path,) = write_dataset(tmp_path, small, RenderOptions(bit_depth=16), image_format="png", workers=1)
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint16
    np.testing.assert_array_equal(picture, render(small, "12", 0, RenderOptions(bit_depth=16)))
    first, again, other = (
        make_scene(SceneOptions(seed=seed, body_seed=own, one_board=True))
        for seed, own in ((3, None), (4, 3), (4, None))
    )
    assert str(first.target_from_face) == str(again.target_from_face) != str(other.target_from_face)
    assert np.array_equal(first.camera.parameters(), again.camera.parameters())
    group, taken_again = (each.groups["12"] for each in (first, again))
    assert not np.array_equal(group.board_circles_target, taken_again.board_circles_target)
    assert group.camera_from_target[0] != taken_again.camera_from_target[0]


def test_refusals_and_a_data_set_that_fails_leaves_no_folder(tmp_path, small):
    (tmp_path / "mine.txt").write_text("keep")
    refuses("E-OUTPUT-EXISTS", write_dataset, tmp_path, small)
    refuses("E-OUTPUT-EXISTS", write_dataset, tmp_path / "mine.txt", small)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    refuses("E-OPTION-VALUE … tif", write_dataset, tmp_path / "new", small, image_format="tif")
    refuses("E-OPTION-FORM", write_dataset, tmp_path / "new", small, RenderOptions(bit_depth=16))

    def fails(done, total):
        raise RuntimeError("no")

    folder = tmp_path / "new" / "set"
    with pytest.raises(RuntimeError, match="no"):
        write_dataset(folder, small, workers=2, progress=fails)
    assert not folder.exists()


TIE_MM = 70.0  # side of a cube whose tags have edges in the middle between two pixels of their drawing


@pytest.mark.parametrize("size_mm", [45.0, 60.0, TIE_MM])
def test_the_border_of_a_tag_is_drawn_where_it_is(size_mm):
    """Along the middle of the upper and of the left border, all ink: areas are exact, in single precision."""
    face = tag_cube(size_mm).faces[0]
    drawing = drawing_of(face)
    ink = (WHITE - drawing.grey) / (WHITE - BLACK)
    low, high = face.xy_mm.min(0), face.xy_mm.max(0)
    cell = (high - low)[0] / 8  # of APRILTAG_36h11
    for axis, lines in ((0, ink), (1, ink.T)):
        number = round(float((low[1 - axis] + cell / 2 - drawing.origin[1 - axis]) * drawing.px_mm - 0.5))
        line = lines[number].astype(float)
        middle = (line * (np.arange(len(line)) + 0.5)).sum() / line.sum() / drawing.px_mm + drawing.origin[axis]
        most = 1e-3 / drawing.px_mm
        assert middle == pytest.approx((low + high)[axis] / 2, abs=most)
        assert line.sum() / drawing.px_mm == pytest.approx((high - low)[axis], abs=2 * most)


def charuco_plate() -> TargetDesign:
    board = CharucoDesign(6, 6, 12.0, 9.0, "DICT_4X4_50")
    faces = [
        printed_face(name, replace(board, first_id=first), 0.05, 0.02, rough_target_from_face=pose)
        for name, first, pose in (("a", 0, Rigid()), ("b", 20, Rigid.exp([0, 0.3, 0, 90, 0, 0])))
    ]
    return TargetDesign("two boards", "bright", tuple(faces))


@pytest.mark.slow
@pytest.mark.parametrize("target", [tag_cube(60.0, size_sigma_mm=0.1), charuco_plate()], ids=["tags", "charuco"])
def test_print_is_off_by_what_the_truth_says(target):
    """Six times as far off as stated: 0.3 mm in the mean, a pixel and more; drawn corners are found to a tenth."""
    options = BodyOptions(images=2, distance_mm=300.0, noise=0.0, seed=3, print_errors=6.0)
    scene = make_body_scene(target, body_camera(576), options)
    truth, exact = scene.circles_target(), replace(scene, off_mm={}).circles_target()
    for face in target.faces:
        design = face.places_mm(face.ids)
        fit = align_rigid(design, design + scene.off_mm[face.id])
        assert np.abs(fit.matrix() - np.eye(4)).max() < 1e-9  # the face itself has not moved
    grey = render_body(scene, 0, scene.drawings())
    found, _ = find_on_faces(grey, "image", {face.id: face.printed for face in target.faces}, scene.camera)
    errors: list[float] = []
    displaced: list[float] = []
    for face_id, view in found.items():
        face = target.face(face_id)
        nearest = np.linalg.norm(view.xyz_board[:, None, :2] - face.xy_mm, axis=2).argmin(1)
        for xyz, into in ((truth, errors), (exact, displaced)):
            places = np.array([xyz[str(face.labels()[i])] for i in nearest])
            at = scene.camera.project(scene.camera_from_target[0] @ places)
            into += np.linalg.norm(at - view.xy_px, axis=1).tolist()
    assert np.median(displaced) > 0.5
    assert np.median(errors) < 0.1
    assert max(errors) < 0.5  # bends of 0.3 mm and more turn what is near the horizon by more


def test_a_tag_that_is_tilted_too_far_is_named_and_the_share_that_an_area_covers_is_exact():
    """A body of two tags, one facing the camera and the other tilted by 75°."""
    target = tag_cube(60.0)
    scene = make_body_scene(target, body_camera(720), BodyOptions(images=1, distance_mm=300.0, noise=0.0, seed=1))
    face = target.faces[0].id
    from_face = scene.target_from_face[face]
    facing = Rigid(np.eye(3), np.array([0.0, 0.0, 250.0])) @ Rigid.exp([0, np.radians(75), 0, 0, 0, 0])
    scene = replace(scene, camera_from_target=(facing @ from_face.inverse(),))
    grey = render_body(scene, 0, scene.drawings())
    _, notes = find_on_faces(grey, "image", {each.id: each.printed for each in target.faces}, scene.camera)
    (note,) = [note for note in notes if "tilted" in note]
    assert note.startswith(f"face {face}: a tag is tilted by 7")
    assert "up to 70° is measured" in note
    line = np.array([[2.25, 1.5], [7.5, 1.5], [7.5, 6.75], [2.25, 6.75]])
    ends = ((10, 2.25, 7.5), (9, 1.5, 6.75))
    x, y = (np.clip(np.minimum(np.arange(n) + 1, b) - np.maximum(np.arange(n), a), 0, 1) for n, a, b in ends)
    np.testing.assert_allclose(covered_share([[line]], (9, 10)), np.outer(y, x), atol=1e-6)
