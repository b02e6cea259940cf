"""The whole way, from command to command: photographs → target → poses → axes → kinematics → compensation →
verification, and tags → the robot's base by hand-eye and by registration. Only keys join what each command writes."""

import csv
import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from stcal import Camera, Rigid, save_camera
from stcal.cli.main import main, main_sfm
from stcal.io.table import POSE, pose_cells, read_table
from stcal.locate.layout import layout_toml
from stcal.robot import forward, load_robot, robot_toml
from stcal.robot.kinematics.robot_model import mh80
from stcal.synthetic import RenderOptions, SceneOptions, make_scene, write_dataset
from tests.locate.drawn_target import LAYOUT, photo, tilted

pytestmark = pytest.mark.full
JOINTS = [f"q{i}_deg" for i in range(1, 7)]
REST = np.radians([10.0, 20.0, -15.0, 30.0, -50.0, 40.0])
REACH = np.radians([8.0, 7.0, 9.0, 22.0, 22.0, 30.0])
"""Either side of the rest position: as far as the target stays in view of a camera a metre away."""
BUILT_MM, BUILT_RAD = 0.5, 1e-3  # σ by which the arm differs from its drawing


class Cell:
    """A fixed camera before an arm that holds the target; the arm is not quite as drawn. Files are in ``root``."""

    def __init__(self, root, capsys):
        self.root, self.capsys, self.rng = root, capsys, np.random.default_rng(0)
        self.scene = make_scene(SceneOptions(width=1296, height=864, images_per_group=6, seed=3))
        self.group = next(iter(self.scene.groups))
        self.flange_from_target = Rigid.exp([0.3, -0.2, 0.5, 20, -30, 110])
        off = self.rng.normal(0, 1, (6, 4)) * [BUILT_MM, BUILT_MM, BUILT_RAD, BUILT_RAD]
        rows = tuple(
            replace(row, a=row.a + a, d=row.d + d, alpha=row.alpha + alpha, theta=row.theta + theta)
            for row, (a, d, alpha, theta) in zip(mh80().rows, off, strict=True)
        )
        self.real = replace(mh80(), rows=rows)
        seen = self.scene.groups[self.group].camera_from_target[0]
        self.camera_from_base = seen @ (forward(self.real, REST)[0] @ self.flange_from_target).inverse()

    def call(self, words, code=0):
        """Run a command that ends with ``code``; ``{}`` in ``words`` is this folder. What it printed, or said of it."""
        before = sys.argv
        sys.argv = words.format(self.root).split()
        self.capsys.readouterr()
        try:
            with pytest.raises(SystemExit) as ended:
                {"stcal": main, "stcal-sfm": main_sfm}[sys.argv[0]]()
        finally:
            sys.argv = before
        shown = self.capsys.readouterr()
        assert ended.value.code == code, shown.err
        return shown.err if code else shown.out

    def write(self, name, columns, images, values):
        rows = [[image, *each] for image, each in zip(images, values, strict=True)]
        with (self.root / name).open("w", newline="") as file:
            csv.writer(file).writerows([["image", *columns], *rows])

    def photographed(self, name, q):
        """Photographs of the arm at joint values (m, 6), rad, in NAME; names of the images."""
        flange = forward(self.real, q)
        poses = tuple(self.camera_from_base @ each @ self.flange_from_target for each in flange)
        own = replace(self.scene.groups[self.group], camera_from_target=poses)
        options = RenderOptions(seed=int(self.rng.integers(1000)))
        paths = write_dataset(
            self.root / name, replace(self.scene, groups={self.group: own}), options, image_format="png"
        )
        return [f"{path.parent.name}/{path.name}" for path in paths]

    def measured(self, name, q):
        """The same, and the target measured: NAME.csv."""
        names = self.photographed(name, q)
        words = f"stcal-sfm measure {{0}}/{name}/images --camera {{0}}/{name}/cameras.txt --faces {{0}}/run/faces.json"
        words += f" --target {{0}}/{name}/target.toml --board {{0}}/{name}/board.toml --out {{0}}/{name}.csv"
        self.call(words)
        return names

    def about(self, count, share=0.6):
        """Random joint values (count, 6), rad."""
        return REST + share * REACH * self.rng.uniform(-1, 1, (count, 6))


@pytest.fixture
def cell(tmp_path, capsys):
    own = Cell(tmp_path, capsys)
    write_dataset(tmp_path / "set", own.scene, RenderOptions(seed=1), image_format="png")
    own.call(
        "stcal-sfm run {0}/set/images --camera {0}/set/cameras.txt --target {0}/set/target.toml "
        "--board {0}/set/board.toml --out {0}/run"
    )
    return own


