"""The report in four sentences: may I use it, how good is it, what limits it, what to do next; from ``report.json``
alone."""

import math
from collections.abc import Iterable
from statistics import median
from typing import Literal

from pydantic import Field

from stcal.geometry.clusters import NOTED
from stcal.io.images import TOP_GROUP
from stcal.io.json import Part
from stcal.report.text import join, number, significant
from stcal.sfm.data.note import ELSEWHERE, GROUP_LEFT_OUT, NOT_AS_DRAWN, SINGLE

CHANCE = "'Suspicious' happens by chance in one run in 1,000, 'failed' in one in 100,000."
"""Text on the false alarms of one check; the limits are those of ``stcal.sfm.checks.verdict``."""
TESTS_OF_CHANCE = 1000
TAIL = 2.0
"""Ratio of a face's σ to the median of the others above which this face limits the result by itself."""
PHOTOGRAPHS = ("circles", "dots")
"""Sources of ``translation_sources_um`` that more photographs make smaller, others hardly."""
MOST_PPM = 1000.0
"""Relative σ, in ppm, from which it is stated in %."""
SHARP_PX = 1.2
"""σ of the blur of edges above which it limits a result: σ of centres are 1.6 times those at 0.75 px, of a sharp lens
and the pixels' own size, which 2.5 times the images would make up for."""
MORE = 4
"""How many times the images the answer gives σ for."""
QUESTIONS = {
    "use": "May I use it?",
    "quality": "How good is it?",
    "limit": "What limits it?",
    "next": "What to do next?",
}
Use = Literal["yes", "with care", "part", "no"]
CAUSE = "cause"
"""Key of the check that names what all images have in common and makes others fail."""
GENERAL = ("centres", "agreement", "halves")
"""Keys of the checks that show that something is wrong, but not what. Other checks are named before them."""
IN_ONE_GROUP = ("board", "board-lines", "flatness", "control", "camera", "residual-field", "moved", "image-residuals")
"""Keys of the checks that test each group by itself, and need no agreement of groups."""
EXPLAINED_BY = {"radius-design": ("rim",), "groups": IN_ONE_GROUP, "loops": IN_ONE_GROUP}
"""Checks that fail because of what others found; those are said before them. A fault within a group makes it contradict
the others, but groups that contradict one another make no fault within one of them."""
TESTED_BY = {"labels", "agreement"}
"""Keys of the checks of which one at least must be possible for σ to be tested at all."""
OF_WHOLE_SET = "Cause of the whole set: "
"""How the title of that check begins, before the cause."""
EVERY_SIGMA = "every σ"
DISTANCES = "all distances and the size"
UNKNOWN_SIZE = "nothing of known size is in view, and its size is that of the drawing"
SIZES = {
    "board": "the board's pitch",
    "faces": "the printed size of the faces",
    "distances": "the known distances",
    "drawing": "a length of the drawing",
}
"""What the size of a result rests on."""
PLACES = "the places of all faces"
CENTRES = "all centres of circles"
INVALIDATES: dict[str, tuple[str, ...]] = {
    CAUSE: (PLACES, DISTANCES, EVERY_SIGMA),
    "camera": (PLACES, DISTANCES, EVERY_SIGMA),
    "residual-field": (PLACES, DISTANCES, EVERY_SIGMA),
    "centres": (EVERY_SIGMA,),
    "agreement": (PLACES, EVERY_SIGMA),
    "halves": (PLACES, EVERY_SIGMA),
    "groups": (PLACES, EVERY_SIGMA),
    "loops": (PLACES, EVERY_SIGMA),
    "moved": (PLACES, EVERY_SIGMA),
    "image-residuals": (PLACES, EVERY_SIGMA),
    "labels": (PLACES, EVERY_SIGMA),
    "board": (DISTANCES, EVERY_SIGMA),
    "board-lines": (DISTANCES, EVERY_SIGMA),
    "pitch": (DISTANCES,),
    "scales": (PLACES, DISTANCES, EVERY_SIGMA),
    "radius": ("the centres of the circles whose radius stands out", EVERY_SIGMA),
    "radius-design": (CENTRES, PLACES),
    "flatness": ("the frames of the faces with circles off their plane", EVERY_SIGMA),
    "control": (CENTRES, PLACES),
}
"""What does not hold where a check has failed, by its key."""


