"""Sections of a run's page: how far to trust it, its settings, its checks, the cross-check and the published method."""

from dataclasses import dataclass
from itertools import product

from stcal.labels import parse_label
from stcal.report.document import Block, Table, alarms, fold, subheading, verdict_word
from stcal.report.text import NONE, cells, join, number
from stcal.sfm.report.check import BY_CHANCE, ORDER, Check, TestedValue, count_verdicts
from stcal.sfm.report.compare import comparison_cells
from stcal.sfm.report.judgement import SIZES, Judgement

SOLVES = {
    "joint": "joint: one adjustment over all groups",
    "chain": "chain: group by group, then combined",
    "paper": "paper: as published by Zhang & Wei (2017), for comparison",
}
FRAMES = {"plane": "plane: Z from the plane of all circles", "three-point": "three-point: from three circles"}


@dataclass(frozen=True, slots=True)
class Words:
    """Words for what was photographed."""

    point: str  # circle, corner or, where faces have either, point
    board: bool  # whether a board of dots gives the scale

    @classmethod
    def of(cls, report: dict) -> "Words":
        """Returns the words for a run."""
        printed = {face in report["summary"].get("printed_faces", []) for face in report["faces"]}
        point = "point" if len(printed) > 1 else "corner" if True in printed else "circle"
        return cls(point, "board" in report["summary"].get("scale_from", ["board"]))

    @property
    def points(self) -> str:
        """Returns the plural of ``point``."""
        return f"{self.point}s"


def trust(report: dict, judgement: Judgement, words: Words) -> list[Block]:
    """Returns for what σ hold, and the worst value of each kind."""
    summary, options = report["summary"], report["options"]
    sources = summary.get("scale_from", ["board"])
    size = " and ".join(SIZES[source] for source in sources)
    if options["solve"] != "joint":
        scope = (
            "No σ were computed, because the groups were solved one by one; look at the chains. All results hold for "
            "the given intrinsics: an error of the camera calibration goes into the faces"
        )
    elif judgement.verdict == "no":
        scope = "No σ are shown, as they would not be valid: they do not include the error that made the checks fail"
    else:
        refined = options.get("refine_camera", False)
        scope = f"σ hold for {'' if refined else 'the given intrinsics and '}{size}"
        scope += "; the intrinsics were adjusted, and their σ are in them" if refined else ""
        scope += ". The σ stated of the size are in them" if {"faces", "distances"} & set(sources) else ""
        absent = [] if refined else ["the camera calibration"]
        absent += ["the pitch as a whole (100 ppm is 4 K on aluminium)"] if words.board else []
        if absent:
            errors = ", or of ".join(absent) + "," * (len(absent) > 1)
            scope += f". An error of {errors} is not in them, and residuals hardly show it"
    factor, sigma0 = summary["sigma_factor"], summary["sigma0"]
    larger = "as large as" if 0.95 <= factor <= 1.05 else f"{factor:.1f} times"
    of_groups = f"group by group, residuals are {larger} the centres' own σ"
    if sigma0 is not None:
        of_groups += (
            f". The joint adjustment multiplies the centres' σ by that factor and leaves σ₀ = {sigma0:.2f}; near 1, "
            "all observations agree with one another. The σ of the faces include that factor, and σ₀ too where it is "
            f"above 1: small residuals make no σ smaller. `budget` states the latter as {max(1.0, sigma0):.3f}"
        )
    single = [face for face, chains in report["chains"].items() if len(chains) == 1]
    one_way = "reached by only one chain, so that no second chain confirms them: face"
    return [scope, of_groups, f"{one_way} {join(single)}" if single else ""]


