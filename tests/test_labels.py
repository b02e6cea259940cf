"""Labels of circles: text where text is wanted, with parts."""

import copy
import json
import pickle

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.labels import CircleLabel, DotLabel, circle_labels, dot_cells, parse_label, parse_labels
from tests.outcome import refuses


def test_parts_make_the_text_and_the_text_gives_the_parts():
    circle, dot = parse_label("3:c"), parse_label("board:2:11")
    assert (type(circle), circle.face, circle.circle, circle.plane) == (CircleLabel, "3", "c", "3")
    assert (type(dot), dot.row, dot.column, dot.plane) == (DotLabel, 2, 11, "board")
    assert circle == "3:c" == CircleLabel("3", "c")
    assert dot == "board:2:11" == DotLabel(2, 11)
    assert parse_label(circle) is circle


def test_a_label_is_text_in_every_other_respect():
    labels = parse_labels(["board:0:1", "1:a", "1:1"])
    assert sorted(labels) == sorted(map(str, labels))
    assert {"1:a": 5}[labels[1]] == 5
    assert json.dumps({labels[0]: labels}) == '{"board:0:1": ["board:0:1", "1:a", "1:1"]}'
    assert f"{labels}" == "('board:0:1', '1:a', '1:1')"  # by which the cache knows its inputs
    for again in (pickle.loads(pickle.dumps(labels)), copy.deepcopy(labels)):
        assert (again, again[0].column, again[1].circle) == (labels, 1, "a")


@pytest.mark.parametrize(
    "text", ["", "1", "1:", ":1", "board:1", "board:1:x", "board:-1:0", "board:01:0", "board:1:2:3"]
)
def test_what_names_no_circle_is_refused(text):
    with pytest.raises(InputError, match=f"^label {text}: face:circle or board:row:column needed$"):
        parse_label(text)


def test_cells_are_those_of_dots_and_circles_those_of_faces():
    assert np.array_equal(dot_cells(parse_labels(["board:0:1", "board:3:2"])), [[0, 1], [3, 2]])
    assert dot_cells([]).shape == (0, 2)
    refuses("E-LABEL-FORM … 1:a … board", dot_cells, parse_labels(["1:a"]))
    refuses("E-LABEL-FORM … board:0:0", circle_labels, ["1:a", "board:0:0"])
