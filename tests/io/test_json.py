"""JSON files: any content is a value or one line of error; result files say what is wrong where. Texts of TOML."""

import json
import time
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.files import json_text
from stcal.io.json import ByFace, Named, Part, Pose, ResultFile, Vector3, checked, read_json, read_result
from stcal.io.toml import toml_of, toml_string
from tests.outcome import fails_with, refuses
from tests.shared import written


class Row(Part):
    name: str
    value: int | float | None


class Example(ResultFile):
    format: Literal["stcal example 1"]
    rows: list[Row]
    poses: dict[ByFace, Pose]
    middle: Vector3
    later: float | None = None


POSE = Rigid.exp([0.1, -0.2, 0.3, 4, 5, 6])
WHOLE = {
    "format": "stcal example 1",
    "rows": [{"name": "ä", "value": 1}, {"name": "b", "value": 1.0}, {"name": "c", "value": None}],
    "poses": {"1": POSE},
    "middle": np.array([0.1, 0.2, 0.3]),
}


def test_written_as_given_and_read_back(tmp_path):
    text = json_text(Example.model_validate(WHOLE).content())
    plain = WHOLE | {"poses": {"1": POSE.matrix().tolist()}, "middle": [0.1, 0.2, 0.3]}
    assert text == json.dumps(plain, indent=1, ensure_ascii=False) + "\n"  # 1 stays 1, and later is not there
    path = written(tmp_path / "example.json", b"\xef\xbb\xbf" + text.encode())
    found = read_result(path, Example, "example", "make one")
    assert np.array_equal(found.poses["1"], POSE.matrix())
    assert found.later is None
    assert found.content() == json.loads(text)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "stcal example 2"}, "E-KEY-VALUE … 'stcal example 2' … 'stcal example 1'"),
        ({"rows": [{"name": "a", "value": float("nan")}]}, "E-KEY-VALUE … 1."),
        ({"rows": [{"name": "a"}]}, "E-KEY-MISSING … 1. … 'value'"),
        ({"rows": [{"name": 3, "value": 1}]}, "E-KEY-VALUE … 1. … 3"),
        ({"poses": {"1": np.diag([2.0, 1, 1, 1])}}, "E-KEY-VALUE … 1"),
        ({"poses": {"1": "abc"}}, "E-KEY-VALUE … 1 … 'abc'"),
        ({"middle": [1, 2]}, "E-KEY-VALUE … 1 … 2 … 2 … 3"),
        ({"middle": [1, 2, float("inf")]}, "E-KEY-VALUE"),
    ],
)
def test_the_place_and_the_reason_are_named(change, message):
    refuses(message, checked, WHOLE | change, Example)


def test_keys_of_later_versions_are_passed_over_and_none_is_written():
    assert "newer" not in checked(WHOLE | {"newer": 1}, Example).content()
    with pytest.raises(ValidationError, match="newer"):
        Example.model_validate(WHOLE | {"newer": 1})


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "E-JSON-INVALID"),
        (b"\xff\xfe\x00", "E-JSON-INVALID"),
        (b"[" * 100_000, "E-JSON-INVALID"),
        (b'{"a": ' + b"9" * 5000 + b"}", "E-JSON-INVALID"),
        (b"[1]", "E-JSON-CONTENT … list"),
        (b"NaN", "E-JSON-CONTENT … float"),
    ],
)
def test_a_file_that_is_no_object(tmp_path, content, reason):
    path = written(tmp_path / "some.json", content)
    with fails_with(reason) as caught:
        read_json(path, "file", "make one")
    assert str(caught.value).startswith(f"file {path}: ")
    assert str(caught.value).endswith("; make one")
    assert "\n" not in str(caught.value)
    refuses("E-FILE-UNREADABLE … none.json … make one", read_json, tmp_path / "none.json", "file", "make one")


@pytest.mark.slow
@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_any_bytes_are_a_value_or_one_line(tmp_path_factory, content):
    path = written(tmp_path_factory.getbasetemp() / "any.json", content)
    try:
        message = str(read_json(path, "file", "make one"))
    except InputError as error:
        message = str(error)
    assert "\n" not in message


@dataclass(frozen=True)
class Fit:
    pose: Rigid
    sigma: np.ndarray
    worst: float = np.inf

    def share(self) -> float:
        return 0.5


@dataclass(frozen=True)
class Found:
    fit: Fit
    names: tuple[str, ...] = ("a",)


class WithKeys(ResultFile):
    every: Annotated[Fit, Named()]
    named: Annotated[Found, Named("names fit.share fit.worst")]


def test_an_object_of_a_file_holds_named_attributes_of_a_result_or_all_its_fields():
    fit = Fit(Rigid(), np.array([1.0, 2.0]))
    content = WithKeys.model_validate({"every": fit, "named": Found(fit)}).content()
    assert content["every"] == {"pose": np.eye(4).tolist(), "sigma": [1.0, 2.0], "worst": None}
    assert content["named"] == {"names": ["a"], "fit": {"share": 0.5, "worst": None}}
    assert WithKeys.model_validate(content).content() == content
    with pytest.raises(ValidationError, match="an object with pose sigma worst needed"):
        WithKeys.model_validate(content | {"every": {"pose": 1}})


@given(st.text())
def test_a_text_comes_back_as_it_was(text):
    assert tomllib.loads(f"name = {toml_string(text)}") == {"name": text}


@pytest.mark.parametrize("filled", ["9", "x", "[", '"', " ", ",", "."])
def test_a_long_line_is_judged_as_fast_as_it_is_read(filled):
    """Its length squared would be minutes."""
    start = time.process_time()
    with suppress(ValueError):
        toml_of("a = 1\n" + filled * 300_000 + "\n")
    assert time.process_time() - start < 5
