"""The calibrated target at work: poses of single images, their covariances, common errors, two-fold ambiguity."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from stcal import CameraPrior, Rigid, reference_target
from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.camera import intrinsic_basis
from stcal.io.table import read_table
from stcal.sfm.adjust.faces_file import TargetCircles, read_target
from stcal.sfm.data.patterns import project_circles
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.measurement.measure_images import MeasureOptions, measure_labelled
from stcal.sfm.measurement.pose import MOST, NO_FACE, PoseOptions, common_errors, pose_from_circles, resolved
from stcal.sfm.measurement.pose_report import poses_csv, poses_file
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.levels import FULL
from tests.outcome import fails_with, refuses
from tests.shared import own_copy
from tests.support.image_poses import face_view, faces_view, is_flipped, known_target, pose_error, see, view

NOISE_PX = 0.02


@pytest.fixture(scope="module")
def scene():
    return make_scene(SceneOptions(seed=5, width=2592, height=1728, images_per_group=6))


@pytest.fixture(scope="module")
def known(scene):
    return known_target(scene, NOISE_PX)


def one_view(scene, rng, faces, noise_px, tilt_deg, distance_mm):
    """A random view of faces that it shows nearly as a whole: truth, what was looked at, observations."""
    towards = face_view(scene, faces[0]) if len(faces) == 1 else faces_view(scene, faces)
    while True:
        truth = view(towards, np.radians(rng.uniform(*tilt_deg)), rng.uniform(*distance_mm), rng)
        image = see(scene, truth, faces, noise_px, rng)
        if len(image) >= 8 * len(faces):
            return truth, towards, image


def measured_from(images, *more):
    return measure_labelled([LabelledImage(image, ()) for image in images], *more)


def squared_errors(scene, known, count, faces, noise_px, tilt_deg, distance_mm=(600, 1500)):
    """eᵀC⁻¹e/6 and χ²/dof of the certain poses, the share of the others, and the flipped ones among the certain."""
    rng = np.random.default_rng(len(faces) + int(1000 * noise_px))
    square, fit, flipped = [], [], 0
    for i in range(count):
        truth, towards, image = one_view(scene, rng, faces[i % len(faces)], noise_px, tilt_deg, distance_mm)
        pose = pose_from_circles(image, known.measured(rng), scene.camera)
        if pose.status == "certain":
            error = pose_error(pose.camera_from_target, truth)
            square.append(error @ np.linalg.solve(pose.covariance, error) / 6)
            fit.append(pose.chi2_per_redundancy())
            flipped += is_flipped(pose, truth, towards)
    return np.array(square), np.array(fit), 1 - len(square) / count, flipped


ONE = [(face,) for face in "12345"]


@pytest.mark.full
@pytest.mark.parametrize(("faces", "tilt_deg"), [(ONE, (0, 65)), ([("1", "2")], (0, 20)), ([("1", "4", "5")], (0, 20))])
def test_errors_are_as_predicted(scene, known, faces, tilt_deg):
    """500 images: the mean of χ²(6)/6 has a standard error of 0.026; every image has a target of its own."""
    square, fit, ambiguous, flipped = squared_errors(scene, known, 500, faces, NOISE_PX, tilt_deg)
    assert abs(square.mean() - 1) < 0.1
    assert abs(fit.mean() - 1) < (0.07 if faces is ONE else 0.05)
    assert abs((square < chi2.ppf(0.5, 6) / 6).mean() - 0.5) < 0.1
    assert ambiguous < 0.01
    assert flipped == 0


@pytest.mark.parametrize(
    ("count", "tilt_deg", "distance_mm", "at_most"),
    [
        (30, (0, 65), (600, 4000), 0.75),  # 15 times the noise, far: many, but not all
        pytest.param(400, (0, 10), (1000, 3000), 0.97, marks=FULL),  # frontal, far and noisy: most
    ],
)
def test_no_flipped_pose_is_certain(scene, known, count, tilt_deg, distance_mm, at_most):
    square, _, ambiguous, flipped = squared_errors(scene, known, count, ONE, 0.3, tilt_deg, distance_mm)
    assert flipped == 0
    assert ambiguous < at_most
    assert square.mean() < 1.6  # where a face is frontal the errors are no Gaussian


def test_a_second_face_or_the_previous_image_resolves_it(scene, known):
    """Images are resolved in order of their names. Certain, ambiguous, ambiguous: the second by the first, the third by
    the second; not without asking."""
    rng = np.random.default_rng(4)
    truth = view(face_view(scene, "1"), np.radians(25), 4500, rng)
    alone, both = (see(scene, truth, faces, 0.5, np.random.default_rng(0)) for faces in (("1",), ("1", "2", "4")))
    pose = pose_from_circles(alone, known.truth, scene.camera)
    assert pose.status == "ambiguous"
    second = pose_from_circles(both, known.truth, scene.camera)
    assert second.status == "certain"
    assert len(second.faces) > 1
    moved = Rigid.exp([0.02, -0.01, 0.02, 3, 2, -5])
    previous = Rigid(moved.rotation @ truth.rotation, truth.translation + moved.translation)
    chosen = resolved(pose, previous)
    assert chosen.status == "resolved"
    assert np.linalg.norm(pose_error(chosen.camera_from_target, truth)[:3]) < 0.1
    # The twin's neighbour chooses the twin, and a view from elsewhere none.
    other = next(p for p in (pose, pose.second) if p.camera_from_target is not chosen.camera_from_target)
    assert resolved(pose, other.camera_from_target).camera_from_target is other.camera_from_target
    far = Rigid(Rigid.exp([0, 1.5, 0, 0, 0, 0]).rotation @ truth.rotation, truth.translation)
    assert resolved(pose, far).status == "ambiguous"
    rng = np.random.default_rng(4)
    images = [
        replace(see(scene, truth, ("1", "2", "4") if i == 0 else ("1",), 0.5, rng), name=f"a/{i}", group="a")
        for i in range(3)
    ]
    asked = measured_from(images[::-1], scene.camera, known.truth, MeasureOptions(previous=True))
    known_by = zip(("a/0", "a/1", "a/2"), ("certain", "resolved", "resolved"), strict=True)
    assert [(i.name, i.pose.status) for i in asked.images] == [*known_by]
    for each in asked.images:
        assert np.linalg.norm(pose_error(each.pose.camera_from_target, truth)[:3]) < 0.1
    plain = measured_from(images, scene.camera, known.truth)
    assert [i.pose.status for i in plain.images] == ["certain", "ambiguous", "ambiguous"]
    content = poses_file(plain).content()
    assert content["images"][0]["alternative"] is None
    assert np.shape(content["images"][1]["alternative"]["camera_from_target"]) == (4, 4)
    json.dumps(content, allow_nan=False)


def test_derivatives_of_the_ellipse_centres(scene, known):
    """Against central differences, whose own error is 1e-10 of normalised coordinates here."""
    target = known.truth
    pose = view(face_view(scene, "2"), 0.5, 900, np.random.default_rng(0))

    def images(step=None, xyz=target.xyz):
        moved = Rigid() if step is None else Rigid.exp(step)
        rotation, translation = moved.rotation @ pose.rotation, pose.translation + moved.translation
        return project_circles(xyz, target.normal, target.radius, rotation[None], translation[None])

    exact = images()
    for k, h in enumerate([1e-5] * 3 + [1e-3] * 3):
        step = h * np.eye(6)[k]
        slope = (images(step).centre - images(-step).centre) / (2 * h)
        assert np.abs(slope - exact.by_pose[..., k]).max() < 1e-9
    for k in range(3):
        step = 1e-3 * np.eye(3)[k]
        slope = (images(xyz=target.xyz + step).centre - images(xyz=target.xyz - step).centre) / 2e-3
        assert np.abs(slope - exact.by_circle[..., k]).max() < 1e-9


def test_a_pose_is_exact_names_its_outliers_and_has_the_sigma_factor_of_the_run_or_a_given_one(scene, known):
    """Whatever the order of the circles."""
    truth, _, image = one_view(scene, np.random.default_rng(6), ("4",), 0.0, (30, 40), (800, 900))
    pose = pose_from_circles(image, known.truth, scene.camera)
    error = pose_error(pose.camera_from_target, truth)
    assert np.abs(error[:3]).max() < 1e-9
    assert np.abs(error[3:]).max() < 1e-6
    other_order = image.select(np.random.default_rng(0).permutation(len(image)))
    turned = pose_from_circles(other_order, known.truth, scene.camera)
    assert np.abs(pose_error(turned.camera_from_target, pose.camera_from_target)).max() < 1e-9
    assert turned.labels == pose.labels
    truth, _, image = one_view(scene, np.random.default_rng(8), ("2",), NOISE_PX, (20, 40), (900, 1000))
    centre = image.centre_px.copy()
    centre[3] += [0.8, -0.5]
    pose = pose_from_circles(replace(image, name="a.jpg", centre_px=centre), known.truth, scene.camera)
    assert [(o.image, o.label) for o in pose.outliers] == [("a.jpg", image.labels[3])]
    assert image.labels[3] not in pose.labels
    assert 0.7 < pose.outliers[0].residual_px < 1.5
    error = pose_error(pose.camera_from_target, truth)
    assert error @ np.linalg.solve(pose.covariance, error) < chi2.isf(1e-3, 6)
    _, _, image = one_view(scene, np.random.default_rng(9), ("2",), NOISE_PX, (20, 40), (900, 1000))
    own = known.truth
    twice = TargetCircles(own.labels, own.xyz, own.radius, own.covariance, 2.0)
    given = {"options": PoseOptions(sigma_factor=1.0)}
    parts = [
        pose_from_circles(image, target, scene.camera, **more).parts["image"]
        for target, more in ((own, {}), (twice, {}), (twice, given))
    ]
    assert np.trace(parts[1][3:, 3:]) > 2 * np.trace(parts[0][3:, 3:])
    assert np.allclose(parts[2], parts[0], rtol=1e-9, atol=0)


def test_stated_intrinsics_go_into_the_covariance(scene, known):
    """Cameras drawn from the σ of the file: errors as predicted with it, far beyond without."""
    rng, count = np.random.default_rng(7), 20
    sigma = np.array([1.0, 1.0, 0.7, 0.7, 3e-4, 1e-3, 3e-5, 3e-5])
    prior = CameraPrior(scene.camera.colmap_model, np.diag(sigma**2))
    square, held = [], []
    for i in range(count):
        truth, _, image = one_view(scene, rng, ONE[i % 5], NOISE_PX, (0, 65), (600, 1500))
        away = intrinsic_basis(scene.camera.colmap_model) @ (sigma * rng.standard_normal(8))
        camera = scene.camera.with_parameters(scene.camera.parameters() + away)
        target = known.measured(rng)
        for own, results in ((prior, square), (None, held)):
            pose = pose_from_circles(image, target, camera, prior=own)
            error = pose_error(pose.camera_from_target, truth)
            results.append(error @ np.linalg.solve(pose.covariance, error) / 6)
    assert abs(np.mean(square) - 1) < 0.15 * np.sqrt(200 / count)  # its standard error is 0.04 for 200
    assert np.mean(held) > 3


def test_too_few_circles_wrong_labels_and_other_joints_are_refused(scene, known, tmp_path):
    _, _, image = one_view(scene, np.random.default_rng(11), ("2",), NOISE_PX, (20, 40), (900, 1000))
    for count in (0, 1, 3):
        few = image.select(list(range(count)))
        refuses("E-MEASURE-FEW-CIRCLES … 4", pose_from_circles, few, known.truth, scene.camera)
    with fails_with("E-MEASURE-AMBIGUOUS … not on one line"):  # circles 1, 2, 3 and a lie in line
        pose_from_circles(image.select([image.labels.index(f"2:{c}") for c in "123a"]), known.truth, scene.camera)
    _, _, both = one_view(scene, np.random.default_rng(11), ("1", "2"), NOISE_PX, (20, 30), (900, 1000))
    in_line = [*(both.labels.index(f"2:{c}") for c in "123a"), both.labels.index("1:1")]
    with fails_with("E-MEASURE-AMBIGUOUS … face 2 … 4 circles … not on one line"):  # and not for the one of face 1
        pose_from_circles(both.select(in_line), known.truth, scene.camera)
    refuses("E-LABEL-REPEATED", pose_from_circles, image.select([0, *range(len(image))]), known.truth, scene.camera)
    with fails_with("E-LABEL-UNKNOWN … 9:1"):
        pose_from_circles(replace(image, labels=("9:1", *image.labels[1:])), known.truth, scene.camera)
    mixed = replace(image, labels=image.labels[::-1])
    with pytest.raises((DegenerateError, ConvergenceError), match=r"labels|contradict"):
        pose_from_circles(mixed, known.truth, scene.camera)
    with fails_with("E-COVARIANCE-VALUE … 0"):
        pose_from_circles(replace(image, covariance_px2=0 * image.covariance_px2), known.truth, scene.camera)
    for text, code in (
        ("image,x_mm\na.jpg,1\n", "E-TABLE-COLUMNS-CONFLICT … x_mm"),
        ("image,q1_deg\nb.jpg,1\n", "E-IMAGES-UNMATCHED … a.jpg"),
        ("image,q1_deg\na.jpg,1\na.jpg,2\n", "E-TABLE-ROW-REPEATED … a.jpg"),
    ):
        _, _, image = one_view(scene, np.random.default_rng(9), ("2",), NOISE_PX, (20, 40), (900, 1000))
        result = measured_from([replace(image, name="a.jpg")], scene.camera, known.truth)
        (tmp_path / "joints.csv").write_text(text)
        with fails_with(code):
            poses_csv(result, read_table(tmp_path / "joints.csv", "joints"))


def test_faces_json_holds_the_covariance_of_all_circles_and_one_of_another_target_is_refused(small_run, tmp_path):
    """Its blocks are the 3×3 that are there too; the reference face's origin has no error in its own plane. What an
    older file lacks is said."""
    content = json.loads((small_run / "faces.json").read_text())
    target = read_target(small_run / "faces.json", reference_target())
    assert target.notes == ()
    assert target.sigma_factor == json.loads((small_run / "report.json").read_text())["summary"]["circle_sigma_factor"]
    for label, i in target.place.items():
        block = target.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert np.allclose(block, content["circle_covariance_mm2"][label], rtol=1e-9, atol=1e-18)
    i, j = target.place["1:1"], target.place["2:1"]
    assert np.abs(target.covariance[3 * i : 3 * i + 2]).max() < 1e-12
    across = target.covariance[3 * j : 3 * j + 3, 3 * j + 3 : 3 * j + 6]
    assert np.trace(across) > 1e-7  # neighbours err together

    def older(content):
        del content["circles_joint_covariance_mm2"], content["centre_sigma_factor"]

    target = read_spoilt(small_run, tmp_path, older)
    assert any("covariances between circles" in note for note in target.notes)
    assert any("no centre_sigma_factor" in note for note in target.notes)
    assert np.abs(target.covariance[:3, 3:]).max() == 0 < np.trace(target.covariance)
    for change, message in (
        (other_circle, r"circle 7:1 is not in target"),
        (lambda content: less(content["circles"]["2:7"], -5.0), r"face 2 is 1\.\d+ mm RMS off that of target"),
        (lambda content: content["radius_mm"].update({"2:7": 7.5}), r"circle 2:7 has radius 7\.5 mm, 8 mm in target"),
        (
            lambda content: less(content["circles_joint_covariance_mm2"]["upper_triangle"], 1.0),
            r"circles_joint_covariance_mm2: variance -1\S* of x of 1:",
        ),
    ):
        with pytest.raises(InputError, match=message):
            read_spoilt(small_run, tmp_path, change)


def command(small_dataset, small_run, tmp_path, *more, faces=None):
    images = tmp_path / "images"
    if not images.exists():
        images.mkdir()
        for i in (1000, 1001):
            own_copy(small_dataset / "images" / "12" / f"IMG_{i}.jpg", images)
    arguments = ["measure", images, "--camera", small_dataset / "cameras.txt", "--workers", 1]
    arguments += ["--faces", faces or small_run / "faces.json", "--board", small_dataset / "board.toml"]
    return [*arguments, "--out", tmp_path / "poses.csv", *more]


def test_command_writes_poses_with_joints(stcal_sfm, small_dataset, small_run, tmp_path):
    joints = tmp_path / "joints.csv"
    joints.write_text("image,q1_deg,q2_deg\nIMG_1000.jpg,10.123456789,20\nIMG_7.jpg,1,2\n")
    more = ("--joints", joints, "--json", tmp_path / "poses.json", "--report", tmp_path / "poses.html")
    words = command(small_dataset, small_run, tmp_path, *more)
    cv2.imwrite(str(tmp_path / "images" / "empty.png"), np.full((864, 1296), 90, np.uint8))
    code, out, err = stcal_sfm(*words)
    assert (code, err.count("error")) == (0, 0)
    assert "no face of the target recognised" in out
    assert "not joined: IMG_1001.jpg: measured, but not in" in out
    assert "not joined: IMG_7.jpg: in" in out
    with open(tmp_path / "poses.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["image"] for row in rows] == ["IMG_1000.jpg"]
    assert rows[0]["q1_deg"] == "10.123456789"
    table = read_table(tmp_path / "poses.csv", "poses")
    content = json.loads((tmp_path / "poses.json").read_text())
    assert [each["image"] for each in content["images"]] == ["IMG_1000.jpg", "IMG_1001.jpg"]
    assert np.allclose(table.poses()[0].matrix(), content["images"][0]["camera_from_target"], atol=1e-9)
    assert np.allclose(table.pose_covariances()[0], content["images"][0]["covariance"], rtol=1e-12)
    parts = content["images"][0]["covariance_parts"]
    assert set(parts) == {"image", "target", "intrinsics", "curvature"}
    assert np.allclose(sum(np.array(p) for p in parts.values()), content["images"][0]["covariance"], rtol=1e-9)
    common = table.common_errors(table.pose_covariances())
    shared = common[0] @ common[0].T
    part = sum(np.array(parts[source]) for source in ("target", "intrinsics"))
    assert np.linalg.eigvalsh(part - shared)[0] > -1e-6 * np.linalg.eigvalsh(part)[-1]
    assert np.trace(np.linalg.solve(table.pose_covariances()[0], part - shared)) < 1  # of 6, with FELT per direction
    assert len(list(tmp_path.glob("*.partial"))) == 0
    assert "no face of the target recognised" in (tmp_path / "poses.html").read_text()


def read_spoilt(small_run, tmp_path, change):
    content = json.loads((small_run / "faces.json").read_text())
    change(content)
    (tmp_path / "faces.json").write_text(json.dumps(content))
    return read_target(tmp_path / "faces.json", reference_target())


def less(values, by):
    values[0] -= by


def other_circle(content):
    for key in ("circles", "radius_mm", "circle_covariance_mm2"):
        content[key]["7:1"] = content[key].pop("1:1")
    labels = content["circles_joint_covariance_mm2"]["labels"]
    labels[labels.index("1:1")] = "7:1"


def test_faces_that_are_not_calibrated_and_mistakes_in_the_camera_file_are_said(scene, known):
    rng, truth = np.random.default_rng(0), known.truth
    image = see(scene, view(face_view(scene, "2"), 0.3, 900, rng), ("2",), 0.02, rng)
    keep = [i for i, label in enumerate(truth.labels) if label.face != "2"]
    none = np.zeros((3 * len(keep), 3 * len(keep)))
    part = TargetCircles(tuple(truth.labels[i] for i in keep), truth.xyz[keep], truth.radius[keep], none)
    result = measured_from([image], scene.camera, part)
    assert result.images == ()
    assert result.left_out[0].reason == "face 2 is not calibrated"
    assert measured_from([image.select([])], scene.camera, truth).left_out[0].reason == NO_FACE
    for change, said in (
        (lambda camera: replace(camera, focal=camera.focal / 2, centre=(camera.centre + 0.5) / 2 - 0.5), "half"),
        (lambda camera: replace(camera, centre=camera.centre + 150), "cut out"),
        (lambda camera: replace(camera, focal=1.1 * camera.focal), None),
    ):
        rng = np.random.default_rng(2)
        images = [
            replace(
                see(scene, view(faces_view(scene, ("1", "2")), 0.2, 700, rng), ("1", "2"), NOISE_PX, rng), name=name
            )
            for name in "abc"
        ]
        true = replace(scene.camera, centre=np.array([scene.camera.width - 1, scene.camera.height - 1]) / 2)
        shifted = [replace(i, centre_px=i.centre_px + true.centre - scene.camera.centre) for i in images]
        assert measured_from(shifted, true, known.truth).mistakes == ()
        found = measured_from(shifted, change(true), known.truth).mistakes
        assert found == () if said is None else said in found[0].replace("0.5 times", "half")


def test_strict_ends_as_failed_where_residuals_are_beyond_their_sigma(small_dataset, small_run, stcal_sfm, tmp_path):
    """σ stated a hundred times too small; with their own σ the same images pass. Without a face there is an error."""
    words = command(small_dataset, small_run, tmp_path, "--strict")
    assert stcal_sfm(*words)[0] == 0
    code, _, err = stcal_sfm(*words, "--sigma-factor", 0.01, "--overwrite")
    assert code == 4
    assert "error: --strict: failed: χ² of " in err
    assert (tmp_path / "poses.csv").exists()
    for i, photograph in enumerate((tmp_path / "images").iterdir()):
        photograph.unlink()
        cv2.imwrite(str(photograph.with_suffix(".png")), np.full((864, 1296), 90 + i, np.uint8))
    code, _, err = stcal_sfm(*words, "--overwrite")
    assert code == 3
    assert "no face of the target measured in 2 images" in err


SIGMA = np.array([0.3, 0.3, 0.3, 0.3, 1e-4, 3e-4, 1e-5, 1e-5])  # of intrinsics: fx, fy, cx, cy, k1, k2, p1, p2


def test_what_is_common_is_less_than_the_whole(scene, known):
    """Of a pose whose covariance is smaller than the target's part of it, as a curved likelihood may have it."""
    rng = np.random.default_rng(1)
    images = [see(scene, view(faces_view(scene, ("1", "2")), 0.2, 900, rng), ("1", "2"), NOISE_PX, rng) for _ in "abc"]
    poses = [pose_from_circles(image, known.truth, scene.camera) for image in images]
    poses[1] = replace(poses[1], covariance=0.3 * poses[1].parts["target"] + 1e-3 * poses[1].parts["image"])
    common = common_errors(poses, known.truth, None)
    for pose, own in zip(poses, common, strict=True):
        root = np.linalg.inv(np.linalg.cholesky(pose.covariance))
        left = np.linalg.eigvalsh(np.eye(6) - root @ own @ own.T @ root.T)
        assert left[0] > 5e-4


