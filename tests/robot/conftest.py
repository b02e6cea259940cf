import pytest

from stcal.cli.main import main
from tests.outcome import Outcome, ended


@pytest.fixture
def stcal_robot(monkeypatch, capsys):
    """``stcal robot`` as it is called: exit code, what it printed, and its errors."""

    def call(*arguments) -> Outcome:
        monkeypatch.setattr("sys.argv", ["stcal", "robot", *map(str, arguments)])
        return ended(main, capsys)

    return call
