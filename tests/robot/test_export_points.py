"""Points for controllers: read by each controller's rules, the arm is where it was told to be."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.io.table import POSE, pose_cells
from stcal.robot.export import FORMS, robot_program
from stcal.robot.kinematics.file import robot_toml
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.model import DHRow, Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made
from stcal.robot.use.compensation import compensate, joint_cells, joint_columns
from stcal.robot.use.targets import read_targets
from tests.outcome import fails_with

PULSES = (1000.0, -1234.5, 800.0, 900.0, 1100.0, 500.0)
NUMBER = r"-?\d+\.\d+"


class Case:
    """Six poses, commanded with the joint values that lead there; the last is out of reach."""

    def __init__(self, folder):
        rng = np.random.default_rng(4)
        self.folder = folder
        self.nominal = replace(mh80(), tools={"": Rigid.exp([0.1, 0.2, -0.3, 10, 20, 150])})
        self.real = made(self.nominal, rng)
        self.q = joint_vectors(self.nominal, 6, rng, 0.7)
        poses = [Rigid(p.rotation, p.translation) for p in forward(self.nominal, self.q)]
        poses[5] = Rigid(poses[5].rotation, [9000, 0, 0])
        rows = [[f"Öse {i}", *pose_cells(pose)] for i, pose in enumerate(poses)]
        self.path = folder / "targets.csv"
        self.path.write_text("\n".join(",".join(row) for row in [["pose", *POSE], *rows]) + "\n")
        (folder / "nominal.toml").write_text(robot_toml(self.nominal))
        (folder / "identified.toml").write_text(robot_toml(self.real))
        self.result = compensate(self.real, read_targets(self.path, self.real), self.nominal)
        self.told = self.result.found.q[:5]
        self.poses = forward(self.nominal, self.told)

    def text(self, form: str, wanted="joints", pulses=None, name="my-points.x") -> str:
        return robot_program(self.result, self.real, form, self.folder / name, wanted, pulses).text


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return Case(tmp_path_factory.mktemp("export"))


def lines(text: str, pattern: str) -> np.ndarray:
    """(m, k) numbers of the lines that match."""
    return np.array([[float(v) for v in each] for each in re.findall(pattern, text)])


def six(*heads: str, between: str = ",", end: str = "") -> str:
    return between.join(f"{head}({NUMBER}){end}" for head in heads)


@pytest.mark.slow
def test_joint_values(case):
    degrees = np.degrees(case.told)
    kuka = lines(case.text("kuka"), r"DECL GLOBAL E6AXIS XP\d+=\{" + six(*(f"A{k} " for k in range(1, 7))) + r"\}")
    abb = lines(case.text("abb"), r"jointtarget p\d+:=\[\[" + six(*[""] * 6) + r"\],\[9E9(?:,9E9){5}\]\];")
    ur = lines(case.text("ur"), r"p\d+ = \[" + six(*[""] * 6, between=", ") + r"\]\n")
    fanuc = lines(
        case.text("fanuc"),
        r"P\[\d+\]\{\n   GP1:\n\tUF : 0, UT : 1,\n\t"
        + six(*(f"J{k} = " for k in range(1, 7)), between=r",\s+", end=" deg")
        + r"\n\};",
    )
    yaskawa = lines(case.text("yaskawa", pulses=PULSES), "C0000[0-4]=" + ",".join([r"(-?\d+)"] * 6) + "\r\n")
    for found in (kuka, abb, fanuc, np.degrees(ur)):
        assert found.shape == (5, 6)
        assert np.abs(found - degrees).max() < 1e-9  # digits printed
    assert np.abs(yaskawa - degrees * PULSES).max() <= 0.5
    assert np.abs(yaskawa).max() > 1e4


def turned(*angles) -> np.ndarray:
    """Rz(third) Ry(second) Rx(first), deg: FANUC's and Yaskawa's manuals."""
    x, y, z = (Rotation.from_rotvec(np.radians(a) * e).as_matrix() for a, e in zip(angles, np.eye(3), strict=True))
    return z @ y @ x


def test_poses_are_the_nominal_robots(case):
    """What the controller must be told so that its own kinematics leads to the compensated joint values."""
    kuka = lines(case.text("kuka", "poses"), r"E6POS XP\d+=\{" + six(*(f"{c} " for c in "XYZABC")) + r"\}")
    abb = lines(
        case.text("abb", "poses"), r"robtarget p\d+:=\[\[" + six(*[""] * 3) + r"\],\[" + six(*[""] * 4) + r"\],"
    )
    ur = lines(case.text("ur", "poses"), r"p\d+ = p\[" + six(*[""] * 6, between=", ") + r"\]")
    pattern = six(*(f"{c} = " for c in "XYZ"), between=r",\s+", end="  mm") + r",\s+"
    fanuc = lines(case.text("fanuc", "poses"), pattern + six(*(f"{c} = " for c in "WPR"), between=r",\s+", end=" deg"))
    yaskawa = lines(case.text("yaskawa"), r"C0000\d=" + six(*[""] * 6) + "\r\n")
    turns = {
        "kuka": ([turned(c, b, a) for a, b, c in kuka[:, 3:]], kuka),
        "abb": (Rotation.from_quat(abb[:, [4, 5, 6, 3]]).as_matrix(), abb),
        "ur": (Rotation.from_rotvec(ur[:, 3:]).as_matrix(), 1000 * ur),
        "fanuc": ([turned(*row) for row in fanuc[:, 3:]], fanuc),
    }
    for rotation, values in turns.values():
        assert np.abs(values[:, :3] - case.poses.translation).max() < 1e-6
        assert np.abs(np.array(rotation) - case.poses.rotation).max() < 1e-9
    assert np.abs(yaskawa[:, :3] - case.poses.translation).max() <= 0.0005001  # three decimals
    assert np.abs(np.array([turned(*row) for row in yaskawa[:, 3:]]) - case.poses.rotation).max() < 3e-6  # four
    commanded = read_targets(case.path, case.real).poses
    assert 0.5 < np.linalg.norm(case.poses.translation - commanded.translation[:5], axis=1).mean() < 20


def test_configuration_of_abb(case):
    quarters = lines(case.text("abb", "poses"), r"\],\[(-?\d),(-?\d),(-?\d),0\],\[9E9")
    assert (quarters == np.floor(np.degrees(case.told[:, [0, 3, 5]]) / 90)).all()
    assert len(np.unique(quarters)) > 2


def test_what_is_said_and_left_out(case):
    made_ = robot_program(case.result, case.real, "kuka", case.folder / "a.dat")
    assert made_.notes[0].endswith("a.dat: 5 points, joints")
    assert made_.notes[1].endswith("a.dat: left out, as they are not reached: line 7")
    assert "; line 3, pose ?se 1\n" in made_.text
    made_.text.encode("ascii")
    notes = " ".join(robot_program(case.result, case.real, "yaskawa", case.folder / "a.jbi").notes)
    assert "poses: joint values are pulses there; give --pulses-per-deg" in notes
    assert "of the tool at 10.000, 20.000, 150.000 mm on the flange" in notes or "on the flange; set ///TOOL" in notes
    assert "DEFDAT my_points PUBLIC" in case.text("kuka")


def test_refusals(case):
    with fails_with("E-OPTION-FORM … --export … abc"):
        case.text("abc")
    with fails_with("E-OPTION-VALUE … --pulses-per-deg … 2 … 6"):
        case.text("yaskawa", pulses=(1.0, 2.0))
    alone = compensate(case.real, read_targets(case.path, case.real))
    with fails_with("E-COMPENSATE-POSES … --nominal"):
        robot_program(alone, case.real, "ur", case.folder / "a", "poses")
    unreached = replace(case.result, found=replace(case.result.found, status=("unreachable",) * 6))
    with fails_with("E-EXPORT-UNREACHED … 6"):
        robot_program(unreached, case.real, "ur", case.folder / "a")


def test_poses_of_two_tools_are_refused(case, tmp_path):
    robot = replace(case.nominal, tools=dict(case.nominal.tools) | {"ball": Rigid()})
    path = tmp_path / "t.csv"
    rows = [[tool, *joint_cells(robot, q)] for tool, q in zip(("", "ball"), case.q, strict=False)]
    path.write_text("\n".join(",".join(row) for row in [["target", *joint_columns(robot)], *rows]) + "\n")
    result = compensate(robot, read_targets(path, robot), robot)
    with fails_with("E-EXPORT-TOOLS … 2 … '', 'ball'"):
        robot_program(result, robot, "kuka", path, "poses")
    assert "line 3, target ball" in robot_program(result, robot, "kuka", path).text


SCARA = Robot(
    "scara",
    "standard",
    (DHRow(325, 0, 300, 0), DHRow(275, np.pi, 0, 0), DHRow(0, 0, 0, 0), DHRow(0, 0, 50, 0)),
    (Joint("revolute", -2.5, 2.5), Joint("revolute", -2.5, 2.5), Joint("prismatic", 0, 200), Joint()),
)


def test_prismatic_joints(tmp_path):
    q = np.array([[0.3, 0.6, 120.5, -0.4], [-0.3, 1.2, 20.25, 0.9]])
    path = tmp_path / "t.csv"
    path.write_text("\n".join(",".join(r) for r in [joint_columns(SCARA), *(joint_cells(SCARA, v) for v in q)]) + "\n")
    result = compensate(SCARA, read_targets(path, SCARA), SCARA)
    shown = np.where(SCARA.prismatic, q, np.degrees(q))
    fanuc = robot_program(result, SCARA, "fanuc", path).text
    assert re.search(r"J3 = 120\.500000000  mm,\n\tJ4 = -22\.918311805 deg\n\};", fanuc)
    abb = lines(robot_program(result, SCARA, "abb", path).text, r"\[\[" + six(*[""] * 6) + r"\]")
    assert np.abs(abb - np.pad(shown, ((0, 0), (0, 2)))).max() < 1e-8
    with fails_with("E-ROBOT-MISMATCH … 4 … 1"):
        robot_program(result, SCARA, "ur", path)
    with fails_with("E-ROBOT-MISMATCH … 1"):
        robot_program(result, SCARA, "yaskawa", path, pulses_per_deg=(1, 1, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("wanted", ["joints", "poses"])
def test_a_file_that_differs_is_not_written(case, form, wanted, monkeypatch):
    """One digit of one point."""
    own = FORMS[form]

    def wrong(points, head):
        text = own.write(points, head)
        *_, last = re.finditer(r"\d+\.\d\d" if wanted == "poses" or form != "yaskawa" else r"(?<=\d,)-?\d+(?=\r)", text)
        return f"{text[: last.start()]}{float(last[0]) + 1.25:.2f}{text[last.end() :]}"

    monkeypatch.setitem(FORMS, form, replace(own, write=wrong))
    with fails_with("E-EXPORT-READ-BACK"):
        case.text(form, wanted, PULSES if wanted == "joints" else None)


@pytest.mark.slow
def test_command_line(case, stcal_robot, tmp_path):
    robots = ("--robot", case.folder / "identified.toml", "--nominal", case.folder / "nominal.toml")
    made_ = ("--export", f"kuka={tmp_path / 'new' / 'a.dat'}", "--export", f"yaskawa={tmp_path / 'b.jbi'}")
    code, out, _ = stcal_robot("compensate", case.path, *robots, *made_, "--pulses-per-deg", ",".join(map(str, PULSES)))
    assert code == 0
    assert f"note: --export kuka={tmp_path / 'new' / 'a.dat'}: 5 points, joints" in out
    assert (tmp_path / "new/a.dat").read_text() == case.text("kuka", name="a.dat")
    assert b"///POSTYPE PULSE\r\n" in (tmp_path / "b.jbi").read_bytes()
    code, out, _ = stcal_robot("compensate", case.path, *robots, *made_[:2], "--export-as", "poses", "--overwrite")
    assert (tmp_path / "new/a.dat").read_text() == case.text("kuka", "poses", name="a.dat")
    for words, told in (
        (("--export", "kuka"), "no file; give kuka=FILE"),
        (("--export", f"ur={case.path}"), "is an input of this command"),
        (("--export", "ur=a", "--pulses-per-deg", "1,x"), "numbers with commas between needed"),
    ):
        code, _, error = stcal_robot("compensate", case.path, *robots, *words)
        assert (code, told in error) == (2, True)
