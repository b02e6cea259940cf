"""The page of a run: its answer, how far to trust it, and all that it rests on; with its figures."""

import base64
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from itertools import chain, product

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.labels import BOARD, parse_label
from stcal.report.document import (
    Block,
    Document,
    Html,
    Section,
    Table,
    alarms,
    columns,
    fold,
    legend,
    macro,
    page_only,
    plot,
    plots,
    subheading,
    swatch,
    tone_of,
    verdict_word,
)
from stcal.report.svg import AXIS_COLOURS, COLOURS, INK, round_below
from stcal.report.text import NONE, cells, join, number
from stcal.sfm.report.check import BY_CHANCE, ORDER, Check, count_verdicts
from stcal.sfm.report.judgement import SIZES, Judgement, judgement_of, without_sigma
from stcal.sfm.report.run_figures import board_residuals, by_photograph, normalised_residuals, residual_field

FIRST_IMAGES = 100  # number of rows and overlays that the page has room for
LONGEST = 0.04  # length of the vector that nineteen of twenty residuals do not exceed, as a share of the image's width
Residuals = np.ndarray  # (n, 6) of circles: centre x, y and residual x, y, px; residual x, y over its σ

SOLVES = {
    "joint": "joint: one adjustment over all groups",
    "chain": "chain: group by group, then combined",
    "paper": "paper: as published by Zhang & Wei (2017), for comparison",
}
FRAMES = {"plane": "plane: Z from the plane of all circles", "three-point": "three-point: from three circles"}


PUBLISHED = (
    "as published, for comparison: centres of contours with equal weights, without the eccentricity; faces are off by "
    "tens of µm, and no residual shows it"
)
CONTROL = "uncorrected control: without the eccentricity faces are off by tens of µm, and no residual shows it"
ALONE = (
    "The board alone: no face of the target was recognised. λ and the board's residuals of each group are under Scale; "
    "there is no calibrated target. If a face is in view, look at the overlays."
)


def report_html(
    report: dict,
    overlays: dict[str, bytes],  # JPEG by image name
    residuals: Mapping[str, Residuals] | None = None,  # centres and their residuals by image name, px; None: not drawn
    gone: int = 0,  # number of overlays that are no longer in the run's folder
) -> str:
    judgement = Judgement.model_validate(report.get("judgement") or judgement_of(report).model_dump())
    if judgement.verdict == "no":
        report = without_sigma(report)
    colours = {group["name"]: COLOURS[i % len(COLOURS)] for i, group in enumerate(report["groups"])}
    summary, options = report["summary"], report["options"]
    others = {"comparison": ("As published", published_section), "crosscheck": ("Cross-check", crosscheck_section)}
    shown, rest = photographs(report, overlays, residuals or {}), len(report["images"]) - len(overlays) - gone
    why = "their overlays were no longer in the run's folder when this page was made"
    pictures = [
        macro("photographs", shown, rest) if shown["each"] else "" if gone else "There are none",
        f"{gone} photographs are not shown: {why}" if gone else "",
    ]
    sections = [
        Section("Faces", _answer(report, colours)),
        Section("Checks", checks_section(report.get("checks", [])), name="use"),
        Section("How far to trust it", trust(report, judgement), name="trust"),
        Section("Faces in detail", _faces_in_detail(report), name="detail"),
        Section("Scale", _scale(report)),
        Section("Residuals", _residuals(report, colours, residuals or {})),
        Section("Left out", _left_out(report)),
        *(Section(title, make(report[key]), name=key) for key, (title, make) in others.items() if key in report),
        Section("Settings", [Table(["<Setting", "<Value"], settings(report), css="text facts")]),
        Section("Overlays", pictures),
    ]
    groups = f"{summary['groups']} group{'' if summary['groups'] == 1 else 's'}"
    mapped = f"{summary['images_mapped']} mapped, {summary['faces']} faces"
    counts = f"{summary['images']} images in {groups}, {mapped}"
    alone, published, control = not report["faces"], options["solve"] == "paper", not options["eccentricity"]
    warnings = [ALONE] * alone + [PUBLISHED] * published + [CONTROL] * control
    banner = [alarms(warnings[:1]), macro("answers", judgement.answers(), tone_of(judgement.verdict))]
    return Document(report["target"], counts, sections, banner, f"{report['target']}: calibration report").page()


