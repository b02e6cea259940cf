"""Faces of simulated bodies are drawn where their design has them."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.boards.board_designs import CharucoDesign
from stcal.boards.finders import find_on_faces
from stcal.boards.target_file import printed_face
from stcal.design import TargetDesign
from stcal.geometry.rigid import Rigid, align_rigid
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
from stcal.synthetic.designs import tag_cube

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


def test_a_tag_that_is_tilted_too_far_is_named():
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


def test_the_share_that_an_area_covers_is_exact():
    line = np.array([[2.25, 1.5], [7.5, 1.5], [7.5, 6.75], [2.25, 6.75]])
    ends = ((10, 2.25, 7.5), (9, 1.5, 6.75))
    x, y = (np.clip(np.minimum(np.arange(n) + 1, b) - np.maximum(np.arange(n), a), 0, 1) for n, a, b in ends)
    np.testing.assert_allclose(covered_share([[line]], (9, 10)), np.outer(y, x), atol=1e-6)
