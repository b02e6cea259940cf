"""The page of a run."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

from stcal.io.images import TOP_GROUP
from stcal.labels import BOARD, parse_label
from stcal.report.document import (
    Block,
    Document,
    Html,
    Section,
    Swatch,
    Table,
    alarms,
    columns,
    fold,
    html,
    legend,
    macro,
    page_only,
    plot,
    plots,
    subheading,
    tiles,
    tone_of,
)
from stcal.report.text import cells, join, number
from stcal.sfm.report import figures
from stcal.sfm.report.figures import FIRST_IMAGES, Residuals, photographs, space_parts
from stcal.sfm.report.judgement import Judgement, judgement_of, without_sigma
from stcal.sfm.report.sections import (
    Words,
    checks_section,
    crosscheck_section,
    headline,
    published_section,
    settings,
    trust,
)

SIDES = {-58: "", 122: ", from the other side"}
"""Azimuths from which target and cameras are drawn."""
BY_ROWS = (2, 3, 4)
"""Columns of the scales that only a board has."""
FIRST_PAIRS = 15
"""Number of rows that the page has room for."""


def report_html(
    report: dict,
    overlays: dict[str, bytes],  # JPEG by image name
    residuals: Mapping[str, Residuals] | None = None,  # centres and their residuals by image name, px; None: not drawn
    gone: int = 0,  # number of overlays that are no longer in the run's folder
) -> str:
    """Returns the page."""
    judgement = Judgement.model_validate(report.get("judgement") or judgement_of(report).model_dump())
    if judgement.verdict == "no":
        report = without_sigma(report)
    report = _with_named_groups(report)
    colours = figures.group_colours([group["name"] for group in report["groups"]])
    summary, words = report["summary"], Words.of(report)
    sections = [
        Section("Faces", _answer(report, colours, words)),
        Section("May I use it?", _use(report, judgement, words), name="use"),
        Section("How far to trust it", trust(report, judgement, words), name="trust"),
        Section("Faces in detail", _faces_in_detail(report), name="detail"),
        Section("Scale", _scale(report, words)),
        Section("Residuals", _residuals(report, colours)),
        Section("Focus", _focus(report)),
        Section("Initial pairs", _pairs(report), name="pairs"),
        Section("Left out", _left_out(report, words)),
        Section(
            "As published", published_section(report["comparison"]) if "comparison" in report else [], name="comparison"
        ),
        Section(
            "Cross-check", crosscheck_section(report["crosscheck"]) if "crosscheck" in report else [], name="crosscheck"
        ),
        Section("Settings", [Table(["<Setting", "<Value"], settings(report, words), css="text facts")]),
        Section("Overlays", _overlays(report, overlays, residuals or {}, gone, words)),
    ]
    counts = (
        f"{summary['images']} images in {summary['groups']} group{'' if summary['groups'] == 1 else 's'}, "
        f"{summary['images_mapped']} mapped, "
        f"{summary['faces']} faces"
    )
    banner = [_warning(report), macro("answers", judgement.answers()[:1], tone_of(judgement.verdict))]
    return Document(report["target"], counts, sections, banner, f"{report['target']}: calibration report").page()


def _with_named_groups(report: dict) -> dict:
    """Returns the report with a word in place of the dot for the group of the folder itself."""
    if all(group["name"] != TOP_GROUP for group in report["groups"]):
        return report
    word = "all" if len(report["groups"]) == 1 else "top folder"

    def named(value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {word if k == TOP_GROUP and key == "boards" else k: named(v, k) for k, v in value.items()}
        if isinstance(value, list):
            return [named(v, key) for v in value]
        return word if value == TOP_GROUP and key in ("group", "groups", "name") else value

    return named(report, "")


def _warning(report: dict) -> Block:
    """Returns what makes all faces useless, or that there are none."""
    warning = ""
    if not report["faces"]:
        warning = (
            "The board alone: no face of the target was recognised. λ and the board's residuals of each group are "
            "under Scale; there is no calibrated target. If a face is in view, look at the overlays."
        )
    elif report["options"]["solve"] == "paper":
        warning = (
            "As published, for comparison: centres of contours with equal weights, without the eccentricity. Faces "
            "are biased by tens of µm; residuals do not show it. Do not use these faces."
        )
    elif not report["options"]["eccentricity"]:
        warning = (
            "Eccentricity is off: this is an uncorrected control. Faces are biased along their normals by tens of "
            "µm; residuals do not show it. Do not use these faces."
        )
    return alarms([warning] if warning else [])


HOW_TO_USE = """import json, numpy as np

faces = json.load(open("faces.json"))
pose = np.array(faces["target_from_face"]["{face}"])  # 4x4, mm
xyz_target = pose @ [x, y, 0, 1]  # of a point on face {face}

