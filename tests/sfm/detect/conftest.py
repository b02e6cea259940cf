"""The sample's photographs, read once; and what a group of images shows, without pixels."""

import numpy as np
import pytest

from tests.sfm.detect.degraded import Bench
from tests.support.degrade import read_set


@pytest.fixture(scope="module")
def group(scene, labels_only):
    """Observations of group 12, to 0.003 px."""
    return [o for o in labels_only.observations(scene, 0.003, np.random.default_rng(0)) if o.group == "12"]


@pytest.fixture(scope="session")
def bench(sample, tmp_path_factory) -> Bench:
    """Degrades, detects and labels groups of the sample."""
    return Bench(read_set(sample), tmp_path_factory.mktemp("bench"))
