"""The package as it is used from Python: the example of its docstring, and what an import loads."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from stcal import robot
from stcal.io.table import POSE, pose_cells
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.robot.use.compensation import joint_cells, joint_columns
from tests.shared import write_rows
from tests.support.arms import TOOL, WORLD


@pytest.mark.full
def test_the_example_of_the_docstring_runs(tmp_path, monkeypatch, capsys):
    """On what one simulated arm gives."""
    rng, nominal = np.random.default_rng(4), mh80()
    true = placed(made(nominal, rng), WORLD, {"": TOOL})
    robot.save_robot(tmp_path / "robot.toml", nominal)
    rest = np.radians([10, 20, -20, 15, 40, 5.0])
    sweeps = np.array([rest + np.eye(6)[i] * step for i in range(6) for step in np.linspace(-0.6, 0.6, 9)])
    for name, q in (("measured", joint_vectors(nominal, 40, rng)), ("sweeps", sweeps)):
        seen = measured(true, q, rng, 0.03, 1e-4).poses()
        rows = [[*joint_cells(nominal, joint), *pose_cells(pose)] for joint, pose in zip(q, seen, strict=True)]
        write_rows(tmp_path / f"{name}.csv", [*joint_columns(nominal), *POSE], rows)
    poses = robot.forward(true, joint_vectors(nominal, 10, rng))
    write_rows(tmp_path / "targets.csv", POSE, map(pose_cells, poses))
    there = np.hstack([poses.translation, poses.translation + rng.normal(0, 0.05, (10, 3))])
    write_rows(tmp_path / "verified.csv", [*(f"commanded_{name}" for name in POSE[:3]), *POSE[:3]], there)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(textwrap.dedent(robot.__doc__.split("::\n", 1)[1]), "example", "exec"), names)
    found, data = names["found"], names["data"]
    assert capsys.readouterr().out.startswith("30 0.")
    assert 0.03 < found.held_out.position_mm.mean() < 0.15  # noise 0.03 mm on each axis, and the model's own
    apart = robot.forward(robot.load_robot(tmp_path / "identified.toml"), data.q).difference(names["base_from_tool"])
    assert np.abs(apart).max() < 1e-9
    assert names["jacobian"].shape == (40, 6, 6)
    assert names["solved"].q == pytest.approx(np.array(data.q), abs=1e-7)
    assert names["plan"].q.shape == (40, 6)
    assert set(names["compensated"].found.status) == {"reached"}
    assert names["check"].sets[0].max_mm < 0.5
    assert names["axes"].robot.rows[1].a == pytest.approx(870, abs=2)


@pytest.mark.slow
def test_an_import_loads_nothing_heavy():
    """0.1 s on a quiet machine; what it must not load takes 0.3 s and more."""
    for what, heavy in (
        ("import stcal.robot", ("scipy", "numpy", "pydantic", "cv2", "typer")),
        ("from stcal.robot import forward, Robot", ("scipy.stats", "scipy.optimize", "pydantic")),
    ):
        code = f"import sys; {what}; print([m for m in {heavy} if m in sys.modules])"
        assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
