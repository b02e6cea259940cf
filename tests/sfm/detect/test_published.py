"""The published rules of detection on drawn patterns: names, what perspective does to them, what is said of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stcal.design import TargetDesign, reference_target
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.published import EQUAL_SIGMA_PX, PublishedPattern, detect_published
from tests.outcome import refuses
from tests.sfm.detect.test_identity import CAMERA, TARGET, face_ellipses, pose

BITS = 8


def drawn(ellipses, grey=200):
    image = np.full((CAMERA.height, CAMERA.width), 20, np.uint8)
    for centre, shape in zip(ellipses.centre_px, ellipses.shape_px, strict=True):
        values, axes = np.linalg.eigh(shape)
        angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
        scaled = [tuple(np.round(2**BITS * np.array(v)).astype(int).tolist()) for v in (centre, values[::-1])]
        cv2.ellipse(image, *scaled, angle, 0, 360, grey, -1, cv2.LINE_AA, BITS)
    return image


def detect(image, target=TARGET):
    return detect_published(image, CAMERA, target, None, EllipseOptions())


@pytest.mark.parametrize("face_id", ["1", "5"])
def test_faces_seen_from_the_front_are_named_as_published(face_id):
    ellipses = face_ellipses(face_id, pose(5, 40, 30.0 * int(face_id)))
    found = detect(drawn(ellipses))
    assert [each.face for each in found.faces] == [face_id]
    assert found.notes == ()
    labels = found.faces[0].circles
    seen = found.centres.centre_px[found.faces[0].rows]
    assert np.abs(seen - ellipses.centre_px[labels]).max() < 0.15  # of a contour, to what pixels leave
    assert (found.centres.covariance_px2 == EQUAL_SIGMA_PX**2 * np.eye(2)).all()


def test_perspective_breaks_the_published_name_and_it_is_said():
    """A square seen from the side: what was perpendicular is not."""
    found = detect(drawn(face_ellipses("1", pose(60, 0, 0))))
    assert [each.face for each in found.faces] == ["1"]
    (note,) = found.notes
    assert note.startswith("a pattern about (")
    assert "perspective breaks the published name" in note
    assert "its own plane says face 1, which was taken" in note


@pytest.mark.parametrize(
    ("hidden", "moved", "said"),
    [
        ("3", "", "circle 3 not found in its direction"),
        ("6", "", "circle 6 not found in its direction"),
        ("c", "", "0 small circles beside circle 7, 1 needed"),
        ("", "2", "radii off in the plane of the others, 0.25 allowed"),  # half a radius along its line
    ],
)
def test_a_pattern_that_lacks_a_circle_or_has_one_out_of_place_is_no_face(hidden, moved, said):
    ellipses = face_ellipses("2", pose(10, 40), tuple(hidden))
    centre = ellipses.centre_px.copy()
    for i in [TARGET.face("2").ids.index(circle) for circle in moved]:
        centre[i] += 0.5 * ellipses.radius_px()[i] * (centre[i] - centre[0]) / np.linalg.norm(centre[i] - centre[0])
    found = detect(drawn(replace(ellipses, centre_px=centre)))
    assert found.faces == ()
    (note,) = found.notes
    assert said in note
    assert note.endswith("left out by the published rules")


def test_an_even_image_has_nothing():
    found = detect(np.full((CAMERA.height, CAMERA.width), 90, np.uint8))
    assert (len(found.centres), found.faces, found.notes) == (0, (), ())


def test_the_names_of_the_reference_design():
    """Dot product zero: 1; positive: 2 and 4, negative: 3 and 5, each two told apart by the vector product."""
    names = PublishedPattern(reference_target()).names
    assert names == {(0, 0): "1", (1, -1): "2", (1, 1): "4", (-1, 1): "3", (-1, -1): "5"}


def test_a_design_of_another_form_is_refused():
    face = TARGET.face("1")
    xy = face.xy_mm.copy()
    xy[face.ids.index("6")] = (50.0, 30.0)
    other = TargetDesign("other", "bright", (replace(face, xy_mm=xy), TARGET.face("2")))
    refuses("E-TARGET-NOT-PUBLISHED … other", PublishedPattern, other)
