"""The budget of a run: its rows, what is stated, the tests of lengths, its page with the PDF; and against simulated
calibrations, each input alone (scripts/studies/budget_study.py)."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from scipy.stats import t as student

from stcal.boards.board_file import board_toml, load_board
from stcal.design import KnownDistance, ScaleReference, StatedSize
from stcal.geometry.rigid import Rigid
from stcal.io.files import RUN_MARKER, digest_of, json_text
from stcal.labels import CircleLabel
from stcal.report import document as pdf
from stcal.report.document import html
from stcal.report.text import significant
from stcal.sfm.adjust.uncertainty import derivatives
from stcal.sfm.budget import combine
from stcal.sfm.budget.budget_file import SHARED, BudgetFile, _unusual, against_run, against_stated
from stcal.sfm.budget.budget_page import budget_report
from stcal.sfm.budget.budget_tables import as_exact
from stcal.sfm.budget.certificate import REQUIRED, drawings
from stcal.sfm.budget.combine import FIELDS, Statement, budget_of_run, conditions_of, longest_of, statement_of
from stcal.sfm.report.check import CHECKS
from stcal.sfm.runs.saved import adjusted_run
from stcal.sfm.runs.transaction import MarkerFile, verify
from tests.levels import sampled
from tests.outcome import INPUT, assert_error, refuses
from tests.scripts import load_script
from tests.shared import own_copy, unsealed_copy

pytestmark = pytest.mark.slow

STATEMENT = """
[fields]
operator = "A. Smith"
[board]
pitch_sigma_ppm = 10.0
expansion_ppm_per_k = 8.0
expansion_sigma_ppm_per_k = 0.5
temperature_c = 24.0
temperature_sigma_k = 0.5
[target]
expansion_ppm_per_k = 23.0
expansion_sigma_ppm_per_k = 1.0
temperature_c = 22.0
temperature_sigma_k = 1.0
"""


@pytest.fixture(scope="module")
def plain(saved):
    return budget_of_run(saved)


def rows_of(budget, kind):
    """Measurands of a kind with their uncertainties, µm or mdeg."""
    return [row for row in budget.rows if row[0].kind == kind]


@pytest.fixture
def stated(saved, tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(STATEMENT)
    return statement_of(saved.board_design.stated, path, {"date": "2026-03-01"})


def test_with_nothing_stated_it_is_the_runs_own_covariance_and_contributions_add_up_as_squares(saved, plain):
    """The run is read from files, so to their digits and the adjustment's last step. Its board has the default of
    0.005 mm, which nobody has measured."""
    assert {face.name for face, _ in rows_of(plain, "position")} == {"2", "4", "5"}
    for kind, part, unit in (("position", slice(3, 6), 1e3), ("rotation", slice(3), 1e3 * np.degrees(1))):
        for face, found in rows_of(plain, kind):
            own = saved.faces.target_from_face_covariance[face.name][part, part]
            summed = sum(face.covariance(each) for each in plain.sources)
            np.testing.assert_allclose(summed, own, rtol=0, atol=1e-3 * np.abs(own).max())
            np.testing.assert_allclose(np.square(found.axes), unit**2 * np.diag(summed))
    (dots,) = (row for row in plain.sources if row.key == "board_dots")
    assert (dots.origin, "the default" in dots.words) == ("assumed", True)
    assert len(plain.rows) == 3 + 3 + 6 + 5
    for face in BudgetFile.of(plain, saved, verify(saved.folder)).faces.values():
        for written in (face.position_um, face.rotation_mdeg):
            assert sum(written.share(key) for key in written.contributions) == pytest.approx(1)
    for _, row in plain.rows:
        assert min(row.contributions.values()) >= 0
        assert np.hypot.reduce(list(row.contributions.values())) == pytest.approx(row.standard)
        # Student's k for 95.45 %; up to 99.3 % for three numbers alike; of 100 000 draws.
        assert row.expanded == pytest.approx(student.ppf(norm.cdf(2), row.degrees_of_freedom) * row.standard)
        assert 0.952 < row.coverage < 0.995


def test_photographs_that_differ_are_what_is_counted_and_sigma_are_as_large_as_checks_made_them(
    saved, plain, monkeypatch
):
    summary = saved.report["summary"] | {"sigma_enlarged": 1.5}
    enlarged = budget_of_run(replace(saved, report=saved.report | {"summary": summary}))
    state, start = adjusted_run(saved)
    monkeypatch.setattr(combine, "adjusted_run", lambda _: (replace(state, differ=3.0), start))
    differing, images = budget_of_run(saved), sum(len(model.images) for model in plain.joint.models)
    for (_, before), (_, larger), (_, after) in zip(plain.rows, enlarged.rows, differing.rows, strict=True):
        assert larger.standard == pytest.approx(1.5 * before.standard, rel=0.02)
        assert before.standard < after.standard <= 3 * before.standard
        assert images <= after.degrees_of_freedom < before.degrees_of_freedom


def test_what_is_stated_adds_its_part_and_one_thermometer_errs_in_the_difference_of_the_expansions(
    saved, plain, stated
):
    """A length of L mm: pitch 10 ppm; α u(T) = 8 · 0.5 and 23 · 1 ppm; u(α) ΔT = 0.5 · 4 and 1 · 2 ppm. By one
    thermometer |8 · 0.5 − 23 · 1| ppm, and nothing for bodies of one alloy; all other rows are as without it."""
    found = budget_of_run(saved, stated)
    ppm = {"board_pitch": 10.0, "board_temperature": 4.0, "board_expansion": 2.0}
    ppm |= {"target_temperature": 23.0, "target_expansion": 2.0}
    for (_, before), (distance, after) in zip(rows_of(plain, "distance"), rows_of(found, "distance"), strict=True):
        length = 1e3 * distance.value
        own = {key: 1e6 * after.contributions[key] / length for key in ppm}
        assert own == pytest.approx(ppm, rel=2e-3)  # a face that must be flat takes part of a change of scale
        added = sum((each * 1e-6 * length) ** 2 for each in own.values())
        assert after.standard == pytest.approx(np.sqrt(before.standard**2 + added), rel=1e-6)
    origins = {each.key: each.origin for each in found.sources}
    assert {origins[key] for key in ppm} == {"stated"}
    assert {each.origin for each in plain.sources if each.key in ppm} == {"not stated"}
    assert origins["circle_centres"] == "estimated"
    assert found.conditions.correction == pytest.approx(1e-6 * (8 * 4 - 23 * 2))
    common = budget_of_run(saved, replace(stated, one_thermometer=True))
    for (_, before), (distance, after) in zip(rows_of(found, "distance"), rows_of(common, "distance"), strict=True):
        length = 1e-3 * distance.value
        assert after.contributions["temperature"] / length == pytest.approx(19.0, rel=5e-3)
        gone = {"board_temperature", "target_temperature"}
        assert set(before.contributions) - set(after.contributions) == gone
        for key in set(before.contributions) - gone:
            assert after.contributions[key] == pytest.approx(before.contributions[key])
        assert after.standard < before.standard
    board, target = (
        replace(s, expansion_ppm_per_k=23.0, temperature_sigma_k=1.0) for s in (stated.board, stated.target)
    )
    alike = budget_of_run(saved, replace(stated, board=board, target=target, one_thermometer=True))
    for distance, row in rows_of(alike, "distance"):
        assert row.contributions["temperature"] / (1e3 * distance.value) < 0.1e-6  # of 23 ppm each
    unstated = replace(stated, board=StatedSize(temperature_sigma_k=0.5), target=StatedSize(), one_thermometer=True)
    source, open_source = (
        next(each for each in found.sources if each.key == "temperature")
        for found in (alike, budget_of_run(saved, unstated))
    )
    assert (source.sigma, source.unit, source.origin) == (1.0, "K", "stated")
    assert (open_source.origin, open_source.words.count("expansion_ppm_per_k")) == ("not stated", 2)


def test_rims_that_were_estimated_are_a_row(saved, plain):
    """Each face lies half of an error of the height along its own normal: against the reference face by the difference
    of both normals."""
    faces = saved.faces.model_copy(update={"rim_mm": dict.fromkeys(saved.faces.circles, 0.2)})
    summary = saved.report["summary"] | {"rim_sigma_mm": 0.01}
    found = budget_of_run(replace(saved, faces_file=faces, report=saved.report | {"summary": summary}))
    assert [each.origin for each in found.sources if each.key == "rims"] == ["estimated"]
    assert all(each.key != "rims" for each in plain.sources)
    normal = {face: np.array(m)[:3, 2] for face, m in saved.faces.target_from_face.items()}
    for face, row in rows_of(found, "position"):
        apart = normal[face.name] - normal[saved.faces.reference_face]
        assert row.contributions["rims"] == pytest.approx(5 * np.linalg.norm(apart), rel=0.02)


def test_a_statement_goes_before_the_boards_own_which_its_file_keeps(saved, tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text("one_thermometer = true\n[board]\ntemperature_c = 24\n[fields]\ndate = 2026-11-27\n")
    own = StatedSize(expansion_ppm_per_k=8.0, temperature_c=30.0)
    found = statement_of(own, path, {"operator": "B", "serial": "12"})
    assert found.one_thermometer
    assert (found.board.expansion_ppm_per_k, found.board.temperature_c) == (8.0, 24.0)
    assert found.origin["board", "temperature_c"] == str(path)
    assert found.origin["board", "expansion_ppm_per_k"] == "board.toml"
    given = {"operator": "B", "serial": "12", "date": "2026-11-27"}  # a date of TOML is its text
    assert found.fields == dict.fromkeys(FIELDS, "") | given
    conditions = conditions_of(found, saved.board_design)
    assert (conditions.correction, conditions.temperature_c) == (pytest.approx(32e-6), None)
    assert "a correction of +32.0 ppm" in conditions.words
    size = StatedSize(12.0, 8.5, 0.5, 23.25, 0.5, 22.0)
    path.write_text(board_toml(replace(saved.board_design, stated=size)))
    assert load_board(path).stated == size


WARM_BOARD = StatedSize(expansion_ppm_per_k=8.5, temperature_c=22.7)
WARM_TARGET = StatedSize(expansion_ppm_per_k=23.0, temperature_c=22.4)


@pytest.mark.parametrize(
    ("board", "target", "ppm", "temperature_c"),
    [
        (WARM_BOARD, WARM_TARGET, 22.95 - 55.2, 20.0),
        (WARM_BOARD, replace(WARM_TARGET, reference_temperature_c=22.0), 22.95 - 9.2, 22.0),
        (WARM_BOARD, StatedSize(), 22.95, None),
        (WARM_BOARD, StatedSize(temperature_c=22.4), 22.95, 22.4),
        (WARM_BOARD, StatedSize(temperature_c=20.0), 22.95, 20.0),
        (StatedSize(temperature_c=20.0), WARM_TARGET, -55.2, 20.0),
        (StatedSize(expansion_ppm_per_k=0.0), WARM_TARGET, -55.2, 20.0),
        (StatedSize(), WARM_TARGET, 0.0, 22.4),
        (StatedSize(), StatedSize(), 0.0, None),
    ],
)
def test_lengths_hold_where_what_is_stated_leads(saved, board, target, ppm, temperature_c):
    """A length at the temperature of the photographs needs the board's expansion, one at 20 °C the target's too."""
    found = conditions_of(Statement(board, target, {}, {}), saved.board_design)
    assert (found.correction, found.temperature_c) == (pytest.approx(1e-6 * ppm, abs=1e-12), temperature_c)
    assert found.size_known
    if temperature_c is not None and ppm:
        assert f"at {temperature_c:g} °C" in found.words


def scale_of(*distances):
    return ScaleReference(0, 0, 1.0, 0.25, "bright", 1.0, distances=distances)


def test_a_size_of_the_target_itself_does_not_expand_and_without_one_nothing_in_mm_is_certified(saved, plain, tmp_path):
    """No board was used: what is stated of one must not change a length."""
    known = KnownDistance(CircleLabel("1", "1"), CircleLabel("1", "2"), 100.0, 0.01)
    found = conditions_of(Statement(WARM_BOARD, WARM_TARGET, {}, {}), scale_of(known))
    assert (found.size_known, found.correction, found.temperature_c) == (True, 0.0, 20.0)
    without = scale_of(replace(known, drawn=True))
    drawn = conditions_of(Statement(WARM_BOARD, WARM_TARGET, {}, {}), without)
    assert (drawn.size_known, drawn.correction, drawn.temperature_c) == (False, 0.0, None)
    shape = replace(plain, conditions=conditions_of(plain.statement, without))
    file = BudgetFile.of(shape, saved, verify(saved.folder))
    assert not file.size_known
    assert (file.reference_temperature_c, file.correction_ppm, file.distances) == (None, None, [])
    for face in file.faces.values():
        assert (face.position_mm, face.position_um) == (None, None)
        assert face.rotation_mdeg.expanded > 0
    for shown in (budget_report(file).text(), budget_report(file).page()):
        assert "only the shape is known" in shown.lower()
        assert not any(word in shown for word in ("Certificate", "hold at", "position of face", "longest distance"))
    (tmp_path / "lengths.csv").write_text("from,to,length_mm\n1:1,1:2,100\n")
    refuses("E-BUDGET-NO-SIZE", against_stated, shape, tmp_path / "lengths.csv")


def test_the_longest_distances_are_of_different_pairs_of_faces_and_lengths_that_are_none_refused(plain, tmp_path):
    labels = [CircleLabel(face, circle) for face in "12" for circle in "ab"]
    xyz = np.array([[0, 0, 0], [1, 0, 0], [0, 5, 0], [0, 7, 0.0]])
    assert longest_of(labels, xyz) == [(1, 3), (2, 3), (0, 1)]
    for row, words in (
        ("1:1,9:9,100,0", "E-BUDGET-LENGTHS … line 2: no circle 9:9"),
        ("1:1,1:1,100,0", "E-BUDGET-LENGTHS … line 2: 1:1 to 1:1"),
        ("1:1,1:2,40,-1", "E-BUDGET-LENGTHS … a σ of 0 or more"),
        ("1:1,1:2,x,0", "E-TABLE-NUMBER … length_mm is 'x'"),
    ):
        (tmp_path / "lengths.csv").write_text(f"from,to,length_mm,sigma_mm\n{row}\n")
        refuses(words, against_stated, plain, tmp_path / "lengths.csv")


def test_command(stcal_sfm, small_run, tmp_path, monkeypatch):
    """Terminal, JSON, page and PDF say the same. Fields are text in the page, not markup."""
    monkeypatch.setattr(pdf, "pdf_of", lambda page: b"%PDF-" + page[:15].encode())
    path, page, out = (tmp_path / name for name in ("lab.toml", "budget.html", "budget.json"))
    path.write_text(STATEMENT)
    words = ("--statement", path, "--field", "instrument=X 5", "--field", "customer=<b>A & B</b>")
    written = ("--lengths", small_run, "--report", page, "--pdf", "--json", out)
    code, text, _ = stcal_sfm("budget", small_run, *words, *written, "-v")
    assert code == 0
    assert all(shown in text for shown in ("performed by: A. Smith\n", "instrument: X 5\n", "-14.0 ppm"))
    file = json.loads(out.read_text())
    marker = json.loads((small_run / ".stcal/run.json").read_text())["sha256"]
    assert (file["run"]["sha256"], file["run"]["faces_sha256"]) == (marker[".stcal/run.json"], marker["faces.json"])
    assert file["run"]["changed"] == []
    origin = {each["key"]: each["origin"] for each in file["sources"]}
    assert origin["intrinsics"] == "not stated"
    first = file["distances"][0]
    assert first["corrected_mm"] == pytest.approx(first["length_mm"] * (1 - 14e-6), abs=1e-9)
    assert first["distance_um"]["contributions"]["board_pitch"] == pytest.approx(10e-3 * first["length_mm"], rel=2e-3)
    faces = json.loads((small_run / "faces.json").read_text())
    pose = np.array(faces["target_from_face"]["5"])
    assert file["faces"]["5"]["position_mm"] == pytest.approx(pose[:3, 3] * (1 - 14e-6), abs=1e-9)
    turn = Rotation.from_rotvec(file["faces"]["5"]["rotation_vector_deg"], degrees=True)
    assert np.allclose(turn.as_matrix(), pose[:3, :3], atol=1e-9)
    assert (file["reference_temperature_c"], file["use"][:4]) == (20.0, "Part")
    combined = next(line for line in text.splitlines() if line.startswith("combined standard")).split()[4:]
    assert combined[-1] == f"{file['faces']['5']['position_um']['standard']:.2f}"
    html = page.read_text(encoding="utf-8")
    assert "&lt;b&gt;A &amp; B&lt;/b&gt;" in html
    assert "<b>A &" not in html
    row = re.search(r'<th scope="row" class="l">combined standard uncertainty u</th>(.*?)</tr>', html, re.DOTALL)
    assert row is not None
    assert re.findall(r"<td>([\d.]+)</td>", row[1]) == combined
    assert "-14.0 ppm" in html
    assert "not a certificate: nothing is stated of" in html
    circle = next(iter(faces["circles"]))
    assert re.search(rf'<th scope="row" class="l">{circle}</th>(<td>-?[\d.]+</td>){{3}}(<td>\d[\d.]*</td>){{3}}', html)
    assert re.search(r"SHA-256 of the result file</th><td[^>]*>[0-9a-f]{64}<", html)
    assert not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert (tmp_path / "budget.pdf").read_bytes() == b"%PDF-<!DOCTYPE html>"


def test_a_changed_run_is_named_and_a_failed_check_is_said(stcal_sfm, small_run, tmp_path):
    copy = own_copy(small_run, tmp_path / "run")
    (copy / "report.html").write_text("x")
    code, text, _ = stcal_sfm("budget", copy)
    assert (code, len(text.splitlines()) <= 15) == (0, True)
    assert "changed since the run: report.html" in text
    report = json.loads((copy / "report.json").read_text())
    title = report["checks"][1]["title"]
    report["checks"][1]["verdict"] = "failed"
    (copy / "report.json").write_text(json.dumps(report))
    marker = MarkerFile.model_validate_json((copy / RUN_MARKER).read_text())
    sealed = marker.sealed(marker.sha256 | {"report.json": digest_of(copy / "report.json")})
    (copy / RUN_MARKER).write_text(json_text(sealed))
    code, text, error = stcal_sfm("budget", copy, "-v")
    assert (code, "--no-strict" in error) == (4, True)
    assert title in text
    assert all(what in text for what in CHECKS[report["checks"][1]["key"]][1])
    assert "expanded uncertainty U" not in text
    assert "do not use what was written" in stcal_sfm("export", copy, tmp_path / "box.csv")[1]
    page, out, lengths = (tmp_path / name for name in ("budget.html", "budget.json", "lengths.csv"))
    lengths.write_text("from,to,length_mm\n1:1,1:2,1000\n")
    words = ("--check-lengths", lengths, "--report", page, "--json", out, "--no-strict", "--quiet")
    code, text, error = stcal_sfm("budget", copy, *words)
    assert (code, text, error.count("\n")) == (0, "", 1)
    assert error.startswith("warning: may run ")
    html, file = page.read_text(), json.loads(out.read_text())
    assert not any(word in text + html for word in ("Lengths and positions hold", "Certificate"))
    assert (file["usable"], file["faces"], file["distances"], file["holds"]) == (False, {}, [], "")
    (test,) = file["length_tests"]
    assert (test["agrees"], test["beyond"], test["lengths"][0]["expanded_um"]) == (None, None, None)
    assert "not judged: 1 lengths" in html


def test_statements_that_are_none_are_refused_and_unusual_ones_asked_about(tmp_path):
    for content, words in (
        ("[board]\npitch_sigma_ppm = 30e-6", "E-KEY-VALUE … 30, and in % 0.3;"),
        ("[board]\ntemperature_c = 295.65", "E-KEY-VALUE … 22.5 °C"),
        ("[board]\npitch_sigma_ppm = -1", "E-KEY-VALUE … board.pitch_sigma_ppm: -1:"),
        ("[target]\nexpansion_ppm_per_k = 0.000023", "E-KEY-VALUE … 2.3e-05 1/K is 23;"),
        ("[target]\npitch_sigma_ppm = 1", "E-KEY-UNKNOWN … target.pitch_sigma_ppm"),
        ("[fields]\noperator = 3", "E-KEY-VALUE … fields.operator: 3:"),
        ("operator = 'x'", "E-KEY-UNKNOWN … operator"),
        ("[target]\none_thermometer = true", "E-KEY-UNKNOWN … move it to the top of the file"),
    ):
        (tmp_path / "lab.toml").write_text(content)
        refuses(words, statement_of, StatedSize(), tmp_path / "lab.toml")

    def asked(**values) -> list[str]:
        return _unusual(Statement(StatedSize(**values), StatedSize(), {}, {}, False))

    assert asked(temperature_c=23.0, temperature_sigma_k=0.5, expansion_ppm_per_k=70.0) == []
    assert "or °F, which were 22.5 °C?" in asked(temperature_c=72.5)[0]
    assert "50 K: is that its value?" in asked(temperature_sigma_k=50.0)[0]
    assert "700 ppm/K" in asked(expansion_ppm_per_k=700.0)[0]


def test_options_that_are_none_and_a_chain_have_no_budget(stcal_sfm, small_run, tmp_path):
    for words, said in (
        (("--field", "operator"), ("E-OPTION-VALUE",)),
        (("--field", "a=1", "--field", "a=2"), ("E-OPTION-REPEATED", "--field")),
        (("--lengths-statement", "x.toml"), ("E-OPTION-NEEDS", "--lengths")),
        (("--pdf",), ("E-OPTION-NEEDS", "--report", "FILE.html")),
        (("--report", "budget.pdf"), ("E-OUTPUT-SUFFIX", "budget.html, and --pdf")),
    ):
        assert_error(stcal_sfm("budget", small_run, *words), INPUT, *said)
    copy = unsealed_copy(small_run, tmp_path / "run")
    faces = json.loads((copy / "faces.json").read_text())
    (copy / "faces.json").write_text(json.dumps(faces | {"solve": "chain"}))
    assert_error(stcal_sfm("budget", copy), INPUT, "solved by chain, which states no covariance", "--solve joint")


def lengths_csv(path, plain, off_u=0.0, rows=4, sigma_mm=0.001, head="from,to,length_mm,sigma_mm"):
    """Lengths of the run, each shorter by so many expanded uncertainties; degrees of freedom grow as the stated σ does
    (Welch–Satterthwaite)."""
    lines = [head]
    for i, j in longest_of(plain.joint.labels, plain.joint.xyz_model)[:rows]:
        a, b = plain.joint.labels[i], plain.joint.labels[j]
        length = float(np.linalg.norm(plain.joint.xyz_model[i] - plain.joint.xyz_model[j]))
        own = next(u for distance, u in rows_of(plain, "distance") if distance.of == (a, b))
        u = np.hypot(1e-3 * own.standard, sigma_mm)
        k = student.ppf(norm.cdf(2), own.degrees_of_freedom * (1e3 * u / own.standard) ** 4)
        cells = [a, b, f"{length - off_u * k * u:.9f}", str(sigma_mm)]
        lines.append(",".join(cells[: head.count(",") + 1]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("off_u", "rows", "beyond", "agrees"),
    [(0.0, 4, 0, True), (0.9, 4, 0, True), (1.1, 1, 1, False), (1.1, 4, 4, True), (1.5, 4, 4, False)],
)
def test_errors_over_their_uncertainty(plain, tmp_path, off_u, rows, beyond, agrees):
    """Of four lengths the limit is 1.27: each is beyond 2.53 σ by chance in 1 of 88, all four in 1 of 22."""
    found = against_stated(plain, lengths_csv(tmp_path / "lengths.csv", plain, off_u, rows))
    assert [each.e_n for each in found.lengths] == pytest.approx([off_u] * rows, abs=1e-5)
    assert (found.beyond, found.agrees) == (beyond, agrees)
    assert found.limit == pytest.approx({1: 1.0, 4: 1.2655}[rows], abs=1e-3)
    (note,) = found.notes  # no temperature is stated
    assert "must state lengths for the temperature at which the target was photographed" in note
    at_20 = replace(plain, conditions=replace(plain.conditions, temperature_c=20.0))
    assert against_stated(at_20, tmp_path / "lengths.csv").notes == ()
    exact = lengths_csv(tmp_path / "exact.csv", plain, off_u, rows, sigma_mm=0.0, head="from,to,length_mm")
    without = against_stated(plain, exact)
    assert [each.e_n for each in without.lengths] == pytest.approx([off_u] * rows, abs=1e-5)
    assert "no sigma_mm" in without.notes[0]


def test_a_run_against_itself_differs_by_nothing_and_pitch_is_not_in_it(saved, plain, tmp_path):
    """u of the difference is √2 that of one run, with twice the degrees of freedom; a pitch that both share leaves it
    as it is, another board's does not."""
    alike = against_run(plain, plain, saved.folder, (saved.board_design, saved.board_design))
    assert alike.agrees
    assert "cannot be seen here" in alike.notes[0]
    distance, longest = rows_of(plain, "distance")[0]
    assert alike.lengths[0].circles == distance.of
    assert alike.lengths[0].error_um == 0
    k = student.ppf(norm.cdf(2), 2 * longest.degrees_of_freedom)
    assert alike.lengths[0].expanded_um == pytest.approx(k * np.sqrt(2) * longest.standard)
    path = tmp_path / "lab.toml"
    path.write_text("[board]\npitch_sigma_ppm = 50.0\n")
    stated = budget_of_run(saved, statement_of(saved.board_design.stated, path))
    same = against_run(stated, stated, saved.folder, (saved.board_design, saved.board_design))
    assert same.lengths[0].expanded_um == pytest.approx(alike.lengths[0].expanded_um)
    other = against_run(stated, stated, saved.folder, (saved.board_design, replace(saved.board_design, pitch_mm=20.0)))
    pitch = 50e-6 * distance.value
    wanted = np.hypot(alike.lengths[0].expanded_um, 2e3 * np.sqrt(2) * pitch)
    assert other.lengths[0].expanded_um == pytest.approx(wanted, rel=2e-3)
    assert other.notes == ()
    assert "board_pitch" in SHARED
    at_20 = replace(plain, conditions=replace(plain.conditions, temperature_c=20.0))
    mixed = against_run(plain, at_20, saved.folder, (saved.board_design, saved.board_design))
    assert len(mixed.notes) == 2
    assert "hold at different temperatures" in mixed.notes[1]


