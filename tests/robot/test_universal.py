"""Arms of Universal Robots: what ur_calibration and the controller write, against matrices multiplied by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.robot.descriptions import LINKS, is_conf, kinematics_content, robot_of_conf, robot_of_kinematics
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_file import load_robot, save_robot
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot
from tests.outcome import fails_with

UR5E = {
    "shoulder": (0, 0, 0.1627122445743823, 0, 0, 5.707382499074709e-08),
    "upper_arm": (0.0001820110310317555, 0, 0, 1.571314866107557, 0, 1.12157791523139e-06),
    "forearm": (-0.425170344631444, 0, 0, 0.001444320579376547, -0.0004261037597356073, 4.642343028998144e-06),
    "wrist_1": (
        *(-0.392646598028507, -0.0004030322688786401, 0.1331063119537431),
        *(0.003027888244224887, -0.001185722601572754, -2.569771029137183e-06),
    ),
    "wrist_2": (
        *(-7.071306960874342e-06, -0.09960359635829828, -3.198591184007791e-07),
        *(1.570799538115874, 0, 1.304820282092834e-06),
    ),
    "wrist_3": (
        *(1.369362273278849e-05, 0.09958483828527664, 9.521789789182917e-05),
        *(1.571752475045119, 3.141592653589793, 3.141592510837143),
    ),
}
"""A published calibration of a UR5e, m and rad."""
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
A, D = (0, -0.612, -0.5723, 0, 0, 0), (0.1273, 0, 0, 0.163941, 0.1157, 0.0922)
ALPHA = (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0)
"""The nominal UR10, m and rad."""
CONF = """[mounting]
delta_theta = [ -8.20642406610186392e-05, -0.103609197138685979, 0.673631891251821, -0.5701697472496, -4.6e-05, 9.7e-07]
delta_a = [ -0.000161187342296687116, 0.00304003843792177708, 0.0916468555721788314, -9.63e-05, -2.98e-05, 0]
delta_d = [ 0.000505390894843998906, 11.1984514757821039, -92.5270326908668181, 81.3282683520703529, -0.00021, -0.00013]
delta_alpha = [ -0.00032142399895862539, -0.00565024518540147101, -0.00378922621833689211, -0.00107, 0.000999586, 0]
joint_checksum = [ 0x6e0f7bf, 0xa32a713f, 0xf636a50, 0x9ec2338a, 0xa1afded8, 0xb29b2979]
"""
Q = np.random.default_rng(3).uniform(-3, 3, (30, 6))
ROUNDING_MM = 1e-9
"""Lengths of 92 m cancel in the controller's rows."""


def yaml_of(links):
    rows = (f"  {n}: {{{', '.join(f'{k}: {v!r}' for k, v in zip(KEYS, links[n], strict=True))}}}" for n in links)
    return "kinematics:\n" + "\n".join(rows) + "\n  hash: calib_1\n"


def place(xyz_mm=(0, 0, 0), turn=None):
    matrix = np.eye(4)
    matrix[:3, 3] = xyz_mm
    if turn is not None:
        matrix[:3, :3] = turn.as_matrix()
    return matrix


def about(axis, angle):
    return place(turn=Rotation.from_euler(axis, angle))


def deltas():
    lines = [line.partition("=") for line in CONF.splitlines() if line.startswith("delta")]
    return {key.strip()[6:]: np.array([float(v) for v in text.strip(" []").split(",")]) for key, _, text in lines}


def by_rows(q):
    """base_from_flange of the controller's rows, mm."""
    delta, product = deltas(), np.eye(4)
    for i in range(6):
        product = product @ about("z", q[i] + delta["theta"][i]) @ place((0, 0, 1000 * (D[i] + delta["d"][i])))
        product = product @ place((1000 * (A[i] + delta["a"][i]), 0, 0)) @ about("x", ALPHA[i] + delta["alpha"][i])
    return product


def by_links(q):
    product = np.eye(4)
    for i, name in enumerate(LINKS):
        x, y, z, roll, pitch, yaw = UR5E[name]
        product = product @ place((1000 * x, 1000 * y, 1000 * z))
        product = product @ about("x", roll) @ about("y", pitch) @ about("z", yaw + q[i])
    return product


