import pytest

from stcal.cli.main import main
from stcal.robot import load_robot, read_measurements
from tests.outcome import Outcome, ended
from tests.scripts import load_script


@pytest.fixture
def stcal_robot(monkeypatch, capsys):
    """``stcal robot`` as it is called: exit code, what it printed, and its errors."""

    def call(*arguments) -> Outcome:
        monkeypatch.setattr("sys.argv", ["stcal", "robot", *map(str, arguments)])
        return ended(main, capsys)

    return call


@pytest.fixture
def rokae(shared_data, tmp_path):
    """The nominal robot and the 30 poses of the public set of a laser tracker."""
    shared_data("rokae_tracker/data")
    load_script("same_results").prepare(tmp_path)
    robot = load_robot(tmp_path / "rokae.toml")
    return robot, read_measurements(tmp_path / "rokae.csv", robot)
