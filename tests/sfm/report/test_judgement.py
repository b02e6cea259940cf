"""The report in four sentences."""

import copy
import re

from stcal.errors import MappingError
from stcal.sfm.data.group_model import ELSEWHERE, Note
from stcal.sfm.report.check import CAUSE, CHECKS, OF_WHOLE_SET, Check, count_verdicts
from stcal.sfm.report.judgement import judgement_of
from stcal.sfm.report.run_page import report_html, trust
from stcal.sfm.runs.report_file import Remark
from tests.sfm.report.test_report import make


def check(key: str, verdict: str, names: tuple[str, ...] = (), remedy: str = "") -> dict:
    own = {"key": key, "title": f"Check {key}", "verdict": verdict, "reason": f"because of {key}"}
    return own | {"measured": [], "tested": 3, "names": list(names), "remedy": remedy}


def report(*checks: dict, source: str = "board", share: float = 0.36, **sigma_um: list[float]) -> dict:
    """Of faces 1 to 4, 300 mm apart, with σ by ``f2`` …, all checks passed where none is given.

    ``share`` of the variances is due to ``source``, the rest to the photographs.
    """
    made = make()
    two = made["faces"]["2"]
    for name in ("2", "3", "4"):
        own = sigma_um.get(f"f{name}", [2.0, 2.0, 1.0])
        sources = {"circles": 0.8, "dots": 0.6}
        parts = {kind: [(1 - share) ** 0.5 * part * value for value in own] for kind, part in sources.items()}
        parts[source] = [share**0.5 * value for value in own]
        made["faces"][name] = copy.deepcopy(two) | {
            "translation_sigma_um": own,
            "translation_mm": [300.0, 0.0, 0.0],
            "translation_sources_um": parts,
        }
    made["faces"]["1"] |= {"translation_sigma_um": [0.0] * 3, "rotation_sigma_mdeg": [0.0] * 3}
    made["summary"] |= {"scale_sigma_ppm": 2.0, "faces": 4, "circle_sigma_px": 0.0174}
    made["checks"] = list(checks) or [check(f"c{i}", "passed") for i in range(17)]
    return made


def test_all_is_well_or_what_makes_sigma_larger_is_named_in_the_words_of_a_photographer():
    found = judgement_of(report(f3=[3.04, 1.0, 1.0]))
    assert (found.verdict, found.use) == ("yes", "Yes: 17 checks passed.")
    assert (found.position_face, found.position_sigma_um) == ("3", 3.04)
    assert (found.rotation_face, found.rotation_sigma_mdeg) == ("4", 0.723)
    assert "3.0 µm (face 3) and 0.72 mdeg (face 4)" in found.quality
    assert "2.0 ppm" in found.quality
    assert "64 % of the variance of face 3 along x (σ 3.0 µm)" in found.limit
    assert "2.2 of 3.0 µm" in found.next  # √(0.36 + 0.64/4) · 3.04
    for name in ("number", "distance", "angles", "blur", "light"):
        good = dict.fromkeys(["number", "distance", "angles", "blur", "light"], (7.3, 1.1))
        found = judgement_of(report() | {"conditions": good})
        assert found.limit.startswith("Number alone: distance, angles, blur, light are good. The centring of circles")
        assert found.next.startswith("Nothing has to be done; four times the images")
        found = judgement_of(report() | {"conditions": good | {name: (7.3, 2.04)}})
        assert found.limit.startswith(f"{name.capitalize()}: ")
        assert "; σ are up to 2.0 times larger. The centring of circles" in found.limit
        assert found.next.startswith("Nothing has to be done. To be better, ")
        found = judgement_of(report() | {"conditions": good | {name: (7.3, 8.0)}})
        assert "Nothing has to be done" not in found.next
        assert ". Or four times the images" in found.next


WHOLE_SET = check(CAUSE, "failed", remedy="look") | {"title": OF_WHOLE_SET + "Check b"}


