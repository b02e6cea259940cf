"""URDF, kept both ways, and files as other programs write them, against matrices multiplied by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.descriptions import LINKS, load_universal, load_urdf, require_urdf_written, robot_urdf
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_file import load_robot, robot_toml, save_robot
from stcal.robot.kinematics.robot_model import DHRow, Elasticity, Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors
from tests.outcome import refuses
from tests.shared import written
from tests.support.arms import two_arms

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


def world_poses(robot: Robot, q: np.ndarray, tool: str = "") -> Poses:
    return robot.world_from_base @ forward(robot, q, tool)


@pytest.fixture
def universal(tmp_path):
    def read(text: str, *more, name: str = "ur.yaml"):
        return load_universal(written(tmp_path / name, text), *more)

    return read


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_the_yaml_of_ur_calibration(universal, convention):
    found = universal(yaml_of(UR5E), None, convention)
    np.testing.assert_allclose(world_poses(found.robot, Q).matrix(), [by_links(q) for q in Q], atol=ROUNDING_MM)
    assert "its flange is 0.0013 mm off" in found.notes[0]  # by yaw of 1e-6 in the upper arm, on 0.9 m
    if convention == "standard":
        # the program makes the upper arm of a length, a twist and the next zero: a row, by angles about turned axes
        assert found.robot.rows[0].alpha == pytest.approx(UR5E["upper_arm"][3], abs=1e-12)
        assert found.robot.rows[1].theta == pytest.approx(UR5E["upper_arm"][5], abs=1e-12)


def test_calibration_conf_and_other_files_of_robots_which_are_to_be_converted(universal, tmp_path):
    """Tools and base of the nominal arm stay; with the nominal lengths in it: `tests/test_python_functions.py`."""
    base, tool = Rigid.exp([0.1, 0.2, 0.3, 4, 5, 6]), Rigid.exp([0.3, 0, 0, 0, 0, 90.0])
    robot = universal(CONF, nominal(world_from_base=base, tools={"": tool}), name="calibration.conf").robot
    wanted = [base.matrix() @ by_rows(q) @ tool.matrix() for q in Q]
    np.testing.assert_allclose(world_poses(robot, Q).matrix(), wanted, atol=ROUNDING_MM)
    assert max(max(abs(row.a), abs(row.d)) for row in robot.rows) < 1000  # and none of 92 m
    for name in ("ur.yaml", "calibration.conf", "arm.urdf"):
        path = written(tmp_path / name, yaml_of(UR5E))
        refuses(f"E-ROBOT-FORM … {name} … robot convert", load_robot, path)
    robot = universal(yaml_of(UR5E)).robot
    save_robot(tmp_path / "ur.toml", robot)
    again, here = (world_poses(each, Q).matrix() for each in (load_robot(tmp_path / "ur.toml"), robot))
    np.testing.assert_allclose(again, here, atol=ROUNDING_MM)


@pytest.mark.parametrize(
    ("text", "given", "error"),
    [
        (CONF, None, "E-ROBOT-NOMINAL … nominal"),
        (CONF, Robot("two", "standard", (DHRow(90, 0, 0, 0),) * 2, (Joint(),) * 2), "E-ROBOT-NOMINAL … 2 joints"),
        (CONF.replace("-0.00013]", "]"), nominal(), "E-ROBOT-ENTRIES … delta_d"),
        (CONF.replace("delta_alpha", "delta_beta"), nominal(), "E-ROBOT-ENTRIES … delta_alpha"),
        (yaml_of({name: UR5E[name] for name in LINKS[:2]}), None, "E-KEY-MISSING … without forearm, wrist_1"),
        ("a: 1\n", None, "E-ROBOT-FORM … ur.yaml"),
    ],
)
def test_mistakes_in_files_of_universal_robots(universal, text, given, error):
    refuses(error, universal, text, given)


TOOLS = {"": Rigid.exp([0.1, 0.2, -0.3, 10, 20, 150]), "ball": Rigid.exp([0, 0.5, 0, -40, 0, 90])}
WORLD = Rigid.exp([0.1, 0.2, 0.3, 1000, -500, 200])
EXAMPLE = replace(mh80(), tools=TOOLS, world_from_base=WORLD)
SLIDE = Joint("prismatic", -100.0, 2000.0)


def turned(seed: int = 0, **more) -> Robot:
    off = np.random.default_rng(seed).normal(size=(6, 4)) * [1, 0.01, 1, 0.01]
    rows = zip(mh80().rows, off, strict=True)
    rows = tuple(DHRow(r.a + a, r.alpha + alpha, r.d + d, r.theta + theta) for r, (a, alpha, d, theta) in rows)
    return replace(EXAMPLE, rows=rows, **more)


ROBOTS = {
    "example": EXAMPLE,
    "made": turned(),
    "modified": turned(1, convention="modified"),
    "prismatic": turned(2, joints=(*mh80().joints[:2], SLIDE, *mh80().joints[3:])),
    "on a track": turned(3, joints=(SLIDE, *mh80().joints[1:])),
    "beta": replace(EXAMPLE, rows=tuple(replace(r, beta=0.003 if i == 1 else 0.0) for i, r in enumerate(EXAMPLE.rows))),
}


def values(robot: Robot, m: int = 50) -> np.ndarray:
    return np.random.default_rng(9).uniform(-3, 3, (m, len(robot.rows))) * np.where(robot.prismatic, 300, 1)


@pytest.mark.parametrize(
    ("name", "convention"),
    [*((name, "standard") for name in ROBOTS), ("example", "modified"), ("prismatic", "modified")],
)
def test_there_and_back(name, convention, tmp_path):
    robot = ROBOTS[name]
    found = load_urdf(written(tmp_path / "a.urdf", robot_urdf(robot)), convention=convention)
    q = values(robot)
    for back in (found.robot, load_robot(written(tmp_path / "b.toml", robot_toml(found.robot)))):
        assert back.convention == convention
        for tool in TOOLS:
            off = world_poses(back, q, tool).difference(world_poses(robot, q, tool))
            assert np.abs(off[:, 3:]).max() < 1e-9
            assert np.abs(off[:, :3]).max() < 1e-12
    np.testing.assert_allclose(found.robot.limits(), robot.limits(), rtol=1e-12)
    assert found.joints == tuple(f"joint_{i}" for i in range(1, 7))
    assert found.notes == ()
    if robot is EXAMPLE and convention == robot.convention:  # as it was
        for row, own in zip(found.robot.rows, robot.rows, strict=True):
            assert [row.a, row.d] == pytest.approx([own.a, own.d], abs=1e-9)
            assert [row.alpha, row.theta] == pytest.approx([own.alpha, own.theta], abs=1e-12)


def test_coupled_joints_are_kinematic_ones(tmp_path):
    coupling = np.eye(6)
    coupling[2, 1] = 1.0
    robot = replace(EXAMPLE, coupling=coupling)
    found = load_urdf(written(tmp_path / "a.urdf", robot_urdf(robot))).robot
    q = values(robot)
    off = forward(found, q @ coupling.T).difference(forward(robot, q))
    assert np.abs(off[:, 3:]).max() < 1e-9
    low, high = np.degrees(found.limits()[2])
    assert (low, high) == pytest.approx((-90 - 80, 155 + 90))


def test_a_file_that_leads_elsewhere_and_robots_that_a_urdf_cannot_hold_are_refused(tmp_path):
    text = robot_urdf(EXAMPLE)
    assert text.count('xyz="0.145 0.0 0.54"') == 1
    path = written(tmp_path / "a.urdf", text.replace('xyz="0.145 0.0 0.54"', 'xyz="0.14501 0.0 0.54"'))
    refuses("E-WRITTEN-DIFFERS … a.urdf", require_urdf_written, path, EXAMPLE)
    refuses("E-ROBOT-NAME … '\\x1b[31mred' has control characters", robot_urdf, replace(EXAMPLE, name="\x1b[31mred"))
    none = Elasticity(np.zeros((6, 2)), np.zeros((6, 3)), np.zeros((6, 4)), np.array([0, 0, -1.0]))
    refuses("E-ROBOT-ELASTICITY", robot_urdf, replace(EXAMPLE, elasticity=none))


OTHER = """<?xml version="1.0" ?>
<!-- expanded by hand -->
<robot name="two_arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="base_link"><visual><geometry><mesh filename="package://a/b.stl"/></geometry></visual></link>
  <link name="base"/>
  <joint name="base_link-base" type="fixed"><parent link="base_link"/><child link="base"/></joint>
  <joint type="revolute" name="a1">
    <origin rpy="0 0 0.3" xyz="0 0 0.45"/><parent link="base_link"/><child link="l1"/>
    <axis xyz="0 0 -1"/><limit effort="0" lower="-2.9670" upper="2.9670" velocity="3.1"/>
    <dynamics damping="1"/>
  </joint>
  <link name="l1"/>
  <joint name="a2" type="continuous"><origin xyz="0.15 0.02 0" rpy="0.1 0 0"/><parent link="l1"/><child link="l2"/>
    <axis xyz="0 1 0"/></joint>
  <link name="l2"/>
  <joint name="slide" type="prismatic"><origin xyz="0.59 0 0" rpy="0 1.5708 0"/><parent link="l2"/><child link="l3"/>
    <axis xyz="2 0 1"/><limit effort="1" lower="0" upper="0.25" velocity="1"/></joint>
  <link name="l3"/>
  <joint name="mount" type="fixed"><origin xyz="0.01 0.02 0.03"/><parent link="l3"/><child link="plate"/></joint>
  <link name="plate"/>
  <joint name="a4" type="revolute"><parent link="plate"/><child link="l4"/><axis xyz="1 0 0"/></joint>
  <link name="l4"/>
  <joint name="l4-flange" type="fixed"><origin xyz="0.1 0 0"/><parent link="l4"/><child link="flange"/></joint>
  <link name="flange"/>
  <joint name="to-tool0" type="fixed"><origin rpy="0 1.5707963 0"/><parent link="flange"/><child link="tool0"/></joint>
  <link name="tool0"/>
