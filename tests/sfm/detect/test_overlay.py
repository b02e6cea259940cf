"""What is drawn on an overlay is where it should be."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stcal.sfm.data.model import ImageObservations
from stcal.sfm.detect.overlay import draw_overlay
from stcal.sfm.runs.folder import overlay_path

FOCAL = np.array([2000.0, 2000.0])
GREY = 90


def overlay(labels, centres, shapes, scale: float, width: int = 1600, notes: int = 0, left_out=()) -> np.ndarray:
    """Drawn on a plain image of ``width`` px, its thumbnail ``scale`` of that."""
    n = len(labels)
    size = (round(width * 0.75 * scale), round(width * scale))
    _, jpeg = cv2.imencode(".jpg", np.full((*size, 3), GREY, np.uint8))
    image = ImageObservations(
        "12/a.jpg",
        "12",
        tuple(labels),
        centres,
        np.zeros((n, 2)),
        np.array(shapes) / FOCAL[:, None],
        np.tile(np.eye(2), (n, 1, 1)),
    )
    drawn = draw_overlay(jpeg.tobytes(), scale, image, ["1", "2"], FOCAL, notes, left_out)
    return cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR).astype(float)


def coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey, (n, 2) as x, y."""
    return np.argwhere(np.ptp(picture, axis=2) > 60)[:, ::-1]


@pytest.mark.parametrize("scale", [1.0, 0.75])
def test_the_rim_is_drawn_where_the_ellipse_is(scale):
    """Every sixteenth of the rim has colour within 1.5 px, and nothing inside it but the cross is coloured."""
    centre, shape = np.array([800.0, 600.0]), np.array([[100.0, 20.0], [0.0, 60.0]])
    found = coloured(overlay(["1:3"], [centre], [shape], scale))
    at = (centre + 0.5) * scale - 0.5
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = at + scale * np.column_stack([np.cos(angle), np.sin(angle)]) @ shape.T
    away = np.linalg.norm(rim[:, None] - found, axis=2).min(1)
    assert away.max() < 1.5
    radius = np.linalg.norm(np.linalg.solve(scale * shape, (found - at).T), axis=0)
    inside = found[(radius < 0.9) & (found[:, 1] > at[1] - 8)]  # the face's name stands above
    assert np.abs(inside - at).max() < 5
    assert np.linalg.norm(inside - at, axis=1).min() < 1


def test_a_small_thumbnail_is_enlarged_and_the_drawing_with_it():
    picture = overlay(["1:3"], [[400.0, 300.0]], [60 * np.eye(2)], 1.0, width=800)
    assert picture.shape == (1200, 1600, 3)
    found = coloured(picture)
    away = np.abs(np.linalg.norm(found - 2 * np.array([400.25, 300.25]), axis=1) - 120)
    assert np.percentile(away, 20) < 1.5


def test_faces_have_colours_of_their_own():
    one = overlay(["1:3"], [[800.0, 600.0]], [60 * np.eye(2)], 1.0)
    two = overlay(["2:3"], [[800.0, 600.0]], [60 * np.eye(2)], 1.0)
    x, y = 860, 600
    near = np.s_[y - 3 : y + 4, x - 2 : x + 3]
    assert np.abs(one[near].mean((0, 1)) - two[near].mean((0, 1))).max() > 20


def test_the_caption_grows_with_the_notes():
    plain, noted = (overlay(["1:3"], [[800.0, 600.0]], [60 * np.eye(2)], 1.0, notes=n) for n in (0, 2))
    caption = np.s_[-60:, :]
    assert (np.abs(noted - plain)[caption].max(2) > 60).sum() > 100
    assert np.abs(noted - plain)[:-80].max() < 20


def test_what_is_left_out_has_a_cross_and_the_picture_says_what_it_means():
    """White along the diagonals of the circle, and nowhere else beside a line of words at the bottom."""
    labels, centres = ["1:3", "1:4"], [[500.0, 600.0], [1000.0, 600.0]]
    plain, crossed = (overlay(labels, centres, 2 * [60 * np.eye(2)], 1.0, left_out=x) for x in ((), ("1:4",)))
    y, x = np.nonzero(np.abs(crossed - plain).max(2) > 60)
    legend = y > 1100
    assert legend.sum() > 100
    across, up = np.abs(x - 1000)[~legend], np.abs(y - 600)[~legend]
    assert np.abs(across - up).max() < 8
    assert 60 < across.max() < 100  # as large as the circle
    assert crossed[580:590, 980:990].max() > 230


def test_a_long_name_is_cut_to_one_of_its_own():
    long = ["ü" * 118 + f"{k}.jpg" for k in range(2)]
    paths = [overlay_path(Path("out"), f"12/{name}") for name in long]
    assert paths[0] != paths[1]
    assert {path.parent for path in paths} == {Path("out/overlays/12")}
    for path, name in zip(paths, long, strict=True):
        assert 190 < len(path.name.encode()) <= 204
        assert path.name[:80] == name[:80]
    assert overlay_path(Path("out"), "12/a.jpg") == Path("out/overlays/12/a.jpg")
    assert overlay_path(Path("out"), "a.png") == Path("out/overlays/a.png.jpg")
