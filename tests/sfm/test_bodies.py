"""Bodies whose faces are boards or tags: no dot board and no camera file are needed. Faces that are not where the
design draws them."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stcal import Camera, Rigid, StcalError, camera_prior, reference_target
from stcal.boards.finders import shift_by_curves
from stcal.boards.target_file import load_target, target_toml
from stcal.design import KnownDistance, StatedSize, scale_reference, with_drawn_size
from stcal.drawing.draw import net_text
from stcal.labels import CircleLabel
from stcal.sfm import RunOptions, Tracker, compare, load_run, pipeline
from stcal.sfm.adjust.calibration import AdjustOptions, calibrate
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.refine import find_scale, refine, with_edge_sigma
from stcal.sfm.adjust.uncertainty import DISTANCES, INTRINSICS, PRINT, SIZES, contributions_of
from stcal.sfm.budget.combine import sources_of, statement_of
from stcal.sfm.camera.intrinsics import start_camera
from stcal.sfm.checks.suite import cause_of_drawing
from stcal.sfm.data.group_model import NOT_AS_DRAWN, ImageObservations, not_as_drawn
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.mapping.body import (
    BodyCorners,
    map_body,
    model_of_body,
    place_and_find_camera,
    place_with_camera,
    wrong_sizes,
)
from stcal.sfm.planning.session import PlanOptions, corners_seen, plan, plan_text, planned_photographs
from stcal.sfm.report.judgement import TESTED_BY, judgement_of
from stcal.sfm.runs.saved import adjusted_run
from stcal.synthetic.body_scene import BodyOptions, body_camera, drawing_of, make_body_scene, render_body
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.designs import second_design, tag_body, tag_cube, tag_dodecahedron
from tests.levels import FULL, sampled
from tests.outcome import COMPUTATION, assert_error, refuses
from tests.support.image_poses import pose_error

pytestmark = pytest.mark.slow

REAL_CUBE = Path(__file__).parents[3] / "shared/data/real/pycamset_cube"
SIGMA_PX = 0.1
THREE = tag_body("cube", "60", "APRILTAG_36h11", 0, "1,2,3")
"""A cube with tags on three faces alone, of which few images show each often enough."""
TARGET = """name = "mixed"
[[face]]
id = "0"
board = { type = "charuco", rows = 5, columns = 5, square_mm = 10, marker_mm = 7, dictionary = "6X6_250", first_id = 3 }
[[face]]
id = "top"
sigma_mm = 0.02
size_sigma_mm = 0.1
tags = [{ dictionary = "APRILTAG_36h11", id = 3, size_mm = 40, x_mm = 0, y_mm = 0, angle_deg = 90 }]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "target.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_printed_faces_are_read_and_written_with_their_rough_poses_and_mistakes_are_named(tmp_path):
    target = load_target(written(tmp_path, TARGET))
    board, tags = target.faces
    assert (len(board.ids), board.ids[5], board.sigma_mm, board.outward) == (16, "1.1", 0.01, -1)
    assert (tags.ids, tags.sigma_mm, tags.size_sigma) == (("3.0", "3.1", "3.2", "3.3"), 0.02, 0.1 / 40)
    np.testing.assert_allclose(board.xy_mm[5], (20, 20))
    np.testing.assert_allclose(tags.xy_mm[0], (20, -20), atol=1e-12)  # top left, turned by 90°
    again = load_target(written(tmp_path, target_toml(target)))
    for face, same in zip(target.faces, again.faces, strict=True):
        assert (face.ids, face.sigma_mm) == (same.ids, same.sigma_mm)
        np.testing.assert_allclose(face.xy_mm, same.xy_mm, atol=1e-9)
    cube = tag_cube(60)
    again = load_target(written(tmp_path, target_toml(cube)))
    for face, same in zip(cube.faces, again.faces, strict=True):
        np.testing.assert_allclose(
            face.rough_target_from_face.matrix(), same.rough_target_from_face.matrix(), atol=1e-8
        )
        outward = -face.rough_target_from_face.rotation[:, 2]
        assert outward @ face.rough_target_from_face.translation == pytest.approx(30)
    refuses("E-TARGET-PRINTED … face 0 … stcal-sfm run", load_target, written(tmp_path, TARGET), printed=False)
    for change, error in (
        (("first_id = 3", "first_id = 3, pitch_mm = 1"), "E-KEY-UNKNOWN … face 0 … board … pitch_mm"),
        (("id = 3, size_mm", "id = 587, size_mm"), "E-TAG-ID-RANGE … face top … 587"),
        (('type = "charuco"', 'type = "chessboard"'), "E-KEY-UNKNOWN … face 0 … board"),
        (("sigma_mm = 0.02", "sigma = 0.02"), "E-KEY-UNKNOWN … face.2.sigma"),
        (("APRILTAG_36h11", "6X6_250"), "E-TAG-REPEATED … 3 … 0 … top"),
        (
            ('"mixed"', '"mixed"\nscale = [{ from = "0:9.9", to = "0:1.1", mm = 5, sigma_mm = 1 }]'),
            "E-TARGET-SCALE … 0:9.9",
        ),
    ):
        refuses(error, load_target, written(tmp_path, TARGET.replace(*change)))