# 6x6, rotation (rad) before translation (mm)
covariance = faces["target_from_face_covariance"]["{face}"]"""
"""Program that reads the result."""


def _answer(report: dict, colours: dict[str, str], words: Words) -> list[Block]:
    """Returns the faces with σ, the target in space, and how to use the result."""
    rows = []
    for name, face in report["faces"].items():
        datum = name == report["reference_face"]
        sigma = [number(v, 1) for v in face["translation_sigma_um"] or [None] * 3]
        sigma += [number(v, 2) for v in face["rotation_sigma_mdeg"] or [None] * 3]
        rows.append(
            [
                f"{name} (datum)" if datum else name,
                *[number(v, 4) for v in face["translation_mm"]],
                *(["0"] * 6 if datum and face["translation_sigma_um"] else sigma),
                *cells(face, "circles circles_of_design plane_rms_um:1 images"),
                join(face["groups"]),
            ]
        )
    heads = ["<Face"] + ["X", "Y", "Z"] * 3 + ["found", "of design", "Plane RMS (µm)", "Images", "<Groups"]
    over = [("", 1), ("Position (mm)", 3), ("σ of position (µm)", 3), ("σ of rotation about (mdeg)", 3)]
    over += [(words.points.capitalize(), 2), ("", 3)]
    others = [face for face in report["faces"] if face != report["reference_face"]]
    with_it = "boards and cameras" if words.board else "cameras"
    origin = "origin circle" if words.point == "circle" else "origin"
    scene, stills = report["scene"], []
    for azimuth, side in SIDES.items():
        text = f"Cameras{', boards' if words.board else ''} and target (black){side}"
        stills.append(plot(partial(figures.scene_view, scene, report["camera"], colours, azimuth), text, css=""))
        text = f"{words.points.capitalize()} of the target, frames of its faces{side}"
        stills.append(plot(partial(figures.target_view, scene["circles"], report["faces"], azimuth), text, css=""))
    space = [
        macro(
            "turned",
            space_parts(figures.upright(report), colours),
            f"Target, {with_it} in space",
            [("target", "Target"), ("all", f"With {with_it}")],
        ),
        "Axes of the face frames: x red, y green, z blue; the name of a face stands at the end of its Z",
        legend(colours, "Groups:"),
    ]
    use = []
    if others:
        use = [
            subheading("How to use it"),
            "faces.json beside this page has the pose of each face as a 4×4 matrix, the covariance of each, and the "
            f"{words.points} in the target frame; `stcal-sfm export RUN` writes it for other programs",
            macro("verbatim", HOW_TO_USE.replace("{face}", others[0])),
        ]
    return [
        f"Pose of each face in the target frame, which is the frame of face {report['reference_face']}: the position "
        f"is that of the face's {origin}, σ are one standard deviation"
        if rows
        else "",
        Table(heads, rows, over),
        columns(space, use) if use else page_only(*space),
        macro("group", "plots still", lambda: [html(*stills)]),
    ]


def _use(report: dict, judgement: Judgement, words: Words) -> list[Block]:
    """Returns the answers in words, the headline, and the checks."""
    checks = checks_section(report["checks"]) if "checks" in report else []
    return [macro("answers", judgement.answers(), tone_of(judgement.verdict)), *checks, tiles(headline(report, words))]


# --- faces and scale --------------------------------------------------------------------------------------------------


def _faces_in_detail(report: dict) -> list[Block]:
    """Returns the axes of the faces, distances between faces, and the ways to each face."""
    axes = []
    for name, face in report["faces"].items():
        matrix = face["target_from_face"]
        directions = [number(matrix[i][j], 7) for j in range(3) for i in range(3)]
        axes.append([name, *directions, number(face["angle_to_reference_deg"], 4)])
    between = [
        [f"{row['a']} – {row['b']}", *cells(row, "distance_mm:4 distance_sigma_um:1 angle_deg:4")]
        for row in report["between_faces"]
    ]
    ways = [
        [face, " → ".join(way["faces"]), " → ".join(way["groups"]), *cells(way, "translation_um:1 rotation_mdeg:2")]
        for face, chains in report["chains"].items()
        for way in chains
    ]
    over = [("", 1), ("X axis of the face", 3), ("Y axis of the face", 3), ("Z axis: the normal", 3), ("", 1)]
    heads = ["<Face", "<Way", "<By groups", "Position off (µm)", "Rotation off (mdeg)"]
    return [
        "The axes of each face in the target frame: the columns of its rotation matrix. Z points out of the body on "
        "faces of circles, and into it on faces of boards and tags, as their own frames do",
        Table(["<Face"] + ["x", "y", "z"] * 3 + ["Angle to datum (°)"], axes, over),
        columns(
            [
                subheading("Between faces"),
                "Distance of the origins, angle of the normals",
                Table(["<Faces", "Distance (mm)", "σ (µm)", "Angle (°)"], between),
            ],
            [
                subheading("Chains"),
                "Ways to each face through single groups, before these are adjusted together, and how far each is off "
                "the result. A way uses a part of the images, so that it may be off by many σ of the result; checks "
                "judge whether the ways agree"
                if ways
                else "No face but the datum",
                Table(heads, ways),
            ],
        ),
    ]


def _scale(report: dict, words: Words) -> list[Block]:
    """Returns λ and the board's residuals of each group."""
    heads = [
        "<Group",
        "λ, least squares (mm/unit)",
        "λ, by rows (mm/unit)",
        "Rows",
        "Difference (ppm)",
        "σ (ppm)",
        "Dots" if words.board else "Points",
    ]
    shown = [k for k in range(11) if words.board or k not in BY_ROWS]
    heads += ["Residual, mean (µm)", "± (µm)", "Residual, RMS (µm)", "Residual, max (µm)"]
    pictures = _board_residuals(report["groups"])
    without = (
        "Without a board in view, λ is from the corners of faces with printed boards or tags, or from known distances "
        "between points: they stand for the dots in this table"
    )
    of_boards = [
        subheading("Board residuals"),
        "Reconstructed minus design, in the board's frame, on the board's grid; one scale for all groups. Arrows show "
        "x and y, colour shows z",
        plots(*pictures),
    ]
    return [
        "λ turns a group's model into mm, by least squares over all dots of the board, and by rows as published "
        "(first and last row, all pairs). σ is that of λ from the board's stated σ"
        if words.board
        else "λ turns a group's model into mm, by least squares over all corners of printed faces, or over the known "
        "distances between points. σ is that of λ from their stated σ",
        Table([heads[k] for k in shown], [[row[k] for k in shown] for row in _scales(report)]),
        without if words.board and len(pictures) < len(report["groups"]) else "",
        *(of_boards if pictures else []),
    ]