class Judgement(Part):
    """Section ``judgement`` of ``report.json``."""

    verdict: Use = Field(description="`yes`; `with care`; `part`: faces of the design are missing; `no`")
    use: str = Field(description="whether the result may be used, in words")
    quality: str = Field(description="how good is it: largest σ of position and rotation, and of the size")
    limit: str = Field(description="what limits it")
    next: str = Field(description="what to do next")
    position_sigma_um: float | None = Field(
        description="largest σ of a face's position along an axis; null without covariances and after *no*, as the "
        "next three"
    )
    position_face: str | None = Field(description="name of that face")
    rotation_sigma_mdeg: float | None = Field(description="largest σ of a face's rotation about an axis")
    rotation_face: str | None = Field(description="name of that face")
    invalid: list[str] = Field(default=[], description="what is invalid, because checks failed on which it rests")
    missing: list[str] = Field(default=[], description="expected faces, and groups, that are not in the result")

    def answers(self) -> list[tuple[str, str]]:
        """Returns the questions with their answers, in order."""
        return [(question, getattr(self, key)) for key, question in QUESTIONS.items()]


Cause = tuple[str, str]
"""What limits a result, and the remedy."""


def judged(report: dict) -> dict:
    """Returns the content of ``report.json`` with a new judgement."""
    return report | {"judgement": judgement_of(report).model_dump()}


def judgement_of(report: dict) -> Judgement:
    """Returns the judgement of a run from the content of ``report.json``."""
    verdict, use = _use(report)
    failed = [check["key"] for check in report.get("checks", []) if check["verdict"] == "failed"]
    lost = _of_notes(report, GROUP_LEFT_OUT, "Left out")
    before = None if failed else lost  # what is only suspicious comes after it
    by_result = _control(report) or before or _by_checks(report) or _by_gaps(report)
    drawing = _of_notes(report, NOT_AS_DRAWN, "The drawing") if report["faces"] else None
    cause = by_result or drawing or lost or _by_size(report) or _by_sigma(report)
    position, rotation = (
        None if verdict == "no" else _largest(report, key) for key in ("translation_sigma_um", "rotation_sigma_mdeg")
    )
    invalid = invalidated(failed)
    return Judgement(
        verdict=verdict,
        use=use,
        quality=_unknown(report, invalid) if verdict == "no" else _quality(report, position, rotation),
        limit=cause[0],
        next=" ".join([*filter(None, cause[1:]), *_more(report, verdict)]),
        position_sigma_um=position and position[0],
        position_face=position and position[1],
        rotation_sigma_mdeg=rotation and rotation[0],
        rotation_face=rotation and rotation[1],
        invalid=invalid,
        missing=[*_missing_faces(report), *_lost_groups(report)],
    )


def invalidated(failed: Iterable[str]) -> list[str]:
    """Returns what failed checks, by their keys, do not let hold, each once."""
    return list(dict.fromkeys(what for key in failed for what in INVALIDATES.get(key, (EVERY_SIGMA,))))


def without_sigma_of(faces: dict[str, dict]) -> dict[str, dict]:
    """Returns the rows of the faces without σ, which a failed run must not show."""
    none = {"translation_sigma_um": None, "rotation_sigma_mdeg": None, "translation_sources_um": {}}
    return {name: face | none for name, face in faces.items()}


def without_sigma(report: dict) -> dict:
    """Returns the content of ``report.json`` without σ."""
    return report | {
        "faces": without_sigma_of(report["faces"]),
        "between_faces": [row | {"distance_sigma_um": None} for row in report["between_faces"]],
        "summary": report["summary"] | {"scale_sigma_ppm": None},
    }


def not_first(keys: Iterable[str]) -> set[str]:
    """Returns which of the checks of one verdict, by their keys, are said after the others."""
    own = set(keys)
    return {key for key in own if key in GENERAL or not own.isdisjoint(EXPLAINED_BY.get(key, ()))}