</robot>
"""


def urdf_pose(q: np.ndarray) -> np.ndarray:
    """base_from_tool0 of OTHER, 4×4, mm: products of its numbers by URDF's rules, R = Rz(yaw) Ry(pitch) Rx(roll)."""

    def origin(xyz, rpy=(0, 0, 0)) -> np.ndarray:
        return place(1000 * np.array(xyz)) @ about("z", rpy[2]) @ about("y", rpy[1]) @ about("x", rpy[0])

    return (
        origin((0, 0, 0.45), (0, 0, 0.3)) @ about("z", -q[0])
        @ origin((0.15, 0.02, 0), (0.1, 0, 0)) @ about("y", q[1])
        @ origin((0.59, 0, 0), (0, 1.5708, 0)) @ place(q[2] * np.array([2, 0, 1]) / np.sqrt(5))
        @ origin((0.01, 0.02, 0.03)) @ about("x", q[3])
        @ origin((0.1, 0, 0)) @ origin((0, 0, 0), (0, 1.5707963, 0))
    )  # fmt: skip


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_file_of_another_program_and_two_arms_that_come_back(tmp_path, convention):
    path = written(tmp_path / "other.urdf", OTHER)
    found = load_urdf(path, convention=convention)
    assert (found.joints, found.from_link, found.to_link) == (("a1", "a2", "slide", "a4"), "base_link", "tool0")
    assert found.notes == ("joint a4 has no limits",)
    assert found.robot.prismatic.tolist() == [False, False, True, False]
    limits = [[-2.967, 2.967], [-np.inf, np.inf], [0, 250], [-np.inf, np.inf]]
    np.testing.assert_allclose(found.robot.limits(), limits, rtol=1e-12)
    q = values(found.robot, 20)
    for pose, each in zip(world_poses(found.robot, q, ""), q, strict=True):
        assert np.abs(pose.matrix() - urdf_pose(each)).max() < 1e-9
    part = load_urdf(path, "l1", "plate", convention)
    assert part.joints == ("a2", "slide")
    robot = two_arms(convention)
    path = written(tmp_path / "a.urdf", robot_urdf(robot))
    require_urdf_written(path, robot)
    found = load_urdf(path, "", ["tool_left", "tool_right"], convention).robot
    assert len(found.rows) == 14
    assert sorted(found.tree.mounts) == [8]
    q = joint_vectors(robot, 5, np.random.default_rng(0))
    for name in ("left", "right"):
        off = world_poses(found, q, f"tool_{name}").difference(world_poses(robot, q, name))
        assert np.abs(off).max() < 1e-9


