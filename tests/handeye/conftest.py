"""The command, for all tests of hand-eye calibration."""

import sys

import pytest

from stcal.cli.main import main
from tests.outcome import ended


@pytest.fixture
def command(monkeypatch, capsys):
    """Exit code, standard output and error of ``stcal handeye``."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["stcal", "handeye", *map(str, arguments)])
        return ended(main, capsys)

    return call