def test_photographs_to_a_compensated_arm_and_tags_to_its_base(cell):
    root = cell.root
    (root / "robot.toml").write_text(robot_toml(mh80()))

    sweeps = np.array([REST + REACH[j] * np.eye(6)[j] * t for j in range(6) for t in np.linspace(-1, 1, 7)])
    images = cell.measured("sweeps", sweeps)
    cell.write("sweeps-joints.csv", JOINTS, images, np.degrees(sweeps))
    cell.call(
        "stcal robot axes --a {0}/sweeps.csv --b {0}/sweeps-joints.csv --robot {0}/robot.toml --out {0}/axes.toml"
    )

    q = cell.about(40)
    images = cell.measured("poses", q)
    cell.write("joints.csv", JOINTS, images, np.degrees(q))
    cell.call(
        "stcal robot identify --a {0}/poses.csv --b {0}/joints.csv --robot {0}/axes.toml --out {0}/identified.toml"
    )
    identified = load_robot(root / "identified.toml")

    # The controller has the drawing, and the tool that was found.
    drawn = replace(mh80(), tools=identified.tools)
    (root / "controller.toml").write_text(robot_toml(drawn))
    q = cell.about(12)
    names = [f"{cell.group}/IMG_{1000 + k}.png" for k in range(len(q))]
    cell.write("targets.csv", POSE, names, map(pose_cells, forward(drawn, q)))
    cell.write("branch.csv", JOINTS, names, np.degrees(q))
    cell.call(
        "stcal robot compensate --a {0}/targets.csv --b {0}/branch.csv --key image --robot {0}/identified.toml "
        "--nominal {0}/controller.toml --out {0}/sent.csv"
    )
    sent = read_table(root / "sent.csv", "joint values")
    assert sent.text("image") == names
    assert cell.measured("before", q) == names
    cell.measured("after", np.column_stack([sent.quantity(f"q{i}", {"deg": np.pi / 180}) for i in range(1, 7)]))
    cell.call(
        "stcal robot verify --a {0}/targets.csv --b {0}/before.csv --b {0}/after.csv --key image "
        "--json {0}/verified.json"
    )
    before, after = json.loads((root / "verified.json").read_text())["sets"]
    assert (before["name"], after["name"]) == ("before", "after")
    # The arm is off by part of what it was built off; then by the measurement: σ of up to 20 µm in depth, twice.
    assert before["pairs_rms_mm"] > BUILT_MM / 4
    assert after["pairs_rms_mm"] < 0.03

    joints = read_table(root / "joints.csv", "joints")
    q = np.radians(np.column_stack([joints.numbers(name) for name in JOINTS]))
    flange = forward(replace(identified, tools={"": Rigid()}), q)
    cell.write("robot.csv", POSE, joints.text("image"), map(pose_cells, flange))
    cell.call("stcal handeye --a {0}/robot.csv --b {0}/poses.csv --setup eye-to-hand --out {0}/handeye.json")
    tips = [(each @ identified.tool()).translation for each in flange]
    cell.write("tips.csv", POSE[:3], joints.text("image"), tips)
    cell.call("stcal register --a {0}/poses.csv --b {0}/tips.csv --key image --out {0}/register.json")

    own = cell.scene.camera
    camera = Camera(own.width, own.height, own.focal, own.centre, np.zeros(8))  # the same, its images undistorted
    seen = tilted(25, 700)
    cv2.imwrite(str(root / "scene.png"), photo(seen, camera=camera))
    save_camera(root / "tags-camera.txt", Camera.of(camera, "PINHOLE"))
    (root / "layout.toml").write_text(layout_toml(LAYOUT))
    truth = identified.world_from_base.inverse() @ seen
    for option, file in (("--hand-eye", "handeye.json"), ("--registration", "register.json")):
        cell.call(
            "stcal locate run {0}/scene.png --layout {0}/layout.toml --camera {0}/tags-camera.txt "
            f"{option} {{0}}/{file} --out {{0}}/goals.csv --overwrite"
        )
        table = read_table(root / "goals.csv", "goals")
        goal = table.poses("base_from_goal_")[0]
        turn = Rotation.from_matrix(goal.rotation @ truth.rotation.T).as_rotvec()
        off = np.concatenate([turn, goal.translation - truth.translation])
        covariance = table.pose_covariances("base_from_goal_")
        assert covariance is not None
        mahalanobis = off @ np.linalg.solve(covariance[0], off)
        assert chdtrc(6, mahalanobis) > 1e-3