# --- may I use it -----------------------------------------------------------------------------------------------------


BEGINNINGS = {"yes": "Yes", "with care": "With care", "no": "No"}


def _use(report: dict) -> tuple[Use, str]:
    verdict, words = _by_result(report)
    begin, reasons, gaps = "", [words], _gaps(report) if report["faces"] else []
    if verdict != "no" and "drawing" in report["summary"].get("scale_from", []):
        verdict, begin, reasons = "with care", "With care, for its shape alone", [UNKNOWN_SIZE, words]
    drawn = _notes(report, NOT_AS_DRAWN) if report["faces"] else []
    reasons += [note["words"] for note in drawn[:1]]
    if verdict == "yes" and (drawn or (gaps and _lost_groups(report))):
        verdict = "with care"
    if verdict != "no" and gaps and (absent := _lacking(report)):
        begin = "Part, with care" if verdict == "with care" else "Part"
        verdict, n = "part", len(report["faces"])
        reasons.insert(0, f"{n} of {n + len(absent)} faces")
    return verdict, f"{begin or BEGINNINGS[verdict]}: {'; '.join([*reasons, *gaps])}."


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def _by_result(report: dict) -> tuple[Use, str]:
    """Returns verdict and reason by what is in the result."""
    checks = [check for check in report.get("checks", []) if check["key"] != CAUSE]
    counts = {v: sum(c["verdict"] == v for c in checks) for v in ("failed", "suspicious", "passed", "not possible")}
    if not report["faces"]:
        return "no", "there is no face in it, only λ and residuals of the board"
    if _control(report):
        return "no", "it was made for comparison, and its faces are biased by tens of µm"
    made = len(checks) - counts["not possible"]
    missing = sum(c["verdict"] == "not possible" and applies(c["verdict"], c["remedy"]) for c in checks)
    n = counts["failed"]
    cause = [check for check in report.get("checks", []) if check["key"] == CAUSE]
    name = cause[0]["title"].removeprefix(OF_WHOLE_SET) if cause else ""
    if cause and cause[0]["verdict"] == "failed":
        of = f"; that is the likely cause of {n} of {made} checks that failed" if n else ""
        return "no", f"{name}{of}"
    if n:
        return "no", f"{n} of {made} checks failed, the first: {_first(report, 'failed')['title']}"
    if different := report.get("crosscheck", {}).get("differences"):
        return "with care", f"the native COLMAP comes to other faces ({different[0]})"
    if words := _larger(report, checks):
        return "with care", f"{words}{f'; the likely cause: {name}' if cause else ''}"
    if cause:
        return "with care", f"{name}, though no check failed"
    if n := counts["suspicious"]:
        message = f"{n} of {made} checks {'is' if n == 1 else 'are'} suspicious, the first: "
        first = _first(report, "suspicious")
        # A residual beyond its limit that was left out is none by chance, and has no probability.
        chance = all(value["probability"] is not None for value in first["measured"][:1])
        by_chance = f"; of {made} checks one is so by chance in one sound run of {round(TESTS_OF_CHANCE / made)}"
        return "with care", f"{message}{first['title']}{by_chance if chance else ''}"
    if report["summary"]["sigma0"] is None:
        return (
            "with care",
            "groups were solved one by one; there are no σ, and there are fewer checks",
        )
    testing = [check["verdict"] for check in checks if check["key"] in TESTED_BY]
    if testing and set(testing) == {"not possible"}:
        return (
            "with care",
            f"the photographs are too few to test one another, {missing} checks were not possible",
        )
    passed = f"{counts['passed']} checks passed" if counts["passed"] else "nothing was checked"
    open_ = f", {missing} {'was' if missing == 1 else 'were'} not possible" if missing else ""
    return "yes", f"{passed}{open_}"


def _larger(report: dict, checks: list[dict]) -> str:
    """Returns by how much σ are larger than pixels explain, and why; empty if they are not."""
    words = []
    if (differ := report["summary"].get("photographs_differ") or 1.0) > NOTED:
        words.append(f"photographs differ {differ:.1f} times more than their pixels explain, and σ are larger by that")
    if (larger := report["summary"].get("sigma_enlarged") or 1.0) > 1:
        first = max(checks, key=lambda check: check.get("enlarges", 1.0))
        words.append(f"all σ are {larger:.1f} times as large, to cover what is beyond chance: {first['title']}")
    return "; ".join(words)


