"""What ``compare`` and ``measure`` take of a ``faces.json``: no other format, no other unit, no matrix that is none."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from stcal import Rigid, reference_target
from stcal.errors import InputError, InputNote
from stcal.io.table import COVARIANCE as COLUMNS
from stcal.io.table import POSE, pose_cells
from stcal.sfm.adjust.faces_file import read_target
from stcal.sfm.report.compare import compare, compare_poses, comparison_table, poses_table
from stcal.synthetic.dataset import TruthFile
from tests.outcome import fails_with

COVARIANCE = "target_from_face_covariance"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda content: content.update(unit="m"), r"unit: 'm': input should be 'mm'"),
        (lambda content: content.update(format="stcal faces 2"), r"format: 'stcal faces 2': .*'stcal faces 1'"),
        (lambda content: content[COVARIANCE]["2"].pop(), rf"{COVARIANCE}\.2: 5×6, 6×6 needed; give"),
        (lambda content: content[COVARIANCE].update({"2": (-np.eye(6)).tolist()}), rf"{COVARIANCE}\.2: variance -1 of"),
    ],
)
def test_what_faces_json_may_not_hold(small_run, small_dataset, tmp_path, spoil, message):
    content = json.loads((small_run / "faces.json").read_text())
    spoil(content)
    path = tmp_path / "faces.json"
    path.write_text(json.dumps(content))
    for read in (lambda: compare(path, small_dataset / "truth.json"), lambda: read_target(path, reference_target())):
        with pytest.raises(InputError, match=message) as caught:
            read()
        assert len(str(caught.value).splitlines()) == 1


def test_a_run_of_another_size_is_compared_and_a_place_beyond_all_reach_named(small_run, small_dataset, tmp_path):
    """Its square overflows, which ended the fit in NumPy's error."""
    for factor in (1.0, 1.05, 3.0):
        content = json.loads((small_run / "faces.json").read_text())
        content["circles"] = {label: [factor * v for v in xyz] for label, xyz in content["circles"].items()}
        for matrix in content["target_from_face"].values():
            for row in matrix[:3]:
                row[3] *= factor
        other = tmp_path / "faces.json"
        other.write_text(json.dumps(content))
        worst = compare(other, small_dataset / "truth.json").worst.translation_um
        assert (worst > 1000) == (factor != 1.0)
    content = json.loads((small_dataset / "truth.json").read_text())
    label = next(iter(content["circles"]))
    content["circles"][label][0] = 1e300
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(content))
    with fails_with(f"E-VALUE-TOO-FAR … truth.json: circles.{label}"):
        compare(small_run, path)


def test_labels_are_counted_rightly_and_it_is_said_where_they_cannot_be(small_run, small_dataset, tmp_path):
    for name in ("faces.json", "labels.csv"):
        (tmp_path / name).write_bytes((small_run / name).read_bytes())
    labels, truth = tmp_path / "labels.csv", small_dataset / "truth.json"
    known, (head, *rows) = compare(tmp_path, truth), labels.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    assert known.labels.wrong == 0
    assert "images that have labels" not in comparison_table(known)

    def found(*lines: str):
        labels.write_text("\n".join([head, *lines]))
        return compare(tmp_path, truth)

    a_column_less = [row for row, cell in zip(rows, cells, strict=True) if not re.fullmatch("board:.*:8", cell[4])]
    assert len(a_column_less) < len(rows)
    assert found(*a_column_less).labels.wrong == 0
    lost = cells[0][2]
    assert found(*rows, f"1,99,{lost},12,board:7:0,5,5").labels.wrong == 1  # off the board
    without = found(*(row for row, cell in zip(rows, cells, strict=True) if cell[2] != lost))
    assert (without.labels.images, without.labels.images_of_truth) == (known.labels.images - 1, known.labels.images)
    said = f"in the {without.labels.images} of {known.labels.images} images that have labels"
    assert said in comparison_table(without)
    labels.write_text("image,label\n12/IMG_1000.jpg,1:a\n")
    with pytest.warns(InputNote, match="labels.csv: damaged: the labels are not compared"):
        assert compare(tmp_path, truth).labels is None
    labels.unlink()
    with pytest.warns(InputNote, match="labels.csv: No such file or directory: the labels are not compared"):
        compare(tmp_path, truth)


def test_measured_poses_are_compared_with_the_truth(small_dataset, tmp_path):
    """Errors over σ of poses that err by what their covariances say are about 1; images are found by their file."""
    truth = TruthFile.model_validate_json((small_dataset / "truth.json").read_text())
    true = {name: Rigid.from_matrix(pose) for name, pose in truth.poses().items()}
    rng, sigma = np.random.default_rng(0), np.array([1e-4, 2e-4, 1e-4, 0.01, 0.02, 0.05])

    def table(names=None) -> Path:
        rows = [["image", *POSE, *COLUMNS]]
        for name, pose in true.items():
            moved = Rigid.exp(np.append(rng.normal(0, sigma[:3]), [0, 0, 0])).rotation @ pose.rotation
            found = Rigid(moved, pose.translation + rng.normal(0, sigma[3:]))
            rows.append([names(name) if names else name, *pose_cells(found, np.diag(sigma**2))])
        path = tmp_path / "poses.csv"
        path.write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
        return path

    found = compare_poses(table(), small_dataset / "truth.json")
    assert found.images.keys() == true.keys()
    over = np.array([each.normalised_error for each in found.images.values()])
    assert 0.4 < (over**2).mean() < 1.6  # χ² of 8 images of 6 each, over 48: 1 ± 3 × 0.2
    assert f"RMS of {len(true)} poses" in poses_table(found)
    with fails_with("E-COMPARE-IMAGES … names like"):
        compare_poses(table(names=lambda name: f"other-{Path(name).name}"), small_dataset / "truth.json")
