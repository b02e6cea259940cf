"""Hexagonal grids of circles: views drawn by their definition, each pixel from where its ray meets the board."""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from stcal.boards.board_designs import HexagonalCirclesDesign
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.workflows.board_views import find_board
from tests.levels import sampled

CAMERA = Camera(800, 600, [900.0, 905.0], [390.0, 305.0], np.zeros(12))
FINER, MARGIN_MM = 2, 25.0
TILTS = [(0.0, 0.0, 0.1), (0.5, 0.0, 0.3), (0.0, 0.6, -1.2), (0.3, -0.4, 2.5)]


def view_of(
    board: HexagonalCirclesDesign, tilt, hidden_from_mm=(np.inf, np.inf), hole: float = 0.4
) -> tuple[np.ndarray, Rigid]:
    """A grey image, and camera_from_board; what lies beyond ``hidden_from_mm`` along X and Y is covered. Rings have a
    hole of ``hole`` times their radius."""
    xy = board.xy_mm()
    turn = Rigid.exp([*tilt, 0, 0, 0]).rotation
    middle = np.append((xy.min(0) + xy.max(0)) / 2, 0.0)
    pose = Rigid(turn, np.array([0, 0, 470.0]) - turn @ middle)
    y, x = (np.mgrid[: CAMERA.height * FINER, : CAMERA.width * FINER] + 0.5) / FINER - 0.5
    xy_px = np.column_stack([x.ravel(), y.ravel()])
    rays = np.pad((xy_px - CAMERA.centre) / CAMERA.focal, ((0, 0), (0, 1)), constant_values=1.0)
    normal = turn[:, 2]
    met = ((rays * (normal @ pose.translation / (rays @ normal))[:, None]) - pose.translation) @ turn
    on_board = ((met[:, :2] > xy.min(0) - MARGIN_MM) & (met[:, :2] < xy.max(0) + MARGIN_MM)).all(1)
    away, nearest = cKDTree(xy).query(met[:, :2], distance_upper_bound=1.01 * board.radius_mm)
    in_hole = np.isin(nearest, [row * board.columns + place for row, place in board.rings])
    in_hole &= away < hole * board.radius_mm
    grey = np.where(on_board & ((away > board.radius_mm) | in_hole), 220.0, 40.0)
    grey[(met[:, :2] > hidden_from_mm).all(1)] = 130.0
    small = cv2.resize(grey.reshape(x.shape), (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(0).normal(0, 1.5, small.shape)
    return np.clip(cv2.GaussianBlur(small, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8), pose


def test_six_neighbours_are_one_spacing_away_and_a_covered_strip_is_said():
    board = HexagonalCirclesDesign(5, 6, 20.0, 6.0, "dark")
    for xy in (board.xy_mm(), board.lattice().xy_mm()):
        apart = np.linalg.norm(xy[:, None] - xy, axis=2)
        assert np.isclose(apart[14], 20.0).sum() == 6
        assert np.sort(apart[14])[7] == pytest.approx(20 * np.sqrt(3))
    lattice = board.lattice()
    np.testing.assert_allclose(lattice.xy_mm() - lattice.xy_mm()[0], board.xy_mm() - board.xy_mm()[0], atol=1e-12)
    np.testing.assert_allclose(lattice.places_mm(lattice.labels())[:, :2], lattice.xy_mm(), atol=1e-12)
    # Of a covered strip it is open which columns are seen: they are all alike.
    board = HexagonalCirclesDesign(9, 8, 20.0, 6.0, "dark")
    view, why = find_board(view_of(board, TILTS[1], (112.0, -np.inf))[0], "a", CAMERA, board)
    assert view is None
    assert "strip of the board is hidden" in why


@pytest.mark.parametrize(("rows", "tilt"), sampled([(r, t) for r in (7, 8) for t in TILTS], kept=(1, 7)))
def test_a_view_has_its_circles_where_they_are(rows, tilt):
    """An even number of rows looks the same after half a turn, an odd one does not."""
    board = HexagonalCirclesDesign(rows, 8, 20.0, 6.0, "dark")
    image, pose = view_of(board, tilt)
    view, why = find_board(image, "a", CAMERA, board)
    assert view is not None, why
    assert len(view) == 8 * rows
    turned = [Rigid(), *board.symmetries()]
    assert len(turned) == 2 - rows % 2
    off = [view.xy_px - CAMERA.project(pose @ (turn @ view.xyz_board)) for turn in turned]
    nearest = min(off, key=np.max)
    assert np.abs(nearest).max() < 0.06  # px; noise of 1.5 grey levels of 180
    in_sigma = np.einsum("ni,nij,nj->n", nearest, np.linalg.inv(view.covariance_px2), nearest) / 2
    assert 0.4 < in_sigma.mean() < 2.5


END_RINGS, COLUMN_RINGS = ((1, 2), (1, 3), (4, 6)), ((2, 1), (5, 3))


@pytest.mark.parametrize(
    ("rows", "rings", "hole", "tilt", "hidden_from_mm", "least", "most"),
    [
        (9, (), 0.4, TILTS[1], (100.0, 80.0), 56, 67),  # a covered corner is no harm
        (9, COLUMN_RINGS, 0.4, TILTS[1], (112.0, -np.inf), 41, 55),  # rings tell which columns are seen
        *sampled(
            [(8, END_RINGS, share, tilt, (np.inf, np.inf), 61, 64) for share in (0.35, 0.6) for tilt in TILTS[1:]],
            kept=(2,),
        ),  # an even number of rows looks the same turned, but for its rings
    ],
)
def test_covered_boards_and_rings_are_numbered_as_they_are(rows, rings, hole, tilt, hidden_from_mm, least, most):
    board = HexagonalCirclesDesign(rows, 8, 20.0, 6.0, "dark", rings=rings)
    image, pose = view_of(board, tilt, hidden_from_mm, hole)
    view, why = find_board(image, "a", CAMERA, board)
    assert view is not None, why
    assert board.symmetries() == []
    assert least <= len(view) <= most
    assert np.abs(view.xy_px - CAMERA.project(pose @ view.xyz_board)).max() < 0.06
