"""From poses of the target in photographs to joint values: simulated poses, no pixels; with photographs in
``tests/test_chain.py``."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import DegenerateError, InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.files import require_new_folder, save_folder
from stcal.io.images import Skipped
from stcal.io.table import POSE, Table, pose_cells, read_table
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import made
from stcal.sfm.measurement.measure_images import MeasuredImage, MeasureResult
from stcal.sfm.measurement.pose import common_errors, pose_from_circles
from stcal.synthetic.scene import SceneOptions, make_scene
from stcal.workflows import from_photos as work
from stcal.workflows.from_photos import FromPhotos, files_of, story
from tests.outcome import refuses
from tests.shared import write_rows
from tests.support.arms import targets
from tests.support.image_poses import known_target, see

JOINTS = [f"q{i}_deg" for i in range(1, 7)]
REST = np.radians([10.0, 20.0, -15.0, 30.0, -50.0, 40.0])
REACH = np.radians([8.0, 7.0, 9.0, 22.0, 22.0, 30.0])
NOISE_PX = 0.02
SWEEPS = np.array([REST + REACH[j] * np.eye(6)[j] * t for j in range(6) for t in np.linspace(-1, 1, 7)])


class Cell:
    """A camera that stands still before an arm with the target on its flange."""

    def __init__(self, seed=4):
        self.rng = np.random.default_rng(seed)
        self.scene = make_scene(SceneOptions(images_per_group=6, seed=3))
        self.real = made(mh80(), self.rng, 0.5, 1e-3)
        self.flange_from_target = Rigid.exp([0.3, -0.2, 0.5, 20, -30, 110])
        seen = next(iter(self.scene.groups.values())).camera_from_target[0]
        self.camera_from_base = seen @ (forward(self.real, REST)[0] @ self.flange_from_target).inverse()
        self.target = known_target(self.scene, NOISE_PX).measured(self.rng)

    def about(self, count):
        """Random joint values (count, 6), rad."""
        return REST + 0.6 * REACH * self.rng.uniform(-1, 1, (count, 6))

    def poses(self, q) -> Poses:
        """camera_from_target, true."""
        return self.camera_from_base @ (forward(self.real, q) @ self.flange_from_target)

    def measured(self, q) -> MeasureResult:
        """As the camera measures it at joint values (m, 6), rad."""
        images, left_out = [], []
        for i, pose in enumerate(self.poses(q)):
            image = see(self.scene, pose, tuple(self.scene.target_from_face), NOISE_PX, self.rng)
            name = f"a/{i:03d}.png"
            try:
                images.append(MeasuredImage(name, pose_from_circles(image, self.target, self.scene.camera)))
            except DegenerateError as error:
                left_out.append(Skipped(name, str(error)))
        common = common_errors([each.pose for each in images], self.target, None)
        return MeasureResult(tuple(images), tuple(left_out), (), 1.0, True, common)

    def missed(self, result: FromPhotos) -> float:
        """Mean square of where the arm is sent less where it is said to be, over that of the predicted σ."""
        q, robot = result.compensated.found.q, result.identified.robot
        off = self.poses(q).difference(robot.world_from_base @ forward(robot, q))[:, 3:]
        return (off**2).sum(axis=1).mean() / (result.sigma_mm() ** 2).mean()


def joint_table(q, names=None) -> Table:
    names = [f"a/{i:03d}.png" for i in range(len(q))] if names is None else names
    return Table("log.csv", {"image": names} | dict(zip(JOINTS, np.degrees(q).T, strict=True)), range(2, len(q) + 2))


@pytest.fixture(scope="module")
def cell():
    return Cell()


@pytest.fixture(scope="module")
def swept(cell):
    """Sweeps and 30 other poses; the last has no joint values, and one row of the log no photograph."""
    q = np.concatenate([SWEEPS, cell.about(30)])
    names = [*(f"a/{i:03d}.png" for i in range(len(q) - 1)), "a/lost.png"]
    wanted, options = targets(None, cell.about(12)), IdentifyOptions(folds=2, repeats=1)
    return work.from_measured("views", cell.measured(q), joint_table(q, names), mh80(), wanted, options)


@pytest.mark.slow
def test_each_model_errs_less_than_the_one_before_and_its_files_are_read_by_the_next_step(cell, swept, tmp_path):
    drawn, axes, same, held = (figures.rms for figures in swept.errors.values())
    assert drawn > 5 * held  # 0.5 mm and 1 mrad, of which base and tool take up a part
    assert axes < drawn / 2
    assert 0.5 * same < held < 1.5 * same  # 30 parameters of 71 poses: √((426 + 30) / (426 - 30)) is 1.07
    assert len(swept.data) == len(SWEEPS) + 29
    photograph, row = (note for note in swept.notes if "no partner" in note)
    assert photograph.startswith("1 rows")
    assert "a/071.png" in photograph
    assert "a/lost.png" in row
    # targets among the rows are known as these are
    sigma = swept.sigma_mm()
    assert 0.8 < np.median(sigma) / np.median(swept.identified.predicted.here_mm) < 1.25  # 0.97 to 1.06 of 20 arms
    assert cell.missed(swept) < 9
    said = story(swept)
    assert any("axis method" in line and line.startswith("every joint is swept") for line in said)
    assert any(f"{sigma.min():.2g} to {sigma.max():.2g} mm" in line for line in said)
    save_folder(tmp_path / "arm", files_of(swept))
    work.require_files_written(tmp_path / "arm", swept)
    steps = {"poses": "csv", "axes": "toml", "identified": "toml", "compensated": "csv"}
    names = {f"{step}.{kind}" for step, own in steps.items() for kind in (own, "json", "html")}
    assert {path.name for path in (tmp_path / "arm").iterdir()} == names | {"report.html"}
    assert [path.name for path in tmp_path.iterdir()] == ["arm"]
    sent = read_table(tmp_path / "arm/compensated.csv", "joint values")
    q = np.column_stack([sent.quantity(f"q{i}", {"deg": np.pi / 180}) for i in range(1, 7)])
    np.testing.assert_allclose(q, swept.compensated.found.q, atol=1e-10)  # nine decimals of a degree
    np.testing.assert_allclose(sent.numbers("sigma_mm"), sigma, atol=1e-6)


@pytest.mark.full
def test_without_sweeps_the_axis_method_is_left_out_with_its_reason(cell):
    q = cell.about(40)
    found = work.from_measured("views", cell.measured(q), joint_table(q), mh80())
    assert found.axes is None
    assert "joint 1, 2, 3, 4, 5, 6 is never swept" in found.without_axes
    assert any(found.without_axes in line for line in story(found))
    names = {f"{step}.{kind}" for step in ("poses", "identified") for kind in ("json", "html")}
    assert set(files_of(found)) == names | {"poses.csv", "identified.toml", "report.html"}
    assert found.errors["as drawn"].rms > 5 * found.errors["identified, the same rows"].rms


@pytest.fixture(scope="module")
def photographed():
    scene = make_scene(SceneOptions(images_per_group=2))
    return scene, known_target(scene, NOISE_PX).measured(np.random.default_rng(1))


@pytest.fixture
def given(tmp_path, monkeypatch, photographed):
    """Inputs; measuring would fail the test."""
    scene, target = photographed
    (tmp_path / "views/a").mkdir(parents=True)
    (tmp_path / "empty").mkdir()
    for i in range(8):
        (tmp_path / f"views/a/{i:03d}.png").write_bytes(b"")

    def call(header, rows, robot=None, key="image", images="views", targets=None):
        log, arm = write_rows(tmp_path / "log.csv", header, rows), mh80() if robot is None else robot
        work.robot_from_photos(tmp_path / images, scene.camera, target, scene.target, log, arm, targets, key=key)

    def unwanted(*_):
        raise AssertionError("measured")

    monkeypatch.setattr(work, "measure", unwanted)
    return call


def rows_of(names=None):
    names = [f"a/{i:03d}.png" for i in range(8)] if names is None else names
    return [[name, *map(float, range(i, i + 6))] for i, name in enumerate(names)]


@pytest.mark.parametrize("key", ["image", "photo"])
def test_the_inputs_of_these_tests_are_taken(given, key):
    with pytest.raises(AssertionError, match="measured"):
        given([key, *JOINTS], rows_of(), key=key)


def with_joints(*chosen) -> Robot:
    """The example with joints of these numbers."""
    nominal = mh80()
    joints, rows = ([each[i] for i in chosen] for each in (nominal.joints, nominal.rows))
    return replace(nominal, joints=tuple(joints), rows=tuple(rows), coupling=np.eye(len(chosen)))


HEAD, NAMED = ["image", *JOINTS], rows_of()
GRIPPER = Table("targets.csv", {"target": ["gripper"]} | dict.fromkeys(JOINTS, np.zeros(1)), [2])
WITH_GRIPPER = {"robot": replace(mh80(), tools={"": Rigid(), "gripper": Rigid()}), "targets": GRIPPER}
SEVEN = "E-TABLE-COLUMN-MISSING … log.csv … no such column … q7_rad or q7_deg"


@pytest.mark.parametrize(
    ("head", "rows", "options", "error"),
    [
        (HEAD, NAMED, {"images": "empty"}, "E-IMAGES-NONE … jpg"),
        (HEAD, rows_of(["b/0.png", "b/1.png"]), {}, "E-TABLES-UNMATCHED … image … a/000.png … b/0.png"),
        (HEAD, NAMED, {"key": "photo"}, "E-TABLE-COLUMN-MISSING … log.csv … photo … --key"),
        (HEAD, rows_of(["a/000.png"] * 2), {}, "E-TABLE-ROW-REPEATED … 3 … image … a/000.png … 2"),
        (HEAD, NAMED, {"robot": with_joints(*range(5))}, "E-ROBOT-MISMATCH … log.csv … 6 … MH80 … 5"),
        (HEAD, NAMED, {"robot": with_joints(*range(6), 0)}, SEVEN),
        (HEAD, NAMED, WITH_GRIPPER, "E-ROBOT-NO-TOOL … targets.csv … 2 … 'gripper' … MH80 … ''"),
        ([*HEAD, *POSE], [[*row, *pose_cells(Rigid())] for row in NAMED], {}, "E-TABLES-BOTH … x_mm"),
    ],
)
def test_what_is_refused(given, head, rows, options, error):
    refuses(error, given, head, rows, **options)


def test_joint_values_by_another_column_and_a_place_that_cannot_be_filled(tmp_path):
    """A column ``image`` beside the one of ``--key`` means something else."""
    rows = [[f"a/{i}.png", f"other-{i}", *range(6)] for i in range(3)]
    log = write_rows(tmp_path / "log.csv", ["photo", "image", *JOINTS], rows)
    found = work.read_joints(log, "photo", ["a/1.png", "a/2.png"], mh80())
    assert found.text("image") == ["a/0.png", "a/1.png", "a/2.png"]
    assert "photo" not in found
    for name in ("views/a/1.png", "full/identified.toml", "file.toml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    for place in ("views", "views/a/new", "full", "file.toml", "file.toml/new"):
        with pytest.raises(InputError, match="give another place"):
            require_new_folder(tmp_path / place, tmp_path / "views")
    require_new_folder(tmp_path / "new/deep", tmp_path / "views")
    with pytest.raises((InputError, OSError)):
        save_folder(tmp_path / "arm", {"poses.csv": "a", "n" * 300: "too long a name"})
    assert sorted(tmp_path.rglob("*")) == before
