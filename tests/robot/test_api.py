"""The package as it is used from Python: the example of its docstring, and what an import loads."""

import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from stcal import robot
from stcal.geometry.rigid import Rigid
from stcal.io.table import POSE, pose_cells
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.robot.use.compensation import joint_cells, joint_columns


def write(path, header, rows) -> None:
    path.write_text("\n".join([",".join(header), *[",".join(map(str, row)) for row in rows]]) + "\n")


@pytest.fixture
def files(tmp_path):
    """What the example reads, of one simulated arm."""
    rng = np.random.default_rng(4)
    nominal = mh80()
    tool = Rigid.exp([0.1, 0.3, -0.2, 20, -30, 90])
    true = placed(made(nominal, rng), Rigid.exp([0.2, -0.1, 0.5, 900, -400, 200]), {"": tool})
    robot.save_robot(tmp_path / "robot.toml", nominal)
    joints = joint_columns(nominal)

    def rows(q, **noise):
        seen = measured(true, q, rng, **noise)
        return [[*joint_cells(nominal, joint), *pose_cells(pose)] for joint, pose in zip(q, seen.poses(), strict=True)]

    q = joint_vectors(nominal, 40, rng)
    write(tmp_path / "measured.csv", [*joints, *POSE], rows(q, sigma_mm=0.03, sigma_rad=1e-4))
    rest = np.radians([10, 20, -20, 15, 40, 5.0])
    sweeps = [rest + np.eye(6)[i] * step for i in range(6) for step in np.linspace(-0.6, 0.6, 9)]
    sweeps = rows(np.array(sweeps), sigma_mm=0.02, sigma_rad=1e-4)
    write(tmp_path / "sweeps.csv", [*joints, *POSE[:3]], [row[:9] for row in sweeps])
    poses = robot.forward(replace(true, tools={"": tool}), q[:10])
    write(tmp_path / "targets.csv", POSE, [pose_cells(pose) for pose in poses])
    there = poses.translation
    verified = [[*place, *(place + rng.normal(0, 0.05, 3))] for place in there]
    write(tmp_path / "verified.csv", ["commanded_x_mm", "commanded_y_mm", "commanded_z_mm", *POSE[:3]], verified)
    return tmp_path


@pytest.mark.full
def test_the_example_of_the_docstring_runs(files, monkeypatch, capsys):
    example = textwrap.dedent(robot.__doc__.split("::\n", 1)[1])
    monkeypatch.chdir(files)
    names: dict = {}
    exec(compile(example, "example", "exec"), names)
    found, data = names["found"], names["data"]
    assert capsys.readouterr().out.startswith("30 0.")
    assert 0.03 < found.held_out.position_mm.mean() < 0.15  # noise 0.03 mm on each axis, and the model's own
    again = robot.load_robot(files / "identified.toml")
    apart = robot.forward(again, data.q).difference(names["base_from_tool"])
    assert np.abs(apart).max() < 1e-9
    assert names["jacobian"].shape == (40, 6, 6)
    assert names["solved"].q == pytest.approx(np.array(data.q), abs=1e-7)
    assert names["plan"].q.shape == (40, 6)
    assert set(names["compensated"].found.status) == {"reached"}
    assert names["check"].sets[0].max_mm < 0.5
    assert names["axes"].robot.rows[1].a == pytest.approx(870, abs=2)


def test_every_name_is_there_and_no_other():
    for name in robot.__all__:
        assert getattr(robot, name).__name__ == name
    with pytest.raises(AttributeError, match="attribute nothing"):
        robot.nothing  # noqa: B018


@pytest.mark.slow
def test_an_import_loads_nothing_heavy():
    """0.1 s on a quiet machine; what it must not load takes 0.3 s and more."""
    for what, heavy in (
        ("import stcal.robot", ("scipy", "numpy", "pydantic", "cv2", "typer")),
        ("from stcal.robot import forward, Robot", ("scipy.stats", "scipy.optimize", "pydantic")),
    ):
        code = f"import sys; {what}; print([m for m in {heavy} if m in sys.modules])"
        assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
