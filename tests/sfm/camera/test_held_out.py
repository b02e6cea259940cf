"""Corners that are errors, views held out from a calibration, and the lens model that they choose; cameras from
photographs of other boards: drawn, and measured."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    HexagonalCirclesDesign,
    TagLayout,
)
from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.labels import DotLabel, unseen_lines
from stcal.sfm.camera import calibrate as calibration
from stcal.sfm.camera.calibrate import judged, of_chosen_model
from stcal.sfm.camera.camera_report import calibration_file, calibration_report
from stcal.workflows.board_views import corner_grid
from tests.boards.drawn import aprilgrid_mm, photograph
from tests.levels import sampled
from tests.outcome import fails_with
from tests.sfm.camera.test_intrinsics import BOARD, TRUE, calibrated, views_of, with_a_field


def moved(view, rows, by_px):
    """The view with some of its points elsewhere."""
    centre = view.centre_px.copy()
    centre[rows] += by_px
    return replace(view, centre_px=centre)


def test_gross_errors_are_left_out_and_other_points_stay():
    """Three points of one view at 40 px pull its pose, so that others look wrong, too."""
    views = views_of(np.random.default_rng(4), count=10)
    spoiled = [*views]
    spoiled[3] = moved(views[3], [0, 1, 2], [40.0, -25.0])
    result = calibrated(spoiled)
    assert calibration.residual_rms_px(result) > calibration.MAX_RESIDUAL_PX
    calibration.require_determined(result, spoiled, BOARD)  # a few do not refuse all
    kept, skipped, (warning,) = calibration.without_gross_errors(spoiled, BOARD, result)
    assert skipped == []
    assert kept[3].labels == views[3].labels[3:]
    assert [len(view) for view in kept] == [len(view) - 3 * (i == 3) for i, view in enumerate(views)]
    assert f"3 corners in 1 views are left out, first {views[3].name} {views[3].labels[0]}" in warning
    for rows, columns, said in ((4, 5, []), (5, 5, ["row 4"]), (4, 7, ["column 5, 6"])):
        labels = [DotLabel(row, column) for row in range(4) for column in range(5)]
        assert [note.split(":")[0] for note in unseen_lines(labels, rows, columns)] == [
            f"board {each}" for each in said
        ]


@pytest.mark.slow
def test_a_view_of_gross_errors_is_skipped_and_residuals_held_out_are_those_of_noise():
    """Views without gross errors stay as they are. Held out: σ of the centres times √(1 − 6/2n) for the pose of n dots,
    wider by what 24 views leave of intrinsics and dots: below 3 %; 2900 coordinates scatter by 1.3 %."""
    board, rng = replace(BOARD, rows=5, columns=6), np.random.default_rng(6)
    views = views_of(np.random.default_rng(5), count=6, board=board)
    wrong = np.arange(len(views[3]))[: int(0.6 * len(views[3]))]
    spoiled = [*views[:3], moved(views[3], wrong, rng.uniform(-15, 15, (len(wrong), 2))), *views[4:]]
    kept, skipped, _ = calibration.without_gross_errors(spoiled, board, calibrated(spoiled, board=board))
    assert [each.name for each in skipped] == [views[3].name]
    assert all(a is b for a, b in zip(kept, [*views[:3], *views[4:]], strict=True))
    views = views_of(np.random.default_rng(0), count=24)
    dots = np.mean([len(view) for view in views])
    found = calibration.held_out(calibrated(views), views, BOARD)
    assert 0.96 < found.rms_px() / (0.02 * np.sqrt(1 - 3 / dots)) < 1.07
    assert abs(found.factor - 1) < 0.1
    assert len(found.in_sigma) == 24
    spoiled = [*views[:3], moved(views[3], [5], 4.0), *views[4:]]  # a dot that is wrong does not count
    assert calibration.held_out(calibrated(spoiled), spoiled, BOARD).rms_px() < 1.05 * found.rms_px()


FISHEYE = Camera(2592, 1728, [1100.0, 1098.0], [1301.0, 859.0], [0.02, -0.01, 0, 0, 0.003, 0, 0, 0], True)
RADIAL = Camera(2592, 1728, [2790.0, 2790.0], [1301.0, 859.0], [-0.06, 0, 0, 0, 0, 0, 0, 0])
PINHOLE = Camera(2592, 1728, [2790.0, 2770.0], [1301.0, 859.0], np.zeros(8))


@pytest.mark.full
def test_each_view_is_foretold_without_itself():
    """One that is of another lens is far off, and the others are as before but for the fits that had it."""
    rng = np.random.default_rng(1)
    views = views_of(rng, count=15)
    bent = replace(TRUE, distortion=[0.1, *[0] * 7])
    views[4] = replace(views_of(rng, count=1, camera=bent)[0], name=views[4].name)
    squares = calibration.held_out(calibrated(views), views, BOARD).squares(1.0)
    assert squares.argmax() == 4


def known_of(views, truth):
    return calibrated(views, "OPENCV_FISHEYE" if truth.fisheye else "OPENCV")


@pytest.mark.parametrize(
    ("truth", "wanted"),
    sampled(
        [
            (PINHOLE, {"PINHOLE"}),
            (RADIAL, {"SIMPLE_RADIAL"}),
            (TRUE, {"OPENCV"}),
            # Of this lens THIN_PRISM_FISHEYE has all parameters too; 16 views cannot tell the rest from zero.
            (FISHEYE, {"OPENCV_FISHEYE"}),
        ],
        kept=(),
    ),
    ids=["pinhole", "radial", "opencv", "fisheye"],
)
def test_the_model_of_the_lens_is_chosen(truth, wanted):
    views = views_of(np.random.default_rng(4), count=16, camera=truth)
    chosen, rows = calibration.choose_model(views, BOARD, known_of(views, truth), 2)
    assert chosen in wanted
    assert [row.model for row in rows] == list(calibration.CANDIDATES)
    assert min(row.worse for row in rows if row.worse is not None) == 0
    assert all(row.why for row in rows if row.worse is None)


@pytest.mark.slow
def test_a_model_that_fails_and_too_few_views_and_a_row_too_many_are_said(monkeypatch, result):
    monkeypatch.setattr(calibration, "CANDIDATES", ("PINHOLE", "OPENCV"))
    views = views_of(np.random.default_rng(6), count=8)
    own = calibration.adjust_intrinsics

    def failing(views, board, start, model, *more):
        if model == "PINHOLE":
            raise DegenerateError("E-TEST", "no minimum")
        return own(views, board, start, model, *more)

    monkeypatch.setattr(calibration, "adjust_intrinsics", failing)
    chosen, rows = calibration.choose_model(views, BOARD, known_of(views, TRUE), 1)
    assert chosen == "OPENCV"
    assert (rows[0].why, rows[0].rms_px) == ("no minimum", None)
    longer = replace(BOARD, rows=BOARD.rows + 1)
    warnings = judged(result.intrinsics, result.views, (), 1, True, longer).warnings
    assert any(f"board row {BOARD.rows}: not seen in any image" in warning for warning in warnings)
    monkeypatch.setattr(calibration, "CANDIDATES", ("OPENCV",))
    views, known = list(result.views[:3]), result.intrinsics
    assert calibration.held_out(known, views, BOARD) is None
    with fails_with("E-CALIBRATE-FEW-VIEWS … --model … 3 … 4 … --model"):
        calibration.choose_model(views, BOARD, known, 1)


@pytest.mark.slow
def test_where_no_perspective_lens_fits_the_wide_one_begins_and_where_neither_does_the_first_reason_is_given(
    monkeypatch,
):
    monkeypatch.setattr(calibration, "CANDIDATES", ("OPENCV_FISHEYE",))
    views = views_of(np.random.default_rng(7), count=6, camera=FISHEYE)
    asked = []

    def calibrate(model):
        asked.append(model)
        if model == "OPENCV":
            raise DegenerateError("E-TEST", "camera: dots are 40 px RMS from where OPENCV puts them")
        return judged(known_of(views, FISHEYE), views, (), 1, True, BOARD)

    result = of_chosen_model(calibrate, BOARD, 1)
    assert asked == ["OPENCV", "OPENCV_FISHEYE"]
    assert result.intrinsics.colmap_model == "OPENCV_FISHEYE"
    assert [each.model for each in result.candidates] == ["OPENCV_FISHEYE"]

    def failing(model):
        raise DegenerateError("E-TEST", f"{model} does not fit")

    with pytest.raises(DegenerateError, match="OPENCV does not fit"):
        of_chosen_model(failing, BOARD, 1)


@pytest.fixture(scope="module")
def result():
    views = views_of(np.random.default_rng(8), count=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "CANDIDATES", ("SIMPLE_RADIAL", "OPENCV"))
        return of_chosen_model(lambda model: judged(calibrated(views, model), views, (), 1, True, BOARD), BOARD, 1)


@pytest.mark.slow
def test_text_page_and_file_have_all_models(result):
    summary = calibration_file(result)
    report = calibration_report(result, summary, "images")
    text, page = report.text(), report.page()
    assert re.search(r"views held out, 5 parts: residual RMS 0\.0\d+ px after their poses were fitted", text)
    assert re.search(r"\* +OPENCV +8 +0\.0\d+ +0\.0000", text)
    assert [each.model for each in summary.models] == ["SIMPLE_RADIAL", "OPENCV"]
    assert summary.held_out_rms_px == result.held_out.rms_px()
    assert page.count("data:image/svg+xml") == 3
    for words in ("σ of a projection over the image", "their pixels explain", "Lens models", "SIMPLE_RADIAL"):
        assert words in page


@pytest.mark.slow
def test_a_lens_model_too_small_is_named_and_no_larger_one_for_other_errors():
    bent = Camera(2592, 1728, TRUE.focal, TRUE.centre, [-0.06, 0.045, 0, 0, 0.3, 0, 0, 0])
    views = views_of(np.random.default_rng(9), count=12, camera=bent)
    (warning,) = calibration.of_lens_model(calibrated(views), views, BOARD)
    assert "OPENCV is too small; use --model FULL_OPENCV" in warning
    rng = np.random.default_rng(10)
    for other in (views_of(rng, 12), with_a_field(views_of(rng, 12), rng, 0.04)):
        assert calibration.of_lens_model(calibrated(other), other, BOARD) == []


FOCAL, CENTRE = (1500.0, 1490.0), (610.0, 440.0)


@pytest.mark.slow
def test_photographs_of_a_drawn_board_give_the_camera_with_its_sigma(tmp_path, stcal_sfm):
    """Photographs of 1200×900 px, 4 px a millimetre, of an AprilGrid as Kalibr has it."""
    sheet, origin_mm = aprilgrid_mm(AprilGridDesign(3, 4, 20.0, 0.3), 2)
    middle_mm = (52.0, -36.0, 0.0)
    board = "target_type: 'aprilgrid'\ntagCols: 4\ntagRows: 3\ntagSize: 0.02\ntagSpacing: 0.3\n"
    images = tmp_path / "photographs"
    images.mkdir()
    (tmp_path / "april.yaml").write_text(board, encoding="utf-8")
    rng = np.random.default_rng(5)
    inner = np.array([[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])
    board_from_sheet = np.array([[1, 0, -origin_mm[0]], [0, 1, -origin_mm[1]], [0, 0, 1.0]])
    for i in range(8):
        turn = Rotation.from_euler("xyz", [*rng.uniform(-30, 30, 2), rng.uniform(-30, 30)], degrees=True).as_matrix()
        place = np.array([rng.uniform(-15, 15), rng.uniform(-12, 12), rng.uniform(230, 300)]) - turn @ middle_mm
        image_from_mm = inner @ np.column_stack([turn[:, :2], place])
        cv2.imwrite(str(images / f"{i}.png"), photograph(sheet, 4, image_from_mm @ board_from_sheet))
    files = "--board", tmp_path / "april.yaml", "--out", tmp_path / "cameras.txt"
    code, text, error = stcal_sfm("calibrate-camera", images, *files, "--model", "PINHOLE")
    assert code == 0, error
    assert "8 views of the board" in text
    assert "photographs differ" in text
    found = json.loads((tmp_path / "cameras.json").read_text())["parameters"]
    for name, true in zip(("fx", "fy", "cx", "cy"), (*FOCAL, *CENTRE), strict=True):
        assert 0 < found[name]["sigma"] < 5
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"] + 0.5  # half a pixel of drawing


def test_points_keep_their_places_and_corners_are_dots_without_extent():
    """The label of each point of a view stands where the board has the point."""
    for board in (
        AprilGridDesign(3, 4, 20.0, 0.3),
        AsymmetricCirclesDesign(5, 3, 8.0, 2.0, "dark"),
        AsymmetricCirclesDesign(4, 3, 8.0, None, "dark"),
        HexagonalCirclesDesign(5, 4, 8.0, 2.0, "dark"),
        ChessboardDesign(4, 6, 25.0),
        CharucoDesign(5, 7, 30.0, 20.0, "DICT_4X4_50"),
    ):
        grid = corner_grid(board)
        labels = [DotLabel(*cell) for cell in grid.cells().tolist()]
        places = grid.places_mm(labels)[:, :2]
        np.testing.assert_allclose(places - places[0], board.xy_mm() - board.xy_mm()[0], atol=1e-5)
        assert len(set(labels)) == len(board.xy_mm())
    grid = corner_grid(ChessboardDesign(4, 6, 25.0, 0.02))
    assert (grid.rows, grid.columns, grid.pitch_mm, grid.sigma_mm) == (4, 6, 25.0, 0.02)
    with fails_with("E-BOARD-TYPE … tags"):
        corner_grid(TagLayout((("DICT_4X4_50", 1),), np.zeros((1, 4, 2))))


@pytest.mark.slow
def test_a_measured_charuco_board(shared_data, tmp_path, stcal_sfm):
    """Mako camera, whose makers of the set state fx 1352, fy 1356 px: another calibration, to some per cent."""
    images = shared_data("charuco_handeye/test_set_charuco/images")
    (tmp_path / "board.toml").write_text(
        'type = "charuco"\nrows = 7\ncolumns = 5\nsquare_mm = 36.195\nmarker_mm = 18.256\ndictionary = "DICT_6X6_250"\n'
    )
    code, text, error = stcal_sfm(
        "calibrate-camera", images, "--board", tmp_path / "board.toml", "--out", tmp_path / "cameras.txt"
    )
    assert code == 0, error
    found = json.loads((tmp_path / "cameras.json").read_text())["parameters"]
    assert found["fx"]["value"] == pytest.approx(1352, rel=0.02)
    assert found["fy"]["value"] == pytest.approx(1356, rel=0.02)
    assert "16 views of the board, 384 dots" in text
