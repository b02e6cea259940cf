"""Findings of the doctor: causes, texts and result file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from numbers import Real
from typing import Annotated, Literal

from pydantic import Field

from stcal.io.json import Part, ResultFile
from stcal.labels import BOARD, DotLabel, parse_label, parse_labels

AT_MOST = ("max_diameter", "outline_area", "outline_deviation", "position", "shape", "face_readings", "residual")
"""Gates whose limit is the largest value allowed. The limit of every other gate is the smallest value needed."""
ADVICE = {
    "border": "it touches the image's border: keep it inside",
    "min_diameter": "come {closer} % closer, or use a longer lens",
    "max_diameter": "step back, or use a shorter lens",
    "min_axis_ratio": "photograph it less obliquely, or without motion blur",
    "min_contrast": "light it, expose longer, or cover what is brighter",
    "hidden": "hidden or dark: uncover it, light it",
    "outline": "nothing round stands out there: uncover it, or cover what outshines it",
    "ellipse": "its outline is no ellipse: uncover it",
    "outline_area": "its outline is no ellipse: uncover it, photograph it sharper or from closer",
    "outline_deviation": "its outline is no ellipse: uncover it, photograph it sharper or from closer",
    "position": "something else is there, or a part of the circle: uncover it; is the place in the target file right?",
    "shape": "something else is there, or a part of the circle: uncover it; is the radius in the target file right?",
    "pattern": "two circles claim the same outline: uncover the other one",
    "face_circles": "found, but too few of its face: let in those that have lines of their own",
    "face_pattern": "found, but not put together as a face: mend its circles with lines of their own, cover other dots",
    "face_readings": "found, but another reading fits as well: show the circles that tell the faces apart",
    "board_dots": "found, but too few of the board: let in dots that have lines of their own",
    "board_grid": "found, but not joined to the board's grid: show the dots between, cover what is like a dot",
    "board_numbering": "found, but the board's numbering stays open: show a face that the group's other images show",
    "tags": "none of its tags is read: show it whole with the white about it, less obliquely, sharper, evenly lit",
    "rim": "partly hidden, reflecting or disturbed: uncover it",
    "not_examined": "give the folder of the images with --images",
    "found_now": "found now: the image or the program has changed since the run; run it again",
    "views": "photograph it from another place too",
    "ray_angle": "photograph it from places further apart",
    "residual": "contradicts the other images: look for glare, dirt, a part hidden, or something that moved",
}
CAUSES = {
    "merged": "it runs into something bright beside it: move or cover that, or photograph it from elsewhere",
    "cut": "only a part of it shows: uncover it, or photograph it from elsewhere",
}
TRIFLES = ("views", "hidden", "note", "copy", "file_type", "folder", "excluded")
"""Gates that can hardly be helped, or need no help."""
WHOLE_PATTERN = "whole_pattern"
"""Gate of a face or board that is visible in an image but was left out of it as a whole."""
MAX_LABELS = 12
MAX_LINES = 40


@dataclass(frozen=True, slots=True)
class Finding:
    """A file, image or circle that was left out, or a note on the whole run.

    ``image`` : name, empty if it concerns the whole run; ``labels`` : circles, empty for a whole file or image;
    ``gate`` : name of the threshold; ``value``, ``limit``, ``unit`` : measured value and what is allowed or needed,
    None if there is no number; ``remedy`` : what to do with the scene; ``options`` : options each of which lets it in,
    as tried on the image, the gentlest first.

    Raises TypeError if a field from a damaged report has another type.
    """

    image: str
    labels: tuple[str, ...]
    gate: str
    value: float | str | None
    limit: float | str | None
    unit: str
    remedy: str
    options: tuple[str, ...] = ()

    def __post_init__(self):
        words = (self.image, self.gate, self.unit, self.remedy, *self.labels)
        known = [value for value in (self.value, self.limit) if value is not None]
        if not (all(isinstance(each, str) for each in words) and all(isinstance(v, Real | str) for v in known)):
            raise TypeError(f"{self.gate}: value {self.value!r}, limit {self.limit!r}")


@dataclass(frozen=True, slots=True)
class GateCount:
    """Counts of one gate: it stopped ``circles`` of ``images``; options let in ``by_option`` of these circles."""

    circles: int
    images: int
    by_option: int


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The findings and counts of a run.

    ``files`` : number given; ``images`` : usable ones among them; ``mapped`` : mapped images; ``circles`` :
    observations in the model; ``findings`` : what was left out, the most useful to know first; ``point`` : what the
    faces show, circle, corner or point.
    """

    files: int
    images: int
    mapped: int
    circles: int
    findings: tuple[Finding, ...]
    point: str = "circle"


