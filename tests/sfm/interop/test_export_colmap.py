"""Databases and models for other versions of COLMAP and other programs. Only native COLMAP 3.8 and pycolmap 4.2 run
here. Models are read back by COLMAP. A run's faces, circles and σ are read back from every form by the programs that
take them."""

import csv
import hashlib
import importlib
import json
import re
import shutil
import sqlite3
import subprocess
import xml.etree.ElementTree as ElementTree
from contextlib import closing
from importlib import import_module

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.labels import parse_label
from stcal.sfm.interop.export import FORMS, export_run
from stcal.sfm.interop.export_colmap import export_database, export_model
from stcal.sfm.mapping.incremental import pipeline_options
from tests.outcome import fails_with, refuses
from tests.shared import own_copy, unsealed_copy
from tests.support.static_transforms import read_messages, read_ros2_launch, static_of_joint

export = import_module("stcal.sfm.interop.export_colmap")


def read_only(path):
    return closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True))


def described(path) -> list[str]:
    """A database in SQLite's words: columns, keys, indices and conditions by table, and the stamp."""
    with read_only(path) as database:
        lines = []
        tables = "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name <> 'sqlite_sequence' ORDER BY name"
        for table, sql in database.execute(tables).fetchall():
            facts = [("column", *row) for row in database.execute(f"PRAGMA table_info({table})")]
            facts += sorted(("key", *row[2:]) for row in database.execute(f"PRAGMA foreign_key_list({table})"))
            for _, index, *kind in sorted(database.execute(f"PRAGMA index_list({table})").fetchall(), key=str):
                facts.append(("index", index, *kind, *database.execute(f"PRAGMA index_info({index})").fetchall()))
            facts += [("check", *re.findall(r"CHECK *\((.*?)\)", sql)), ("counts up", "AUTOINCREMENT" in sql)]
            lines += [f"{table}: {fact}" for fact in facts]
        (stamp,) = database.execute("PRAGMA user_version").fetchone()
    return [*sorted(lines), f"user_version {stamp}"]


def rows_of(path, table, columns) -> list[tuple]:
    """Rows in stored order, with the type of every value."""
    kinds = ", ".join(f"typeof({column})" for column in columns)
    with read_only(path) as database:
        return database.execute(f"SELECT {', '.join(columns)}, {kinds} FROM {table} ORDER BY rowid").fetchall()


def columns_of(path) -> dict[str, list[str]]:
    with read_only(path) as database:
        names = [n for (n,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()]
        return {n: [row[1] for row in database.execute(f"PRAGMA table_info({n})")] for n in names if "sqlite" not in n}


def state_of(folder) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}


@pytest.fixture
def colmap(monkeypatch):
    """The native program: what it says when it is called with arguments."""
    if shutil.which("colmap") is None:
        pytest.skip("native colmap is not on PATH")
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")

    def call(*arguments) -> str:
        done = subprocess.run(["colmap", *map(str, arguments)], capture_output=True, text=True, check=True)
        return done.stdout + done.stderr

    return call


@pytest.fixture(scope="module")
def database(small_run, tmp_path_factory):
    """Path of a copy of the run's database; the run's own one stays as it is."""
    path, before = tmp_path_factory.mktemp("databases") / "copy.db", state_of(small_run / "colmap")
    written = export_database(small_run, path, "3.13")
    assert written.text.startswith("for COLMAP 3.13: 8 images, 28 pairs, camera model OPENCV\n")
    assert state_of(small_run / "colmap") == before
    assert list(path.parent.iterdir()) == [path]
    return path


def test_the_form_is_what_the_oldest_program_itself_makes(database, tmp_path, colmap):
    """Against an empty database of native COLMAP 3.8, made here and now."""
    if not colmap("help").startswith("COLMAP 3.8"):
        pytest.skip("native colmap is not 3.8")
    colmap("database_creator", "--database_path", tmp_path / "empty.db")
    assert described(database) == described(tmp_path / "empty.db")


