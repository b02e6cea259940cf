"""A real robot and a total station: the acceptance figures."""

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.forward import forward
from tests.scripts import load_script

pytestmark = pytest.mark.slow  # a set that lies beside the repository


@pytest.fixture(scope="module")
def script():
    return load_script("register_shared")


@pytest.fixture(scope="module")
def data(script, shared_data):
    """Stations by name, and the robot of the URDF."""
    root = shared_data("hilti_stationing")
    return root, script.stations(root), script.robot_of(root / "data" / "trailblazer.urdf")


def test_rows_make_the_poses_of_the_urdf(script, data):
    """The URDF's transforms multiplied one by one, with both stages of the column as it says."""
    root, stations, robot = data
    q = script.everything(stations["flat"]).q[::40]
    for values, found in zip(q, (robot.world_from_base @ forward(robot, q).translation), strict=True):
        pose, rest = Rigid(), list(values[1:])
        for name, kind, origin in script.urdf_joints(root / "data" / "trailblazer.urdf"):
            pose = pose @ origin
            if kind == "prismatic":
                offset = {"column_middle_joint": -706.0, "column_top_joint": -736.0}[name]
                pose = pose @ Rigid(np.eye(3), [0, 0, values[0] / 2 + offset])
            elif kind == "revolute":
                pose = pose @ Rigid.exp([0, 0, rest.pop(0), 0, 0, 0])
        np.testing.assert_allclose(pose.translation, found, atol=1e-8)


def test_rigid_registration_holds_to_a_centimetre_and_affine_to_metres(script, data):
    """The figures of SOURCE.txt: 6.9–9.9 mm, and 3.2–5.4 m of the affine fit to coplanar places."""
    _, stations, robot = data
    rigid = {name: script.errors_by_part(s, robot).mean() for name, s in stations.items()}
    affine = {name: script.errors_by_part(s, robot, affine=True).mean() for name, s in stations.items()}
    assert len(rigid) == 7
    assert min(rigid.values()) > 6.0
    assert max(rigid.values()) < 9.95
    assert min(affine.values()) > 2000


def test_kinematics_of_one_station_serve_another(script, data):
    """Identified where the floor is flat, used where it is not: the error falls to below 70 %."""
    _, stations, robot = data
    real = script.identified(robot, script.everything(stations["flat"]))
    for name in ("outdoor", "pallet", "diagonal_wood"):
        nominal, better = (script.errors_by_part(stations[name], each).mean() for each in (robot, real))
        assert better < 0.7 * nominal
