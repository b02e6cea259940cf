"""Distances against stated lengths and against a second calibration."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import StcalError
from stcal.sfm.budget.budget_file import SHARED, against_run, against_stated
from stcal.sfm.budget.combine import budget_of_run, longest_of, statement_of
from tests.outcome import INPUT, assert_error

PITCH = "[board]\npitch_sigma_ppm = 50.0\n"


@pytest.fixture(scope="module")
def budget(saved):
    return budget_of_run(saved)


def lengths_csv(path, budget, off_u=0.0, rows=4, sigma_mm=0.001, head="from,to,length_mm,sigma_mm"):
    """Lengths of the run, each shorter by so many expanded uncertainties."""
    lines = [head]
    for i, j in longest_of(budget.joint.labels, budget.joint.xyz_model)[:rows]:
        a, b = budget.joint.labels[i], budget.joint.labels[j]
        length = float(np.linalg.norm(budget.joint.xyz_model[i] - budget.joint.xyz_model[j]))
        u = next(r.standard for r in budget.of_kind("distance") if r.measurand.circles == (a, b))
        cells = [a, b, f"{length - off_u * 2 * np.hypot(u, sigma_mm):.9f}", str(sigma_mm)]
        lines.append(",".join(cells[: head.count(",") + 1]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("off_u", "rows", "beyond", "agrees"),
    [(0.0, 4, 0, True), (0.9, 4, 0, True), (1.1, 1, 1, False), (1.1, 4, 4, True), (1.5, 4, 4, False)],
)
def test_errors_over_their_uncertainty(budget, tmp_path, off_u, rows, beyond, agrees):
    """Of four lengths the limit is 1.27: each is beyond 2.53 σ by chance in 1 of 88, all four in 1 of 22."""
    found = against_stated(budget, lengths_csv(tmp_path / "lengths.csv", budget, off_u, rows))
    assert [each.e_n for each in found.lengths] == pytest.approx([off_u] * rows, abs=1e-5)
    assert (found.beyond, found.agrees) == (beyond, agrees)
    assert found.limit == pytest.approx({1: 1.0, 4: 1.2655}[rows], abs=1e-3)
    (note,) = found.notes  # no temperature is stated
    assert "must state lengths for the temperature at which the target was photographed" in note
    at_20 = replace(budget, conditions=replace(budget.conditions, temperature_c=20.0))
    assert against_stated(at_20, tmp_path / "lengths.csv").notes == ()


def test_lengths_without_sigma_are_exact(budget, tmp_path):
    path = lengths_csv(tmp_path / "lengths.csv", budget, 0.9, sigma_mm=0.0, head="from,to,length_mm")
    found = against_stated(budget, path)
    assert [each.e_n for each in found.lengths] == pytest.approx([0.9] * 4, abs=1e-5)
    assert "no sigma_mm" in found.notes[0]


def test_a_run_against_itself_differs_by_nothing_and_pitch_is_not_in_it(saved, budget, tmp_path):
    """U of the difference is √2 that of one run; a pitch that both share leaves it as it is, another board's does
    not."""
    plain = against_run(budget, budget, saved.folder, (saved.board_design, saved.board_design))
    assert plain.agrees
    assert "cannot be seen here" in plain.notes[0]
    longest = budget.of_kind("distance")[0]
    assert plain.lengths[0].circles == longest.measurand.circles
    assert plain.lengths[0].error_um == 0
    assert plain.lengths[0].expanded_um == pytest.approx(1e3 * np.sqrt(2) * longest.expanded)
    path = tmp_path / "lab.toml"
    path.write_text(PITCH)
    stated = budget_of_run(saved, statement_of(saved.board_design.stated, path))
    same = against_run(stated, stated, saved.folder, (saved.board_design, saved.board_design))
    assert same.lengths[0].expanded_um == pytest.approx(plain.lengths[0].expanded_um)
    other = against_run(stated, stated, saved.folder, (saved.board_design, replace(saved.board_design, pitch_mm=20.0)))
    pitch = 50e-6 * longest.measurand.length_mm
    wanted = np.hypot(plain.lengths[0].expanded_um, 2e3 * np.sqrt(2) * pitch)
    assert other.lengths[0].expanded_um == pytest.approx(wanted, rel=2e-3)
    assert other.notes == ()
    assert "board_pitch" in SHARED
    at_20 = replace(budget, conditions=replace(budget.conditions, temperature_c=20.0))
    mixed = against_run(budget, at_20, saved.folder, (saved.board_design, saved.board_design))
    assert len(mixed.notes) == 2
    assert "hold at different temperatures" in mixed.notes[1]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1:1,9:9,100,0", "line 2: no circle 9:9"),
        ("1:1,1:1,100,0", "line 2: 1:1 to 1:1"),
        ("1:1,1:2,-3,0", "a length between two circles"),
        ("1:1,1:2,40,-1", "a σ of 0 or more"),
        ("1:1,1:2,x,0", "length_mm is 'x'"),
    ],
)
def test_lengths_that_are_none(budget, tmp_path, row, words):
    path = tmp_path / "lengths.csv"
    path.write_text(f"from,to,length_mm,sigma_mm\n{row}\n")
    with pytest.raises(StcalError) as error:
        against_stated(budget, path)
    assert words in str(error.value)


def test_a_statement_of_no_second_run(stcal_sfm, small_run, tmp_path):
    words = "budget", small_run, "--lengths-statement", tmp_path / "x.toml"
    assert_error(stcal_sfm(*words), INPUT, "E-OPTION-NEEDS", "--lengths")
