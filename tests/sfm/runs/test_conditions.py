"""What in the photographs limits σ."""

import math
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.sfm.runs.conditions import conditions
from stcal.synthetic.render import RenderOptions


def test_conditions_are_those_of_the_rendered_photographs(small_result, small_scene, labels_only):
    found, as_rendered = conditions(small_result), RenderOptions()
    assert found["number"] == (4.0, math.sqrt(10 / 4))
    assert found["blur"][0] == pytest.approx(math.hypot(as_rendered.blur_px, 1 / math.sqrt(12)), rel=0.02)
    contrast = np.median(np.concatenate([i.detection.centres.contrast for i in small_result.detection.images])) / 255
    assert found["light"][0] == pytest.approx(100 * as_rendered.noise / contrast, rel=0.15)  # as of a straight edge
    widest, seen = [], labels_only.observations(small_scene, 0.001, np.random.default_rng(1))
    for model in labels_only.models(small_scene, seen):
        middle = model.xyz_model.mean(axis=0)
        rays = [pose.inverse().translation - middle for pose in model.camera_from_model]
        widest.append(max(Rotation.align_vectors([a], [b])[0].magnitude() for a, b in combinations(rays, 2)))
    assert found["angles"][0] == pytest.approx(np.degrees(min(widest)), rel=0.01)
