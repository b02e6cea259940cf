"""The sample's photographs, read once."""

import pytest

from tests.sfm.detect.degraded import Bench
from tests.support.photograph import read_set


@pytest.fixture(scope="session")
def bench(sample, tmp_path_factory) -> Bench:
    """Degrades, detects and labels groups of the sample."""
    return Bench(read_set(sample), tmp_path_factory.mktemp("bench"))