def test_a_failed_check_forbids_the_use_and_a_suspicious_one_says_how_often_chance_makes_it():
    for others, count in (
        ((check("a", "suspicious"), check("b", "failed", remedy="look"), check("c", "passed")), "1 of 3"),
        # One that names an image comes first, one that does not tell what is wrong last, the cause of all before.
        ((check("a", "failed", ("face 2",)), check("b", "failed", ("a/1.jpg",), "look")), "2 of 2"),
        ((check("agreement", "failed", ("all",)), check("b", "failed", (), "look")), "2 of 2"),
        ((check("moved", "failed", ("a/1.jpg",), "wait"), check("c", "passed"), WHOLE_SET), "1 of 2"),
    ):
        found = judgement_of(report(*others))
        assert (found.verdict, found.next) == ("no", "Look.")
        assert count in found.use
        assert "Check b" in found.use
    others = [check(f"c{i}", "passed") for i in range(16)]
    found = judgement_of(report(check("a", "suspicious", remedy="repeat it"), *others, check("d", "not possible")))
    assert found.verdict == "with care"
    assert "1 of 17 checks is suspicious, the first: Check a; " in found.use
    assert "one sound run of 59" in found.use
    assert found.next.startswith("Check a: because of a. Repeat it.")
    left_out = check("a", "suspicious") | {
        "measured": [{"name": "a", "value": 2.0, "limit": 1.0, "unit": "px", "probability": None}]
    }  # such a residual is none by chance
    assert judgement_of(report(left_out, *others)).use == "With care: 1 of 17 checks is suspicious, the first: Check a."


def test_the_face_that_stands_out_limits_else_the_largest_share():
    """Along z the board has more than the photographs of face 3; of x, y and z together it has less."""
    found = judgement_of(report(f4=[6.0, 3.0, 2.0]))
    assert found.limit == "Face 4: 6.0 µm along x, where the others have 2.0 µm; 2 images show it, of group a."
    assert "images that show face 4" in found.next
    assert judgement_of(report(f4=[3.9, 2.0, 2.0])).limit.startswith("The centring")  # less than twice 2.0 µm
    own = report(share=0.51, f3=[2.5, 2.5, 3.5])
    for kind, factor in (("board", 0.1), ("circles", 1.4), ("dots", 1.4)):
        sources = own["faces"]["3"]["translation_sources_um"]
        sources[kind] = [*(factor * value for value in sources[kind][:2]), sources[kind][2]]
    found = judgement_of(own)
    assert "3.5 µm (face 3)" in found.quality
    assert "dots: 51 % of the variance of face 3 along z (σ 3.5 µm)" in found.limit
    assert "board.toml" in found.next
    assert judgement_of(report(share=0.49)).limit.startswith("The centring")


def test_each_source_has_its_own_remedy_and_some_results_are_not_without_care():
    """A σ of the edges of tags becomes no smaller by what is stated of the print."""
    for source, edge_share, words, not_said in (
        ("sizes", 0.6, "[[scale]]", "size_sigma_mm"),
        ("sizes", 0.1, "size_sigma_mm", "edges"),
        ("distances", None, "a longer one", "size_sigma_mm"),
        ("intrinsics", None, "calibrate-camera", "[[scale]]"),
    ):
        own = report(source=source, share=0.8)
        own["summary"]["edge_share"] = edge_share
        found = judgement_of(own)
        assert "80 % of the variance of face 4 along x (σ 2.0 µm)" in found.limit
        assert words in found.next
        assert not_said not in found.next
    for own, verdict, part, words in (
        (report() | {"options": {"solve": "paper", "eccentricity": False}}, "no", "next", "--solve paper"),
        (report() | {"options": {"solve": "chain", "eccentricity": False}}, "no", "next", "--no-eccentricity"),
        (make(sigma=False), "with care", "next", "--solve joint"),
        (report() | {"crosscheck": {"differences": ["face 2 is off"]}}, "with care", "limit", "COLMAP differs: face 2"),
        # The dots of the board tell it where groups are lost.
        (report(check(CAUSE, "failed"), check("camera", "passed")), "no", "use", "Check cause"),
    ):
        found = judgement_of(own)
        assert found.verdict == verdict
        assert words in getattr(found, part)
    own = make(sigma=False)
    assert "solved one by one; look at the chains" in trust(own, judgement_of(own))[0]


def test_the_board_alone_one_face_and_what_is_missing():
    own = report()
    own["faces"] = {}
    found = judgement_of(own)
    assert (found.verdict, found.position_face) == ("no", None)
    assert "3.6 µm RMS" in found.quality
    own["faces"] = {"1": report()["faces"]["1"]}
    assert "only one face" in judgement_of(own).limit
    own = report(*[check(key, "not possible", remedy="add a group") for key in "ab"])
    own["summary"]["faces_not_seen"] = ["5", "6"]
    told = judgement_of(own)
    assert told.use.startswith("Part: 4 of 6 faces; nothing was checked, 2 were not possible; ")
    assert "faces 5, 6" in told.use
    assert "4 of the 6 faces" in told.limit
    assert told.next.startswith("Photograph faces 5, 6")
    assert told.next.endswith("For 2 more checks: add a group.")