FEW_IMAGES = 6
"""Number of photographs below which more of them are the first thing to do."""


def _are_few(report: dict) -> bool:
    """Returns whether too few photographs were used of a body that is its own setting, without groups."""
    alone = all(group["name"] == TOP_GROUP for group in report["groups"])
    return alone and report["summary"]["images_mapped"] < FEW_IMAGES


def applies(verdict: str, remedy: str) -> bool:
    """Returns whether a check could be made or made possible: not one of circles or a board where there are none."""
    return verdict != "not possible" or bool(remedy)


def _faces(names: list[str]) -> str:
    """Returns the names of faces in words."""
    return f"face{'' if len(names) == 1 else 's'} {join(names)}"


def _lacking(report: dict) -> list[str]:
    """Returns the faces without which the result is a part: of the design, or of those that the user expects."""
    wanted = report["options"].get("expect_faces")
    return [face for face in report["summary"]["faces_not_seen"] if not wanted or face in wanted]


def _missing_faces(report: dict) -> list[str]:
    """Returns the faces that were expected from the photographs and are missing from the result."""
    expected = report["summary"].get("faces_expected") or []
    return [face for face in report["summary"]["faces_not_seen"] if face in expected]


def _notes(report: dict, code: str) -> list[dict]:
    return [note for note in report["notes"] if note["code"] == code]


def _lost_groups(report: dict) -> list[str]:
    return [f"group {note['place']}" for note in _notes(report, GROUP_LEFT_OUT)]


def left_out_in(report: dict, face: str) -> list[str]:
    """Returns the images in which a face was read but left out."""
    of_face = {(ELSEWHERE, face), (SINGLE, face)}
    notes = report["left_out"]["notes"]
    return list(dict.fromkeys(each["image"] for each in notes if (each["code"], each["place"]) in of_face))


def _is_read(report: dict, face: str) -> bool:
    """Whether a face that is not in the result was read in two images, or has circles that were mapped or left out."""
    return len(left_out_in(report, face)) > 1 or _has_circles(report, face)


def _has_circles(report: dict, face: str) -> bool:
    rows = [*report["residuals_by_label"], *report["left_out"]["circles"]]
    return any(row["label"].startswith(f"{face}:") for row in rows)


def _some_unused(report: dict) -> bool:
    """Whether photographs were left out, which may show what was seen in no other."""
    return bool(report["left_out"]["images"] or _lost_groups(report))


def _gaps(report: dict) -> list[str]:
    """Returns in words what is missing: faces that are not in the result, or in one image alone, and lost groups."""
    never, words = [], []
    for face in report["summary"]["faces_not_seen"]:
        images = left_out_in(report, face)
        if images:
            shown = "1 image" if len(images) == 1 else f"{len(images)} images"
            words.append(f"face {face} was read in {shown} and left out")
        elif _has_circles(report, face):
            those = "those in the images that were used" if _some_unused(report) else "they"
            words.append(f"face {face} is not in it, though circles of it were seen: {those} do not hold its frame")
        else:
            never.append(face)
    if never:
        was = "was seen in no image" if len(never) == 1 else "were seen in no image"
        if _some_unused(report):
            was = "is in no image that was used" if len(never) == 1 else "are in no image that was used"
        words.insert(0, f"{_faces(never)} of the design {was}")
    single = [name for name, face in report["faces"].items() if face["images"] == 1]
    if single:
        words.append(f"{_faces(single)} {'rests' if len(single) == 1 else 'rest'} on one image")
    words += [f"{group} was left out completely" for group in _lost_groups(report)]
    return words


