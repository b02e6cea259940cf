"""Mastering offsets: what the controller should show, with which the nominal robot is the arm."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.identified_report import HEAD, offsets_csv, zeros
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, measured, placed

COUPLING = np.eye(6)
COUPLING[2, 1] = COUPLING[5, 3] = 1.0
OFF = np.radians([0, 0.4, -0.3, 0.5, -0.2, 0])
"""Of the joints of the arm; the first and the last joint's are the base's and the tool's too."""


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(3)
    nominal = replace(mh80(), coupling=COUPLING)
    rows = tuple(replace(row, theta=row.theta + off) for row, off in zip(nominal.rows, OFF, strict=True))
    world, tool = Rigid.exp([0.1, 0.2, 0.3, 1000, 500, 200]), Rigid.exp([0, 0, 1, 90, 50, 200])
    true = placed(replace(nominal, rows=rows), world, {"": tool})
    q = joint_vectors(nominal, 60, rng, 0.5)
    found = identify(nominal, measured(true, q, rng, sigma_mm=0.02, sigma_rad=2e-5), IdentifyOptions(folds=0))
    return nominal, true, found, q


def test_zeros_are_what_was_put_in(case):
    nominal, _, found, _ = case
    change, sigma, known = zeros(found, nominal)
    assert known.tolist() == [False, True, True, True, True, False]  # J6 turns with J4, and its own zero is open
    wanted = np.linalg.solve(COUPLING, OFF)
    error = np.abs(change - wanted)[known] / sigma[known]
    assert error.max() < 4
    assert (sigma[known] < np.radians(0.01)).all()
    assert np.abs(change - OFF)[2] > np.radians(0.1)  # not those of the arm's joints


def test_the_nominal_robot_with_other_joint_values_is_the_arm(case):
    nominal, true, found, q = case
    change, _, _ = zeros(found, nominal)
    placed_ = replace(nominal, world_from_base=found.robot.world_from_base, tools=found.robot.tools)
    before, after = ((r.world_from_base @ forward(r, v)).translation for r, v in ((placed_, q), (placed_, q + change)))
    wanted = (true.world_from_base @ forward(true, q)).translation
    assert np.linalg.norm(before - wanted, axis=1).mean() > 3
    assert np.linalg.norm(after - wanted, axis=1).mean() < 0.3  # what the noise leaves open of lengths and twists


def test_table(case):
    nominal, _, found, _ = case
    rows = list(csv.DictReader(offsets_csv(found, nominal).splitlines()))
    assert tuple(rows[0]) == HEAD
    assert len(rows) == 6 * 6
    by_name = {(int(row["joint"]), row["parameter"]): row for row in rows}
    theta, zero = by_name[4, "theta"], by_name[3, "zero"]
    assert (theta["unit"], theta["determined"], theta["nominal"]) == ("deg", "yes", "0.000000000")
    assert float(theta["difference"]) == pytest.approx(0.5, abs=0.02)
    assert float(theta["identified"]) - float(theta["nominal"]) == pytest.approx(float(theta["difference"]), abs=2e-9)
    assert float(zero["difference"]) == pytest.approx(-0.7, abs=0.02)
    assert 0 < float(zero["sigma"]) < 0.01
    first = by_name[1, "theta"]
    assert (first["difference"], first["sigma"], first["determined"]) == ("0.000000000", "", "no")
    assert by_name[2, "a"]["unit"] == "mm"