def _scales(report: dict) -> list[list]:
    return [
        [
            group["name"],
            *cells(scale := group["scale"], "mm_per_unit:6 mm_per_unit_rows:6"),
            " and ".join(str(row) for row in scale["rows"]),
            *cells(scale, "difference_ppm:1 sigma_ppm:1 dots board_mean_um:1 board_spread_um:1 board_rms_um:1"),
            number(max((math.hypot(*v) for v in scale["board_residuals_um"].values()), default=None), 1),
        ]
        for group in report["groups"]
    ]


def _board_residuals(groups: list[dict]) -> list[Html]:
    """Returns the plots of the boards' residuals, all on one scale."""
    scales = {each["name"]: each["scale"] for each in groups if each["scale"].get("source", "board") == "board"}
    vectors = [vector for scale in scales.values() for vector in scale["board_residuals_um"].values()]
    reach = max((math.hypot(*vector[:2]) for vector in vectors), default=0.0)
    height = max((abs(vector[2]) for vector in vectors), default=0.0)
    return [
        plot(
            partial(figures.board_residuals, scale["board_residuals_um"], reach, height),
            f"Residual vectors of the board, group {name}",
            f"Group {name}: RMS {number(scale['board_rms_um'], 1)} µm",
            "",
        )
        for name, scale in scales.items()
    ]


# --- residuals, pairs, left out ---------------------------------------------------------------------------------------


def _residuals(report: dict, colours: dict[str, str]) -> list[Block]:
    """Returns the residuals by image; and by label, face by face and board by board."""
    target: dict[str, list] = {}
    board: dict[str, list] = {}
    for row in report["residuals_by_label"]:
        plane, shown = parse_label(row["label"]).plane, cells(row, "label observations rms_px:4 max_px:4")
        if plane == BOARD:
            board.setdefault(f"Board, group {row['group']}", []).append(shown)
        else:
            target.setdefault(f"Face {plane}", []).append(shown)
    images = [
        [
            i,
            row["image"],
            Swatch(row["group"], colours.get(row["group"], "")),
            *cells(row, "observations rms_px:4 max_px:4 worst"),
        ]
        for i, row in enumerate(report["residuals_by_image"], 1)
    ]
    worst = max(report["residuals_by_label"], key=lambda row: row["rms_px"], default=None)
    named = ""
    if worst:
        group = f" of group {worst['group']}" if worst["group"] else ""
        named = f". The worst label is {worst['label']}{group} with {worst['rms_px']:.4f} px RMS"
    table = Table(["No.", "<Image", "<Group", "Centres", "RMS (px)", "Max (px)", "<Worst label"], images)
    bars = partial(figures.image_bars, report["residuals_by_image"], colours)
    return [
        f"RMS is per axis, max is the length of the largest vector{named}",
        subheading("By image"),
        legend(colours, "Groups:"),
        plot(bars, "Residuals by image", "Bars: RMS of the image; ticks: its largest"),
        fold(f"All {len(images)} images", table) if len(images) > FIRST_IMAGES else table,
        subheading("By label"),
        _by_label(target),
        fold("Dots of the board, by group", _by_label(board)),
    ]