@pytest.mark.parametrize(
    ("with_camera", "draws"), [(True, 4), *(pytest.param(own, 20, marks=pytest.mark.full) for own in (True, False))]
)
def test_poses_err_together_as_stated(scene, known, with_camera, draws):
    """Without noise in the images all errors are common ones: z of each direction, from the errors of all poses, has
    mean square 1, to 1.4 / √(directions × draws)."""
    rng = np.random.default_rng(0)
    faces = [("1", "2"), ("1", "4"), ("1", "5"), ("2", "3")] * 3
    truths = [view(faces_view(scene, f), np.radians(15), rng.uniform(700, 1200), rng) for f in faces]
    images = [see(scene, truth, f, 0.0, rng) for truth, f in zip(truths, faces, strict=True)]
    images = [replace(i, covariance_px2=np.tile(NOISE_PX**2 * np.eye(2), (len(i), 1, 1))) for i in images]
    prior = CameraPrior(scene.camera.colmap_model, np.diag(SIGMA**2)) if with_camera else None
    exact = [pose_from_circles(image, known.truth, scene.camera, prior=prior) for image in images]
    common = common_errors(exact, known.truth, prior)
    assert 6 <= common.shape[2] <= MOST
    own = np.linalg.cholesky([pose.covariance for pose in exact])
    felt = np.linalg.pinv(np.linalg.solve(own, common).reshape(6 * len(images), -1))
    z = []
    for _ in range(draws):
        target, camera = known.measured(rng), scene.camera
        if with_camera:
            away = intrinsic_basis(scene.camera.colmap_model) @ (SIGMA * rng.standard_normal(8))
            camera = camera.with_parameters(camera.parameters() + away)
        poses = [pose_from_circles(image, target, camera, prior=prior) for image in images]
        error = [pose_error(p.camera_from_target, t) for p, t in zip(poses, truths, strict=True)]
        z.append(felt @ np.linalg.solve(own, np.array(error)[:, :, None]).ravel())
    assert np.mean(np.square(z)) == pytest.approx(1, abs=3 * np.sqrt(2 / np.size(z)))