GRIP = 'child link="hand"/></joint><joint name="j" type="fixed"><parent link="l4"/><child link="grip"/></joint>'


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (("<robot", "<robots"), {}, "not XML"),
        (('type="continuous"', 'type="floating"'), {}, "joint a2 is floating; fixed, revolute, continuous, prismatic"),
        (('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'), {}, "joint a2: its axis has no direction"),
        (('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><axis xyz="0 0 1"/>'), {}, "joint a2: axis 2 times"),
        (('<axis xyz="0 1 0"/>', '<axis vector="0 1 0"/>'), {}, "joint a2: axis has vector, which is not one of"),
        (('rpy="', 'quat="1 0 0 0" rpy="'), {}, "origin has quat, which is not one of URDF's xyz, rpy"),
        (('rpy="0 1.5708 0"', 'rpy="0 90 0"'), {}, "rpy of 90, more than a turn: URDF is in radians"),
        (('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>'), {}, "joint a2: '0 1': finite numbers"),
        (('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="a1"/>'), {}, "joint a2 mimics a1"),
        (('child link="l4"', 'child link="l1"'), {}, "child of two joints"),
        (('lower="-2.9670"', 'lower="3"'), {}, "lower limit 3 is above upper 2.967"),
        (("", ""), {"to_link": "hand"}, "--to-link hand: no such link; there are base_link, base,"),
        (("", ""), {"from_link": "l4", "to_link": "l1"}, "no joints lead from link l4"),
        (("", ""), {"to_link": "base"}, "no joint from base_link to base moves"),
        (('child link="tool0"/></joint>', GRIP), {"from_link": "base_link"}, "give --to-link, one of hand, grip"),
        (('<parent link="l3"/>', '<parent link="l1"/>'), {}, "several links may be the tool; give --to-link, one of"),
        (("</robot>", "<xacro:if/></robot>"), {}, "has macros of xacro; expand it first"),
        (("<!-- expanded by hand -->", '<!DOCTYPE r [<!ENTITY a "b">]>'), {}, "defines entities of XML"),
    ],
)  # fmt: skip
def test_mistakes_are_named(tmp_path, change, options, words):
    path = written(tmp_path / "other.urdf", OTHER.replace(*change, 1))
    with pytest.raises(InputError) as caught:
        load_urdf(path, **options)
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"URDF {path}: ")


