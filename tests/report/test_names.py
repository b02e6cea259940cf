"""Names cut to what tells them apart."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.report.text import telling_names


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["img_8.png", "img_9.png", "img_10.png"], ["8", "9", "10"]),
        (["img100.png", "img101.png"], ["100", "101"]),  # numbers are whole
        (["left/1.png", "right/1.png"], ["left", "right"]),  # words too
        (["line 7", "line 8"], ["7", "8"]),
        (["2026_left/frame_0001_exposure_a.png", "2026_left/frame_0001_exposure_b.png"], ["a", "b"]),
        (["one.png"], ["one.png"]),
        (["a_very_long_name_of_a_pose.png"], ["a_very_…se.png"]),
    ],
)
def test_what_tells_names_apart(names, short):
    assert telling_names(names) == short


@given(st.lists(st.text("ab01_/.", min_size=1, max_size=30), min_size=1, max_size=8, unique=True))
def test_short_names_are_short_and_different(names):
    short = telling_names(names)
    assert len(set(short)) == len(names)
    assert all(0 < len(each) <= 14 for each in short)