def test_uncertainties_have_two_significant_digits_and_values_end_with_the_last_of_them():
    shown = {14.26: "14", 9.96: "10", 0.01234: "0.012", 126.0: "130", None: "–"}
    assert {value: significant(value) for value in shown} == shown
    assert [as_exact(166.18664, 0.031), as_exact(236.457, 15.0), as_exact(1.23456, 0.0)] == ["166.187", "236", "1.2346"]


@pytest.fixture(scope="module")
def certified(saved, plain):
    """The budget of a sound run, as if all were stated."""
    file = BudgetFile.of(plain, saved, verify(saved.folder))
    stated = [row.model_copy(update={"origin": "stated"}) for row in file.sources]
    return file.model_copy(update={"sources": stated, "fields": dict.fromkeys(REQUIRED, "rule 7")})


def test_a_certificate_has_all_inputs_stated_and_a_traceability_and_never_says_how_to_use_it(saved, plain, certified):
    """ISO/IEC 17025 keeps results of the item from what helps its user; each photograph has its hash."""
    full, file = certified, BudgetFile.of(plain, saved, verify(saved.folder))
    for one, lacks in (
        *((full.model_copy(update={"fields": full.fields | {name: " "}}), name) for name in REQUIRED),
        (file.model_copy(update={"fields": full.fields}), "board&#39;s pitch"),
    ):
        page = budget_report(one).page()
        assert "Certificate" not in page
        assert "certificate number" not in page
        assert re.search(f"not a certificate: nothing is stated of [^<]*{re.escape(lacks)}", page)
    care = full.model_copy(update={"reserved": True})
    assert "not a certificate: the run says that it is to be used with care" in budget_report(care).page()
    page = budget_report(full).page()
    assert "<h1>Certificate of calibration no. rule 7</h1>" in page
    assert "not a certificate" not in page
    assert "origin at circle" in page
    assert saved.folder.parent.name not in page
    assert [row.value for row in file.stated if row.key == "pitch_mm"] == [saved.board_design.pitch_mm]
    file, page = certified, budget_report(certified).page()
    for word in ("May the run", "May I use", "faces.json", "--", "as `draw` numbers them", '<img src=""'):
        assert word not in re.sub("<style>.*?</style>|<script>.*?</script>", "", page, flags=re.DOTALL), word
    assert '<td class="l"></td>' not in page
    assert len(file.run.photographs_sha256) == sum(each.images for each in file.views)
    assert all(digest in page for digest in file.run.photographs_sha256.values())
    assert page.count("seen from outside") == 2 * len(file.faces) + 2  # as text and for those who do not see


