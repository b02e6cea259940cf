"""Light that differs from plane to plane, and circles and boards that are covered, cost what is covered and no more.

Labels are judged by the truth of rendered photographs: one is right within 1.5 px, or a quarter of its radius, of its
circle's ellipse. Neighbours are three radii apart at least, so that no wrong label passes, and the centres of what must
be found are off by hundredths. "All" therefore means all, without a tolerance.
"""

import numpy as np
import pytest

from stcal.design import reference_board, reference_target
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import read_image
from tests.levels import sampled
from tests.sfm.detect.degraded import KINDS
from tests.support import degrade

FIRST = "12/IMG_1000"


def assert_all_read(bench, pixels) -> None:
    designs = reference_target(), reference_board()
    reading = read_image(degrade.stored(pixels), bench.data.camera, *designs, EllipseOptions())
    assert {each.face: len(each.rows) for each in reading.faces} == {"1": 10, "2": 10}
    assert [len(board.rows) for board in reading.boards] == [63]


def test_an_image_alone_reads_a_face_five_times_as_dark_as_the_rest(bench):
    """No other image helps: circles of 35 grey values beside the other face's and the board's of 180."""
    photo = bench.groups("12").photographs[0]
    (dark,) = [plane for plane in photo.faces if plane.name == "1"]
    assert_all_read(bench, degrade.brightened(photo.grey, photo.face_region(dark), 0.2))


@pytest.mark.parametrize("factor", [3.0, 1 / 3])
def test_an_image_alone_reads_a_board_in_other_light_than_the_target(bench, factor):
    """Exposed for the brighter of the two, as a camera does."""
    photo = bench.groups("12").photographs[0]
    pixels = KINDS["board brighter"].make(photo, factor, None).pixels
    on_board = photo.face_region(photo.board) > 0.99
    before, after = (float(np.percentile(image[on_board], 99)) for image in (photo.grey, pixels))
    target = photo.face_region(photo.faces[0]) > 0.99
    darker = float(np.percentile(pixels[target], 99) / np.percentile(photo.grey[target], 99))
    assert after / before / darker == pytest.approx(factor, rel=0.02)  # light, not exposure
    assert_all_read(bench, pixels)


@pytest.mark.parametrize("group", sampled(["12", "14", "15", "23"]))
@pytest.mark.parametrize(("kind", "value"), [("face dimmed", 0.2), ("board brighter", 1 / 3)])
def test_all_circles_are_labelled_whatever_light_a_plane_has(bench, kind, value, group):
    """The face dimmed is the one that most images show."""
    bench.label(kind, value, group).assert_all_found()


@pytest.mark.parametrize(
    ("group", "count", "share"),
    sampled([(group, *how) for group in ("12", "14", "15", "23") for how in ((3, 1.0), (4, 0.8))], kept=(0, 3)),
)
def test_some_of_ten_circles_of_every_face_hidden_in_every_image(bench, group, count, share):
    """Others in each image, at random: of those in view all are found, and none of the hidden ones. Six circles are the
    fewest that name a face; where chance leaves them alike on several faces, and no image of the group tells them, a
    face may be missing: four of five circles are to be found. A wrong one is never to be."""
    found = bench.label("circles hidden", count, group)
    found.assert_all_found(share)
    for name, picture in found.pictures.items():
        assert len(picture.hidden) >= 2 * count
        assert not picture.hidden & found.labels(name)


@pytest.mark.slow
def test_a_strip_over_the_first_images_board_leaves_the_others_theirs(bench):
    """Three of nine columns, or two of seven rows, whole or in part. The first keeps what is left."""
    found = bench.label("one board covered", 0.3)
    picture = found.pictures[FIRST]
    assert 14 <= sum(label.startswith("board:") for label in picture.hidden | picture.waived) <= 27
    found.assert_all_found()
    for name in found.images:
        gone = (picture.hidden, picture.waived) if name == FIRST else (set(), set())
        hidden, waived = (sum(label.startswith("board:") for label in labels) for labels in gone)
        assert 63 - hidden - waived <= len(found.labels(name, "board")) <= 63 - hidden


@pytest.mark.slow
def test_images_that_show_other_halves_of_the_board_number_it_together(bench):
    """Two show three full rows at one end, one at the other: none can tell which rows they are, all three can. The one
    whose covered dots would lie in the image takes them for dots outside of it, when it is asked alone."""
    found = bench.label("board covered", 0.5, "15")
    found.assert_all_found()
    rows = {name: {label.row for label in found.labels(name, "board")} for name in found.images}
    assert sorted(map(len, rows.values())) == [3, 3, 3]
    assert len(set.union(*rows.values())) == 6


@pytest.mark.parametrize("value", sampled([0.2, 0.3, 0.4], kept=(1,)))
@pytest.mark.parametrize("group", sampled(["12", "14", "15", "23"], kept=(3,)))
def test_circles_cut_by_a_part_of_their_area_take_no_other_with_them(bench, value, group):
    """Four of ten of every face, and a tenth of the board: every other one is found, and none is labelled whose ellipse
    is off. That of what is left of a circle is 0.25 radii off at a fifth of its area, 0.42 at two fifths."""
    bench.label("circles cut", value, group).assert_all_found()