def _first(report: dict, verdict: str) -> dict:
    """Returns the cause of the whole set, else the first check of this verdict, rather one that names an image."""
    images = {image["name"] for image in report["images"]}
    matching = [check for check in report.get("checks", []) if check["verdict"] == verdict]
    naming = [check for check in matching if any(name in images for name in check["names"])]
    later = not_first(check["key"] for check in matching)
    telling = [check for check in matching if check["key"] not in later]
    return [*(check for check in matching if check["key"] == CAUSE), *naming, *telling, *matching][0]


# --- how good ---------------------------------------------------------------------------------------------------------


def _unknown(report: dict, invalid: list[str]) -> str:
    """Returns the answer of a result that must not be used: no number, and what does not hold."""
    if not report["faces"]:
        return _quality(report, None, None)
    if invalid:
        return f"That is unknown: {join(invalid)} are not valid before the cause of the failure is removed."
    if _control(report):
        return "That is unknown: biased faces have no valid σ."
    return "That is unknown."


def _quality(report: dict, position: tuple[float, str] | None, rotation: tuple[float, str] | None) -> str:
    if not report["faces"]:
        worst = max((group["scale"]["board_rms_um"] for group in report["groups"]), default=0.0)
        return f"The board's dots are within {number(worst, 1)} µm RMS of their design."
    if len(report["faces"]) == 1:
        return "There is one face, which is the target frame itself; σ of its circles are in faces.json."
    if position is None or rotation is None:
        ways = [chain for chains in report["chains"].values() if len(chains) > 1 for chain in chains]
        if not ways:
            return "There are no σ, and no face is reached by two chains that could be compared."
        apart, turned = max(way["translation_mm"] for way in ways), max(way["rotation_rad"] for way in ways)
        return (
            f"There are no σ; chains to the same face through different groups are up to {number(1e3 * apart, 1)} µm "
            f"and {number(1e3 * math.degrees(turned), 2)} mdeg off their mean."
        )
    size = report["summary"]["scale_sigma_ppm"]
    scale = "" if size is None else f", the size to {_relative(size)}"
    if "drawing" in report["summary"].get("scale_from", []):
        scale = ", in the unit of the drawing, and the size is not known"
    rim = report["summary"].get("rim_mm")
    surface = f" They are those of the luminous surface, behind rims of {rim:.3f} mm." if rim else ""
    return (
        f"Faces are known against face {report['reference_face']} to {number(position[0], 1)} µm (face {position[1]}) "
        f"and {number(rotation[0], 2)} mdeg (face {rotation[1]}) at worst, one σ along and about an axis{scale}; that "
        f"holds where {_premise(report)} as stated.{surface}"
    )


def _relative(ppm: float) -> str:
    """Returns a relative σ in ppm, a large one in %."""
    return f"{number(ppm, 1)} ppm" if ppm < MOST_PPM else f"{significant(1e-4 * ppm)} %"


def _premise(report: dict) -> str:
    premises = [] if report["options"].get("refine_camera") else ["the intrinsics"]
    sources = report["summary"].get("scale_from", ["board"])
    single = len(premises) + len(sources) == 1 and sources != ["distances"]
    return f"{' and '.join([*premises, *(SIZES[source] for source in sources)])} {'is' if single else 'are'}"


def _largest(report: dict, key: str) -> tuple[float, str] | None:
    """Returns (largest value over the axes, face) of the worst face."""
    others = {name: face for name, face in report["faces"].items() if name != report["reference_face"]}
    return max(((max(f[key]), name) for name, f in others.items() if f[key] is not None), default=None)


# --- what limits it, what next ----------------------------------------------------------------------------------------


def _control(report: dict) -> Cause | None:
    """Returns the cause of a result without faces, or of one made for comparison; None for other results."""
    options = report["options"]
    if not report["faces"]:
        return (
            f"No face of the target was recognised in {report['summary']['images']} images.",
            "Look at the overlays; where a face is in view, give its design with --target.",
        )
    if options["solve"] == "paper":
        return (
            "The published method: contours with equal weights, without the eccentricity of circles.",
            "Run it without --solve paper.",
        )
    if not options["eccentricity"]:
        return "The eccentricity of circles is not corrected.", "Run it without --no-eccentricity."
    return None


