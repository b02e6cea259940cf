"""A run's faces, circles and σ read back from every form by the programs that take them."""

import csv
import importlib
import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.labels import parse_label
from stcal.sfm.interop.export import FORMS, export_run
from tests.outcome import fails_with
from tests.support.static_transforms import read_messages, read_ros1_launch, read_ros2_launch, static_of_joint

AGAIN_MM = 1e-9
"""Doubles in their shortest text, by way of metres and quaternions."""


@pytest.fixture(scope="module")
def files(small_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    return {name: export_run(small_run, folder / f"box{form.suffix}", name="box").path for name, form in FORMS.items()}


@pytest.fixture(scope="module")
def faces(small_run):
    return json.loads((small_run / "faces.json").read_text(encoding="utf-8"))


def require_frames(statics, faces):
    """The tree gives every face and every circle where ``faces.json`` has them."""
    target_from = {"box": Rigid(np.eye(3), np.zeros(3))}
    for each in statics:
        target_from[each.child] = target_from[each.parent] @ each.pose
    for face, matrix in faces["target_from_face"].items():
        np.testing.assert_allclose(target_from[f"box_{face}"].matrix(), matrix, rtol=0, atol=AGAIN_MM)
    for label, xyz in faces["circles"].items():
        own = parse_label(label)
        np.testing.assert_allclose(target_from[f"box_{own.face}_{own.circle}"].translation, xyz, rtol=0, atol=AGAIN_MM)
    assert len(target_from) == 1 + len(faces["target_from_face"]) + len(faces["circles"])


@pytest.mark.slow
def test_urdf(files, faces):
    robot = ElementTree.parse(files["urdf"]).getroot()
    joints = robot.findall("joint")
    require_frames([static_of_joint(joint) for joint in joints], faces)
    links = {link.attrib["name"] for link in robot.findall("link")}
    assert {part.attrib["link"] for joint in joints for part in joint if part.tag in ("parent", "child")} == links
    radii = sorted(float(e.attrib["radius"]) for e in robot.iter("cylinder"))
    np.testing.assert_allclose(radii, sorted(1e-3 * r for r in faces["radius_mm"].values()))


@pytest.mark.slow
def test_xacro(files, faces, tmp_path):
    """Twice on one robot, by the program itself."""
    xacro = importlib.import_module("xacro")
    calls = "".join(
        f'<xacro:box prefix="{side}_" parent="flange"><origin xyz="0 {y} 1" rpy="0 0 0"/></xacro:box>'
        for side, y in (("left", 1), ("right", -1))
    )
    (tmp_path / "robot.xacro").write_text(
        f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="{files["xacro"]}"/>'
        f'<link name="flange"/>{calls}</robot>',
        encoding="utf-8",
    )
    robot = ElementTree.fromstring(xacro.process_file(str(tmp_path / "robot.xacro")).toxml())
    for side, y in (("left_", 1000.0), ("right_", -1000.0)):
        own = [static_of_joint(j) for j in robot.findall("joint") if j.find("child").attrib["link"].startswith(side)]
        mount, *statics = own
        assert (mount.parent, mount.child, mount.pose.translation.tolist()) == ("flange", f"{side}box", [0, y, 1000])
        for each in statics:
            object.__setattr__(each, "parent", each.parent.removeprefix(side))
            object.__setattr__(each, "child", each.child.removeprefix(side))
        require_frames(statics, faces)


@pytest.mark.parametrize(
    ("form", "read"), [("tf2", read_messages), ("ros2", read_ros2_launch), ("ros1", read_ros1_launch)]
)
def test_ros(files, faces, form, read):
    require_frames(read(files[form].read_text(encoding="utf-8")), faces)


def test_table(files, faces):
    with open(files["csv"], encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        place = [float(row[f"{c}_mm"]) for c in "xyz"]
        matrix = np.array(faces["target_from_face"][row["face"]])
        turn = Rotation.from_quat([float(row[f"q{c}"]) for c in "xyzw"]).as_matrix()
        np.testing.assert_allclose(turn, matrix[:3, :3], atol=1e-12)
        np.testing.assert_allclose([float(row[f"n{c}"]) for c in "xyz"], matrix[:3, 2], atol=1e-12)
        sigma = [float(row[f"sigma_{c}_um"]) for c in "xyz"]
        if row["kind"] == "face":
            np.testing.assert_allclose(place, matrix[:3, 3], atol=AGAIN_MM)
            variance = np.diag(faces["target_from_face_covariance"][row["face"]])
            np.testing.assert_allclose(sigma, 1e3 * np.sqrt(np.maximum(variance[3:], 0)), rtol=1e-3)
            turned = [float(row[f"sigma_r{c}_mdeg"]) for c in "xyz"]
            np.testing.assert_allclose(turned, 1e3 * np.degrees(np.sqrt(np.maximum(variance[:3], 0))), rtol=1e-3)
        else:
            label = f"{row['face']}:{row['circle']}"
            assert place == faces["circles"][label]
            assert float(row["radius_mm"]) == faces["radius_mm"][label]
            variance = np.diag(faces["circle_covariance_mm2"][label])
            np.testing.assert_allclose(sigma, 1e3 * np.sqrt(variance), rtol=1e-3)
    assert [row["kind"] for row in rows].count("circle") == len(faces["circles"])


@pytest.mark.parametrize(
    ("name", "form", "root", "said"),
    [
        ("box.stl", "", "target", "E-OUTPUT-SUFFIX … .stl … --form"),
        ("box", "", "target", "E-OUTPUT-SUFFIX … missing"),
        ("box.csv", "stl", "target", "E-OPTION-FORM … --form … stl … urdf"),
        ("box.csv", "", "my box", "E-FRAME-NAME … --name … 'my box'"),
        ("no/box.csv", "", "target", "E-OUTPUT-FOLDER"),
        ("mine.csv", "", "target", "E-OUTPUT-EXISTS"),
    ],
)
def test_refused(small_run, tmp_path, name, form, root, said):
    (tmp_path / "mine.csv").write_text("mine", encoding="utf-8")
    with fails_with(said):
        export_run(small_run, tmp_path / name, form, root)
    assert (tmp_path / "mine.csv").read_text(encoding="utf-8") == "mine"


def test_the_form_may_be_told(small_run, tmp_path, faces):
    path = export_run(small_run, tmp_path / "box.txt", "tf2", "box").path
    require_frames(read_messages(path.read_text(encoding="utf-8")), faces)