def advice(gate: str, value: float | None = None, limit: float | None = None, cause: str = "") -> str:
    """Returns what to do with the scene for a circle that a gate stopped. ``cause`` : as in :class:`OutlineEnd`."""
    closer = 0 if gate != "min_diameter" or value is None or limit is None else math.ceil(100 * (1 - value / limit))
    return CAUSES.get(cause) or ADVICE[gate].format(closer=closer)


def in_order(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Returns the findings sorted, with equal reasons of one image and face together.

    Whole images and faces come first, then what an option lets in, then the rest, by number of circles. What can hardly
    be helped comes last.
    """
    together = [list(findings_of_line) for _, findings_of_line in groupby(sorted(findings, key=_key), key=_key)]
    together.sort(
        key=lambda findings_of_line: (
            _rank(findings_of_line[0]),
            -sum(len(f.labels) for f in findings_of_line),
            _key(findings_of_line[0]),
        )
    )
    return tuple(finding for findings_of_line in together for finding in findings_of_line)


def _key(finding: Finding) -> tuple[str, ...]:
    """Returns the key that findings of one line of the table share."""
    plane = parse_label(finding.labels[0]).plane if finding.labels else ""
    advised = finding.remedy.partition("%")[2] or finding.remedy
    return finding.image, plane, finding.gate, *finding.options[:1], advised


def _rank(finding: Finding) -> int:
    if finding.gate in TRIFLES and (finding.image or not finding.value):
        return 3
    if not (finding.image and finding.labels):
        return 0
    return 1 if finding.options else 2


def by_gate(findings: Iterable[Finding]) -> dict[str, GateCount]:
    """Returns how many outlines each gate stopped in images. Findings on the whole run do not count."""
    together: dict[str, list[Finding]] = {}
    for finding in findings:
        if finding.image:
            together.setdefault(finding.gate, []).append(finding)
    return {
        gate: GateCount(
            sum(len(finding_of_gate.labels) for finding_of_gate in findings_of_gate),
            len({finding_of_gate.image for finding_of_gate in findings_of_gate}),
            sum(len(finding_of_gate.labels) for finding_of_gate in findings_of_gate if finding_of_gate.options),
        )
        for gate, findings_of_gate in together.items()
    }


def table(diagnosis: Diagnosis, lines: int | None = MAX_LINES) -> str:
    """Returns counts, what options let in, and one line for each reason, up to ``lines`` of them."""
    findings, point = diagnosis.findings, diagnosis.point
    heading = f"{diagnosis.mapped} of {diagnosis.images} images mapped, {diagnosis.circles} {point}s in the model"
    if not findings:
        return f"nothing was left out: {heading}, every {point} in view has a label"
    files = _number(diagnosis.files - diagnosis.images, "file")
    images = _number(diagnosis.images - diagnosis.mapped, "image")
    patterns = [whole_pattern for whole_pattern in findings if whole_pattern.gate == WHOLE_PATTERN]
    whole = f"{_number(len(patterns), 'whole face or board', 'whole faces and boards')}, " if patterns else ""
    text = [f"{heading}; left out: {files}, {images}, {whole}{_circles(findings, point)}"]
    for gate, count in sorted(by_gate(findings).items(), key=lambda item: (-item[1].circles, -item[1].images)):
        circles = f"{_number(count.circles, point)} of " if count.circles else ""
        text.append(f"  {gate:<18}{circles}{_number(count.images, 'image')}")
    helping: dict[str, list[Finding]] = {}
    for finding in findings:
        for option in finding.options:
            helping.setdefault(option, []).append(finding)
    for option, findings_of_option in sorted(helping.items(), key=lambda item: -len(item[1])):
        whole = sum(not finding.labels for finding in findings_of_option)
        parts = [_number(whole, "whole image")] * bool(whole) + [_circles(findings_of_option, point)] * (
            whole < len(findings_of_option)
        )
        text.append(f"{option} lets in {', '.join(parts)}")
    text.append("")
    rows = [_line(list(findings_of_option), point) for _, findings_of_option in groupby(findings, key=_key)]
    text += rows[:lines]
    if lines is not None and len(rows) > lines:
        text.append(f"… {len(rows) - lines} more lines with --all")
    return "\n".join(text)


def _circles(findings: Iterable[Finding], point: str) -> str:
    in_images = [finding for finding in findings if finding.labels and finding.image]
    images = len({finding.image for finding in in_images})
    circles = _number(sum(len(finding.labels) for finding in in_images), point)
    return f"{circles} of {_number(images, 'image')}" if in_images else circles


def _number(count: int, what: str, several: str = "") -> str:
    return f"{count} {what}" if count == 1 else f"{count} {several or what + 's'}"


def _line(own: list[Finding], point: str) -> str:
    first = min(own, key=lambda f: f.value if isinstance(f.value, float) else 0.0)  # asks most of whoever comes closer
    labels = [label for finding in own for label in finding.labels]
    where = "  ".join(word for word in (first.image, _listed(labels, point)) if word) or "the run"
    values, limits = [f.value for f in own], [f.limit for f in own]
    # Enough digits to tell the value from the limit.
    digits = next((n for n in range(3, 7) if _range(values, n) != _range(limits, n)), 3)
    value, limit = _range(values, digits), _range(limits, digits)
    with_unit = " ".join(word for word in (limit or value, first.unit) if word)
    bound = f"at most {with_unit}" if first.gate in AT_MOST else f"{with_unit} needed"
    measured = ", ".join(word for word in (value, bound) if word) if limit else with_unit if value else ""
    remedy = first.remedy
    if first.options:
        python = ", from Python" if first.options[0].startswith("EllipseOptions") else ""
        remedy = f"{first.options[0]} lets {'it' if len(labels) < 2 else 'them'} in{python}"
    return f"{where}  {' '.join(word for word in (first.gate, measured) if word)}: {remedy}"


def _range(values: list, digits: int) -> str:
    """Returns the range of some values as a text, or the first value that is itself a text."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    texts = [value for value in known if isinstance(value, str)]
    if texts:
        return texts[0]
    low, high = (f"{value:.{digits}g}" for value in (min(known), max(known)))
    return low if low == high else f"{low} to {high}"


def _listed(labels: list[str], point: str) -> str:
    """Returns the labels as a text; consecutive dots of one row of the board as ``board:2:0–5``."""
    parts: list[str] = []
    dots: dict[str, list[int]] = {}
    for label in parse_labels(labels):
        if isinstance(label, DotLabel):
            dots.setdefault(f"{BOARD}:{label.row}", []).append(label.column)
        else:
            parts.append(label)
    for row, columns in dots.items():
        for _, run in groupby(enumerate(sorted(columns)), key=lambda position: position[1] - position[0]):
            first, *_, last = [column for _, column in run] * 2
            parts.append(f"{row}:{first}" if first == last else f"{row}:{first}–{last}")
    shown = ", ".join(parts[:MAX_LABELS])
    return shown if len(parts) <= MAX_LABELS else f"{shown} … ({len(labels)} {point}s)"


ByGate = Annotated[str, "gate"]


class Counts(Part):
    files: int
    images: int
    mapped: int
    circles: int


class DoctorFile(ResultFile):
    """The JSON file of ``doctor``."""

    format: Literal["stcal doctor 1"] = Field(description="the file's form and its version")
    summary: Counts = Field(
        description="`files` given, `images` of them that could be used, `mapped` images, `circles` observed in the "
        "model"
    )
    gates: dict[ByGate, GateCount] = Field(
        description="`circles` and `images` that it stopped, `by_option` circles that an option lets in"
    )
    findings: tuple[Finding, ...] = Field(
        description="in the order of the table: `image`, empty for the whole run; `labels`, none for a whole file or "
        "image; `gate`, `value`, `limit`, `unit`, null without a number; `remedy`, what to do with the scene; "
        "`options`, each of which lets it in: detection was run with it on this image, for `views` on those of the "
        "group that lack circles. `EllipseOptions(…)` is an option of Python, `RunOptions(ellipses=…)`"
    )

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> "DoctorFile":
        """Returns the file of a diagnosis."""
        return cls(
            format="stcal doctor 1",
            summary=Counts.model_validate(diagnosis),
            gates=by_gate(diagnosis.findings),
            findings=diagnosis.findings,
        )