def test_sigma_that_are_larger_than_pixels_explain_and_premises_are_said():
    own = report(check("groups", "suspicious") | {"enlarges": 1.8})
    own["summary"] |= {"photographs_differ": 1.4, "sigma_enlarged": 1.8}
    told = judgement_of(own)
    assert (told.verdict, told.position_sigma_um) == ("with care", 2.0)
    assert "differ 1.4 times" in told.use
    assert "1.8 times as large, to cover what is beyond chance: Check groups" in told.use
    own["summary"] |= {"photographs_differ": 1.1, "sigma_enlarged": 1.0}
    own["checks"] = [check("cause", "suspicious") | {"title": "Cause of the whole set: focus changed"}]
    assert judgement_of(own).use == "With care: focus changed, though no check failed."
    own = report()
    assert judgement_of(own).quality.endswith("that holds where the intrinsics and the board's pitch are as stated.")
    own["options"]["refine_camera"] = True
    assert judgement_of(own).quality.endswith("that holds where the board's pitch is as stated.")


def test_what_nobody_can_make_possible_is_not_missed_but_photographs_that_do_not_test_one_another():
    """A body of tags has no circles and no board: what tests these is not applicable. Two of five checks passed, but
    none that residuals decide."""
    own = report(check("labels", "passed"), check("rim", "not possible"), check("halves", "not possible", remedy="add"))
    assert judgement_of(own).use == "Yes: 1 checks passed, 1 was not possible."
    assert count_verdicts(map(Check.read, own["checks"])) == "1 passed, 1 not possible, 1 not applicable"
    keys = {"centres": "not possible", "labels": "not possible", "agreement": "not possible"}
    missed = [check(key, verdict, remedy="add images") for key, verdict in keys.items()]
    own = report(check("pitch", "passed"), check("radius", "passed"), *missed)
    told = judgement_of(own)
    assert told.verdict == "with care"
    assert told.use == "With care: the photographs are too few to test one another, 3 checks were not possible."
    keys["labels"] = "passed"
    assert judgement_of(report(*(check(k, v) for k, v in keys.items()))).verdict == "yes"


def test_a_face_that_was_expected_or_read_and_left_out_is_missing():
    own = report()
    own["summary"] |= {"faces_not_seen": ["5", "6"], "faces_expected": ["1", "6"]}
    told = judgement_of(own)
    assert (told.verdict, told.missing, told.position_sigma_um) == ("part", ["6"], 2.0)
    assert "faces 5, 6" in told.use
    assert "Face 6 should have been photographed" in told.limit
    own["checks"] = [check("a", "failed", remedy="x")]
    assert re.search("the first: Check a; .* faces 5, 6 ", judgement_of(own).use)
    own = report()
    own["summary"]["faces_not_seen"] = ["5"]
    own["left_out"]["notes"] = [{"image": f"a/{i}.jpg", "code": ELSEWHERE, "place": "5"} for i in range(3)]
    told = judgement_of(own)
    assert (told.verdict, "face 5 was read in 3 images" in told.use) == ("part", True)
    assert "Read why face 5 was left out" in told.next
    own["summary"]["faces_expected"] = ["1", "2"]  # the photographs were not to show it, but it is said
    told = judgement_of(own)
    assert (told.verdict, told.missing, "face 5 was read in 3 images" in told.use) == ("part", [], True)


def test_a_group_that_was_left_out_calls_for_care_and_after_no_there_are_no_micrometres():
    """In place of what limits the rest, which is not what the user should look at first."""
    own = report()
    note = Note.of_group("25", MappingError("E-GROUP-NO-BOARD", "group 25: no board in 4 images; keep it in view"))
    own["notes"] = [Remark.model_validate(note).model_dump()]
    told = judgement_of(own)
    assert (told.verdict, told.missing) == ("with care", ["group 25"])
    assert "group 25" in told.use
    assert (told.limit, told.next) == ("Left out: group 25: no board in 4 images.", "Keep it in view.")
    own["checks"][0] = check("a", "suspicious")
    assert judgement_of(own).use.count("With care: ") == 1
    for key in (key for key, (_, invalid) in CHECKS.items() if invalid):
        failed = report(check(key, "failed", remedy="x"), check("b", "passed"), f3=[3.04, 1.0, 1.0])
        told = judgement_of(failed).model_dump()
        assert told["invalid"] == list(CHECKS[key][1])
        assert all(what in told["quality"] for what in told["invalid"])
        assert "µm" not in told["quality"]
        sigma = ("position_sigma_um", "rotation_sigma_mdeg", "position_face", "rotation_face")
        assert {told[k] for k in sigma} == {None}
    page = report_html(failed, {})
    assert "No σ are shown" in page
    assert "3.04" not in page.replace("-3.04", "")