def test_everything_is_kept_and_pycolmap_makes_the_same_model(database, small_run, tmp_path):
    """Every row and value of the run's own database, its type and its place. A newer program brings the older form to
    its own, and finds exactly the same numbers in it."""
    own = small_run / "colmap/database.db"
    ours = columns_of(own)
    for table, columns in columns_of(database).items():
        shared = [column for column in columns if column in ours[table]]
        assert rows_of(database, table, shared) == rows_of(own, table, shared)
        for column in set(columns) - {*ours[table]}:
            assert {row[0] for row in rows_of(database, table, [column])} <= {None}
    assert len(rows_of(database, "keypoints", ["data"])) == 8
    assert database.read_bytes()[18:20] == b"\1\1"  # rollback journal: one file is all of it
    with read_only(database) as opened:
        assert opened.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert opened.execute("PRAGMA foreign_key_check").fetchall() == []
    names, pair = first_group(small_run)
    ours = points_by_track(mapped(own, tmp_path / "ours", names, pair))
    assert len(ours) >= 80
    model = mapped(database, tmp_path / "theirs", names, pair)
    assert model.num_reg_images() == len(names)
    theirs = points_by_track(model)
    assert theirs.keys() == ours.keys()
    assert all(np.array_equal(ours[track], theirs[track]) for track in ours)


def first_group(run) -> tuple[list[str], tuple[int, int]]:
    """Names of the first group's images, and the ids of its initial pair."""
    pair = json.loads((run / "report.json").read_text())["groups"][0]["pairs"][0]
    with read_only(run / "colmap/database.db") as opened:
        ids = {name: i for i, name in opened.execute("SELECT image_id, name FROM images")}
    group = pair["first"].split("/")[0]
    return [name for name in ids if name.startswith(f"{group}/")], (ids[pair["first"]], ids[pair["second"]])


def mapped(database, folder, names, pair) -> pycolmap.Reconstruction:
    folder.mkdir()
    own = own_copy(database, folder / "database.db")  # pycolmap changes what it opens
    models = pycolmap.incremental_mapping(str(own), str(folder), str(folder), pipeline_options(names, pair))
    assert len(models) == 1
    return models[0]


def points_by_track(model) -> dict[tuple, np.ndarray]:
    return {
        tuple(sorted((element.image_id, element.point2D_idx) for element in point.track.elements)): point.xyz
        for point in model.points3D.values()
    }


def test_a_refused_export_writes_and_overwrites_nothing_nor_a_file_that_appears_meanwhile(saved, tmp_path, monkeypatch):
    (tmp_path / "mine.db").write_text("mine")
    (tmp_path / "link.db").symlink_to(tmp_path / "nowhere")
    before = state_of(tmp_path)
    for schema, out, error in (
        ("3.7", "out.db", "E-OPTION-VALUE … 3.7 … 3.8, 3.9, 3.10, 3.11, 3.12, 3.13, 4.0, 4.1, 4.2"),
        ("3.8", "none/out.db", "E-OUTPUT-FOLDER … out.db … /none"),
        ("3.8", "mine.db", "E-OUTPUT-EXISTS … mine.db"),
        ("3.8", "link.db", "E-OUTPUT-EXISTS … link.db"),
    ):
        refuses(error, export_database, saved, tmp_path / out, schema)
    assert state_of(tmp_path) == before
    place = tmp_path / "out.db"
    monkeypatch.setattr(export, "write_copy", lambda run, made: made.touch() or place.write_text("theirs"))
    refuses("E-OUTPUT-EXISTS", export_database, saved, place, "3.8")
    assert state_of(tmp_path) == before | {"out.db": hashlib.sha256(b"theirs").hexdigest()}


AGAIN_PX = 5e-5
"""The eccentricity, settled group by group in ``labels.csv``, is computed again in the joint adjustment: nanometres."""
FORMATS = ("colmap-bin", "colmap-txt")


