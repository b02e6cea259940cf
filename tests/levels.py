"""Levels of tests, see CONTRIBUTING: a sample of many cases is `slow`, the rest is `full`."""

from collections.abc import Collection, Iterable

import pytest

SLOW, FULL = pytest.mark.slow, pytest.mark.full


def sampled(cases: Iterable, kept: Collection[int] = (0,)) -> list:
    """Cases for ``pytest.mark.parametrize``, of which `.ci/run` takes those at the places ``kept``."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=SLOW if i in kept else FULL)
        for i, case in enumerate(cases)
    ]