def test_circles_without_a_board_need_a_camera_and_tags_take_no_options_for_circles(tmp_path):
    images, out = tmp_path / "images", tmp_path / "r"
    images.mkdir()
    Image.new("L", (640, 480)).save(images / "1.png")
    distance = '\nscale = [{ from = "1:1", to = "1:2", mm = 60, sigma_mm = 0.1 }]\n'
    head, faces = target_toml(reference_target()).split("[[face]]", 1)
    target = written(tmp_path, f"{head}{distance}[[face]]{faces}")
    refuses("E-CAMERA-NEEDED … --camera", pipeline.run, images, None, out, target)
    for option in (RunOptions(solve="paper"), RunOptions(board_only=True)):
        refuses("E-OPTION-CONFLICT … --", pipeline.run, images, None, out, tag_cube(60), None, option)


def observed(target, count: int, seed: int, distance_mm: float = 300):
    """Corners of a body in images, with noise, as detection would give them; and the scene."""
    scene = make_body_scene(target, body_camera(1200), BodyOptions(images=count, distance_mm=distance_mm, seed=seed))
    rng = np.random.default_rng(seed)
    images = []
    for i, pose in enumerate(scene.camera_from_target):
        labels: list[CircleLabel] = []
        pixels = []
        for face in target.faces:
            camera_from_face = pose @ scene.target_from_face[face.id]
            middle = camera_from_face @ np.append(face.xy_mm.mean(0), 0.0)
            if -face.outward * camera_from_face.rotation[:, 2] @ middle > 0.3 * np.linalg.norm(middle):
                labels += face.labels()
                pixels.append(scene.camera.project(camera_from_face @ face.places_mm(face.ids)))
        xy = np.concatenate(pixels)
        xy = xy + rng.normal(0, SIGMA_PX, xy.shape)
        zero = np.zeros((len(xy), 2, 2))
        images.append(
            ImageObservations(f"{i}.png", ".", tuple(labels), xy, 0 * xy, zero, zero + SIGMA_PX**2 * np.eye(2))
        )
    return scene, images


def calibrated(target, images, size):
    start = Camera.of(start_camera(*size, "OPENCV"), "OPENCV")
    body = place_and_find_camera(images, target.faces, [start])
    camera = body.camera
    images = [replace(i, centre=camera.normalised_from_pixel(i.centre_px)) for i in images]
    board = scale_reference(None, target)
    model = refine(model_of_body(body, images, camera), camera, target, board).model
    options = AdjustOptions(target.faces[0].id, refine_camera=True)
    return body, calibrate([model], camera, target, board, options, camera_prior(camera))


