"""The sample's photographs, read once."""

import pytest

from stcal.synthetic.photograph import read_set
from tests.sfm.detect.degraded import Bench


@pytest.fixture(scope="session")
def bench(sample, tmp_path_factory) -> Bench:
    """Degrades, detects and labels groups of the sample."""
    return Bench(read_set(sample), tmp_path_factory.mktemp("bench"))
