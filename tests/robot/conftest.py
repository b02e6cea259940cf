import pytest

from stcal.robot import load_robot, read_measurements
from tests.outcome import program
from tests.scripts import load_script

stcal_robot = program("stcal", "robot")


@pytest.fixture
def rokae(shared_data, tmp_path):
    """The nominal robot and the 30 poses of the public set of a laser tracker."""
    shared_data("rokae_tracker/data")
    load_script("same_results").prepare(tmp_path)
    robot = load_robot(tmp_path / "rokae.toml")
    return robot, read_measurements(tmp_path / "rokae.csv", robot)