def faces_table(faces: dict[str, dict], reference: str) -> Table:
    """Returns the poses of the faces in the target frame, with σ."""
    rows = []
    for name, face in faces.items():
        sigma = [number(v, 1) for v in face["translation_sigma_um"] or [None] * 3]
        sigma += [number(v, 2) for v in face["rotation_sigma_mdeg"] or [None] * 3]
        if name == reference and face["translation_sigma_um"]:
            sigma = ["0"] * 6
        label = f"{name} (datum)" if name == reference else name
        rows.append([label, *[number(v, 4) for v in face["translation_mm"]], *sigma])
    return Table(["<Face"] + ["x", "y", "z"] * 3, rows, [("", 1), ("mm", 3), ("σ µm", 3), ("σ mdeg", 3)], "poses")


def _answer(report: dict, colours: dict[str, str]) -> list[Block]:
    """Returns the faces with σ, and the target in space."""
    with_it = "boards and cameras" if "board" in report["summary"].get("scale_from", ["board"]) else "cameras"
    views = [("target", "Target"), ("all", f"With {with_it}")]
    return [
        f"Pose of each face in the target frame, which is the frame of face {report['reference_face']}: the position "
        "is that of the face's origin, σ are one standard deviation, of the position along and of the rotation about "
        "an axis. faces.json beside this page has poses, covariances and points; `stcal-sfm export RUN` writes them "
        "for other programs"
        if report["faces"]
        else "",
        faces_table(report["faces"], report["reference_face"]),
        page_only(
            macro("turned", partial(space_parts, report, colours), f"Target, {with_it} in space", views),
            "Axes of the face frames: x red, y green, z blue; the name of a face stands at the end of its Z",
            legend(colours, "Groups:"),
        ),
    ]


