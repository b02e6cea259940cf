"""``images.txt`` with and without its empty lines."""

import pytest

from stcal.io.static_transforms import image_lines
from tests.outcome import refuses

A, B, C = (f"{i} 1 0 0 0 0 0 {i} 1 {name}\n" for i, name in ((1, "a.jpg"), (2, "b c.jpg"), (3, "0003")))


@pytest.mark.parametrize(
    ("text", "followed"),
    [
        (f"# head\n{A}\n{B}\n{C}\n", [True, True, True]),
        (f"{A}1.5 2.5 -1 3 4 7\n{B}\n{C}5 6 1\n", [True, True, True]),
        (A + B + C, [False, False, False]),
        (f"{A}\n{B}\n{C}", [True, True, False]),
        (f"\n\n{A}{B}1 2 3\n{C}\n", [False, True, True]),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_every_image_is_read(text, followed, end):
    images = image_lines(text.replace("\n", end), "images.txt")
    assert [image.name for image in images] == ["a.jpg", "b c.jpg", "0003"]
    assert [image.followed for image in images] == followed


def test_a_line_of_another_form_is_named():
    refuses("E-MODEL-UNREADABLE … line 2 … 2 cells", image_lines, f"{A}1.0 2.0\n{B}\n", "images.txt")
    refuses("E-MODEL-UNREADABLE … line 3", image_lines, f"{A}\nno image\n", "images.txt")
