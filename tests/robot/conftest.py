import pytest

from stcal.cli.main import main


@pytest.fixture
def stcal_robot(monkeypatch, capsys):
    """``stcal robot`` as it is called: exit code, what it printed, and its errors."""

    def call(*arguments) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["stcal", "robot", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capsys.readouterr()
        return caught.value.code, out, err

    return call
