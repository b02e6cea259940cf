"""The report in four sentences: may I use it, how good is it, what limits it, what to do next; from ``report.json``
alone."""

import math
from statistics import median
from typing import Literal

from pydantic import Field

from stcal.geometry.clusters import NOTED
from stcal.io.images import TOP_GROUP
from stcal.io.json import Part
from stcal.report.document import sentence
from stcal.report.text import join, number, significant
from stcal.sfm.data.group_model import ELSEWHERE, GROUP_LEFT_OUT, NOT_AS_DRAWN
from stcal.sfm.report.check import CAUSE, SUSPICIOUS, Check, invalidated, ranked

TAIL = 2.0  # ratio of a face's σ to the median of the others above which this face limits the result by itself
PHOTOGRAPHS = ("circles", "dots")  # the sources that more photographs make smaller, others hardly
MOST_PPM = 1000.0  # relative σ, in ppm, from which it is stated in %
MORE = 4  # how many times the images the answer gives σ for
FEW_IMAGES = 6  # number of photographs below which more of them are the first thing to do
QUESTIONS = {
    "use": "May I use it?",
    "quality": "How good is it?",
    "limit": "What limits it?",
    "next": "What to do next?",
}
Use = Literal["yes", "with care", "part", "no"]
TESTED_BY = {"labels", "agreement"}  # σ are tested if one of these checks is possible
UNKNOWN_SIZE = "nothing of known size is in view, and its size is that of the drawing"
SIZES = {
    "board": "the board's pitch",
    "faces": "the printed size of the faces",
    "distances": "the known distances",
    "drawing": "a length of the drawing",
}
"""What the size of a result rests on."""


SOURCES = {
    "edges": (
        "The size, by the edges of tags",
        "all edges may have the same error, which no residual shows; {distance}",
    ),
    "sizes": ("The size of the print", "measure the print better than size_sigma_mm says, or {distance}"),
    "board": (
        "The places of the board's dots",
        "measure the dots, or take a better plate, and state sigma_mm in board.toml",
    ),
    "print": (
        "The places of the printed corners",
        "measure the corners, or take a better print, and state sigma_mm in target.toml",
    ),
    "distances": (
        "The known distances",
        "measure a longer one, or the same better, and state it with [[scale]] in target.toml",
    ),
    "flatness": ("The flatness of the faces", "measure the flatness, and state it with --flatness"),
    "intrinsics": ("The intrinsics", "calibrate the camera better (`stcal-sfm calibrate-camera`), and give that file"),
}
"""Name and remedy of each source of σ beside the photographs."""
MATTERS = 1.25  # factor on σ from which a condition of the photographs is named
HARMS = 3.0  # the same from which it is to be changed
CONDITIONS = {
    "number": ("{:.0f} images in a group, 10 are usual", "take more photographs"),
    "distance": ("pictures are filled to {:.0f} %, 70 % is usual", "go nearer"),
    "angles": ("the cameras of a group stand within {:.0f}°, 80° is usual", "photograph from farther apart"),
    "blur": ("rims are blurred by {:.1f} px, 0.8 px is sharp", "focus on the target's middle and close the aperture"),
    "light": ("noise is {:.1f} % of the contrast, 1.4 % is usual", "give more light, or expose longer at a lower gain"),
}
"""What is said of each condition of the photographs with its measured value, and the remedy."""


class Judgement(Part):
    """Section ``judgement`` of ``report.json``."""

    verdict: Use = Field(description="`yes`; `with care`; `part`: faces of the design are missing; `no`")
    reserved: bool = Field(False, description="whether it is to be used with care, also where it is a part")
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


Cause = tuple[str, str]  # what limits a result, and the remedy