def settings(report: dict, words: Words) -> list[list[str]]:
    summary, options, camera = report["summary"], report["options"], report["camera"]
    left_out, last_move = report["left_out"], summary["last_move_px"]
    sizes = " × ".join(str(size) for size in camera["size_px"])
    solve, frame = str(options["solve"]), str(options["frame"])
    round_ = words.point != "corner"
    single = sum(row.get("gate") == "views" for row in left_out["circles"])
    eccentricity = "corrected" if options["eccentricity"] else "off (uncorrected control)"
    rows = [
        ["Solve", SOLVES.get(solve, solve)],
        ["Face frames", FRAMES.get(frame, frame) if round_ else "those of their drawings"],
        ["Eccentricity", eccentricity if round_ else ""],
        ["Surface", f"luminous, behind rims of {rim:.3f} mm" if (rim := summary.get("rim_mm")) else ""],
        ["Dots of the board", f"behind rims of {rim:.3f} mm" if (rim := summary.get("dot_rim_mm")) else ""],
        ["Reference face", report["reference_face"]],
        ["Faces not in the result", join(summary["faces_not_seen"]) if summary["faces_not_seen"] else "none"],
        ["Centres observed", f"{summary['observations']}, redundancy {summary['redundancy'] or NONE}"],
        ["Last step of the joint adjustment", NONE if last_move is None else f"{last_move:.1g} px"],
        [
            "Left out",
            f"{len(left_out['files'])} files, {len(left_out['images'])} images, "
            f"{len(left_out['circles']) - single} {words.points}; {single} more that one image of a group alone shows",
        ],
        ["Scale", join([SIZES[source] for source in summary.get("scale_from", ["board"])])],
        [
            "Camera, as given" if summary.get("camera_given", True) else "Camera, found from the photographs",
            f"{camera['model']}, {sizes} px",
        ],
        ["Focal lengths (px)", ", ".join(number(v, 4) for v in camera["focal_px"])],
        ["Principal point (px)", ", ".join(number(v, 4) for v in camera["centre_px"]) + " (pixel centres integer)"],
        ["Distortion", ", ".join(f"{v:.8g}" for v in camera["distortion"])],
        ["Program", f"stcal {report['version']}"],
    ]
    return [[name, value] for name, value in rows if value]


LIMITS = (
    ("mapped_sigma", "σ", "of faces and circles between the programs"),
    ("sigma", "σ", "of these adjusted"),
    ("face_um", "µm", "of faces"),
    ("face_mdeg", "mdeg", "of faces"),
    ("circle_um", "µm", "of circles"),
    ("camera_um", "µm", "of cameras"),
    ("camera_mdeg", "mdeg", "of cameras"),
)


def crosscheck_section(check: dict) -> list[Block]:
    """Returns the section on the cross-check with the native COLMAP."""
    limits, mapping = check["tolerances"], check["mapping"]
    allowed = [f"{limits[key]:g} {unit} {what}" for key, unit, what in LIMITS if limits[key] is not None]
    faces: dict[str, list[tuple[float, str]]] = {}
    for label, value in mapping["circles_um"].items():
        faces.setdefault(parse_label(label).plane, []).append((value, label))
    names = (f"COLMAP {check['native']}", f"pycolmap {check['pycolmap']}", "this result")
    models = [
        [name, check["images"][key], number(check["residual_rms_px"][key], 4)]
        for key, name in zip(("native", "pycolmap", "run"), names, strict=True)
    ]
    circles = [
        [face, len(rows), number(sum(v for v, _ in rows) / len(rows), 3), number(max(rows)[0], 3), max(rows)[1]]
        for face, rows in sorted(faces.items())
    ]
    largest = ""
    if worst := max(mapping["cameras"], key=lambda row: row["sigmas"], default=None):
        largest = f"; the largest is {worst['sigmas']:.2f} σ, {worst['position_um']:.1f} µm, at {worst['image']}"
    rows = [[face] for face in mapping["faces"]]
    for row, key in product(rows, ("mapping", "result", "plain")):
        entry = check[key]["faces"].get(row[0])
        row += [*cells(entry, "translation_um:3 rotation_mdeg:3 sigmas:2")] if entry else [NONE] * 3
    over = [("", 1), ("Native – pycolmap", 3), ("Native, adjusted – result", 3), ("Native – result", 3)]
    return [
        f"Native COLMAP {check['native']} and pycolmap {check['pycolmap']} on the same database (schema "
        f"{check['schema']} for the native one), initial pairs and thresholds",
        alarms([f"They differ: {'; '.join(check['differences'])}."]) if check["differences"] else "They agree",
        Table(["<Model", "Images", "Residual RMS (px)"], models),
        subheading("Faces"),
        "Differences in the target frame: the two programs' models as COLMAP adjusts them; the native models against "
        "this result, after our own adjustment and without it. σ is the difference in the run's own standard "
        f"deviations. Allowed in the first two: {', '.join(allowed)}; the third shows what weights and the joint "
        "adjustment are worth",
        Table(["<Face"] + ["Position (µm)", "Rotation (mdeg)", "σ"] * 3, rows, over),
        subheading("Circles"),
        "Native against pycolmap",
        Table(["<Face", "Circles", "Mean (µm)", "Max (µm)", "<Worst"], circles),
        subheading("Cameras"),
        "Native against pycolmap, against the target, and in σ of the camera in its group. They matter only if faces "
        f"move with them, which the table of faces shows{largest}",
        *check["notes"],
    ]