def nominal(**more):
    rows = tuple(DHRow(1000 * a, alpha, 1000 * d, 0.0) for a, d, alpha in zip(A, D, ALPHA, strict=True))
    return Robot("ur10", "standard", rows, (Joint(),) * 6, **{"tools": {"": Rigid()}, **more})


def poses(robot):
    return np.array([(robot.world_from_base @ pose).matrix() for pose in forward(robot, Q)])


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_the_yaml_of_ur_calibration(convention):
    robot, off_mm = robot_of_kinematics(kinematics_content(yaml_of(UR5E)), "k.yaml", convention)
    np.testing.assert_allclose(poses(robot), [by_links(q) for q in Q], atol=ROUNDING_MM)
    assert 1e-4 < off_mm < 0.01  # by yaw of 1e-6 in the upper arm, on 0.9 m
    if convention == "standard":
        # the program makes the upper arm of a length, a twist and the next zero: a row, by angles about turned axes
        assert robot.rows[0].alpha == pytest.approx(UR5E["upper_arm"][3], abs=1e-12)
        assert robot.rows[1].theta == pytest.approx(UR5E["upper_arm"][5], abs=1e-12)


@pytest.mark.parametrize("with_nominal", [False, True])
def test_calibration_conf(with_nominal):
    """Tools and base of the nominal arm stay."""
    lists = (
        f"{key} = [{', '.join(map(repr, map(float, values)))}]"
        for key, values in (("a", A), ("d", D), ("alpha", ALPHA))
    )
    text = CONF if with_nominal else "[DH]\n" + "\n".join(lists) + "\n" + CONF
    assert is_conf(text)
    base = tool = Rigid()
    if with_nominal:
        base, tool = Rigid.exp([0.1, 0.2, 0.3, 4, 5, 6]), Rigid.exp([0.3, 0, 0, 0, 0, 90.0])
    given = nominal(world_from_base=base, tools={"": tool}) if with_nominal else None
    robot = robot_of_conf(text, "calibration.conf", given, "standard")
    wanted = [base.matrix() @ by_rows(q) @ tool.matrix() for q in Q]
    np.testing.assert_allclose(poses(robot), wanted, atol=ROUNDING_MM)
    assert max(max(abs(row.a), abs(row.d)) for row in robot.rows) < 1000  # and none of 92 m


@pytest.mark.parametrize(
    ("text", "given", "error"),
    [
        (CONF, None, "E-ROBOT-NOMINAL … --nominal"),
        (CONF, Robot("two", "standard", (DHRow(90, 0, 0, 0),) * 2, (Joint(),) * 2), "E-ROBOT-NOMINAL … 2 joints"),
        (CONF.replace("-0.00013]", "]"), nominal(), "E-ROBOT-ENTRIES … delta_d"),
        (CONF.replace("delta_alpha", "delta_beta"), nominal(), "E-ROBOT-ENTRIES … delta_alpha"),
    ],
)
def test_mistakes_in_calibration_conf(text, given, error):
    with fails_with(error):
        robot_of_conf(text, "calibration.conf", given, "standard")


def test_a_yaml_that_lacks_links():
    links = {name: UR5E[name] for name in LINKS[:2]}
    with pytest.raises(InputError, match=r"k\.yaml: kinematics without forearm, wrist_1") as caught:
        robot_of_kinematics(kinematics_content(yaml_of(links)), "k.yaml", "standard")
    assert caught.value.code == "E-KEY-MISSING"
    assert kinematics_content("a: 1\n") is None


def test_other_files_of_robots_are_to_be_converted(tmp_path):
    for name in ("ur.yaml", "calibration.conf", "arm.urdf"):
        (tmp_path / name).write_text(yaml_of(UR5E))
        with fails_with(f"E-ROBOT-FORM … {name} … robot convert"):
            load_robot(tmp_path / name)
    robot, _ = robot_of_kinematics(kinematics_content(yaml_of(UR5E)), "k.yaml", "standard")
    save_robot(tmp_path / "ur.toml", robot)
    np.testing.assert_allclose(poses(load_robot(tmp_path / "ur.toml")), poses(robot), atol=ROUNDING_MM)