@pytest.mark.parametrize("target", sampled([tag_cube(60), tag_dodecahedron(30)]), ids=["cube", "dodecahedron"])
def test_a_body_of_tags_gives_faces_and_camera(target):
    scene, images = observed(target, 10, 8)
    body, result = calibrated(target, images, (1200, 800))
    assert (len(body.body_from_face), len(body.camera_from_body)) == (len(target.faces), 10)
    focal = scene.camera.focal[0]
    sigma = float(np.sqrt(result.joint.camera_covariance[0, 0]))
    assert sigma < 0.01 * focal  # the views determine it
    assert abs(result.camera.focal[0] - focal) < 4 * sigma
    for face, pose in result.target.target_from_face.items():
        if face == result.target.reference_face:
            continue
        off = pose_error(pose, scene.target_from_face[face])
        normalised = off @ np.linalg.solve(result.target.face_covariance[face], off)
        assert normalised < 30  # χ² of 6: by chance in 4 of 100 000


@pytest.mark.parametrize("seed", sampled(range(5)))
def test_of_photographs_of_tags_only_planted_corners_contradict(seed):
    """One sound corner of the some 100 of a set may be named in a hundred sets."""
    target, planted_px = tag_cube(45), 3.0
    scene = make_body_scene(target, body_camera(900), BodyOptions(images=10, distance_mm=300, seed=seed))
    drawings = {face.id: drawing_of(face) for face in target.faces}
    images = []
    for i in range(10):
        found = detect_image(render_body(scene, i, drawings), scene.camera, target, None, EllipseOptions())
        labels = tuple(label for each in found.printed for label in each.labels(target.face(each.face)))
        rows = np.concatenate([each.rows for each in found.printed])
        xy, covariance = found.centres.centre_px[rows], found.centres.covariance_px2[rows]
        images.append(ImageObservations(f"{i}.png", ".", labels, xy, 0 * xy, 0 * covariance, covariance))

    def left_out() -> list[tuple[str, str]]:
        mapping = map_body(place_with_camera(images, target.faces, scene.camera), images, scene.camera)
        refined = refine(mapping.model, scene.camera, target, scale_reference(None, target))
        return [(each.image, str(each.label)) for each in (*mapping.outliers, *refined.outliers)]

    assert left_out() == []
    moved = images[3].centre_px.copy()
    moved[1] += [0.0, planted_px]
    images[3] = replace(images[3], centre_px=moved)
    assert left_out() == [("3.png", str(images[3].labels[1]))]


def test_images_of_one_tag_beside_circles_are_placed():
    cube, circles = tag_cube(100), second_design()[0].face("top")
    middle = Rigid(np.diag([1.0, -1, -1]), [0.0, 0.0, 0.0]) @ Rigid(np.eye(3), np.append(-circles.xy_mm.mean(0), 0))
    sides = {"2": replace(circles, id="2", rough_target_from_face=cube.faces[1].rough_target_from_face @ middle)}
    target = replace(cube, polarity="dark", faces=tuple(sides.get(face.id, face) for face in cube.faces))
    scene, images = observed(target, 16, 3, 450)
    printed = target.with_faces(printed=True).faces
    alone, both = (place_with_camera(images, faces, scene.camera) for faces in (printed, target.faces))
    assert len(alone.camera_from_body) < len(both.camera_from_body) == len(images)
    assert {"2"} == both.body_from_face.keys() - alone.body_from_face.keys()
    found = both.body_from_face["1"].inverse() @ both.body_from_face["2"]
    off = found @ (scene.target_from_face["1"].inverse() @ scene.target_from_face["2"]).inverse()
    assert np.degrees(off.angle_rad()) < 0.5


