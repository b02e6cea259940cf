"""A run's faces, circles, σ and cameras read back from every form by the programs that take them."""

import base64
import csv
import errno
import importlib
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.poses.programs import read_messages, read_ros1_launch, read_ros2_launch, static_of_joint
from stcal.labels import parse_label
from stcal.sfm.interop.export import FORMS, export_run
from stcal.sfm.interop.export.content import content_of
from stcal.sfm.interop.export.viewers import EDGES
from stcal.sfm.runs.saved import load_run
from tests.outcome import fails_with

AGAIN_MM = 1e-9
"""Doubles in their shortest text, by way of metres and quaternions."""
FLOAT_MM = 1e-4
"""Single precision at a metre: 6e-5 mm."""


@pytest.fixture(scope="module")
def files(small_run, tmp_path_factory):
    """Path by form."""
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


@pytest.mark.slow
def test_ply(files, faces, small_run):
    trimesh = importlib.import_module("trimesh")
    mesh = trimesh.load(files["ply"], process=False)
    lines = files["ply"].read_text(encoding="utf-8").splitlines()
    named = {line.split()[2].rstrip(":"): line.split()[-1] for line in lines if ": centre of " in line}
    assert sorted(named.values()) == sorted(faces["circles"])
    for vertex, label in named.items():
        own = mesh.vertices[int(vertex) : int(vertex) + EDGES + 1]
        np.testing.assert_allclose(own[0], faces["circles"][label], atol=AGAIN_MM)
        reach = np.linalg.norm(own[1:] - own[0], axis=1)
        np.testing.assert_allclose(reach, faces["radius_mm"][label])
        normal = np.array(faces["target_from_face"][parse_label(label).face])[:3, 2]
        seen = np.cross(own[1] - own[0], own[2] - own[0])
        assert np.dot(seen / np.linalg.norm(seen), normal) == pytest.approx(1)
    cameras = [line for line in lines if " projection centre of " in line]
    scene = json.loads((small_run / "report.json").read_text(encoding="utf-8"))["scene"]["cameras"]
    for line, camera in zip(cameras, scene, strict=True):
        vertex = int(line.split()[2].rstrip(":"))
        np.testing.assert_allclose(mesh.vertices[vertex], camera["position_mm"])
        middle = mesh.vertices[vertex + 1 : vertex + 5].mean(axis=0) - mesh.vertices[vertex]
        assert np.dot(middle / np.linalg.norm(middle), camera["axes"][2]) > 0.99  # the way it looks
    assert "nan" not in files["ply"].read_text(encoding="utf-8")


def test_dxf(files, faces):
    ezdxf = importlib.import_module("ezdxf")
    drawing = ezdxf.readfile(files["dxf"])
    assert not drawing.audit().errors
    assert drawing.header["$INSUNITS"] == ezdxf.units.MM
    space = drawing.modelspace()
    seen = set()
    for circle, point in zip(space.query("CIRCLE"), space.query("POINT"), strict=True):
        label = circle.get_xdata("STCAL")[0].value
        centre = circle.ocs().to_wcs(circle.dxf.center)
        np.testing.assert_allclose(centre, faces["circles"][label], atol=AGAIN_MM)
        np.testing.assert_allclose(point.dxf.location, faces["circles"][label], atol=AGAIN_MM)
        assert circle.dxf.radius == faces["radius_mm"][label]
        normal = np.array(faces["target_from_face"][parse_label(label).face])[:3, 2]
        np.testing.assert_allclose(circle.dxf.extrusion, normal, atol=1e-12)
        assert drawing.layers.get(circle.dxf.layer).description == f"face {parse_label(label).face}"
        sigma = [tag.value for tag in circle.get_xdata("STCAL")[2:5]]
        np.testing.assert_allclose(sigma, np.sqrt(np.diag(faces["circle_covariance_mm2"][label])))
        seen.add(label)
    assert seen == set(faces["circles"])


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