def judgement_of(report: dict) -> Judgement:
    """Returns the judgement of a run from the content of ``report.json``."""
    run = _Run(report)
    verdict, reserved, use = run.use()
    limit, remedy = run.limit()
    keys = ("translation_sigma_um", "rotation_sigma_mdeg")
    position, rotation = (None if verdict == "no" else run.largest(key) for key in keys)
    invalid = invalidated(check.key for check in run.every if check.verdict == "failed")
    if verdict == "no" and run.faces:  # no number, and what does not hold
        biased = "That is unknown: biased faces have no valid σ." if run.control() else "That is unknown."
        broken = f"That is unknown: {join(invalid)} are not valid before the cause of the failure is removed."
        quality = broken if invalid else biased
    else:
        quality = run.quality(position, rotation)
    return Judgement(
        verdict=verdict,
        reserved=reserved,
        use=use,
        quality=quality,
        limit=limit,
        next=" ".join([*filter(None, [remedy]), *run.further(verdict)]),
        position_sigma_um=position and position[0],
        position_face=position and position[1],
        rotation_sigma_mdeg=rotation and rotation[0],
        rotation_face=rotation and rotation[1],
        invalid=invalid,
        missing=[*run.missing, *(f"group {note['place']}" for note in run.lost)],
    )


def without_sigma_of(faces: dict[str, dict]) -> dict[str, dict]:
    """Returns the rows of the faces without σ, which a failed run must not show."""
    none = {"translation_sigma_um": None, "rotation_sigma_mdeg": None, "translation_sources_um": {}}
    return {name: face | none for name, face in faces.items()}


def without_sigma(report: dict) -> dict:
    """Returns the content of ``report.json`` without the σ of faces, which a failed run must not show."""
    between = [row | {"distance_sigma_um": None} for row in report["between_faces"]]
    summary = report["summary"] | {"scale_sigma_ppm": None}
    return report | {"faces": without_sigma_of(report["faces"]), "between_faces": between, "summary": summary}


def _faces(names: list[str]) -> str:
    return f"face{'' if len(names) == 1 else 's'} {join(names)}"