def _by_checks(report: dict) -> Cause | None:
    """Returns the cause by the first failed check, a suspicious one that limits the result, or the cross-check."""
    verdicts = {check["verdict"] for check in report.get("checks", [])}
    for verdict in ("failed", "suspicious"):
        if verdict in verdicts:
            check = _first(report, verdict)
            remedy = f"{_capital(check['remedy'] or 'look at what the check names')}."
            found = f"{check['title']}: {check['reason']}."
            if verdict == "failed":
                return found, remedy
            limits = _by_gaps(report) or _by_size(report) or _by_sigma(report)
            return limits[0], f"{found} {remedy}"  # what is suspicious is to be looked at; σ still tell
    if different := report.get("crosscheck", {}).get("differences"):
        remedy = "Look at the cross-check to see which of the two is right."
        return f"The native COLMAP differs: {different[0]}.", remedy
    return None


def _by_gaps(report: dict) -> Cause | None:
    """Returns the cause where faces are missing that were to be there; None if all are."""
    if missing := _missing_faces(report):
        return (
            f"Face {join(missing)} should have been photographed, and is not in the result.",
            "Look at the overlays and at what was left out, in the photographs that show it.",
        )
    if report["faces"] and (absent := _lacking(report)):
        n, of = len(report["faces"]), len(report["faces"]) + len(absent)
        return f"The photographs: they give {n} of the {of} faces of the design.", ""
    return None


def _of_notes(report: dict, code: str, begin: str) -> Cause | None:
    """Returns what the first note of this kind says limits the result; None if there is none."""
    for note in _notes(report, code)[:1]:
        return f"{begin}: {note['words']}.", f"{_capital(note['remedy'] or 'take it again')}."
    return None


def _by_size(report: dict) -> Cause | None:
    """Returns the cause where no size is known; None where one is."""
    if "drawing" not in report["summary"].get("scale_from", []):
        return None
    return (
        "Its size: nothing of known size is in view.",
        "Measure the distance of two points and state it with scale in target.toml, or photograph the board of dots "
        "with it; if one is in view, give its file with --board.",
    )


def _by_sigma(report: dict) -> Cause:
    """Returns the cause that the σ show, of the face and along the axis that "How good is it?" has."""
    if len(report["faces"]) == 1:
        remedy = "Photograph it together with other faces."
        return "There is only one face, and nothing links it to others.", remedy
    found = _largest(report, "translation_sigma_um")
    if found is None:
        return "What limits it is unknown without σ.", "Run it with --solve joint."
    sigma, worst = found
    face = report["faces"][worst]
    axis = face["translation_sigma_um"].index(sigma)
    variance = {kind: values[axis] ** 2 for kind, values in face.get("translation_sources_um", {}).items()}
    photographs = sum(variance.pop(kind, 0.0) for kind in PHOTOGRAPHS)
    source = max(variance, key=lambda kind: variance[kind], default="")
    of_all = f"% of the variance of face {worst} along {'xyz'[axis]} (σ {number(sigma, 1)} µm)"
    if source and variance[source] > photographs:
        name, remedy = _source(report, source)
        return f"{name}: {number(100 * variance[source] / sigma**2, 0)} {of_all}.", remedy
    others = [
        max(row["translation_sigma_um"])
        for name, row in report["faces"].items()
        if name not in (worst, report["reference_face"]) and row["translation_sigma_um"] is not None
    ]
    if others and sigma > TAIL * median(others):
        of_groups = "" if face["groups"] == [TOP_GROUP] else f", of group {join(face['groups'])}"
        return (
            f"Face {worst}: {number(sigma, 1)} µm along {'xyz'[axis]}, where the others have "
            f"{number(median(others), 1)} µm; {face['images']} images show it{of_groups}.",
            f"Add images that show face {worst}; `stcal-sfm advise RUN` says from where.",
        )
    return _by_images(report, sigma, photographs, of_all)


