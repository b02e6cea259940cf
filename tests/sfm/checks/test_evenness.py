"""Circles that are darker on one side are suspected, and by chance none is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid, Similarity
from stcal.sfm.adjust.refine import free_network
from stcal.sfm.checks.image_checks import UNEVEN_BY_CHANCE, evenness_check

SHIFT_PX = 0.02


class Group:
    """Five images of a group, their centres exact, and the check of it."""

    def __init__(self, scene, labels_only):
        seen = labels_only.observations(scene, 0.003, np.random.default_rng(0))
        self.images = [o for o in seen if o.group == "12"]
        self.camera = scene.camera
        (model,) = labels_only.models(scene, self.images)
        self.network = free_network(model.metric(Similarity(1.0, Rigid())), scene.camera)

    def check(self, uneven):
        """``uneven`` : whether a circle is, of its label and the image's number."""
        images = []
        for i, image in enumerate(self.images):
            shift = [[0.6 * SHIFT_PX, 0.8 * SHIFT_PX] if uneven(label, i) else [0, 0] for label in image.labels]
            images.append(replace(image, uneven_px=np.array(shift)))
        calibration = SimpleNamespace(camera=self.camera)
        return evenness_check(
            SimpleNamespace(networks=[self.network], images=images, calibration=calibration, radius_mm={"any": 1.0})
        )

    def in_all(self):
        return sorted(set.intersection(*(set(image.labels) for image in self.images)))


@pytest.fixture(scope="module")
def group(scene, labels_only):
    return Group(scene, labels_only)


def test_even_circles_pass(group):
    check = group.check(lambda label, i: False)
    assert (check.verdict, check.names, check.remedy) == ("passed", (), "")
    assert check.tested == len({label for image in group.images for label in image.labels})
    assert check.measured[0].value == 0


def test_half_of_every_circle_darker_is_suspicious_and_no_failure(group):
    """A shift of 0.02 px at the circle's distance, 0.9 to 1.4 m with 2787 px of focal length: 6 to 10 µm."""
    check = group.check(lambda label, i: True)
    assert check.verdict == "suspicious"
    assert set(group.in_all()) <= set(check.names)
    depth = group.network.model.xyz_camera()[:, 2]
    low, high = 1e3 * SHIFT_PX * np.array([depth.min(), depth.max()]) / np.sqrt(group.camera.focal.prod())
    assert all(low <= m.value <= high for m in check.measured)
    assert check.measured[0].unit == "µm"
    assert "shade them from glare" in check.remedy


@pytest.mark.parametrize(("views", "verdict"), [(1, "passed"), (2, "passed"), (3, "suspicious"), (5, "suspicious")])
def test_one_circle_is_suspected_by_how_often_it_is_uneven(group, views, verdict):
    """By chance one centre in a hundred: of five views two are once in a thousand, among 80 circles no wonder; three
    are once in 100 000 circles."""
    own = group.in_all()[7]
    check = group.check(lambda label, i: label == own and i < views)
    assert check.verdict == verdict
    assert check.names == ((own,) if verdict == "suspicious" else ())


@pytest.mark.slow
def test_chance_alone_is_suspected_as_rarely_as_promised(group):
    """One verdict in a thousand; of 150 three would be chance once in 2000 (Poisson, 0.15)."""
    rng = np.random.default_rng(1)
    verdicts = [group.check(lambda label, i: rng.random() < UNEVEN_BY_CHANCE).verdict for _ in range(150)]
    assert verdicts.count("suspicious") < 3
