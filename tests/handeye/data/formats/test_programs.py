"""Poses in programs of robot controllers and in recordings: rotations are products of turns about single axes."""

from pathlib import Path

import numpy as np
import pytest

from stcal.handeye.data.formats.record import Said
from stcal.handeye.data.robot_poses import read_robot_poses
from tests.outcome import fails_with

ANGLES = [(10.0, 20.0, 30.0), (-40.0, 15.5, 5.0), (80.0, -33.0, 120.0)]
PLACES = [(100.5, -200.0, 300.0), (1e3, 2.25, -3.0), (0.0, 400.0, 555.5)]


def about(axis: str, degrees: float) -> np.ndarray:
    """A turn about an axis of the frame."""
    i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    turn, angle = np.eye(3), np.radians(degrees)
    turn[[i, j, i, j], [i, j, j, i]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return turn


def rows(form: str) -> str:
    return "\n".join(
        form.format(*place, *angles, n=n) for n, (place, angles) in enumerate(zip(PLACES, ANGLES, strict=True), 1)
    )


KUKA = "DECL E6POS XP{n}={{X {0},Y {1},Z {2},A {3},B {4},C {5},S 2,T 10,E1 0.0,E2 0.0}}"
FANUC = (
    "P[{n}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',\n\tX =   {0}  mm,\tY =   {1}  mm,"
    "\tZ =   {2}  mm,\n\tW =   {3} deg,\tP =   {4} deg,\tR =   {5} deg\n}};"
)
EPSON = "Point{n} {{\n\tnNumber={n}\n\trX={0}\n\trY={1}\n\trZ={2}\n\trU={3}\n\trV={4}\n\trW={5}\n\tnHand=1\n}}"
PROGRAMS = {
    "KUKA": (f"&ACCESS RVP\nDEFDAT P()\n;DECL E6POS XP0={{X 9,Y 9,Z 9,A 9,B 9,C 9}}\n{rows(KUKA)}\nENDDAT\n", "ZYX"),
    "KUKA, frames": (rows("{{X {0}, Y {1}, Z {2}, A {3}, B {4}, C {5}}}"), "ZYX"),
    "FANUC": (f"/PROG  A\n/POS\n{rows(FANUC)}\n/END\n", "XYZ fixed"),
    "Doosan": (f"p = []\n{rows('p.append(posx({0}, {1}, {2}, {3}, {4}, {5}))')}\n", "ZYZ"),
    "Epson": (rows(EPSON), "ZYX"),
}
"""A program of each controller, and its axes in the order of its angles."""


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_have_their_controllers_convention(tmp_path, name):
    text, axes = PROGRAMS[name]
    (tmp_path / "program").write_text(text)
    poses = read_robot_poses(tmp_path / "program").base_from_flange
    np.testing.assert_allclose(poses.translation, PLACES, atol=1e-9)
    for found, angles in zip(poses.rotation, ANGLES, strict=True):
        turns = [about(axis, angle) for axis, angle in zip(axes[:3], angles, strict=True)]
        wanted = np.linalg.multi_dot(turns[::-1] if "fixed" in axes else turns)
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_targets_of_abb_have_w_first(tmp_path):
    target = "  CONST robtarget p{n}:=[[{0},{1},{2}],[0.8,0,0,0.6],[0,0,-1,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];"
    (tmp_path / "a.mod").write_text(f"MODULE m\n! robtarget p0:=[[9,9,9],[1,0,0,0]\n{rows(target)}\nENDMODULE\n")
    poses = read_robot_poses(tmp_path / "a.mod").base_from_flange
    np.testing.assert_allclose(poses.translation, PLACES, atol=1e-9)
    np.testing.assert_allclose(poses.rotation[0], about("Z", 2 * np.degrees(np.arccos(0.8))), atol=1e-12)


def test_a_recording_of_rtde_is_read(tmp_path):
    """Metres, and rotation vectors in radians."""
    names = " ".join(f"actual_TCP_pose_{i}" for i in range(6))
    values = "\n".join(f"{i}.008 0.{i}1 -0.2 0.3 0 0 0.5" for i in range(3))
    (tmp_path / "r.csv").write_text(f"timestamp {names}\n{values}\n")
    found = read_robot_poses(tmp_path / "r.csv")
    assert found.images == ("0.008", "1.008", "2.008")
    np.testing.assert_allclose(found.base_from_flange.translation[2], [210, -200, 300])
    np.testing.assert_allclose(found.base_from_flange.rotation[0], about("Z", np.degrees(0.5)), atol=1e-12)


def test_an_index_without_a_name_names_rows(tmp_path):
    (tmp_path / "p.csv").write_text(",x,y,z,qx,qy,qz,qw\n0,0.1,0.2,0.3,0,0,0.6,0.8\n1,0.2,0.2,0.3,0,0,0.6,0.8\n")
    found = read_robot_poses(tmp_path / "p.csv")
    assert found.images == ("0", "1")
    np.testing.assert_allclose(found.base_from_flange.translation[0], [100, 200, 300])


STAMP = "14036365797635558{:02}"
EUROC = ",".join(
    ["#timestamp [ns]", *(f"p_RS_R_{c} [m]" for c in "xyz"), *(f"q_RS_{c} []" for c in "wxyz")]
    + [f"{name}_{c} [m s^-1]" for name in ("v_RS_R", "b_w_RS_S", "b_a_RS_S") for c in "xyz"]
)


def nanoseconds(path: Path, head: str = "", more: str = "") -> Path:
    lines = [f"{STAMP.format(i)},0.1,0.2,0.{i},0.8,0.0,0.0,0.6{more}" for i in range(3)]
    path.write_text("\n".join([*([head] if head else []), *lines]) + "\n")
    return path


def test_the_ground_truth_of_euroc_has_its_poses_first(tmp_path):
    found = read_robot_poses(nanoseconds(tmp_path / "d.csv", EUROC, ",0" * 9)).base_from_flange
    np.testing.assert_allclose(found.translation[1], [100, 200, 100])
    np.testing.assert_allclose(found.rotation[0], about("Z", 2 * np.degrees(np.arccos(0.8))), atol=1e-12)


def test_quaternions_after_nanoseconds_have_an_open_order(tmp_path):
    """VINS writes w first and no header, where TUM's files have seconds and w last."""
    path = nanoseconds(tmp_path / "vio.csv")
    with fails_with("E-ROTATION-AMBIGUOUS … vio.csv … wxyz or xyzw"):
        read_robot_poses(path)
    for order, axis in (("wxyz", "Z"), ("xyzw", "X")):
        said = Said.of_options([f"robot={order}"], [], [], None)
        found = read_robot_poses(path, statements=said).base_from_flange.rotation[0]
        turn = np.arccos(0.8) if axis == "Z" else np.pi / 2 - np.arccos(0.8)
        np.testing.assert_allclose(found, about(axis, 2 * np.degrees(turn)), atol=1e-12)


def test_more_than_a_turn_in_radians_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text("X,Y,Z,Rx,Ry,Rz\n100,200,300,10,20,30\n110,200,300,-10,20,35\n")
    with fails_with("E-ANGLE-UNIT … 35 … rotvec-deg"):
        read_robot_poses(tmp_path / "p.csv", statements=Said.of_options(["robot=ur-rotvec"], [], [], None))
