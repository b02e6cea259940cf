"""Sections of the page on checks, on the cross-check with the native COLMAP, and on the published method."""

from stcal.labels import parse_label
from stcal.report.document import Block, Table, Verdict, alarms, fold, subheading
from stcal.report.text import NONE, cells, number
from stcal.sfm.report.compare import comparison_cells
from stcal.sfm.report.judgement import CHANCE

LIMITS = (
    ("mapped_sigma", "σ", "of faces and circles between the programs"),
    ("sigma", "σ", "of these adjusted"),
    ("face_um", "µm", "of faces"),
    ("face_mdeg", "mdeg", "of faces"),
    ("circle_um", "µm", "of circles"),
    ("camera_um", "µm", "of cameras"),
    ("camera_mdeg", "mdeg", "of cameras"),
)
COMPARISONS = ("mapping", "result", "plain")


def crosscheck_section(check: dict) -> list[Block]:
    """Returns the section on the cross-check with the native COLMAP."""
    limits, mapping = check["tolerances"], check["mapping"]
    allowed = [f"{limits[key]:g} {unit} {object_name}" for key, unit, object_name in LIMITS if limits[key] is not None]
    faces: dict[str, list[tuple[float, str]]] = {}
    for label, value in mapping["circles_um"].items():
        faces.setdefault(parse_label(label).plane, []).append((value, label))
    programs = {
        "native": f"COLMAP {check['native']}",
        "pycolmap": f"pycolmap {check['pycolmap']}",
        "run": "this result",
    }
    models = [[name, check["images"][key], number(check["residual_rms_px"][key], 4)] for key, name in programs.items()]
    circles = [
        [face, len(rows), number(sum(v for v, _ in rows) / len(rows), 3), number(max(rows)[0], 3), max(rows)[1]]
        for face, rows in sorted(faces.items())
    ]
    single = [
        [label, number(value, 3), number(mapping["circles_sigmas"].get(label), 2)]
        for label, value in mapping["circles_um"].items()
    ]
    largest = ""
    if worst := max(mapping["cameras"], key=lambda row: row["sigmas"], default=None):
        largest = f"; the largest is {worst['sigmas']:.2f} σ, {worst['position_um']:.1f} µm, at {worst['image']}"
    over = [("", 1), ("Native – pycolmap", 3), ("Native, adjusted – result", 3), ("Native – result", 3)]
    cameras = [cells(row, "image position_um:2 rotation_mdeg:3 sigmas:2") for row in mapping["cameras"]]
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
        Table(
            ["<Face"] + ["Position (µm)", "Rotation (mdeg)", "σ"] * 3,
            [_face_row(check, f) for f in mapping["faces"]],
            over,
        ),
        subheading("Circles"),
        "Native against pycolmap",
        Table(["<Face", "Circles", "Mean (µm)", "Max (µm)", "<Worst"], circles),
        fold("Circle by circle", Table(["<Circle", "Difference (µm)", "σ"], single)),
        subheading("Cameras"),
        "Native against pycolmap, against the target, and in σ of the camera in its group. They matter only if faces "
        f"move with them, which the table of faces shows{largest}",
        fold("Camera by camera", Table(["<Image", "Position (µm)", "Rotation (mdeg)", "σ"], cameras)),
        *check["notes"],
    ]


def _face_row(check: dict, face: str) -> list[str]:
    """Returns the row of a face: position, rotation and σ of each comparison."""
    row = [face]
    for key in COMPARISONS:
        entry = check[key]["faces"].get(face)
        row += [*cells(entry, "translation_um:3 rotation_mdeg:3"), number(entry["sigmas"], 2)] if entry else [NONE] * 3
    return row


ORDER = ("failed", "suspicious", "passed", "not possible")
FIRST_NAMES = 6
"""Number of names that a row has room for."""


def count_verdicts(verdicts: list[str]) -> str:
    """Returns the number of checks with each verdict as ``2 failed, 13 passed``, the worst first."""
    return ", ".join(f"{verdicts.count(v)} {v}" for v in ORDER if v in verdicts) or "none"


def checks_section(checks: list[dict]) -> list[Block]:
    """Returns the checks that did not pass; the others, and what all of them measured, folded."""
    heads = ["<Check", "<Verdict", "Value", "Limit", "<Named", "<Found", "<What to do"]
    ranked = sorted(checks, key=lambda check: ORDER.index(check["verdict"]))
    open_ = [_check_row(check) for check in ranked if check["verdict"] in ("failed", "suspicious")]
    others = [_check_row(check) for check in ranked if check["verdict"] not in ("failed", "suspicious")]
    measured = [
        [check["title"], m["name"], *_number(m), NONE if m["probability"] is None else f"{m['probability']:.1g}"]
        for check in ranked
        for m in check["measured"]
    ]
    counts = count_verdicts([check["verdict"] for check in checks])
    columns_measured = ["<Check", "<What", "Value", "Limit", "Probability by chance"]
    return [
        f"Checks: {counts}. Each tests what small residuals do not prove. {CHANCE} That holds for one check, however "
        f"many images or points it tested",
        Table(heads, open_, css="text"),
        fold(f"{len(others)} checks that passed or were not possible", Table(heads, others, css="text")),
        fold("What was measured", Table(columns_measured, measured, css="text")),
    ]


def _check_row(check: dict) -> list:
    return [
        check["title"],
        Verdict(check["verdict"]),
        *(_number(check["measured"][0]) if check["measured"] else [NONE, NONE]),
        _names(check),
        check["reason"],
        check["remedy"],
    ]


def _number(measured: dict) -> list[str]:
    """Returns value and limit with their unit."""
    unit = f" {measured['unit']}" if measured["unit"] else ""
    return [_short(measured["value"]) + unit, NONE if measured["limit"] is None else _short(measured["limit"]) + unit]


def _short(value: float) -> str:
    """Returns the value with about three digits."""
    return f"{value:.3g}" if 1e-4 < abs(value) < 1e3 else number(value, 0) if abs(value) >= 1e3 else f"{value:.2g}"


def _names(check: dict) -> str:
    names = check["names"]
    surplus = f" and {len(names) - FIRST_NAMES} more" if len(names) > FIRST_NAMES else ""
    return ", ".join(names[:FIRST_NAMES]) + surplus if names else NONE


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
