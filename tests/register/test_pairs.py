"""Files of point pairs: what they may hold, and bad rows by their line."""

import numpy as np
import pytest

from stcal.register import read_pairs
from tests.outcome import fails_with

HEAD = "ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm"
ROWS = ["0,0,0,10,20,30", "1,0,0,11,20,30", "0,2,0,10,22,30", "0,0,3.5,10,20,33.5"]
COV = "cov_x_x,cov_x_y,cov_x_z,cov_y_y,cov_y_z,cov_z_z"


@pytest.fixture
def written(tmp_path):
    def write(rows, head=HEAD):
        path = tmp_path / "pairs.csv"
        path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
        return path

    return write


def with_cells(cells):
    return [f"{row},{cell}" for row, cell in zip(ROWS, cells, strict=True)]


def test_points_lines_and_units(written):
    pairs = read_pairs(written([ROWS[0], "# a remark", *ROWS[1:]]))
    assert list(pairs.lines) == [2, 4, 5, 6]
    np.testing.assert_array_equal(pairs.xyz_a[3], [0, 0, 3.5])
    np.testing.assert_array_equal(pairs.xyz_b[2], [10, 22, 30])
    assert pairs.weights is None
    assert pairs.covariances is None
    pairs = read_pairs(written(ROWS, "ax_m,ay_mm,az_mm,bx_in,by_in,bz_in"))
    np.testing.assert_allclose(pairs.xyz_a[1], [1000, 0, 0])
    np.testing.assert_allclose(pairs.xyz_b[0], np.array([10, 20, 30]) * 25.4)


def test_noise_of_three_kinds(written):
    assert read_pairs(written(with_cells([1, 2, 3, 4]), HEAD + ",weight")).weights.tolist() == [1, 2, 3, 4]
    variances = read_pairs(written(with_cells([1, 2, 3, 4]), HEAD + ",sigma_um")).covariances
    np.testing.assert_allclose(variances, np.array([1, 4, 9, 16]) * 1e-6)
    full = read_pairs(written(with_cells(["4,1,0,5,2,6"] * 4), f"{HEAD},{COV}")).covariances
    np.testing.assert_array_equal(full[2], [[4, 1, 0], [1, 5, 2], [0, 2, 6]])


@pytest.mark.parametrize(
    ("rows", "head", "message"),
    [
        ([], HEAD, "E-TABLE-EMPTY"),
        ([*ROWS, "1,2,nan,4,5,6"], HEAD, "E-TABLE-NUMBER … 6 … az_mm … 'nan'"),
        ([*ROWS, "1,2,3,4,much,6"], HEAD, "E-TABLE-NUMBER … 6 … by_mm … 'much'"),
        ([*ROWS, "1,2,3,4,5"], HEAD, "E-TABLE-CELLS … 6 … 5 … 6"),
        ([*ROWS, "", ROWS[1]], HEAD, "E-TABLE-ROW-REPEATED … 7 … 3"),
        ([*ROWS, ROWS[1], ROWS[1]], HEAD, "E-TABLE-ROW-REPEATED … 6"),
        (ROWS, HEAD.replace("bz_mm", "z_mm"), "E-TABLE-COLUMN-MISSING … no such column … bz_mm or bz_m"),
        (with_cells([1, 2, 0, 4]), HEAD + ",weight", "E-SIGMA-VALUE … 4 … weight … 0"),
        (with_cells([1, -2, -1, 4]), HEAD + ",sigma_mm", "E-SIGMA-VALUE … 3 … sigma … -2 … (and 1 more)"),
        (with_cells(["1,1"] * 4), HEAD + ",sigma_mm,weight", "E-TABLE-COLUMNS-CONFLICT … weight and sigma"),
        (with_cells(["1,2"] * 4), HEAD + ",cov_x_x,cov_x_y", "E-TABLE-COLUMN-MISSING … cov_x_z … 6"),
        (with_cells(["1,0,0,1,0,1"] * 3 + ["1,2,0,1,0,1"]), f"{HEAD},{COV}", "E-TABLE-COVARIANCE … 5 … 2"),
    ],
)
def test_bad_files(written, rows, head, message):
    with fails_with(message):
        read_pairs(written(rows, head))
