"""The published steps, each for itself."""

import numpy as np
import pytest

from stcal.boards.tags import Tags
from stcal.errors import DegenerateError
from stcal.geometry.rigid import Rigid
from stcal.locate.scenes import exposure_times
from stcal.locate.verdict import PatentOptions, gate, largest_area, locate_as_patent, most_tags, triangulated_area
from tests.outcome import fails_with, refuses
from tests.support.tags import CAMERA, CornerNoise, example_layout, simulated_exposures

LAYOUT = example_layout(1e-6)
TRUTH = Rigid.exp([0.4, -0.1, 0.2, 10, 5, 600.0])


def tag_at(x: float, y: float, side: float = 10.0) -> np.ndarray:
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


def test_exposure_times_are_a_geometric_series():
    assert np.allclose(exposure_times(1.0, 16.0, 5), [1, 2, 4, 8, 16])
    refuses("E-EXPOSURES-VALUE", exposure_times, 0.0, 1.0, 3)
    refuses("E-EXPOSURES-VALUE", exposure_times, 1.0, 2.0, 1)


def test_selection_by_number_and_area():
    small = np.stack([tag_at(0, 0), tag_at(20, 0)])
    large = np.stack([tag_at(0, 0), tag_at(90, 0)])
    single = tag_at(0, 0)[None]
    corners = [small, single, large, large + 1]
    assert most_tags(corners) == [0, 2, 3]
    assert largest_area(corners, [0, 2, 3], 0.8) == [2, 3]
    assert largest_area(corners, [0, 2, 3], 0.2) == [0, 2, 3]
    share = triangulated_area(small.reshape(-1, 2)) / triangulated_area(large.reshape(-1, 2))
    assert largest_area(corners, [0, 2, 3], share) == [2, 3]  # more than S_dis, as written


def test_the_exposure_with_the_smallest_error_is_kept():
    rng = np.random.default_rng(0)
    coarse = simulated_exposures(LAYOUT, TRUTH, rng, CornerNoise(0.5, 0.0))[0]
    fine = simulated_exposures(LAYOUT, TRUTH, rng, CornerNoise(0.01, 0.0))[0]
    few = simulated_exposures(LAYOUT, TRUTH, rng, CornerNoise(0.0, 0.0), ((0, 1),))[0]
    found = locate_as_patent([coarse, fine, few], LAYOUT, CAMERA)
    assert found.exposure == 1
    assert found.candidates == (0, 1)
    assert [(each.tags, each.candidate, each.poses is None) for each in found.exposures] == [
        (len(LAYOUT.tags), True, False),
        (len(LAYOUT.tags), True, False),
        (2, False, True),
    ]
    assert found.exposures[1].errors_px == found.errors_px
    assert found.exposures[0].errors_px[0] > found.errors_px[0]
    assert found.exposures[1].det_j == found.det_j
    assert found.exposures[2].area_px2 is None
    assert (found.camera_from_obj @ TRUTH.inverse()).angle_rad() < np.radians(0.2)
    assert found.verdict.decision == "accept"


def test_a_step_can_be_replaced():
    def refuse(xy, seen):
        raise DegenerateError("E-TEST", "no")

    tags = simulated_exposures(LAYOUT, TRUTH, np.random.default_rng(0))
    with pytest.raises(DegenerateError, match=r"no pose explains .* in any exposure"):
        locate_as_patent(tags, LAYOUT, CAMERA, solve=refuse)


@pytest.mark.parametrize(
    ("det_j", "error", "ratio", "same", "reasons"),
    [
        (1e-6, 0.3, 5.0, False, []),
        (1e-9, 0.3, 5.0, False, ["det J"]),
        (1e-6, 1.3, 5.0, False, ["error 1.3"]),
        (1e-6, 0.3, 1.5, False, ["error ratio 1.5"]),
        (1e-6, 0.3, 1.0, True, []),
        (1e-9, 2.0, 1.0, False, ["det J", "error 2", "error ratio"]),
    ],
)
def test_the_gate(det_j, error, ratio, same, reasons):
    verdict = gate(det_j, error, ratio, same, PatentOptions())
    assert verdict.decision == ("reject" if reasons else "accept")
    assert len(verdict.reasons) == len(reasons)
    assert all(text.startswith(start) for text, start in zip(verdict.reasons, reasons, strict=True))


def test_a_pose_that_fits_exactly_has_a_ratio():
    flat = np.pad(LAYOUT.corners_mm.reshape(-1, 2), ((0, 0), (0, 1)))
    corners = CAMERA.project(TRUTH @ flat).reshape(-1, 4, 2)
    exact = Tags(LAYOUT.tags, corners, np.tile(np.eye(2), (len(corners), 4, 1, 1)))
    assert locate_as_patent([exact], LAYOUT, CAMERA).verdict.decision == "accept"


def test_without_tags_there_is_no_pose():
    empty = Tags((), np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)))
    with fails_with("E-LOCATE-NO-TAG"):
        locate_as_patent([empty], LAYOUT, CAMERA)