FIRST_NAMES = 6
"""Number of names that a row has room for."""


def checks_section(rows: list[dict]) -> list[Block]:
    """Returns the checks that did not pass; the others, and what all of them measured, folded."""
    checks = sorted(map(Check.read, rows), key=lambda check: ORDER.index(check.verdict))
    heads = ["<Check", "<Verdict", "Value", "Limit", "<Named", "<Found", "<What to do"]
    is_open = [check.verdict in ("failed", "suspicious") for check in checks]
    open_, others = ([_check_row(c) for c, own in zip(checks, is_open, strict=True) if own is k] for k in (True, False))
    measured = [
        [check.title, m.name, *_number(m), NONE if m.probability is None else f"{m.probability:.1g}"]
        for check in checks
        for m in check.measured
    ]
    return [
        f"Checks: {count_verdicts(checks)}. Each tests what small residuals do not prove; {BY_CHANCE}, however many "
        "images or points it tested",
        Table(heads, open_, css="text"),
        fold(
            f"{len(others)} checks that passed, were not possible or not applicable", Table(heads, others, css="text")
        ),
        fold(
            "What was measured",
            Table(["<Check", "<What", "Value", "Limit", "Probability by chance"], measured, css="text"),
        ),
    ]


def _check_row(check: Check) -> list:
    surplus = len(check.names) - FIRST_NAMES
    names = join(check.names[:FIRST_NAMES]) + (f" and {surplus} more" if surplus > 0 else "")
    value = _number(check.measured[0]) if check.measured else [NONE, NONE]
    return [check.title, verdict_word(check.told()), *value, names, check.reason, check.remedy]


def _number(measured: TestedValue) -> list[str]:
    """Returns value and limit with their unit."""

    def short(value: float) -> str:
        return f"{value:.3g}" if 1e-4 < abs(value) < 1e3 else number(value, 0) if abs(value) >= 1e3 else f"{value:.2g}"

    unit = f" {measured.unit}" if measured.unit else ""
    return [short(measured.value) + unit, NONE if measured.limit is None else short(measured.limit) + unit]


def published_section(comparison: dict) -> list[Block]:
    """Returns the gain of each step from the published method to this result."""
    heads, rows = comparison_cells(comparison)
    return [
        "The same photographs by the method of Zhang & Wei (2017) as published, and with one more step of this "
        "package in each row. The last row is this result. All have three-point frames. Faces: distance of the origin "
        "from that of the last row. Compared with σ of the last row, it shows what each step is worth here",
        Table(heads, rows),
        alarms([f"{row['method']}: {row['reason']}." for row in comparison["rows"] if row["reason"]]),
    ]