@pytest.fixture(scope="module")
def exported(small_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    paths = {kind: folder / f"model.{kind}" for kind in FORMATS}
    for kind, path in paths.items():
        export_model(small_run, path, kind)
    return paths


@pytest.fixture(scope="module")
def known(small_run):
    """``faces.json``, and ``report.json``'s scene: camera_from_target (R, t) by image."""
    faces = json.loads((small_run / "faces.json").read_text(encoding="utf-8"))
    scene = json.loads((small_run / "report.json").read_text(encoding="utf-8"))["scene"]
    poses = {}
    for camera in scene["cameras"]:
        rotation = np.array(camera["axes"])
        poses[camera["image"]] = rotation, -rotation @ np.array(camera["position_mm"])
    return faces, scene, poses


@pytest.fixture
def own(small_run, tmp_path):
    return unsealed_copy(small_run, tmp_path / "run")


def labels_of(path) -> list[dict]:
    with open(path / "labels.csv", encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def xyz_of(row: dict) -> np.ndarray:
    return np.array([float(row[f"{axis}_mm"]) for axis in "xyz"])


@pytest.mark.parametrize("kind", ["colmap-bin", "colmap-txt"])
def test_colmap_has_the_runs_circles_poses_and_keypoints(exported, known, small_run, kind):
    faces, scene, poses = known
    place = {(row["image"], int(row["keypoint"])): row for row in labels_of(small_run)}
    read = pycolmap.Reconstruction(str(exported[kind]))
    rows = labels_of(exported[kind])
    assert {int(row["point"]) for row in rows} == set(read.point3D_ids())
    for row in rows:
        xyz = read.point3D(int(row["point"])).xyz
        assert np.abs(xyz - xyz_of(row)).max() < 1e-9
        if row["label"] in faces["circles"]:
            assert np.abs(xyz - faces["circles"][row["label"]]).max() < 1e-9
    assert {row["label"] for row in rows if not row["label"].startswith("board")} == set(faces["circles"])
    for group, dots in scene["boards"].items():
        own = [xyz_of(row) for row in rows if row["group"] == group and row["label"].startswith("board")]
        assert np.abs(np.array(own) - dots).max() < 1e-9
    images = {read.image(i).name: read.image(i) for i in read.reg_image_ids()}
    assert images.keys() == poses.keys()
    for name, (rotation, translation) in poses.items():
        pose = images[name].cam_from_world()
        assert np.abs(pose.rotation.matrix() - rotation).max() < 1e-9
        assert np.abs(pose.translation - translation).max() < 1e-9
        for k, point in enumerate(images[name].points2D):
            own = [float(place[name, k][f"corrected_{axis}_px"]) for axis in "xy"]  # as OpenCV has pixels
            assert np.abs(point.xy - 0.5 - own).max() < AGAIN_PX


@pytest.mark.parametrize("kind", ["colmap-bin", "colmap-txt"])
def test_native_colmap_reads_it(exported, kind, tmp_path, colmap):
    """Another version than pycolmap's, 3.8 for one, which knows no rigs and frames and passes over their files."""
    ours = pycolmap.Reconstruction(str(exported[kind]))
    said = colmap("model_analyzer", "--path", exported[kind])
    number = {key: float(re.search(rf"{key}: ([\d.]+)", said)[1]) for key in ("Registered images", "Points", "error")}
    assert number["Registered images"] == ours.num_reg_images()
    assert number["Points"] == ours.num_points3D()
    assert number["error"] == pytest.approx(ours.compute_mean_reprojection_error(), abs=2e-6)
    colmap("model_converter", "--input_path", exported[kind], "--output_path", tmp_path, "--output_type", "TXT")
    for line in (tmp_path / "points3D.txt").read_text(encoding="ascii").splitlines():
        if not line.startswith("#"):
            point_id, *xyz = line.split()[:4]
            assert np.abs(np.array(xyz, float) - ours.point3D(int(point_id)).xyz).max() < 1e-9


def test_a_model_that_was_changed_is_refused(small_run, tmp_path):
    own = own_copy(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("cache", "overlays"))
    model = pycolmap.Reconstruction(str(own / "colmap/target_model"))
    model.point3D(5).xyz = model.point3D(5).xyz * [1, 1, 1 + 1e-9]
    model.write_binary(str(own / "colmap/target_model"))
    with fails_with("E-RUN-CHANGED … points3D.bin"):
        export_model(own, tmp_path / "model", "colmap-bin")
    assert not (tmp_path / "model").exists()


def test_labels_carry_group_and_sigma_but_those_of_a_chained_run(exported, known, own, tmp_path):
    rows = {(row["group"], row["label"]): row for row in labels_of(exported["colmap-txt"])}
    faces = known[0]
    assert {group for group, label in rows if label.startswith("board:")} == {"12", "14"}
    assert {group for group, label in rows if label.startswith("1:")} == {""}  # both groups have it in common
    assert {group for group, label in rows if label.startswith("2:")} == {"12"}
    for (_, label), row in rows.items():
        sigma = [row[f"sigma_{axis}_um"] for axis in "xyz"]
        if label.startswith("board:"):
            assert sigma == ["", "", ""]
        else:
            covariance = np.array(faces["circle_covariance_mm2"][label])
            np.testing.assert_allclose(np.array(sigma, float) ** 2, 1e6 * np.diag(covariance), atol=0.01, rtol=0.01)
    faces = json.loads((own / "faces.json").read_text(encoding="utf-8"))
    del faces["circle_covariance_mm2"]
    (own / "faces.json").write_text(json.dumps(faces), encoding="utf-8")
    export_model(own, tmp_path / "model", "colmap-bin")
    assert {row[f"sigma_{axis}_um"] for row in labels_of(tmp_path / "model") for axis in "xyz"} == {""}


def test_errors(own, small_run, tmp_path):
    def refused(error, run, kind="colmap-bin"):
        refuses(error, export_model, run, out, kind)
        assert not out.exists()

    out = tmp_path / "a file" / "m"
    (tmp_path / "a file").write_text("mine", encoding="utf-8")
    refused(f"E-OUTPUT-FOLDER … {tmp_path / 'a file'}", small_run)
    (tmp_path / "a file").unlink()
    out.parent.mkdir()
    refused("E-OPTION-FORM … obj … colmap-bin", small_run, "obj")
    for made in (out.touch, out.mkdir):
        made()
        (out / "mine").touch() if out.is_dir() else None
        refuses("E-OUTPUT-EXISTS … m", export_model, small_run, out, "colmap-bin")
        shutil.rmtree(out) if out.is_dir() else out.unlink()
    refused("E-RUN-FOLDER", tmp_path)
    model = own / "colmap/target_model"
    labels = (own / "labels.csv").read_text(encoding="utf-8")
    (own / "labels.csv").write_text(
        labels.replace(",2:1,", ",x,", 1).replace(",2:2,", ",2:1,", 1).replace(",x,", ",2:2,"), encoding="utf-8"
    )  # of the first two rows
    refused("E-MODEL-NOT-OF-RUN … 2 labels, 1 needed", own)
    (own / "labels.csv").write_text(labels, encoding="utf-8")
    other = pycolmap.Reconstruction(str(model))
    other.image(1).name = "12/other.jpg"
    other.write_binary(str(model))
    refused("E-MODEL-NOT-OF-RUN … 12/other.jpg … labels.csv", own)
    points = (model / "points3D.bin").read_bytes()
    (model / "points3D.bin").write_bytes(points[: len(points) // 2])
    for kind in FORMATS:
        refused("E-MODEL-UNREADABLE", own, kind)
    shutil.rmtree(model)
    refused("E-RUN-VERSION … colmap/target_model", own)
    assert list(out.parent.iterdir()) == []


AGAIN_MM = 1e-9
"""Doubles in their shortest text, by way of metres and quaternions."""
FLOAT_MM = 1e-4
"""Single precision at a metre: 6e-5 mm."""


@pytest.fixture(scope="module")
def files(small_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    made = {name: export_run(small_run, folder / f"box{form.suffix}", name="box").path for name, form in FORMS.items()}
    return made | {"told": export_run(small_run, folder / "box.txt", "tf2", "box").path}


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
    ("form", "read"), [("tf2", read_messages), ("told", read_messages), ("ros2", read_ros2_launch)]
)
def test_ros(files, faces, form, read):
    require_frames(read(files[form].read_text(encoding="utf-8")), faces)


def test_opencv_and_table(files, faces):
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
    refuses(said, export_run, small_run, tmp_path / name, form, root)
    assert (tmp_path / "mine.csv").read_text(encoding="utf-8") == "mine"
