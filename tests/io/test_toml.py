"""Texts as TOML has them."""

import time
import tomllib
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.io.toml import toml_of, toml_string


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