def test_contributions_of_a_body_add_up_to_its_covariance():
    target = tag_cube(60, size_sigma_mm=0.1)
    scene, images = observed(target, 12, 8)
    start = Camera.of(scene.camera, "OPENCV")
    body = place_and_find_camera(images, target.faces, [start])
    model = refine(model_of_body(body, images, body.camera), body.camera, target, scale_reference(None, target)).model
    distance = KnownDistance(CircleLabel("1", "0.0"), CircleLabel("6", "5.1"), 75.0, 0.02)
    board = replace(scale_reference(None, target), distances=(distance,))
    scale = find_scale(model, board)
    metric = model.metric(scale.group_from_world())
    found = contributions_of(adjusted([metric], board, body.camera, 0.02, camera_prior(body.camera)))
    total = sum(found.covariance_mm2.values())
    np.testing.assert_allclose(total, found.joint.covariance_mm2, atol=1e-8 * np.abs(total).max())
    assert all(np.trace(found.covariance_mm2[kind]) > 0 for kind in (PRINT, SIZES, DISTANCES, INTRINSICS))
    assert size_row(found, board) == ("stated", "size_sigma_mm")
    seen = with_edge_sigma(board, images)
    assert size_row(found, seen) == ("stated", "size_sigma_mm, and a common displacement of the edges of all tags")
    drawn = scale_reference(None, tag_cube(60))
    assert size_row(found, drawn) == ("not stated", "no size_sigma_mm; taken as exact")
    edges = with_edge_sigma(drawn, images)
    assert size_row(found, edges) == ("assumed", "no size_sigma_mm; a common displacement of the edges of all tags")
    for face, own, both in zip(drawn.faces, edges.faces, seen.faces, strict=True):
        stated = target.face(face.id).size_sigma
        assert both.size_sigma == pytest.approx(np.hypot(stated, own.size_sigma))
        assert both.edge_share == pytest.approx((own.size_sigma / both.size_sigma) ** 2)
        assert (face.edge_share, own.edge_share) == (0.0, 1.0)


def size_row(found, board) -> tuple[str, str]:
    """Origin and words of the row of the printed size in a budget."""
    rows = sources_of(found, None, board, 0.02, True, statement_of(StatedSize()), False)
    (row,) = [row for row in rows if row.key == "print_size"]
    assert not [row for row in rows if row.key.startswith("target_")]  # a size of the target itself does not expand
    return row.origin, row.words


def test_each_face_is_seen_often_and_squarely_or_named():
    """Five times, and twice within 45° of the normal; at random, a face of a cube is in two to four of 20 images. So is
    the distance that a body needs."""
    for target, images, seed in ((tag_cube(60), 20, 1), (tag_dodecahedron(60), 40, 2)):
        scene = make_body_scene(target, body_camera(900), BodyOptions(images, 300.0, seed=seed))
        for face in target.faces:
            normal = face.outward * scene.target_from_face[face.id].rotation[:, 2]
            middle = scene.target_from_face[face.id] @ np.append(face.xy_mm.mean(0), 0.0)
            rays = np.array([pose.inverse().translation for pose in scene.camera_from_target]) - middle
            tilts = np.degrees(np.arccos(rays @ normal / np.linalg.norm(rays, axis=1)))
            assert (tilts < 61).sum() >= 5  # faces are up to a degree off their design
            assert (tilts < 46).sum() >= 2
        assert scene.hardly_seen() == ""
    scene = make_body_scene(tag_cube(60), body_camera(900), BodyOptions(2, 300.0, pose_sigma_mm=0, pose_sigma_deg=0))
    shown = [face.id for image in range(2) for face in scene.faces_in_view(image)]
    for face in scene.target.faces:
        assert f"{face.id} ({shown.count(face.id)} of 2 images" in scene.hardly_seen()
    assert "hardly seen: face" in plan_text(plan(PlanOptions(4, distance_mm=300, width=900), THREE), "")
    near = tag_cube(60), body_camera(900), BodyOptions(1, 60.0)
    refuses("E-SIMULATE-BODY … 60 mm … 182 mm", make_body_scene, *near)
    make_body_scene(tag_cube(60), body_camera(900), BodyOptions(1, 182.5))


def test_what_is_forecast_is_what_is_simulated_and_more_images_and_a_known_distance_help():
    """The same views, although simulated faces are not quite where the design has them, so near that few poses fit."""
    near = 145.0
    options = PlanOptions(images=4, distance_mm=near, width=900, seed=4, camera=body_camera(900))
    forecast, _, _ = planned_photographs(options, THREE)
    simulated = make_body_scene(THREE, body_camera(900), BodyOptions(4, near, seed=4, print_errors=1.0))
    pairs = list(zip(forecast.camera_from_target, simulated.camera_from_target, strict=True))
    assert all(np.array_equal(one.matrix(), two.matrix()) for one, two in pairs)
    assert not np.array_equal(forecast.target_from_face["2"].matrix(), simulated.target_from_face["2"].matrix())
    for scene in (forecast, simulated):
        points = np.array(list(scene.circles_target().values()))
        seen = np.array([scene.camera.project(pose @ points) for pose in scene.camera_from_target])
        assert (seen > 0).all()
        assert (seen < [900, 600]).all()
    planned = plan(PlanOptions(images=12, distance_mm=300, width=900, seed=1), tag_cube(60))
    worst = planned.forecast.worst()[1]
    remedies = {remedy.what: remedy.sigma_mm for remedy in planned.remedies}
    assert set(planned.shares["2"]) == {"image noise", "print", "flatness", "intrinsics"}
    for shares in planned.shares.values():
        assert sum(shares.values()) == pytest.approx(1, abs=2e-3)
    assert all(sigma < worst for sigma in remedies.values())
    assert remedies["a distance known to 20 µm"] < 0.6 * worst  # the edges of tags leave the size open