def test_an_angle_is_that_of_the_normals_and_its_uncertainty_what_draws_of_the_circles_say(saved, plain):
    """Faces moved by draws from the covariance of all of them together."""
    own = derivatives(plain.joint, adjusted_run(saved)[1], saved.target_design, saved.faces.frame)
    variances, axes = np.linalg.eigh(plain.joint.covariance_mm2)
    draws = axes * np.sqrt(np.maximum(variances, 0)) @ np.random.default_rng(0).standard_normal((len(axes), 2000))
    for angle, row in rows_of(plain, "angle"):
        normals = [
            Rotation.from_rotvec((own.faces[face][:3] @ draws).T).apply(own.target_from_face[face].matrix()[:3, 2])
            for face in angle.of
        ]
        angles = np.arctan2(np.linalg.norm(np.cross(*normals), axis=1), np.sum(np.multiply(*normals), axis=1))
        assert np.mean(angles) == pytest.approx(angle.value, abs=1e-5)
        assert 1e3 * np.degrees(np.std(angles)) == pytest.approx(row.standard, rel=0.06)  # 4 σ of 2000 draws


@pytest.mark.parametrize("of", ["many points", "edge on", "one plane"])
def test_a_drawing_of_any_item_has_all_its_faces(of):
    """Faces of Z into the body have Y downwards; of many points the outermost are named."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0), np.zeros(1)), -1).reshape(-1, 3)
    turns = {"many points": [0, 0.5], "edge on": [0, 1.0], "one plane": [0]}[of]
    circles, faces = {}, {}
    for name, turn in zip("12", turns, strict=False):
        pose = Rigid(Rotation.from_rotvec([np.pi * turn, 0, 0]), [0, 0, 20.0 * turn])
        circles |= {f"{name}:{i}": {"position_mm": xyz} for i, xyz in enumerate((pose @ grid).tolist())}
        turned = pose.as_scipy().as_rotvec(degrees=True).tolist()
        faces[name] = SimpleNamespace(position_mm=pose.translation.tolist(), rotation_vector_deg=turned)
    del faces["1"]
    points = {label: SimpleNamespace(**each) for label, each in circles.items()}
    drawn = html(drawings(SimpleNamespace(circles=points, faces=faces, reference_face="1")))
    pictures = [b64decode(each).decode() for each in re.findall(r"base64,([^\"]+)", drawn)]
    assert len(pictures) == 1 + len(turns)
    assert "nan" not in "".join(pictures)
    assert [f">{i}<" in pictures[1] for i in (0, 8, 40, 72, 80)] == [True, True, False, True, True]


study = load_script("budget_study")

CHANCE = 1e-5
"""On either side, of one measurand; there are some hundred."""
DRAWS = 15


@pytest.fixture(scope="module")
def fixed():
    case = study.case_of(False)
    return case, study.stated_by(case)


def errors_of(case, stated, which, draws):
    single = study.single_inputs(1, draws)
    return [study.errors(case, stated, which, single[i], i, stated.common) for i in range(draws)]


def source_of(stated, key):
    return next(each for each in stated.budget.sources if each.key == key)


@pytest.mark.parametrize(
    "which", sampled(["circle_centres", "dot_centres", "board_dots", "flatness", "intrinsics"], kept=(2,))
)
def test_errors_of_one_input_are_as_its_contribution_says(fixed, which):
    """eᵀC⁻¹e of positions, rotations and distances; the board's dots erring as the run takes them to. σ of the centres
    and σ₀ are estimated, to 2 %."""
    case, stated = fixed
    rows, source = errors_of(case, stated, which, DRAWS), source_of(stated, which)
    for k, (measurand, _) in enumerate(stated.budget.rows):
        error = np.array([each[k] for each in rows])
        covariance = measurand.unit**2 * measurand.covariance(source)
        square = float(np.einsum("ni,ni->", error, np.linalg.solve(covariance, error.T).T))
        low, high = chi2.ppf([CHANCE, 1 - CHANCE], error.size) * [0.96, 1.04]
        assert low < square < high, (measurand.name, measurand.kind, square / error.size)


@pytest.mark.parametrize("which", sampled(study.SINGLE))
def test_a_change_of_scale_is_foretold(fixed, which):
    """Drawn stratified, so that the numbers themselves have their σ to 4 % with so few; second order is far less."""
    case, stated = fixed
    single = study.single_inputs(1, 8)
    rows = [study.errors(case, stated, which, single[i], i) for i in range(8)]
    own = float(np.sqrt((single[:, study.SINGLE.index(which)] ** 2).mean()))
    for k, (measurand, row) in enumerate(stated.budget.rows):
        if measurand.kind == "distance":
            spread = float(np.sqrt(np.mean([each[k] ** 2 for each in rows])))
            assert spread == pytest.approx(own * row.contributions[which], rel=0.03)
