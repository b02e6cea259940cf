"""A model goes out as the run's report has it, or not at all."""

import json
import shutil

import numpy as np
import pycolmap
import pytest

from stcal.sfm.interop.export_model import export_model
from tests.outcome import fails_with
from tests.shared import own_copy, unsealed_copy


@pytest.fixture(scope="module")
def own_run(small_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit") / "run"
    unsealed_copy(small_run, folder, ignore=shutil.ignore_patterns("cache", "overlays"))
    return folder


@pytest.fixture
def changed(small_run, own_run):
    def change(spoil):
        model = pycolmap.Reconstruction(str(small_run / "colmap/target_model"))
        spoil(model)
        model.write_binary(str(own_run / "colmap/target_model"))
        return own_run

    return change


def move_points(place):
    def spoil(model) -> None:
        for point in model.points3D.values():
            point.xyz = place(point.xyz)

    return spoil


def move_camera(shift):
    """Of image 3, in its own axes."""

    def spoil(model) -> None:
        frame = model.frame(model.image(3).frame_id)
        pose = frame.rig_from_world
        pose.translation = pose.translation + np.array(shift)
        frame.rig_from_world = pose

    return spoil


def move_point(shift):
    def spoil(model) -> None:
        model.point3D(5).xyz = model.point3D(5).xyz + np.array(shift)

    return spoil


def behind(model) -> None:
    """Points and cameras through the origin: the same pixels, from behind."""
    move_points(np.negative)(model)
    for image_id in model.reg_image_ids():
        frame = model.frame(model.image(image_id).frame_id)
        pose = frame.rig_from_world
        pose.translation = -pose.translation
        frame.rig_from_world = pose


def transformed(scale: float, shift):
    return lambda model: model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.array(shift)))


def without_a_point(model) -> None:
    model.delete_point3D(5)


def other_keypoint(model) -> None:
    model.image(2).points2D[3].xy = model.image(2).points2D[3].xy + 0.01


CASES = {
    "mirrored": (move_points(lambda xyz: xyz * [-1, 1, 1]), "E-MODEL-NOT-OF-RUN"),
    "mirrored through the origin": (behind, "E-MODEL-NOT-OF-RUN"),
    "a point by 0.1 mm": (move_point([0.1, 0, 0]), "E-MODEL-NOT-OF-RUN"),
    "a pose by 30 mm": (move_camera([0, 0, 30]), "E-MODEL-NOT-OF-RUN"),
    "all by 5 mm": (transformed(1.0, [5.0, 0, 0]), "E-MODEL-NOT-OF-RUN … 12/IMG_1000.jpg … 5 … report.json"),
    "larger by 1e-6": (transformed(1 + 1e-6, [0.0, 0, 0]), "E-MODEL-NOT-OF-RUN … report.json"),
    "a point gone": (without_a_point, "E-MODEL-NOT-OF-RUN … 12/IMG_1000.jpg … report.json"),
    "a keypoint": (other_keypoint, "E-MODEL-NOT-OF-RUN … 12/IMG_1001.jpg … 3 … 0.002"),
}


@pytest.mark.parametrize("case", CASES)
def test_another_model_than_the_report_s_is_refused(changed, tmp_path, case):
    spoil, message = CASES[case]
    with fails_with(message) as caught:
        export_model(changed(spoil), tmp_path / "model", "colmap-bin")
    assert len(str(caught.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_same_model_written_again_goes_out(changed, tmp_path):
    assert export_model(changed(lambda _: None), tmp_path / "model.nvm", "nvm").images == 8


def test_a_refined_camera_is_that_of_the_report(changed, tmp_path):
    """Not that of cameras.txt, which is as the run was given it."""

    def refined(content):
        content["options"]["refine_camera"] = True

    def longer(content):
        content["camera"]["focal_px"] = [1.001 * f for f in content["camera"]["focal_px"]]
        for row in content["residuals_by_image"]:
            row["max_px"] = 10.0

    def change(name, how):
        content = json.loads((own / name).read_text())
        how(content)
        (own / name).write_text(json.dumps(content))

    def zoomed(model):
        params = model.camera(1).params.copy()
        params[:2] *= 1.001
        model.camera(1).params = params

    own = tmp_path / "run"
    own_copy(changed(zoomed), own)
    change("report.json", longer)
    with fails_with("E-MODEL-NOT-OF-RUN"):
        export_model(own, tmp_path / "model.nvm", "nvm")
    change(".stcal/run.json", refined)
    written = export_model(own, tmp_path / "model.nvm", "nvm")
    assert written.focal_px == pytest.approx(json.loads((own / "report.json").read_text())["camera"]["focal_px"][0])


def test_a_report_of_another_version(changed, tmp_path):
    own = tmp_path / "run"
    own_copy(changed(lambda _: None), own)
    report = json.loads((own / "report.json").read_text())
    del report["scene"]["cameras"]
    (own / "report.json").write_text(json.dumps(report))
    with fails_with("E-RUN-DAMAGED … report.json … scene.cameras: no 'cameras'"):
        export_model(own, tmp_path / "model", "colmap-bin")


@pytest.mark.parametrize("name", ["12/../../x.jpg", "/x.jpg", "C:\\x.jpg", "12/\x7fx.jpg"])
def test_a_name_that_leads_out_of_the_folder(changed, tmp_path, name):
    own = tmp_path / "run"
    own_copy(changed(lambda _: None), own)
    report = json.loads((own / "report.json").read_text())
    report["images"][0]["name"] = name
    (own / "report.json").write_text(json.dumps(report))
    with fails_with("E-RUN-DAMAGED … report.json"):
        export_model(own, tmp_path / "model", "colmap-bin")