def test_straight_lines_along_curved_edges_meet_beside_the_corners():
    camera = body_camera(900)
    square = np.array([[[700.0, 60], [820, 60], [820, 180], [700, 180]]])
    shift = shift_by_curves(square, camera)
    assert 0.1 < np.abs(shift).max() < 0.5
    assert np.abs(shift_by_curves(square, replace(camera, distortion=np.zeros(8)))).max() < 1e-9


def test_neighbouring_faces_of_a_designed_body_share_their_corners_and_some_may_have_no_tags():
    for body in ("cube", "dodecahedron"):
        target = tag_body(body, "60", "APRILTAG_36h11", 3)
        corners = [face.rough_target_from_face @ np.pad(face.outline_mm, ((0, 0), (0, 1))) for face in target.faces]
        apart = np.sort(np.linalg.norm(np.concatenate(corners)[:, None] - np.concatenate(corners), axis=2), axis=1)
        assert (apart[:, :3] < 1e-5).all()  # three faces meet in each corner
        assert apart[:, 3].min() > 10
        assert "one sheet of A" in net_text(target)
    five = tag_body("cube", "62", "APRILTAG_36h11", 3, "1,2,3,4,5")
    assert [face.id for face in five.faces] == ["1", "2", "3", "4", "5"]
    assert net_text(five) == "net to fold, 186 × 186 mm: one sheet of A3"
    assert net_text(tag_body("cube", "45", "APRILTAG_36h11", 0)).endswith("mm: one sheet of A4")
    refuses("E-OPTION-VALUE … no face 9 … 1, 2, 3", tag_body, "cube", "62", "APRILTAG_36h11", 3, "1,9")
    refuses("E-OPTION-VALUE … two or more", tag_body, "cube", "62", "APRILTAG_36h11", 3, "1")
    refuses("E-OPTION-VALUE … 60,60 … width", tag_body, "cube", "60,60", "APRILTAG_36h11", 0)
    refuses("E-TAG-ID-RANGE … 50", tag_body, "cube", "60", "4X4_50", 47)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Ten photographs of a cube of tags with their truth, not to be written to; and the scene."""
    scene = make_body_scene(tag_cube(60), body_camera(640), BodyOptions(images=10, distance_mm=300, seed=2))
    folder = tmp_path_factory.mktemp("photographed") / "set"
    write_dataset(folder, scene)
    return folder, scene


def first_images(count: int, folder: Path, to: Path) -> Path:
    (images := to / f"first {count}").mkdir()
    for path in sorted((folder / "images").iterdir())[:count]:
        shutil.copy(path, images)
    return images


def test_tags_of_other_dictionaries_or_ids_are_named(photographed, tmp_path, stcal_sfm):
    other = tag_cube(60.0, "DICT_5X5_100")
    target, out = written(tmp_path, target_toml(other)), tmp_path / "run"
    words = ("run", first_images(2, photographed[0], tmp_path), "--target", target, "--out", out)
    assert_error(stcal_sfm(*words), COMPUTATION, "E-TARGET-UNSEEN", "DICT_APRILTAG_36H11", "correct dictionary")
    written(tmp_path, target_toml(tag_cube(60.0, first_id=100)))
    assert_error(stcal_sfm(*words), COMPUTATION, "E-TARGET-UNSEEN", "tags ", "correct the ids")


def test_a_run_of_photographs_without_board_and_camera(photographed, tmp_path, no_page):
    folder, scene = photographed
    result = pipeline.run(folder / "images", None, tmp_path / "r", folder / "target.toml", None, RunOptions())
    assert len(result.target.target_from_face) == 6
    errors = compare(tmp_path / "r", folder / "truth.json")
    normalised = [face.normalised_error for face in errors.faces.values() if face.normalised_error is not None]
    assert 0.3 < np.sqrt(np.mean(np.square(normalised))) < 2  # about 1 of five faces that share their camera
    summary = load_run(tmp_path / "r").report["summary"]
    assert (summary["scale_from"], summary["camera_given"]) == (["faces"], False)
    own = next(check for check in result.checks if check.key == "camera")
    assert own.verdict == "not possible"  # there is no camera file to compare with
    truth = json.loads((folder / "truth.json").read_text())["camera_from_target"]
    assert np.array_equal(truth["IMG_1003.jpg"], scene.camera_from_target[3].matrix())
    assert not (tmp_path / "r/board.toml").exists()
    again = adjusted_run(load_run(tmp_path / "r"))[0].result()
    assert again.sigma0 == pytest.approx(result.calibration.joint.sigma0, rel=1e-3)
    tracker = Tracker(result.circles(), result.refined_camera)
    for i, path in enumerate(sorted((folder / "images").iterdir())[:3]):  # each is searched as a whole
        pose = tracker.locate(np.asarray(Image.open(path)))
        assert pose.status == "certain"
        off = pose.camera_from_target @ scene.camera_from_target[i].inverse()
        assert np.degrees(off.angle_rad()) < 0.5
        assert np.linalg.norm(pose.camera_from_target.translation - scene.camera_from_target[i].translation) < 2


def test_few_photographs_end_in_a_line_or_a_result(photographed, tmp_path, no_page):
    """As many as one takes first: what they do not determine is an error, what they do not test is "not possible"."""
    folder, solved, refusals = photographed[0], 0, []
    for count in (2, 7):
        taken = first_images(count, folder, tmp_path)
        try:
            result = pipeline.run(taken, None, tmp_path / "r", folder / "target.toml", None, RunOptions())
        except StcalError as error:
            refusals.append(str(error))
        else:
            solved += 1
            tested = any(c.key in TESTED_BY and c.verdict == "passed" for c in result.checks)
            assert tested or result.judgement.verdict != "yes"
            named = {name for s in result.solutions for name in (*s.left_out, *s.model.images)}
            assert named == {image.observations.name for image in result.labelled}
    assert (solved, len(refusals)) == (1, 1)
    assert all("; add " in line or "take " in line for line in refusals), refusals


def test_the_unit_of_a_body_of_unknown_size_is_kept_in_its_file(tmp_path):
    target = with_drawn_size(second_design()[0], [[CircleLabel("left", circle) for circle in "pqrstuvw"]])
    (known,) = load_target(written(tmp_path, target_toml(target))).distances
    face = target.face("left")
    apart = np.linalg.norm(face.xy_mm[:, None] - face.xy_mm, axis=2).max()
    assert (known.first.face, known.second.face, known.drawn) == ("left", "left", True)  # the face that is seen
    assert known.mm == pytest.approx(apart, abs=1e-6)


def test_circles_without_anything_of_known_size_are_known_up_to_scale(tmp_path, no_page):
    """Faces without a board: a known distance gives the size; without one, the shape is right and the rest is said."""
    options = BodyOptions(images=7, distance_mm=420, seed=4, noise=0.005)
    scene = make_body_scene(second_design()[0], body_camera(560), options)
    write_dataset(tmp_path / "set", scene)
    truth = scene.circles_target()
    ends = CircleLabel("top", "A"), CircleLabel("left", "q")
    long = float(np.linalg.norm(truth[str(ends[0])] - truth[str(ends[1])]))
    images, camera = tmp_path / "set/images", tmp_path / "set/cameras.txt"
    stretch = 1.01  # a bar in another unit: the whole result follows it
    known = replace(scene.target, distances=(KnownDistance(*ends, stretch * long, 0.01),))
    free = pipeline.run(images, camera, tmp_path / "free", scene.target)
    held = pipeline.run(images, camera, tmp_path / "held", known)
    assert (free.scale_from(), held.scale_from()) == (["drawing"], ["distances"])
    ratio = {
        face: np.linalg.norm(held.target.target_from_face[face].translation)
        / np.linalg.norm(free.target.target_from_face[face].translation)
        for face in ("left", "right")
    }
    assert ratio["left"] == pytest.approx(ratio["right"], abs=3e-5)  # one shape; flatness is in mm
    assert ratio["left"] == pytest.approx(stretch, abs=2e-3)
    report, faces = load_run(tmp_path / "free").report, load_run(tmp_path / "free").faces
    assert (faces.up_to_scale, faces.scale_sigma_ppm, report["summary"]["scale_sigma_ppm"]) == (True, None, None)
    assert report["judgement"]["verdict"] != "yes"
    assert 0.01 / long < held.target.scale_sigma < 1e-3  # the bar's, and what few small photographs add


@FULL
@pytest.mark.skipif(not REAL_CUBE.is_dir(), reason="real photographs are not shipped")
def test_a_real_cube_of_charuco_boards(tmp_path):
    faces = "".join(
        f'\n[[face]]\nid = "{k}"\nboard = {{ type = "charuco", rows = 10, columns = 10, square_mm = 3.2, '
        f'marker_mm = 2.4, dictionary = "DICT_6X6_1000", first_id = {50 * k} }}\n'
        for k in range(6)
    )
    target = written(tmp_path, f'name = "cube"\n{faces}')
    result = pipeline.run(REAL_CUBE / "cam0", None, tmp_path / "r", target)
    mapped = sum(len(s.model.images) + len(s.left_out) for s in result.solutions)
    assert mapped + len(result.detection.skipped) == 24
    assert sum(len(s.model.images) for s in result.solutions) == 24
    assert 0.1 < result.calibration.joint.print_amplitude < 1  # paper, printed 0.3 % long
    poses = result.target.target_from_face
    assert len(poses) == 6
    normals = np.array([pose.rotation[:, 2] for pose in poses.values()])
    angles = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)))
    beside = angles[(angles > 45) & (angles < 135)]
    assert len(beside) == 24
    assert np.abs(beside - 90).max() < 1.5


CUBE = tag_cube(60.0)


def found(size: float = 1.0, seed: int = 1) -> dict[str, Rigid]:
    """The cube made to 5° and 3 mm, in the frame of its third face."""
    rng, rough = np.random.default_rng(seed), CUBE.rough_poses()
    off = [Rigid.exp([*rng.normal(0, np.radians(3), 3), *rng.normal(0, 1.5, 3)]) for _ in rough]
    third = rough["3"].inverse()
    return {
        face: Rigid((at := third @ pose @ error).rotation, size * at.translation)
        for (face, pose), error in zip(rough.items(), off, strict=True)
    }


def test_a_body_as_drawn_says_nothing_and_sizes_and_faces_that_are_not_are_named():
    assert [not_as_drawn(found(seed=seed), CUBE) for seed in range(5)] == [[]] * 5
    assert not_as_drawn({"1": Rigid()}, CUBE) == []
    [size] = not_as_drawn(found(0.1), CUBE)
    assert re.match(r"not as drawn: faces are 0\.(1|09\d|10) times as far from one another as their rough_pose", size)
    poses = found()
    poses["2"], poses["5"] = poses["5"], poses["2"]
    [turned] = not_as_drawn(poses, CUBE)
    assert re.search(r"face 2 is turned by \d+°, face 5 is turned by \d+°", turned)
    assert "as if the names of faces 2 and 5 were exchanged" in turned
    turn = Rigid.exp([0, 0, np.pi / 2, 0, 0, 0])
    poses = found()
    [turned] = not_as_drawn(poses | {"4": poses["4"] @ turn}, CUBE)
    assert "face 4 is turned by 9" in turned or "face 4 is turned by 8" in turned
    one, other = (poses["4"] @ Rigid.exp([np.radians(turned), 0, 0, 0, 0, 0]) for turned in (30.0, 60.0))
    assert cause_of_drawing(poses | {"4": one}, CUBE) is None
    cause = cause_of_drawing(poses | {"4": other}, CUBE)  # it is on another side
    assert (cause.verdict, cause.names) == ("failed", ("4",))
    assert "face 4 is not where its rough_pose has it" in cause.title


@pytest.mark.parametrize("what", sampled(["size", "id"]))
def test_one_tag_of_another_size_or_id_is_named(tmp_path, no_page, what):
    write_dataset(
        tmp_path / "set", make_body_scene(CUBE, body_camera(640), BodyOptions(images=10, distance_mm=300, seed=5))
    )
    text = target_toml(CUBE)
    second = [line for line in text.splitlines() if "size_mm = " in line and "dictionary" in line][1]
    old, new = {"size": (second, second.replace("size_mm = 45.0", "size_mm = 40.0")), "id": ("id = 2,", "id = 77,")}[
        what
    ]
    (path := tmp_path / "target.toml").write_text(text.replace(old, new), encoding="utf-8")
    result = pipeline.run(tmp_path / "set/images", tmp_path / "set/cameras.txt", tmp_path / "run", path)
    scales = next(check for check in result.checks if check.key == "scales")
    if what == "size":
        assert (scales.verdict, scales.names) == ("failed", ("face 2",))
        assert scales.reason.startswith("face 2 would fit with 1.1")
        assert result.judgement.verdict == "no"
    else:
        assert scales.verdict != "failed"
        assert any("tag 2 of dict_apriltag_36h11" in note.lower() and "not 77 of" in note for note in result.notes)


def test_a_run_that_is_not_as_drawn_is_with_care_and_says_what_to_do(small_run):
    report = load_run(small_run).report
    drawn = {"code": NOT_AS_DRAWN, "words": "faces are 0.1 times as far", "remedy": "check the sizes"}
    notes = [*report["notes"], drawn]
    report["options"]["expect_faces"] = list(report["faces"])
    assert judgement_of(report).verdict == "yes"
    judged = judgement_of(report | {"notes": notes})
    assert judged.verdict == "with care"
    assert "; faces are 0.1 times as far" in judged.use
    assert judged.limit == "The drawing: faces are 0.1 times as far."
    assert judged.next.startswith("Check the sizes.")


@pytest.fixture(scope="module")
def corners():
    """The cube's scene, and its corners in 16 images."""
    scene = make_body_scene(CUBE, body_camera(640), BodyOptions(images=16, distance_mm=300, seed=5))
    return scene, corners_seen(scene, 0.02)[0]