def _faces_in_detail(report: dict) -> list[Block]:
    """Returns what each face rests on, distances between faces, and the ways to each face."""
    rests = [
        [name, *cells(face, "circles circles_of_design plane_rms_um:1 images"), join(face["groups"])]
        for name, face in report["faces"].items()
    ]
    between = [
        [f"{row['a']} – {row['b']}", *cells(row, "distance_mm:4 distance_sigma_um:1 angle_deg:4")]
        for row in report["between_faces"]
    ]
    ways = []
    for face, way in ((face, way) for face, chains in report["chains"].items() for way in chains):
        off = number(1e3 * way["translation_mm"], 1), number(1e3 * math.degrees(way["rotation_rad"]), 2)
        ways.append([face, " → ".join(way["faces"]), " → ".join(way["groups"]), *off])
    distances = Table(["<Faces", "Distance (mm)", "σ (µm)", "Angle (°)"], between)
    heads = ["<Face", "<Way", "<By groups", "Position off (µm)", "Rotation off (mdeg)"]
    found = ["Points found", "of design", "Plane RMS (µm)", "Images", "<Groups"]
    return [
        Table(["<Face", *found], rests),
        columns(
            [subheading("Between faces"), "Distance of the origins, angle of the normals", distances],
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


def _scale(report: dict) -> list[Block]:
    """Returns λ and the board's residuals of each group, the plots of all on one scale."""
    rows, boards = [], {}
    for group in report["groups"]:
        scale, by_rows = group["scale"], [NONE] * 3
        if scale.get("source", "board") == "board":
            boards[group["name"]] = scale
            mm, off = cells(scale, "mm_per_unit_rows:6 difference_ppm:1")
            by_rows = [mm, " and ".join(str(row) for row in scale["rows"]), off]
        least, *own = cells(scale, "mm_per_unit:6 sigma_ppm:1 dots board_mean_um:1 board_spread_um:1 board_rms_um:1")
        most = max((math.hypot(*vector) for vector in scale["board_residuals_um"].values()), default=None)
        rows.append([group["name"], least, *by_rows, *own, number(most, 1)])
    heads = ["<Group", "λ, least squares (mm/unit)", "λ, by rows (mm/unit)", "Rows", "Difference (ppm)", "σ (ppm)",
             "Points", "Residual, mean (µm)", "± (µm)", "Residual, RMS (µm)", "Residual, max (µm)"]  # fmt: skip
    residuals = [vector for scale in boards.values() for vector in scale["board_residuals_um"].values()]
    reach = max((math.hypot(*vector[:2]) for vector in residuals), default=0.0)
    height = max((abs(vector[2]) for vector in residuals), default=0.0)
    pictures = []
    for name, scale in boards.items():
        draw = partial(board_residuals, scale["board_residuals_um"], reach, height)
        caption = f"Group {name}: RMS {number(scale['board_rms_um'], 1)} µm"
        pictures.append(plot(draw, f"Residual vectors of the board, group {name}", caption, ""))
    of_boards = [
        subheading("Board residuals"),
        "Reconstructed minus design, in the board's frame, on the board's grid; one scale for all groups. Arrows show "
        "x and y, colour shows z",
        plots(*pictures),
    ]
    return [
        "λ turns a group's model into mm, by least squares over all dots of the board, and by rows as published (first "
        "and last row, all pairs); without a board, over the corners of printed faces or the known distances between "
        "points. σ is that of λ from their stated σ",
        Table(heads, rows),
        *(of_boards if pictures else []),
    ]


def _residuals(report: dict, colours: dict[str, str], residuals: Mapping[str, Residuals]) -> list[Block]:
    """Returns the residuals in figures, by image, and by label: face by face and board by board."""
    target: dict[str, list] = {}
    board: dict[str, list] = {}
    for row in report["residuals_by_label"]:
        plane, shown = parse_label(row["label"]).plane, cells(row, "label observations rms_px:4 max_px:4")
        if plane == BOARD:
            board.setdefault(f"Board, group {row['group']}", []).append(shown)
        else:
            target.setdefault(f"Face {plane}", []).append(shown)
    images: list[list] = []
    for i, row in enumerate(report["residuals_by_image"], 1):
        coloured = swatch(row["group"], colours.get(row["group"], ""))
        images.append([i, row["image"], coloured, *cells(row, "observations rms_px:4 max_px:4 worst")])
    named = ""
    if worst := max(report["residuals_by_label"], key=lambda row: row["rms_px"], default=None):
        group = f" of group {worst['group']}" if worst["group"] else ""
        named = f". The worst label is {worst['label']}{group} with {worst['rms_px']:.4f} px RMS"
    table = Table(["No.", "<Image", "<Group", "Centres", "RMS (px)", "Max (px)", "<Worst label"], images)
    return [
        f"RMS is per axis, max is the length of the largest vector{named}",
        plots(*_residual_plots(report, residuals)),
        subheading("By image"),
        fold(f"All {len(images)} images", table) if len(images) > FIRST_IMAGES else table,
        subheading("By label"),
        _by_label(target),
        fold("Dots of the board, by group", _by_label(board)),
    ]


def _residual_plots(report: dict, residuals: Mapping[str, Residuals]) -> Iterable[Html]:
    by_image, every = report["residuals_by_image"], np.concatenate([np.zeros((0, 6)), *residuals.values()])
    if len(every):
        size_px, of = tuple(report["camera"]["size_px"]), f"of {len(residuals)} photographs"
        yield plot(partial(residual_field, every, size_px), f"Mean residuals over the image, {of}", css="")
    if by_image:
        yield plot(partial(by_photograph, by_image), "RMS of each photograph; the largest is named", css="")
    if len(every):
        yield plot(partial(normalised_residuals, every[:, 4:].ravel()), f"Residuals over their σ, {of}", css="")


def _by_label(planes: dict[str, list]) -> Block:
    heads = ["<Label", "Images", "RMS (px)", "Max (px)"]
    return columns(*([subheading(name), Table(heads, rows)] for name, rows in planes.items()), css="columns small")


def _left_out(report: dict) -> list[Block]:
    """Returns all that was left out, with reasons, and the notes."""
    left = report["left_out"]
    blocks: list[Block] = []
    circles: dict[tuple[str, str], list[str]] = {}
    for circle in left["circles"]:
        circles.setdefault((circle["image"], circle["reason"]), []).append(circle["label"])
    of_circles = [[image, len(labels), join(labels), reason] for (image, reason), labels in circles.items()]
    for title, heads, rows in (
        ("Files", ["<File", "<Reason"], [cells(row, "name reason") for row in left["files"]]),
        ("Images", ["<Image", "<Reason"], [cells(row, "name reason") for row in left["images"]]),
        ("Points", ["<Image", "Number", "<Points", "<Reason"], of_circles),
        ("Notes on images", ["<Image", "<Note"], [cells(row, "image note") for row in left["notes"]]),
        ("Notes on the whole run", ["<No.", "<Note"], [[i, note["note"]] for i, note in enumerate(report["notes"], 1)]),
    ):
        if rows:
            blocks += [subheading(title), Table(heads, rows, css="text")]
    return blocks or ["Nothing was left out"]


def trust(report: dict, judgement: Judgement) -> list[Block]:
    """Returns which errors no σ includes, and what residuals and chains tell of the σ."""
    summary = report["summary"]
    scope = "No σ are shown, as they would not be valid: they do not include the error that made the checks fail"
    if report["options"]["solve"] != "joint":
        scope = "No σ were computed: groups were solved one by one; look at the chains"
    elif judgement.verdict != "no":
        absent = [] if report["options"].get("refine_camera") else ["the camera calibration"]
        pitch = "the pitch as a whole (100 ppm is 4 K on aluminium)"
        absent += [pitch] if "board" in summary.get("scale_from", ["board"]) else []
        scope = f"No σ includes an error of {' or of '.join(absent)}, and residuals hardly show it" if absent else ""
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


def settings(report: dict) -> list[list[str]]:
    summary, options, camera = report["summary"], report["options"], report["camera"]
    last_move = summary["last_move_px"]
    sizes = " × ".join(str(size) for size in camera["size_px"])
    solve, frame = str(options["solve"]), str(options["frame"])
    round_ = not report["faces"] or not report["faces"].keys() <= set(summary.get("printed_faces", []))
    source = "as given" if summary.get("camera_given", True) else "found from the photographs"
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
        ["Scale", join([SIZES[source] for source in summary.get("scale_from", ["board"])])],
        [f"Camera, {source}", f"{camera['model']}, {sizes} px"],
        ["Focal lengths (px)", ", ".join(number(v, 4) for v in camera["focal_px"])],
        ["Principal point (px)", ", ".join(number(v, 4) for v in camera["centre_px"]) + " (pixel centres integer)"],
        ["Distortion", ", ".join(f"{v:.8g}" for v in camera["distortion"])],
        ["Program", f"stcal {report['version']}"],
    ]
    return [[name, value] for name, value in rows if value]


def crosscheck_section(check: dict) -> list[Block]:
    """Returns the section on the cross-check with the native COLMAP."""
    mapping = check["mapping"]
    names = {"native": f"COLMAP {check['native']}", "pycolmap": f"pycolmap {check['pycolmap']}", "run": "this result"}
    images, rms_px = check["images"], check["residual_rms_px"]
    models = [[name, images[key], number(rms_px[key], 4)] for key, name in names.items()]
    largest = ""
    if worst := max(mapping["cameras"], key=lambda row: row["sigmas"], default=None):
        largest = f"; the largest is {worst['sigmas']:.2f} σ, {worst['position_um']:.1f} µm, at {worst['image']}"
    rows = [[face] for face in mapping["faces"]]
    for row, key in product(rows, ("mapping", "result", "plain")):
        entry = check[key]["faces"].get(row[0])
        row += [*cells(entry, "translation_um:3 rotation_mdeg:3 sigmas:2")] if entry else [NONE] * 3
    over = [("", 1), ("Native – pycolmap", 3), ("Native, adjusted – result", 3), ("Native – result", 3)]
    return [
        f"Native COLMAP {check['native']} and pycolmap {check['pycolmap']} on the same database (form of "
        f"COLMAP {check['schema']}), initial pairs and thresholds",
        alarms([f"They differ: {'; '.join(check['differences'])}."]) if check["differences"] else "They agree",
        Table(["<Model", "Images", "Residual RMS (px)"], models),
        subheading("Faces"),
        "Differences in the target frame: the two programs' models as COLMAP adjusts them; the native models against "
        "this result, after our own adjustment and without it. σ is the difference in the run's own standard "
        "deviations. The third has no tolerance: it shows what weights and the joint adjustment are worth",
        Table(["<Face"] + ["Position (µm)", "Rotation (mdeg)", "σ"] * 3, rows, over),
        subheading("Cameras"),
        "Native against pycolmap, against the target, and in σ of the camera in its group. They matter only if faces "
        f"move with them, which the table of faces shows{largest}",
        *check["notes"],
    ]


FIRST_NAMES = 6  # number of names that a row has room for


def checks_section(checks_of_report: list[dict]) -> list[Block]:
    """Returns the checks that did not pass; the others, and what all of them measured, folded."""
    checks = sorted(map(Check.read, checks_of_report), key=lambda check: ORDER.index(check.verdict))
    heads = ["<Check", "<Verdict", "Value", "Limit", "<Named", "<Found", "<What to do"]
    of_values = ["<Check", "<What", "Value", "Limit", "Probability by chance"]
    open_: list[list] = []
    others: list[list] = []
    measured: list[list] = []
    for check in checks:
        surplus = len(check.names) - FIRST_NAMES
        names = join(check.names[:FIRST_NAMES]) + (f" and {surplus} more" if surplus > 0 else "")
        value = check.measured[0].texts() if check.measured else [NONE, NONE]
        row = [check.title, verdict_word(check.told()), *value, names, check.reason, check.remedy]
        (open_ if check.verdict in ("failed", "suspicious") else others).append(row)
        for m in check.measured:
            chance = NONE if m.probability is None else f"{m.probability:.1g}"
            measured.append([check.title, m.name, *m.texts(), chance])
    passed = f"{len(others)} checks that passed, were not possible or not applicable"
    return [
        f"Checks: {count_verdicts(checks)}. Each tests what small residuals do not prove; {BY_CHANCE}, however many "
        "images or points it tested",
        Table(heads, open_, css="text"),
        fold(passed, Table(heads, others, css="text")),
        fold("What was measured", Table(of_values, measured, css="text")),
    ]


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


def _points(places: Iterable) -> np.ndarray:
    """Returns places as an array (n, 3), also if there are none."""
    return np.array(list(places), float).reshape(-1, 3)


def _length(share: float, points: np.ndarray) -> float:
    """Returns a share of the largest extent of points along an axis, mm; 1 if there are none."""
    return share * float(np.ptp(points, axis=0).max()) if len(points) else 1.0


def frustum(pose: dict, camera: dict, depth: float) -> list[np.ndarray]:
    """Returns the path of a camera's pyramid; rows of ``axes`` are the camera's axes, with Z as viewing direction."""
    at, axes = np.array(pose["position_mm"], float), np.array(pose["axes"], float)
    half = depth * np.array(camera["size_px"]) / (2 * np.array(camera["focal_px"]))
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    corners = [at + depth * axes[2] + sx * half[0] * axes[0] + sy * half[1] * axes[1] for sx, sy in around]
    sides = [place for k in range(4) for place in (at, corners[k], corners[k - 3])]
    return [*sides, at, at + 2.2 * depth * axes[2]]


DIGITS = 2  # number of decimals of coordinates in mm: far finer than a screen shows
AXIS = 0.2  # length of the faces' axes, as a share of the target's extent
CAMERA = 0.07  # depth of a camera's pyramid, as a share of the scene's extent
SHEET = "#7f93a8"
FLAT_MM = 0.1  # distance of a face from the middle of the circles within which there is no body, but one plane
LEAST_UPRIGHT = 0.5  # length of the mean of the photographs' upward directions from which on they agree


def space_parts(report: dict, colours: dict[str, str]) -> list[dict]:
    """Returns the parts to be drawn in the target frame: ``kind`` (``line``, ``sheet``, ``point``, ``text``), ``xyz``
    (mm), ``colour``, and for some ``name``, ``size`` (px), ``face`` and ``target``: whether it is of the target."""
    scene = report["scene"]
    parts = _faces(scene["circles"], report["faces"])
    for label, xyz in scene["circles"].items():
        face = parse_label(label).plane
        parts.append(_part("point", [xyz], "#000000", name=label, size=2.2, target=True, face=face))
    for group, dots in scene["boards"].items():
        parts += [_part("point", [xyz], colours.get(group, INK), size=1.2) for xyz in dots]
        if len(dots):
            parts.append(_part("text", [np.mean(dots, axis=0)], colours.get(group, INK), name=f"group {group}"))
    places = [view["position_mm"] for view in scene["cameras"]]
    everything = np.array([*scene["circles"].values(), *chain.from_iterable(scene["boards"].values()), *places])
    depth = _length(CAMERA, everything)
    for camera in scene["cameras"]:
        path, colour = frustum(camera, report["camera"], depth), colours.get(camera["group"], INK)
        parts.append(_part("line", path, colour, name=camera["image"], size=1.1))
    up = -np.mean([camera["axes"][1] for camera in scene["cameras"]] or [np.zeros(3)], axis=0)
    if np.linalg.norm(up) < LEAST_UPRIGHT:
        return parts
    turn = Rotation.align_vectors([[0, 0, 1]], [up])[0]  # as it stood for upright photographs
    return [part | {"xyz": np.round(turn.apply(part["xyz"]), DIGITS).tolist()} for part in parts]


def _faces(circles: dict[str, list[float]], faces: dict[str, dict]) -> list[dict]:
    """Returns sheet, axes and name of each face; corners of a sheet run counterclockwise seen from outside."""
    from scipy.spatial import ConvexHull, QhullError

    body = _points(circles.values())
    reach, parts = _length(AXIS, body), []
    for name, face in faces.items():
        centres = _points(place for label, place in circles.items() if parse_label(label).plane == name)
        pose, own = np.array(face["target_from_face"], float), {"target": True, "face": name}
        origin, middle = pose[:3, 3], centres.mean(0) if len(centres) else pose[:3, 3]
        with suppress(QhullError, ValueError):  # circles that do not span the plane
            corners = centres[ConvexHull((centres - origin) @ pose[:3, :2]).vertices]
            outwards = (middle - body.mean(0)) @ pose[:3, 2] >= -FLAT_MM
            parts.append(_part("sheet", corners if outwards else corners[::-1], SHEET, **own))
        for axis, colour in enumerate(AXIS_COLOURS):
            parts.append(_part("line", [origin, origin + reach * pose[:3, axis]], colour, size=1.6, **own))
        parts.append(_part("text", [middle + 0.9 * reach * pose[:3, 2]], "#1c2733", name=name, **own))
    return parts


def _part(kind: str, xyz, colour: str, **more) -> dict:
    return {"kind": kind, "xyz": np.round(np.asarray(xyz, float), DIGITS).tolist(), "colour": colour, **more}


def photographs(report: dict, overlays: dict[str, bytes], residuals: Mapping[str, Residuals]) -> dict:
    """Returns all photographs that the page shows, with vectors on one scale, and a bar of that scale."""
    width, height = report["camera"]["size_px"]
    mapped = {row["image"]: row for row in report["residuals_by_image"]}
    lengths = np.concatenate([np.zeros(0), *(np.hypot(*entry[:, 2:4].T) for entry in residuals.values())])
    usual = float(np.quantile(lengths, 0.95)) if len(lengths) else 0.0
    factor = round_below(LONGEST * width / usual) if usual > 0 else 0.0
    bar_px = round_below(LONGEST * width / factor) if factor else 0.0
    each = []
    for name, jpeg in overlays.items():
        entry = mapped.get(name)
        says = f"{entry['observations']} centres, {number(entry['rms_px'], 4)} px RMS" if entry else "not mapped"
        lines = residuals.get(name, np.zeros((0, 6)))[:, :4].tolist()
        vectors = "".join(f"M{x:.1f} {y:.1f}l{factor * dx:.1f} {factor * dy:.1f}" for x, y, dx, dy in lines)
        uri = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
        each.append({"name": name, "says": says, "jpeg": uri, "vectors": vectors})
    return {
        "each": each,
        "box": f"-0.5 -0.5 {width} {height}",
        "aspect": round(width / height, 5),
        "factor": factor,
        "stroke": round(width / 450, 2),
        "bar": f"M{0.98 * width:.1f} {0.97 * height:.1f}h{-factor * bar_px:.1f}",
        "bar_px": bar_px,
    }


def shown_overlays(report: dict) -> list[str]:
    """Returns the names of the images whose overlays the page shows; of a large set, those that deserve a look."""
    names = [image["name"] for image in report["images"]]
    if len(names) <= FIRST_IMAGES:
        return names
    worst = {row["image"]: row["max_px"] for row in report["residuals_by_image"]}
    noted = {note["image"] for note in report["left_out"]["notes"]}
    ranked = sorted(names, key=lambda name: (name in worst, name not in noted, -worst.get(name, 0.0)))
    chosen = set(ranked[:FIRST_IMAGES])
    return [name for name in names if name in chosen]


def comparison_cells(comparison: dict) -> tuple[list[str], list[list[str]]]:
    """Returns heads and rows of the table; ``comparison`` : its content in ``report.json``."""
    faces = list(comparison["sigma"])
    heads = ["<Method", *(f"Face {face} (µm)" for face in faces), "Rotation, largest (mdeg)", "Board, mean (µm)",
             "± (µm)", "Residual (px)"]  # fmt: skip
    rows = []
    for row in comparison["rows"]:
        is_last = row is comparison["rows"][-1]
        values, sign = (comparison["sigma"], "σ ") if is_last else (row["faces"], "")
        shown = [f"{sign}{number(values[face]['translation_um'], 2)}" if face in values else NONE for face in faces]
        turned = sign + number(max((each["rotation_mdeg"] for each in values.values()), default=None), 2)
        rows.append([row["method"], *shown, turned, *cells(row, "board_mean_um:1 board_spread_um:1 residual_rms_px:4")])
    return heads, rows
