"""The page, from a small report made by hand, and figures of residuals: what they show is in the run. What ``compare``
and ``measure`` take of a ``faces.json``: no other format, no other unit, no matrix that is none."""

import base64
import copy
import json
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from stcal import Rigid, reference_target
from stcal.errors import InputError, InputNote
from stcal.io.table import COVARIANCE as COLUMNS
from stcal.io.table import POSE, pose_cells
from stcal.sfm.adjust.faces_file import read_target
from stcal.sfm.report.compare import compare, compare_poses, comparison_table, poses_table
from stcal.sfm.report.run_figures import by_photograph, normalised_residuals, residual_field
from stcal.sfm.report.run_page import report_html
from stcal.sfm.runs import folder
from stcal.synthetic.dataset import TruthFile
from tests.outcome import fails_with

NASTY = 'a/<script>alert("1")</script>&$_.jpg'
VOID = {"meta", "img", "br", "link", "hr", "input"}
JPEG = b"\xff\xd8 not a picture, but bytes \xff\xd9"
IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
TURNED = [[0.0, 0.0, 1.0, 150.0], [0.0, 1.0, 0.0, -0.00001], [-1.0, 0.0, 0.0, -60.1234567], [0.0, 0.0, 0.0, 1.0]]
CIRCLES = {
    **{f"1:{i}": [40.0 * (i % 2), 40.0 * (i // 2), 0.0] for i in range(4)},
    **{f"2:{i}": [150.0, 40.0 * (i % 2), -60.0 - 40.0 * (i // 2)] for i in range(4)},
}


def face(pose: list, sigma: bool) -> dict:
    return {
        "target_from_face": pose,
        "translation_mm": [row[3] for row in pose[:3]],
        "angle_to_reference_deg": 0.0,
        "translation_sigma_um": [1.04, 2.06, 3.08] if sigma else None,
        "rotation_sigma_mdeg": [0.501, 0.612, 0.723] if sigma else None,
        "circles": 4,
        "circles_of_design": 10,
        "plane_rms_um": 0.44,
        "groups": ["a"],
        "images": 2,
    }


def group() -> dict:
    residuals = {f"board:{r}:{c}": [3.0 * r, -4.0 * c, 0.5] for r in range(2) for c in range(2)}
    return {
        "name": "a",
        "scale": {
            "mm_per_unit": 116.2175381,
            "mm_per_unit_rows": 116.2175976,
            "rows": [0, 1],
            "difference_ppm": -0.5119,
            "sigma_ppm": 6.4293,
            "dots": 4,
            "board_mean_um": 3.0,
            "board_spread_um": 2.0,
            "board_rms_um": 3.6,
            "board_residuals_um": residuals,
        },
    }


def by_image(name: str) -> dict:
    return {"image": name, "group": "a", "observations": 12, "rms_px": 0.0035312, "max_px": 0.01079, "worst": "1:0"}


def make(sigma: bool = True, eccentricity: bool = True) -> dict:
    """A report of a joint adjustment, or of chains only where ``sigma`` is off: those have null values."""
    return {
        "format": "stcal report 1",
        "version": "0.1.0",
        "target": "target <one>",
        "reference_face": "1",
        "options": {
            "solve": "joint" if sigma else "chain",
            "frame": "plane",
            "eccentricity": eccentricity,
            "max_pair_angle_deg": 60.0,
        },
        "camera": {
            "model": "OPENCV",
            "size_px": [2592, 1728],
            "focal_px": [2785.28891198, 2785.43592782],
            "centre_px": [1299.14276961, 857.667041202],
            "distortion": [-0.05, 0.05, 0.0, 0.0],
        },
        "summary": {
            "files": 3,
            "images": 2,
            "images_mapped": 2,
            "groups": 1,
            "faces": 2,
            "faces_not_seen": [],
            "observations": 24,
            "residual_rms_px": 0.0037931,
            "centre_sigma_rms_px": 0.0044,
            "sigma_factor": 1.494,
            "scale_sigma_ppm": 6.4 if sigma else None,
            "sigma0": 0.9312 if sigma else None,
            "redundancy": 17 if sigma else None,
            "last_move_px": 3.14e-8 if sigma else None,
        },
        "faces": {"1": face(IDENTITY, sigma), "2": face(TURNED, sigma)},
        "between_faces": [{"a": "1", "b": "2", "distance_mm": 161.59991, "distance_sigma_um": 3.2, "angle_deg": 90.0}],
        "chains": {
            "1": [],
            "2": [{"faces": ["1", "2"], "groups": ["a"], "translation_mm": 0.013137, "rotation_rad": 1.2655e-4}],
        },
        "groups": [group()],
        "residuals_by_image": [by_image(NASTY), by_image("a/1.jpg")],
        "residuals_by_label": [
            {"label": label, "group": of_group, "observations": 2, "rms_px": 0.0046, "max_px": 0.0166}
            for label, of_group in (*((circle, None) for circle in CIRCLES), ("board:0:0", "a"))
        ],
        "left_out": {"files": [], "images": [], "circles": [], "notes": []},
        "notes": [],
        "images": [{"image_id": i, "name": n, "group": "a", "circles": 12} for i, n in enumerate(OVERLAYS, start=1)],
        "scene": {
            "cameras": [
                {
                    "image": name,
                    "group": "a",
                    "position_mm": [x, 0.0, 900.0],
                    "axes": np.diag([1.0, -1.0, -1.0]).tolist(),
                }
                for name, x in ((NASTY, -100.0), ("a/1.jpg", 400.0))
            ],
            "boards": {"a": [[200.0, 0.0, 0.0], [230.0, 0.0, 0.0], [200.0, 30.0, 0.0], [230.0, 30.0, 0.0]]},
            "circles": CIRCLES,
        },
    }


OVERLAYS = {NASTY: JPEG, "a/1.jpg": JPEG, "a/not mapped.jpg": JPEG}


class Page(HTMLParser):
    """Collects tags, references and text; fails where tags are not balanced."""

    def __init__(self, page: str):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.references: list[str] = []
        self.ids: list[str] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert self.open == []
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.references += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data


@pytest.fixture(scope="module")
def joint() -> str:
    return report_html(make(), OVERLAYS)


@pytest.fixture(scope="module")
def chained() -> str:
    return report_html(make(sigma=False, eccentricity=False), OVERLAYS)


def rows_of(page: str, section: str) -> list[list[str]]:
    part = page.split(f'<section id="{section}">')[1].split("</section>")[0]
    lines = re.findall(r"<tr>(.*?)</tr>", part, re.DOTALL)
    return [
        [unescape(re.sub("<.*?>", "", cell)) for cell in re.findall(r"<t[hd].*?>(.*?)</t[hd]>", line)] for line in lines
    ]


def test_the_page_is_whole_stands_alone_and_embeds_its_pictures(request, joint):
    for kind in ("joint", "chained"):
        page = request.getfixturevalue(kind)
        parsed = Page(page)
        assert parsed.tags.count("section") == parsed.tags.count("h2") == 9
        assert len(parsed.ids) == len(set(parsed.ids))
        inside = [r for r in parsed.references if r.startswith("#")]
        embedded = [
            r for r in parsed.references if r.startswith(("data:image/svg+xml;base64,", "data:image/jpeg;base64,"))
        ]
        assert sorted(inside + embedded) == sorted(parsed.references)
        assert {r[1:] for r in inside} <= set(parsed.ids)
        assert {"link", "iframe", "object"}.isdisjoint(parsed.tags)
        assert not re.search(r"url\(|@import|https?:", page)
        assert re.findall(r"<script[^>]*>", page) == ['<script type="application/json">', "<script>"]  # scene, and ours
        assert "alert(" not in "".join(re.findall(r"<script>(.*?)</script>", page, re.DOTALL))
        assert NASTY in parsed.text
        assert "target <one>" in parsed.text
    plots = re.findall(r"data:image/svg\+xml;base64,([A-Za-z0-9+/=]+)", joint)
    assert len(plots) == 2  # board of the one group, and photographs
    for plot in plots:
        references = re.findall(r'(?:href|src)="([^"]*)"', base64.b64decode(plot).decode())
        assert all(reference.startswith(("#", "data:image/png")) for reference in references)
    found = re.findall(r"data:image/jpeg;base64,([A-Za-z0-9+/=]+)", joint)
    assert [base64.b64decode(each) for each in found] == [JPEG] * 3
    assert "a/not mapped.jpg not mapped" in Page(joint).text
    assert report_html(copy.deepcopy(make()), OVERLAYS) == joint


def test_numbers_have_their_digits_and_what_was_not_computed_is_a_dash(joint, chained):
    """A control without eccentricity raises an alarm."""
    faces = rows_of(joint, "faces")
    assert ["1 (datum)", "0.0000", "0.0000", "0.0000", *["0"] * 6] in faces
    pose, sigma = ["150.0000", "0.0000", "-60.1235"], ["1.0", "2.1", "3.1", "0.50", "0.61", "0.72"]
    assert ["2", *pose, *sigma] in faces
    detail = rows_of(joint, "detail")
    assert ["2", "4", "10", "0.4", "2", "a"] in detail
    assert ["1 – 2", "161.5999", "3.2", "90.0000"] in detail
    assert ["2", "1 → 2", "a", "13.1", "7.25"] in detail
    scale = ["a", "116.217538", "116.217598", "0 and 1", "-0.5", "6.4", "4", "3.0", "2.0", "3.6", "5.0"]
    assert scale in rows_of(joint, "scale")
    assert ["1:0", "2", "0.0046", "0.0166"] in rows_of(joint, "residuals")
    assert [page.count('role="alert"') for page in (joint, chained)] == [0, 1]
    face_row = next(row for row in rows_of(chained, "faces") if row[0] == "2")
    assert face_row[4:] == ["–"] * 6
    assert "None" not in Page(chained).text


def test_left_out_with_reasons_and_sigma0_as_in_the_certificate(joint):
    """0.93 makes no σ smaller, 1.3 makes all larger: the factor of ``budget`` is named beside it."""
    report = make()
    report["summary"]["faces_not_seen"] = ["6"]
    report["notes"] = [{"note": "group a: face <6> has no frame", "code": ""}]
    report["left_out"] = {
        "files": [{"name": "readme<b>.txt", "reason": "not an image"}],
        "images": [{"name": "a/9.jpg", "reason": "not registered"}],
        "circles": [{"image": "a/1.jpg", "label": f"5:{i}", "reason": "seen once"} for i in range(3)],
        "notes": [{"image": "a/1.jpg", "note": "board of 20 dots left out", "code": "", "place": ""}],
    }
    page = report_html(report, {})
    rows = rows_of(page, "left-out")
    assert ["readme<b>.txt", "not an image"] in rows
    assert ["a/9.jpg", "not registered"] in rows
    assert ["a/1.jpg", "3", "5:0, 5:1, 5:2", "seen once"] in rows  # one row for one reason
    assert ["a/1.jpg", "board of 20 dots left out"] in rows
    assert ["1", "group a: face <6> has no frame"] in rows
    large = make()
    large["summary"]["sigma0"] = 1.3
    assert "leaves σ₀ = 0.93" in Page(joint).text
    assert "states the latter as 1.000" in Page(joint).text
    assert "states the latter as 1.300" in Page(report_html(large, OVERLAYS)).text


def words(drawing) -> list[str]:
    return re.findall(r">([^<]+)</text>", drawing.svg())


def test_residuals_over_their_sigma_are_of_a_normal_distribution_and_figures_have_limits(small_result, monkeypatch):
    """As in any adjustment with true σ. Circles that both groups show are counted as unknown in each, which makes the
    share of the redundancy smaller by up to a sixth, and the spread larger by up to a twelfth."""
    run, drawn = small_result.out, []
    monkeypatch.setattr(folder, "report_html", lambda report, overlays, residuals, gone: drawn.append(residuals) or "")
    folder._report_page(run, small_result.report)
    values = np.concatenate([*drawn[0].values()])[:, 4:]
    assert np.std(values) == pytest.approx(1.04, abs=0.06)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.1
    assert f"{values.size} coordinates, " in " ".join(words(normalised_residuals(values.ravel())))
    one = np.tile([110.0, 70.0, 0.02, 0.0], (20, 1))
    seen = words(residual_field(np.vstack([one, np.tile([1000.0, 70.0, 5.0, 0.0], (4, 1))]), (1200, 800)))
    assert "20" in seen
    assert "4" not in seen
    assert any(text.startswith("0.02 px") for text in seen)
    rows = [{"image": f"{i}.jpg", "rms_px": rms} for i, rms in enumerate((0.01, 0.05, 0.02))]
    assert [text for text in words(by_photograph(rows)) if text.endswith(".jpg")] == ["1.jpg"]


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