TWO_ARMS = """<robot name="cell"><link name="world"/>
{arms}</robot>"""
ARM = """<link name="{arm}_base"/><link name="{arm}_1"/><link name="{arm}_2"/><link name="{arm}_tool"/>
<joint name="{arm}_mount" type="fixed"><origin xyz="{x} 0 0.5" rpy="0 0 {x}"/><parent link="world"/><child
 link="{arm}_base"/></joint>
<joint name="{arm}_a" type="continuous"><parent link="{arm}_base"/><child link="{arm}_1"/><axis xyz="0 0 1"/></joint>
<joint name="{arm}_b" type="continuous"><origin xyz="0.4 0 0.3"/><parent link="{arm}_1"/><child link="{arm}_2"/>
<axis xyz="0 1 0"/></joint>
<joint name="{arm}_end" type="fixed"><origin xyz="0.3 0 0"/><parent link="{arm}_2"/><child link="{arm}_tool"/></joint>
"""


def test_two_arms_that_stand_at_two_places_and_links_in_a_circle_which_are_refused(tmp_path):
    """Each fixed to the world by a joint of its own: the tool of either is where its own mount puts it."""
    arms = "".join(ARM.format(arm=arm, x=x) for arm, x in (("left", 1.0), ("right", -2.0)))
    path = written(tmp_path / "cell.urdf", TWO_ARMS.format(arms=arms))
    robot = load_urdf(path, to_link=["left_tool", "right_tool"]).robot
    for tool, x in (("left_tool", 1.0), ("right_tool", -2.0)):
        (pose,) = world_poses(robot, np.zeros((1, 4)), tool)
        expected = np.array([1000 * x + 700 * np.cos(x), 700 * np.sin(x), 800.0])
        assert pose.translation == pytest.approx(expected, abs=1e-6)
    circle = ARM.format(arm="a", x=0.0).replace('<parent link="world"/>', '<parent link="a_tool"/>')
    path = written(tmp_path / "circle.urdf", TWO_ARMS.format(arms=circle))
    refuses("E-URDF-LINKS … is below itself", load_urdf, path, from_link="a_base")
