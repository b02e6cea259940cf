"""An instrument that stood at several places: one adjustment, each station with a place of its own."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.measurements import Measurements, read_measurements
from stcal.robot.kinematics.robot_model import mh80
from tests.outcome import fails_with
from tests.support.arms import seen_arm

MOVED = Rigid.exp([0.2, -0.1, 1.5, 4000, -3000, 200])
"""second_from_first."""


def drawn(kind: str, rows: int = 60, second: int = 25) -> Measurements:
    """Rows from two stations; ``second`` : how many are of B."""
    rng = np.random.default_rng(0)
    data = seen_arm(rng, rows)[1]
    from_b = np.arange(rows) % 2 == 1
    from_b &= np.cumsum(from_b) <= second
    poses = Poses(data.rotations, data.points())
    there = MOVED @ poses
    positions = np.where(from_b[:, None], there.translation, poses.translation)
    rotations = np.where(from_b[:, None, None], there.rotation, poses.rotation) if kind == "pose" else None
    names = tuple(np.where(from_b, "B", "A").tolist())
    return replace(data, positions=positions, rotations=rotations, stations=names)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["position", "pose"])
def test_two_stations_are_as_good_as_one_but_for_six_numbers(kind):
    data = drawn(kind)
    found = identify(mh80(), data)
    one = identify(mh80(), replace(drawn(kind, second=0), stations=()))
    assert found.rank == one.rank + 6
    assert found.weighting.sigma_mm == pytest.approx(one.weighting.sigma_mm, rel=0.2)
    assert np.nanmean(found.held_out.position_mm) < 1.25 * np.nanmean(one.held_out.position_mm)
    off = found.state.stations["B"].matrix() - MOVED.matrix()
    # 25 rows of 0.05 mm: 0.01 mm at their middle, and as much over their spread of a metre at the station 5 m away
    assert np.abs(off[:3, 3]).max() < 0.5
    assert np.abs(off[:3, :3]).max() < 1e-4
    assert next(iter(found.state.stations)) == "A"


@pytest.mark.slow
def test_stations_taken_for_one_and_rows_of_another_are_refused():
    data = drawn("position")
    names = list(data.stations)
    names[1:40:4] = ["A"] * len(names[1:40:4])
    for stations in ((), tuple(names)):
        with fails_with("E-IDENTIFY-MISFIT … robot MH80 misses the measurements"):
            identify(mh80(), replace(data, stations=stations))


@pytest.mark.slow
def test_distances_of_positions_go_within_stations():
    options = IdentifyOptions(observe="distance", folds=0)
    found = identify(mh80(), drawn("position"), options)
    one = identify(mh80(), replace(drawn("position", second=0), stations=()), options)
    assert found.rank == one.rank
    assert np.sqrt((found.fitted_mm**2).mean()) < 0.15


def test_a_station_of_two_rows_is_named():
    with fails_with("E-STATION-FEW … 2"):
        identify(mh80(), drawn("position", second=2))


def test_the_column_is_read(tmp_path):
    data = drawn("position", rows=30, second=10)
    names = [f"q{i}_rad" for i in range(1, 7)]
    lines = [",".join([*names, "x_mm", "y_mm", "z_mm", "station"])]
    for q, at, station in zip(data.q, data.points(), data.stations, strict=True):
        lines.append(",".join([*map(repr, q.tolist()), *map(repr, at.tolist()), station]))
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    read = read_measurements(tmp_path / "data.csv", mh80())
    assert read.stations == data.stations
    assert read.notes == ()
    assert {name: int(rows.sum()) for name, rows in read.by_station().items()} == {"A": 20, "B": 10}
