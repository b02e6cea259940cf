"""A run whose board is a grid of circles with shifted rows, OpenCV's asymmetric or hexagonal: the lattice's places are
its dots."""

import numpy as np
import pytest

from stcal.boards.board_designs import AsymmetricCirclesDesign, HexagonalCirclesDesign, LatticePart
from stcal.boards.board_file import board_toml, load_board
from stcal.labels import DotLabel
from stcal.sfm import run
from stcal.sfm.report.compare import compare
from stcal.sfm.runs.saved import load_run
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.designs import second_design
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene
from tests.outcome import fails_with

CIRCLES = AsymmetricCirclesDesign(11, 5, 20.0, 6.0, "dark")


def written(folder, text):
    path = folder / "board.toml"
    path.write_text(text)
    return path


def test_the_lattice_holds_the_circles_and_no_others(tmp_path):
    board = load_board(written(tmp_path, board_toml(CIRCLES.lattice())))
    assert isinstance(board, LatticePart)
    assert board.circles == CIRCLES
    xy = board.xy_mm()
    assert len(board.labels()) == len(board.radii_mm()) == len(xy) == 55
    # Neighbours' distances are those of OpenCV's documented layout.
    wanted = np.sort(np.linalg.norm(CIRCLES.xy_mm()[:, None] - CIRCLES.xy_mm(), axis=2).ravel())
    np.testing.assert_allclose(np.sort(np.linalg.norm(xy[:, None] - xy, axis=2).ravel()), wanted, atol=1e-9)
    np.testing.assert_allclose(board.places_mm([DotLabel(*board.cells()[7])])[0, :2], xy[7])


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('type = "boards"\n[[board]]\nfile = "other.toml"\n', "E-BOARD-SINGLE … several boards"),
        (
            "target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: True\n",
            "E-BOARD-RADIUS … radius_mm",
        ),
    ],
)
def test_other_boards_are_refused_with_what_takes_them(tmp_path, text, error):
    with fails_with(error):
        load_board(written(tmp_path, text))


@pytest.mark.slow
@pytest.mark.parametrize("circles", [CIRCLES, HexagonalCirclesDesign(9, 7, 27.0, 6.0, "dark")])
def test_faces_beside_circles_in_shifted_rows_are_right(tmp_path, circles):
    target, _, *rough = second_design()
    options = SceneOptions(seed=5, width=1728, height=1152, images_per_group=4)
    scene = make_scene(options, target, circles.lattice(), *rough)
    data = tmp_path / "data"
    write_dataset(data, scene)
    result = run(data / "images", data / "cameras.txt", tmp_path / "run", data / "target.toml", data / "board.toml")
    for image in result.observations:
        seen = image_circles(scene, image.group, int(image.name.split("_")[-1].split(".")[0]) - 1000)
        truth = dict(zip(seen.labels, seen.centre_px, strict=True))
        labels = [label for label in image.labels if not isinstance(label, DotLabel)]
        dots = [label for label in image.labels if isinstance(label, DotLabel)]
        assert len(dots) > 40
        for label, centre in zip(image.labels, image.centre_px, strict=True):
            if label in labels:
                assert np.linalg.norm(centre - truth[label]) < 1.5
    comparison = compare(tmp_path / "run", data / "truth.json").content()
    assert not comparison["missing"]
    for face_id, row in comparison["faces"].items():
        if face_id != comparison["reference_face"]:
            assert row["normalised_error"] < 2.0, face_id
            assert row["translation_um"] < 40, face_id
    assert load_run(tmp_path / "run").board_design.labels() == circles.lattice().labels()