def _by_images(report: dict, sigma: float, variance: float, of_all: str) -> Cause:
    """Returns the cause where photographs limit the result; ``variance``: their part of ``sigma``², 0 if unknown."""
    summary, advice = report["summary"], "`stcal-sfm advise RUN` says which do most."
    if not variance:
        return "What limits it is not in this report.", f"`stcal-sfm budget RUN` shows it, and {advice}"
    centre = summary.get("circle_sigma_px")
    of_centres = "" if centre is None else f", σ {number(centre, 4)} px"
    blurs = [sum(row["blur_px"]) / 2 for row in report.get("focus", [])]
    if blurs and (blur := median(blurs)) > SHARP_PX:
        return (
            f"The sharpness: edges are blurred by {number(blur, 1)} px, half of that is usual, and σ of centres grow "
            f"with it; they are {number(100 * variance / sigma**2, 0)} {of_all}.",
            f"Focus on the middle of target and board, close the aperture, or stand farther away; then {advice}",
        )
    fewer = math.sqrt(max(sigma**2 - variance * (1 - 1 / MORE), 0.0))
    return (
        f"The centring of circles{of_centres} in {summary['images_mapped']} images: "
        f"{number(100 * variance / sigma**2, 0)} {of_all}; no face stands out.",
        f"Nothing has to be done; four times the images would make {number(fewer, 1)} µm of these {number(sigma, 1)} "
        f"µm, and {advice}",
    )


def _source(report: dict, kind: str) -> tuple[str, str]:
    """Returns the name of a source other than the photographs that limits the result, and its remedy."""
    few = "" if _are_few(report) else "More photographs help little: "
    if kind == "sizes":
        summary = report["summary"]
        given = "distances" in summary.get("scale_from", [])
        distance = f"state {'a longer or better known' if given else 'the'} distance of two points of the target"
        if (summary.get("edge_share") or 0.0) > 0.5:
            common = "all edges may have the same error, which no residual shows"
            return "The size, by the edges of tags", f"{few}{common}; {distance} with [[scale]] in target.toml."
        remedy = f"measure it better than size_sigma_mm says, or {distance} with [[scale]] in target.toml."
        return "The size of the print", f"{few}{remedy}" if few else _capital(remedy)
    remedies = {
        "board": ("The places of the board's dots", "measure them, or take a better plate, and state sigma_mm in "
                  "board.toml."),
        "print": ("The places of the printed corners", "measure them, or take a better print, and state sigma_mm in "
                  "target.toml."),
        "distances": ("The known distances", "measure a longer one, or the same better, and state it with [[scale]] in "
                      "target.toml."),
        "flatness": ("The flatness of the faces", "measure it, and state it with --flatness."),
        "intrinsics": ("The intrinsics", "calibrate the camera better (`stcal-sfm calibrate-camera`), and give that "
                       "file."),
    }  # fmt: skip
    name, remedy = remedies[kind]
    return name, f"{few}{remedy}" if few else _capital(remedy)


def _more(report: dict, verdict: Use) -> list[str]:
    """Returns what to do beyond the limit: about missing faces, and about checks that could not be made."""
    advice = []
    used, given = (report["summary"][key] for key in ("images_mapped", "images"))
    if report["faces"] and _are_few(report):
        advice.append(f"Take more photographs: {used} of {given} could be used, and 10 to 20 are usual.")
    if report["faces"] and (missing := _lacking(report)):
        read = [face for face in missing if _is_read(report, face) or left_out_in(report, face)]
        unseen = [face for face in missing if face not in read]
        if unseen:
            seen = "in no image that was used" if _some_unused(report) else "not seen in any image"
            body = "" if verdict == "part" else "; if they are in the images, check that target.toml is of this body"
            advice.append(f"Photograph {_faces(unseen)} together with one of the others: {seen}{body}.")
        if read:
            was, it = ("was", "it") if len(read) == 1 else ("were", "them")
            advice.append(f"Read why {_faces(read)} {was} left out, and photograph {it} again from other places.")
    open_ = [
        c for c in report.get("checks", []) if c["verdict"] == "not possible" and applies(c["verdict"], c["remedy"])
    ]
    if verdict in ("yes", "part") and open_:
        remedy = open_[0]["remedy"].removeprefix("to be able to make it, ")
        same = sum(check["remedy"] == open_[0]["remedy"] for check in open_)
        advice.append(f"For {same} more check{'s' * (same > 1)}: {remedy}.")
    return advice
