"""The command, for all tests of hand-eye calibration."""

from tests.outcome import program

command = program("stcal", "handeye")