@pytest.mark.slow
def test_recording(files, faces, small_run):
    """What the viewer's own program finds in it; its numbers are single."""
    found = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(files["rerun"])],
        capture_output=True,
        encoding="utf-8",
        check=True,
    ).stdout
    own = {}
    for part in found.split("\nChunk(")[1:]:
        path = re.search(r"entity_path: (\S+)", part).group(1)
        own[path] = own.get(path, "") + part
    for face, matrix in faces["target_from_face"].items():
        assert f"/world/box/{face}/circles" in own
        assert f"/world/box/{face}/sigma" in own
        place = re.findall(r"\[\[([-+e.\d]+), ([-+e.\d]+), ([-+e.\d]+)\]\]", own[f"/world/box/{face}"])
        np.testing.assert_allclose(np.array(place, float), [np.array(matrix)[:3, 3]], atol=FLOAT_MM)
    for camera in json.loads((small_run / "report.json").read_text(encoding="utf-8"))["scene"]["cameras"]:
        path = "/world/cameras/" + camera["image"].replace("/", "\\/")
        place = re.findall(r"\[\[([-+e.\d]+), ([-+e.\d]+), ([-+e.\d]+)\]\]", own[path])
        np.testing.assert_allclose(np.array(place, float), [camera["position_mm"]], atol=FLOAT_MM)
        assert "EncodedImage:blob" in own[f"{path}/image"]
        assert "Pinhole:image_from_camera" in own[f"{path}/image"]
        assert f"{path}/image/circles" in own


def test_photographs_that_are_gone_are_said(small_run, tmp_path):
    saved = load_run(small_run)
    object.__setattr__(saved, "images", tmp_path / "gone")
    recording = importlib.import_module("stcal.sfm.interop.export.viewers")
    notes = recording.write_rrd(content_of(saved, "target"), tmp_path / "run.rrd")
    assert notes == [
        f"{len(saved.report['scene']['cameras'])} photographs are no longer in {tmp_path / 'gone'}, "
        f"{saved.report['scene']['cameras'][0]['image']} first: left out"
    ]


def test_a_recording_that_no_disk_takes_leaves_nothing(small_run, tmp_path, monkeypatch):
    """The chunk after the first one does not go in; Rerun's own writer would try for ever."""

    def full(_, path) -> list[str]:
        path.write_bytes(b"RRF2")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("stcal.sfm.interop.export.write_rrd", full)
    with fails_with("E-OUTPUT-UNWRITABLE … box.rrd … No space left"):
        export_run(small_run, tmp_path / "box.rrd")
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_recording_is_written_by_parts_as_far_as_there_is_room(small_run, tmp_path):
    """In a process whose files may not grow: Rerun's own writer said nothing, or tried for ever."""
    code = (
        "import resource, signal, sys; from stcal.sfm.interop.export import export_run; from pathlib import Path\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (200_000,) * 2)\n"
        f"export_run(Path({str(small_run)!r}), Path({str(tmp_path / 'box.rrd')!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert "cannot be written: File too large" in done.stderr.splitlines()[-1]
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("form", "library", "extra"), [("dxf", "ezdxf", "cad"), ("rerun", "rerun", "rerun")])
def test_a_library_that_is_missing_is_named(small_run, tmp_path, monkeypatch, form, library, extra):
    monkeypatch.setitem(sys.modules, library, None)
    path = tmp_path / f"box{FORMS[form].suffix}"
    with pytest.raises(InputError, match=rf"install stereo-target-calibration\[{extra}\]$"):
        export_run(small_run, path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "form", "root", "said"),
    [
        ("box.stl", "", "target", "E-OUTPUT-SUFFIX … .stl … --form"),
        ("box", "", "target", "E-OUTPUT-SUFFIX … missing"),
        ("box.csv", "stl", "target", "E-OPTION-FORM … --form … stl … urdf"),
        ("box.csv", "", "my box", "E-FRAME-NAME … --name … 'my box'"),
        ("box.csv", "", "", "E-FRAME-NAME … --name … ''"),
        ("no/box.csv", "", "target", "E-OUTPUT-FOLDER"),
    ],
)
def test_refused(small_run, tmp_path, name, form, root, said):
    with fails_with(said):
        export_run(small_run, tmp_path / name, form, root)


def test_nothing_is_overwritten(small_run, tmp_path):
    path = tmp_path / "box.urdf"
    path.write_text("mine", encoding="utf-8")
    with fails_with("E-OUTPUT-EXISTS"):
        export_run(small_run, path)
    assert path.read_text(encoding="utf-8") == "mine"


def test_the_form_may_be_told(small_run, tmp_path, faces):
    path = export_run(small_run, tmp_path / "box.txt", "tf2", "box").path
    require_frames(read_messages(path.read_text(encoding="utf-8")), faces)