def test_sizes_that_others_contradict_are_named_before_anything_is_adjusted_but_of_two_faces_none(corners):
    """Even by a rough camera. A run of such a drawing ended in no minimum, or in a lens that folds its image."""
    scene, images = corners
    rough = replace(scene.camera, focal=1.1 * scene.camera.focal)
    rng = np.random.default_rng(0)
    noisy = [replace(each, centre_px=each.centre_px + rng.normal(0, 0.02, each.centre_px.shape)) for each in images]
    assert wrong_sizes(BodyCorners(noisy, CUBE.faces), rough)[0] == {}
    for faces, factor in (((2,), 10.0), ((0,), 0.1), ((3,), 1.25), ((0, 1), 10.0)):
        drawn = list(CUBE.faces)
        for face in faces:
            drawn[face] = replace(drawn[face], xy_mm=drawn[face].xy_mm / factor)
        found = wrong_sizes(BodyCorners(noisy, tuple(drawn)), rough)[0]
        assert sorted(found) == sorted(faces)
        assert list(found.values()) == pytest.approx([factor] * len(faces), rel=0.05)
        refuses(f"E-BODY-SIZES … face {CUBE.faces[faces[0]].id}", place_with_camera, noisy, drawn, rough)
    one, two = (next(face for face in CUBE.faces if face.id == name) for name in ("1", "5"))
    said = "faces 1 and 5 contradict one another … face 5 is 10 times as large against face 1"
    small = [one, replace(two, xy_mm=two.xy_mm / 10)]
    refuses(f"E-BODY-SIZES … {said}", place_with_camera, images, small, scene.camera)