class _Run:
    """What is decided by, of the content of ``report.json``."""

    def __init__(self, report: dict):
        self.report, self.faces, self.summary = report, report["faces"], report["summary"]
        self.options, images = report["options"], {image["name"] for image in report["images"]}
        self.every = ranked([Check.read(row) for row in report.get("checks", [])], images)
        self.cause = next((check for check in self.every if check.key == CAUSE), None)
        self.checks = [check for check in self.every if check is not self.cause]
        self.open = [check for check in self.checks if check.told() == "not possible"]
        self.lost = [note for note in report["notes"] if note["code"] == GROUP_LEFT_OUT]
        self.drawn = [note for note in report["notes"] if note["code"] == NOT_AS_DRAWN] if self.faces else []
        self.scale_from = self.summary.get("scale_from", ["board"])
        self.has_no_size = "drawing" in self.scale_from
        wanted, unseen = self.options.get("expect_faces"), self.summary["faces_not_seen"]
        # Without these faces the result is a part: those of the design, or those that the user expects.
        self.lacking = [face for face in unseen if not wanted or face in wanted] if self.faces else []
        self.missing = [face for face in unseen if face in (self.summary.get("faces_expected") or [])]
        alone = all(group["name"] == TOP_GROUP for group in report["groups"])
        self.different = report.get("crosscheck", {}).get("differences", [])
        self.are_few = alone and self.summary["images_mapped"] < FEW_IMAGES

    def use(self) -> tuple[Use, bool, str]:
        """Returns verdict, whether it is to be used with care, and both in words."""
        verdict, words = self._by_result()
        begin, reasons, gaps = "", [words], self._gaps() if self.faces else []
        if verdict != "no" and self.has_no_size:
            verdict, begin, reasons = "with care", "With care, for its shape alone", [UNKNOWN_SIZE, words]
        reasons += [note["words"] for note in self.drawn[:1]]
        if verdict == "yes" and (self.drawn or self.lost):
            verdict = "with care"
        reserved = verdict == "with care"
        if verdict != "no" and self.lacking:
            begin, verdict = "Part, with care" if reserved else "Part", "part"
            reasons.insert(0, f"{len(self.faces)} of {len(self.faces) + len(self.lacking)} faces")
        return verdict, reserved, f"{begin or verdict.capitalize()}: {'; '.join([*reasons, *gaps])}."

    def _by_result(self) -> tuple[Use, str]:
        """Returns verdict and reason by what is in the result."""
        if not self.faces:
            return "no", "there is no face in it, only λ and residuals of the board"
        if self.control():
            return "no", "it was made for comparison, and its faces are biased by tens of µm"
        verdicts = [check.verdict for check in self.checks]
        failed, suspicious, passed = map(verdicts.count, ("failed", "suspicious", "passed"))
        cause, made, missing = self.cause, failed + suspicious + passed, len(self.open)
        if cause and cause.verdict == "failed":
            of = f"; that is the likely cause of {failed} of {made} checks that failed" if failed else ""
            return "no", f"{cause.cause}{of}"
        if failed:
            return "no", f"{failed} of {made} checks failed, the first: {self.checks[0].title}"
        if self.different:
            return "with care", f"the native COLMAP comes to other faces ({self.different[0]})"
        if words := self._larger():
            return "with care", f"{words}{f'; the likely cause: {cause.cause}' if cause else ''}"
        if cause:
            return "with care", f"{cause.cause}, though no check failed"
        if suspicious:
            first = self.checks[0]
            are = "is" if suspicious == 1 else "are"
            words = f"{suspicious} of {made} checks {are} suspicious, the first: {first.title}"
            # A residual beyond its limit that was left out is none by chance, and has no probability.
            if all(value.probability is not None for value in first.measured[:1]):
                words += f"; of {made} checks one is so by chance in one sound run of {round(1 / SUSPICIOUS / made)}"
            return "with care", words
        if self.summary["sigma0"] is None:
            return "with care", "groups were solved one by one; there are no σ, and there are fewer checks"
        if {check.verdict for check in self.checks if check.key in TESTED_BY} == {"not possible"}:
            return "with care", f"the photographs are too few to test one another, {missing} checks were not possible"
        open_ = f", {missing} {'was' if missing == 1 else 'were'} not possible" if missing else ""
        return "yes", f"{f'{passed} checks passed' if passed else 'nothing was checked'}{open_}"

    def _larger(self) -> str:
        """Returns by how much σ are larger than pixels explain, and why; empty if they are not."""
        words = []
        if (by := self.summary.get("photographs_differ") or 1.0) > NOTED:
            words.append(f"photographs differ {by:.1f} times more than their pixels explain, and σ are larger by that")
        if (larger := self.summary.get("sigma_enlarged") or 1.0) > 1:
            first = max(self.checks, key=lambda check: check.enlarges)
            words.append(f"all σ are {larger:.1f} times as large, to cover what is beyond chance: {first.title}")
        return "; ".join(words)

    def _seen(self, face: str) -> str:
        """Returns how a face that is not in the result was seen nevertheless; empty if it was not."""
        notes, left_out = self.report["left_out"]["notes"], self.report["left_out"]["circles"]
        if images := {n["image"] for n in notes if n["code"] == ELSEWHERE and n["place"] == face}:
            return f"face {face} was read in {len(images)} image{'s' * (len(images) > 1)} and left out"
        if any(row["label"].startswith(f"{face}:") for row in [*self.report["residuals_by_label"], *left_out]):
            return f"face {face} is not in it: circles of it were seen, but they do not hold its frame"
        return ""

    def _gaps(self) -> list[str]:
        """Returns in words what is missing: faces that are not in it, or in one image alone, and lost groups."""
        seen = {face: self._seen(face) for face in self.summary["faces_not_seen"]}
        never, words = [face for face in seen if not seen[face]], [words for words in seen.values() if words]
        if never:
            words.insert(0, f"no image that was used shows {_faces(never)} of the design")
        if single := [name for name, face in self.faces.items() if face["images"] == 1]:
            words.append(f"one image alone shows {_faces(single)}")
        return words + [f"group {note['place']} was left out completely" for note in self.lost]

    def quality(self, position: tuple[float, str] | None, rotation: tuple[float, str] | None) -> str:
        if not self.faces:
            worst = max((group["scale"]["board_rms_um"] for group in self.report["groups"]), default=0.0)
            return f"The board's dots are within {number(worst, 1)} µm RMS of their design."
        if len(self.faces) == 1:
            return "There is one face, which is the target frame itself; σ of its circles are in faces.json."
        if position is None or rotation is None:
            return "There are no σ; the report has how far chains to the same face are off their mean."
        ppm, rim, scale = self.summary["scale_sigma_ppm"], self.summary.get("rim_mm"), ""
        if ppm is not None:
            scale = f", the size to {f'{number(ppm, 1)} ppm' if ppm < MOST_PPM else f'{significant(1e-4 * ppm)} %'}"
        if self.has_no_size:
            scale = ", in the unit of the drawing, and the size is not known"
        surface = f" They are those of the luminous surface, behind rims of {rim:.3f} mm." if rim else ""
        premises = [] if self.options.get("refine_camera") else ["the intrinsics"]
        premises += [SIZES[source] for source in self.scale_from]
        are = "is" if len(premises) == 1 and self.scale_from != ["distances"] else "are"
        um = f"{number(position[0], 1)} µm (face {position[1]})"
        mdeg = f"{number(rotation[0], 2)} mdeg (face {rotation[1]})"
        known = f"Faces are known against face {self.report['reference_face']} to {um} and {mdeg}"
        holds = f"that holds where {' and '.join(premises)} {are} as stated.{surface}"
        return f"{known} at worst, one σ along and about an axis{scale}; {holds}"

    def largest(self, key: str) -> tuple[float, str] | None:
        """Returns (largest value over the axes, face) of the worst face."""
        others = {name: face for name, face in self.faces.items() if name != self.report["reference_face"]}
        return max(((max(f[key]), name) for name, f in others.items() if f[key] is not None), default=None)

    def limit(self) -> Cause:
        """Returns what limits a result, and the remedy."""
        worst, lost = self.every[0].verdict if self.every else "passed", _noted(self.lost, "Left out")
        return (
            self.control()
            or (None if worst == "failed" else lost)  # what is only suspicious comes after groups that were lost
            or self._by_checks(worst)
            or self._by_gaps()
            or _noted(self.drawn, "The drawing")
            or lost
            or self._by_size()
            or self._by_sigma()
        )

    def control(self) -> Cause | None:
        """Returns the cause of a result without faces, or of one made for comparison; None for other results."""
        if not self.faces:
            remedy = "Look at the overlays; where a face is in view, give its design with --target."
            return f"No face of the target was recognised in {self.summary['images']} images.", remedy
        if self.options["solve"] == "paper":
            method = "The published method: contours with equal weights, without the eccentricity of circles."
            return method, "Run it without --solve paper."
        if not self.options["eccentricity"]:
            return "The eccentricity of circles is not corrected.", "Run it without --no-eccentricity."
        return None

    def _by_checks(self, worst: str) -> Cause | None:
        """Returns the cause by the first failed check, a suspicious one that limits the result, or the cross-check."""
        if worst in ("failed", "suspicious"):
            check = self.every[0]
            found = f"{check.title}: {check.reason}."
            remedy = sentence(check.remedy or "look at what the check names")
            if worst == "failed":
                return found, remedy
            limits = self._by_gaps() or self._by_size() or self._by_sigma()
            return limits[0], f"{found} {remedy}"  # what is suspicious is to be looked at; σ still tell
        if self.different:
            remedy = "Look at the cross-check to see which of the two is right."
            return f"The native COLMAP differs: {self.different[0]}.", remedy
        return None

    def _by_gaps(self) -> Cause | None:
        """Returns the cause where faces are missing that were to be there; None if all are."""
        if self.missing:
            remedy = "Look at the overlays and at what was left out, in the photographs that show it."
            return f"Face {join(self.missing)} should have been photographed, and is not in the result.", remedy
        n, of = len(self.faces), len(self.faces) + len(self.lacking)
        return (f"The photographs: they give {n} of the {of} faces of the design.", "") if n < of else None

    def _by_size(self) -> Cause | None:
        """Returns the cause where no size is known; None where one is."""
        measure = "Measure the distance of two points and state it with scale in target.toml"
        board = "or photograph the board of dots with it; if one is in view, give its file with --board."
        return ("Its size: nothing of known size is in view.", f"{measure}, {board}") if self.has_no_size else None

    def _by_sigma(self) -> Cause:
        """Returns the cause that the σ show, of the face and along the axis that "How good is it?" has."""
        if len(self.faces) == 1:
            remedy = "Photograph it together with other faces."
            return "There is only one face, and nothing links it to others.", remedy
        found = self.largest("translation_sigma_um")
        if found is None:
            return "What limits it is unknown without σ.", "Run it with --solve joint."
        sigma, worst = found
        face = self.faces[worst]
        axis = face["translation_sigma_um"].index(sigma)
        variance = {kind: values[axis] ** 2 for kind, values in face.get("translation_sources_um", {}).items()}
        photographs = sum(variance.pop(kind, 0.0) for kind in PHOTOGRAPHS)
        source = max(variance, key=lambda kind: variance[kind], default="")
        of_all = f"% of the variance of face {worst} along {'xyz'[axis]} (σ {number(sigma, 1)} µm)"
        if source and variance[source] > photographs:
            share = number(100 * variance[source] / sigma**2, 0)
            given = "a longer or better known" if "distances" in self.scale_from else "the"
            distance = f"state {given} distance of two points of the target with [[scale]] in target.toml"
            if source == "sizes" and (self.summary.get("edge_share") or 0.0) > 0.5:
                source = "edges"
            few, (name, remedy) = "" if self.are_few else "More photographs help little: ", SOURCES[source]
            return f"{name}: {share} {of_all}.", sentence(f"{few}{remedy.format(distance=distance)}")
        rows = [row for name, row in self.faces.items() if name not in (worst, self.report["reference_face"])]
        others = [max(row["translation_sigma_um"]) for row in rows if row["translation_sigma_um"] is not None]
        if others and sigma > TAIL * median(others):
            of_groups = "" if face["groups"] == [TOP_GROUP] else f", of group {join(face['groups'])}"
            apart = f"{number(sigma, 1)} µm along {'xyz'[axis]}, where the others have {number(median(others), 1)} µm"
            remedy = f"Add images that show face {worst}; `stcal-sfm advise RUN` says from where."
            return f"Face {worst}: {apart}; {face['images']} images show it{of_groups}.", remedy
        centre, advice = self.summary.get("circle_sigma_px"), "`stcal-sfm advise RUN` says how."
        if not photographs:
            return "What limits it is not in this report.", f"`stcal-sfm budget RUN` shows it, and {advice}"
        fewer, share = math.sqrt(max(sigma**2 - photographs * (1 - 1 / MORE), 0.0)), 100 * photographs / sigma**2
        limit, remedy = self._by_conditions()
        centring = f"{limit}The centring of circles{'' if centre is None else f', σ {number(centre, 4)} px'}"
        more = f"four times the images make {number(fewer, 1)} of {number(sigma, 1)} µm; {advice}"
        return f"{centring}: {number(share, 0)} {of_all}.", f"{remedy} {more}"

    def _by_conditions(self) -> tuple[str, str]:
        """Returns what of the photographs makes σ larger than usual, and the beginning of the remedy."""
        conditions = self.report.get("conditions", {})
        worst = max(conditions, key=lambda name: conditions[name][1], default="")
        value, factor = conditions.get(worst, (0.0, 1.0))
        if factor < MATTERS:
            good = [name for name in CONDITIONS if name in conditions and name != "number"]
            return f"Number alone: {join(good)} are good. " if good else "", "Nothing has to be done;"
        words, remedy = CONDITIONS[worst]
        limit = f"{worst.capitalize()}: {words.format(value)}; σ are up to {factor:.1f} times larger. "
        return limit, f"{sentence(remedy)} Or" if factor > HARMS else f"Nothing has to be done. To be better, {remedy};"

    def further(self, verdict: Use) -> list[str]:
        """Returns what to do beyond the limit: about missing faces, and about checks that could not be made."""
        advice = []
        if self.faces and self.are_few:
            used, given = (self.summary[key] for key in ("images_mapped", "images"))
            advice.append(f"Take more photographs: {used} of {given} could be used, and 10 to 20 are usual.")
        read = [face for face in self.lacking if self._seen(face)]
        if not self.cause and (unseen := [face for face in self.lacking if face not in read]):
            together = f"{_faces(unseen)} together with one of the others"
            advice.append(f"Photograph {together}: no image that was used shows it.")
        if read:
            was = "was" if len(read) == 1 else "were"
            advice.append(f"Read why {_faces(read)} {was} left out, and take further photographs from other places.")
        if verdict in ("yes", "part") and self.open:
            remedy = self.open[0].remedy
            same = sum(check.remedy == remedy for check in self.open)
            advice.append(f"For {same} more check{'s' * (same > 1)}: {remedy}.")
        return advice


def _noted(notes: list[dict], begin: str) -> Cause | None:
    """Returns what the first note says limits the result; None if there is none."""
    return next(((f"{begin}: {n['words']}.", sentence(n["remedy"] or "take it again")) for n in notes), None)
