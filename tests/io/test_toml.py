"""Texts as TOML has them."""

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from stcal.io.toml import toml_string


@given(st.text())
def test_a_text_comes_back_as_it_was(text):
    assert tomllib.loads(f"name = {toml_string(text)}") == {"name": text}
