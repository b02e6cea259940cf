"""``report``: the page of a finished run made again, and its PDF."""

import csv
import json
import math
import re

import pytest

from stcal.io.files import RUN_MARKER
from stcal.report.document import with_code
from stcal.sfm.report.judgement import Judgement
from stcal.sfm.runs import folder
from stcal.sfm.runs.folder import run_text
from stcal.sfm.runs.transaction import added_results, verify
from tests.outcome import INPUT, assert_error


@pytest.mark.slow
def test_the_same_files_make_the_same_page_there_or_in_a_file_of_ones_own(
    own_run, small_run, tmp_path, stcal_sfm, monkeypatch
):
    monkeypatch.setattr(folder, "pdf_of", lambda page: page[:15].encode())
    (own_run / "report.html").write_text("spoilt")
    assert verify(own_run).notes()
    before, page = (own_run / RUN_MARKER).read_bytes(), (small_run / "report.html").read_bytes()
    own = tmp_path / "for the lab"
    code, out, _ = stcal_sfm("report", own_run, "--pdf", "--out", f"{own}.html")
    assert (code, out) == (0, f"report: {own}.html\nreport: {own}.pdf\n")
    assert (own.with_suffix(".html").read_bytes(), own.with_suffix(".pdf").read_bytes()) == (page, b"<!DOCTYPE html>")
    assert ((own_run / RUN_MARKER).read_bytes(), (own_run / "report.pdf").exists()) == (before, False)
    code, out, _ = stcal_sfm("report", own_run, "--pdf")
    assert (code, out) == (0, f"report: {own_run}/report.html\nreport: {own_run}/report.pdf\n")
    assert (own_run / "report.html").read_bytes() == page
    assert (own_run / "report.pdf").read_bytes() == b"<!DOCTYPE html>"
    assert verify(own_run).notes() == []
    with added_results(own_run) as stage:
        (stage / "report.html").write_text("another")
    assert not (own_run / "report.pdf").exists()  # it was made of the page before
    assert verify(own_run).notes() == []


def test_what_cannot_be_made_is_said_in_one_line(own_run, tmp_path, stcal_sfm):
    assert_error(stcal_sfm("report", tmp_path), INPUT, "E-RUN-FOLDER", "--out")
    assert_error(
        stcal_sfm("report", own_run, "--out", tmp_path / "a.pdf"), INPUT, "E-OUTPUT-SUFFIX", "a.html", "--pdf", "a.pdf"
    )
    assert_error(stcal_sfm("report", own_run, "--out", own_run / "report.html"), INPUT, "E-OUTPUT-IS-INPUT", "run")
    content = json.loads((own_run / "report.json").read_text())
    del content["faces"]
    (own_run / "report.json").write_text(json.dumps(content))
    assert_error(stcal_sfm("report", own_run), INPUT, "E-RUN-DAMAGED", "report.json", "faces")
    assert (own_run / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("report.json", '"label": "1:1"', '"label": "?"'),
        ("labels.csv", "\n1,0,", "\n1,0,12/IMG_1000.jpg,12,x,0,0,0,0,1,0,1,left,0\n1,0,"),
    ],
)
def test_a_page_that_cannot_be_made_leaves_the_earlier_one(own_run, stcal_sfm, name, old, new):
    text, before = (own_run / name).read_text(), (own_run / "report.html").read_bytes()
    (own_run / name).write_text(text.replace(old, new, 1))
    assert_error(stcal_sfm("report", own_run), INPUT, "E-RUN-DAMAGED", f"{name}")
    assert (own_run / "report.html").read_bytes() == before


def test_terminal_file_and_page_have_the_same_judgement(small_result, small_run):
    stored = Judgement.model_validate(json.loads((small_run / "report.json").read_text())["judgement"])
    assert stored == small_result.judgement
    page, terminal = (small_run / "report.html").read_text(), " ".join(run_text(small_result).split())
    assert len(stored.answers()) == 4
    for question, answer in stored.answers():
        assert f"{question} {answer}" in terminal
        assert f"<dt>{question}</dt><dd>{with_code(answer)}</dd>" in page


def test_residuals_of_the_table_are_those_of_the_report_and_of_the_page(small_run):
    report = json.loads((small_run / "report.json").read_text())
    with open(small_run / "labels.csv", encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["residual_x_px"]]
    page = (small_run / "report.html").read_text()
    factor = float(re.search(r"measured less projected, ([\d,]+) times", page)[1].replace(",", ""))
    drawn = page.split('alt="Overlay of ')
    for image in report["residuals_by_image"]:
        own = [[float(row[f"residual_{axis}_px"]) for axis in "xy"] for row in rows if row["image"] == image["image"]]
        assert len(own) == image["observations"]
        assert math.sqrt(sum(x * x + y * y for x, y in own) / (2 * len(own))) == pytest.approx(image["rms_px"])
        assert max(math.hypot(*each) for each in own) == pytest.approx(image["max_px"])
        (part,) = [each for each in drawn if each.startswith(image["image"])]
        vectors = re.findall(r"M[\d.-]+ [\d.-]+l([\d.-]+) ([\d.-]+)", part)
        assert [[float(v) / factor for v in each] for each in vectors] == [
            [pytest.approx(v, abs=0.051 / factor) for v in each] for each in own
        ]
