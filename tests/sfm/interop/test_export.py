"""A run's faces, circles, σ and cameras read back from every form by the programs that take them."""

import base64
import csv
import importlib
import json
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.labels import parse_label
from stcal.sfm.interop.export import FORMS, export_run
from tests.outcome import fails_with
from tests.support.static_transforms import read_messages, read_ros2_launch, static_of_joint

AGAIN_MM = 1e-9
"""Doubles in their shortest text, by way of metres and quaternions."""
FLOAT_MM = 1e-4
"""Single precision at a metre: 6e-5 mm."""


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


@pytest.mark.parametrize(("form", "read"), [("tf2", read_messages), ("ros2", read_ros2_launch)])
def test_ros(files, faces, form, read):
    require_frames(read(files[form].read_text(encoding="utf-8")), faces)


def test_opencv(files, faces):
    storage = cv2.FileStorage(str(files["opencv"]), cv2.FILE_STORAGE_READ)
    found = storage.getNode("faces")
    assert found.size() == len(faces["target_from_face"])
    for place, (face, matrix) in enumerate(faces["target_from_face"].items()):
        own = found.at(place)
        assert own.getNode("id").string() == face
        np.testing.assert_allclose(own.getNode("target_from_face").mat(), matrix, rtol=0, atol=AGAIN_MM)
        assert own.getNode("target_from_face_covariance").mat().tolist() == faces["target_from_face_covariance"][face]
        labels = [f"{face}:{own.getNode('circles').at(i).string()}" for i in range(own.getNode("circles").size())]
        assert own.getNode("centres").mat().tolist() == [faces["circles"][label] for label in labels]
        assert own.getNode("radii").mat().ravel().tolist() == [faces["radius_mm"][label] for label in labels]
        covariances = own.getNode("centres_covariance").mat().reshape(-1, 3, 3)
        assert covariances.tolist() == [faces["circle_covariance_mm2"][label] for label in labels]


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


@pytest.mark.parametrize("form", ["gltf", "glb"])
def test_gltf(files, faces, form, small_run):
    """Circles and cameras at their places in a general viewer; covariances in the nodes' own data."""
    trimesh = importlib.import_module("trimesh")
    scene = trimesh.load(files[form])
    y_up_from_target = Rotation.from_rotvec([-np.pi / 2, 0, 0]).as_matrix()
    for label, xyz in faces["circles"].items():
        own = parse_label(label)
        world_from_circle, _ = scene.graph[f"box_{own.face}_{own.circle}"]
        np.testing.assert_allclose(1e3 * world_from_circle[:3, 3], y_up_from_target @ xyz, atol=FLOAT_MM)
        turn = y_up_from_target @ np.array(faces["target_from_face"][own.face])[:3, :3]
        np.testing.assert_allclose(world_from_circle[:3, :3], turn, atol=1e-6)
    tree, data = content_of_gltf(files[form])
    assert tree["buffers"][0]["byteLength"] == sum(view["byteLength"] for view in tree["bufferViews"]) == len(data)
    nodes = {node["name"]: node for node in tree["nodes"]}
    (factor,) = {node["extras"]["sigma_drawn_times"] for node in [nodes["box"]]}
    for label, covariance in faces["circle_covariance_mm2"].items():
        own = parse_label(label)
        assert nodes[f"box_{own.face}_{own.circle}"]["extras"]["covariance_mm2"] == covariance
        ball = nodes[f"sigma of {label}, times {factor:g}"]
        turn = Rotation.from_quat(ball["rotation"]).as_matrix()
        face = np.array(faces["target_from_face"][own.face])[:3, :3]
        drawn = face @ turn @ np.diag(1e3 * np.array(ball["scale"]) / factor) ** 2 @ turn.T @ face.T
        np.testing.assert_allclose(drawn, covariance, atol=1e-9 * np.abs(covariance).max() + 1e-18)
    y_up = Rotation.from_quat(nodes["y_up"]["rotation"]).as_matrix()
    np.testing.assert_allclose(y_up, y_up_from_target, atol=1e-12)
    for camera in json.loads((small_run / "report.json").read_text(encoding="utf-8"))["scene"]["cameras"]:
        own = nodes[camera["image"]]
        np.testing.assert_allclose(1e3 * np.array(own["translation"]), camera["position_mm"], atol=AGAIN_MM)
        turn = Rotation.from_quat(own["rotation"]).as_matrix()
        np.testing.assert_allclose(turn.T * [[1], [-1], [-1]], camera["axes"], atol=1e-12)  # it looks along −Z, Y up
    lens = tree["cameras"][0]
    assert lens["perspective"]["yfov"] == pytest.approx(
        2 * np.arctan(lens["extras"]["size_px"][1] / 2 / lens["extras"]["focal_px"][1])
    )


def content_of_gltf(path) -> tuple[dict, bytes]:
    raw = path.read_bytes()
    if path.suffix == ".gltf":
        tree = json.loads(raw)
        return tree, base64.b64decode(tree["buffers"][0]["uri"].partition(",")[2])
    length = int.from_bytes(raw[12:16], "little")
    tree = json.loads(raw[20 : 20 + length])
    return tree, raw[28 + length :]


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