def _by_label(planes: dict[str, list]) -> Block:
    heads = ["<Label", "Images", "RMS (px)", "Max (px)"]
    return columns(*([subheading(name), Table(heads, rows)] for name, rows in planes.items()), css="columns small")


def _focus(report: dict) -> list[Block]:
    """Returns what was corrected for blur that varies across a circle."""
    if not report.get("focus"):
        return []
    heads = ["<Image", "In focus at (mm)", "Nearest circle (mm)", "Its blur (px)", "Farthest (mm)", "Its blur (px)"]
    keys = "image focused_mm:0 nearest_mm:0 nearest_blur_px:2 farthest_mm:0 farthest_blur_px:2 shift_px:4"
    return [
        "Out of focus the blur grows with the distance from the plane of focus, also across a tilted circle, whose "
        "centre then seems to lie nearer to its blurrier side. Centres are corrected for it, and what is uncertain of "
        "it is in their σ",
        Table([*heads, "Largest correction (px)"], [cells(row, keys) for row in report["focus"]]),
    ]


def _pairs(report: dict) -> list[Block]:
    """Returns how each group's mapping began."""
    heads = ["<First", "<Second", "Labels shared", "Median angle (°)", "In front", "Forward", "<Verdict"]
    blocks: list[Block] = []
    for group in report["groups"]:
        pairs = [
            cells(p, "first second shared median_angle_deg:2 in_front:2 forward:2 verdict") for p in group["pairs"]
        ]
        more = fold(f"{len(pairs) - FIRST_PAIRS} more pairs", Table(heads, pairs[FIRST_PAIRS:]))
        blocks.append(fold(f"Group {group['name']}: {len(pairs)} pairs", Table(heads, pairs[:FIRST_PAIRS]), more))
    heads = ["<Group", "Images mapped", "<Faces", "Points", "<Chosen pair", "Angle (°)", "<Started from", "Rounds"]
    return [
        "Each group starts from the pair of images with the largest median ray angle that is still safe "
        f"({report['options']['max_pair_angle_deg']:.1f}° at most). In front is the share of points before both "
        "cameras, forward that of the motion along the optical axis",
        Table(heads, _starts(report)),
        *blocks,
    ]


def _left_out(report: dict, words: Words) -> list[Block]:
    """Returns all that was left out, with reasons, and the notes."""
    left, unseen = report["left_out"], report["summary"]["faces_not_seen"]
    blocks: list[Block] = []
    points = words.points.capitalize()
    for title, heads, rows in (
        ("Files", ["<File", "<Reason"], [cells(row, "name reason") for row in left["files"]]),
        ("Images", ["<Image", "<Reason"], [cells(row, "name reason") for row in left["images"]]),
        (points, ["<Image", "Number", f"<{points}", "<Reason"], _circles_left_out(report)),
        ("Notes on images", ["<Image", "<Note"], [cells(row, "image note") for row in left["notes"]]),
        ("Notes on the whole run", ["<No.", "<Note"], list(enumerate(report["notes"], 1))),
    ):
        if rows:
            blocks += [subheading(title), Table(heads, rows, css="text")]
    if unseen:
        blocks.append(f"Faces of the design that are not in the result: {join(unseen)}")
    return blocks or ["Nothing was left out"]


def _overlays(report: dict, overlays: dict, residuals: Mapping[str, Residuals], gone: int, words: Words) -> list[Block]:
    """Returns the photographs with their circles."""
    rest = len(report["images"]) - len(overlays) - gone
    shown = photographs(report, overlays, residuals)
    lost = (
        f"{gone} photographs are not shown: their overlays were no longer in the run's folder when this page was made"
    )
    return [
        macro("photographs", shown, rest, words) if shown.each else "" if gone else "There are none",
        lost if gone else "",
    ]


def _starts(report: dict) -> list[list]:
    """Returns rows on the start of the mapping of each group."""
    return [
        [
            group["name"],
            len(group["images"]),
            join(group["faces"]),
            group["points"],
            " and ".join(name for pair in group["pairs"][:1] for name in (pair["first"], pair["second"])),
            number(group["pairs"][0]["median_angle_deg"] if group["pairs"] else None, 2),
            group["seeded"],
            group["rounds"],
        ]
        for group in report["groups"]
    ]


def _circles_left_out(report: dict) -> list[list]:
    circles: dict[tuple[str, str], list[str]] = {}
    for circle in report["left_out"]["circles"]:
        circles.setdefault((circle["image"], circle["reason"]), []).append(circle["label"])
    return [[image, len(labels), join(labels), reason] for (image, reason), labels in circles.items()]
