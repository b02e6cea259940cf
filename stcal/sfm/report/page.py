"""``report.html``: the report as one page that opens off line, for people; ``report.json`` is the same for programs."""

import base64
import math
from html import escape

from stcal.labels import BOARD, parse_label
from stcal.report.page import NONE, Html, cells, fold, join, number, page, plot, swatch, table
from stcal.sfm.report import figures
from stcal.sfm.report.checks import checks_section
from stcal.sfm.report.crosscheck import crosscheck_section
from stcal.sfm.report.figures import legend

FIRST_PAIRS = 15
FIRST_IMAGES = 100
"""Rows and overlays that the page has room for."""


def report_html(report: dict, overlays: dict[str, bytes]) -> str:
    """The page.

    Parameters
    ----------
    report : what :func:`stcal.sfm.run.output.report_json` made
    overlays : JPEG by image name
    """
    colours = figures.group_colours([group["name"] for group in report["groups"]])
    sections = [
        ("result", "Result", _result(report)),
        *([("checks", "Checks", checks_section(report["checks"]))] if "checks" in report else []),
        ("trust", "How far to trust it", _trust(report)),
        ("faces", "Faces", _faces(report)),
        ("scale", "Scale", _scale(report)),
        ("space", "Picture in space", _space(report, colours)),
        ("residuals", "Residuals", _residuals(report, colours)),
        ("pairs", "Initial pairs", _pairs(report)),
        ("left-out", "Left out", _left_out(report)),
        *([("crosscheck", "Cross-check", crosscheck_section(report["crosscheck"]))] if "crosscheck" in report else []),
        ("overlays", "Overlays", _overlays(report, overlays)),
    ]
    return page(f"{report['target']}: calibration report", _banner(report), sections)


def _size_mm(report: dict) -> float:
    """The diagonal of the box about the target's circles."""
    circles = list(report["scene"]["circles"].values())
    return math.dist(*[[pick(axis) for axis in zip(*circles, strict=True)] for pick in (min, max)]) if circles else 0.0


# --- result and trust -------------------------------------------------------------------------------------------------


def _banner(report: dict) -> str:
    summary = report["summary"]
    counts = (
        f"{summary['images']} images in {summary['groups']} groups, {summary['images_mapped']} mapped, "
        f"{summary['faces']} faces"
    )
    control = ""
    if not report["options"]["eccentricity"]:
        control = (
            '<p class="alarm" role="alert"><strong>Eccentricity is off: this is an uncorrected control.</strong> Faces '
            "are biased along their normals by tens of µm; residuals do not show it. Do not use these faces.</p>\n"
        )
    return f'<h1>{escape(report["target"])}</h1>\n<p class="counts">{counts}</p>\n{control}'


def _factor_in_words(factor: float) -> str:
    if 0.95 <= factor <= 1.05:
        return "residuals are as large as the centres' own σ"
    return f"residuals are {factor:.1f} times the centres' own σ"


def _worst(found) -> tuple[float, str] | None:
    return max(found, key=lambda each: each[0], default=None)


def _largest_sigma(report: dict, key: str) -> tuple[float, str] | None:
    return _worst((max(face[key]), f"face {name}") for name, face in report["faces"].items() if face[key] is not None)


def _worst_chain(report: dict, key: str) -> tuple[float, str] | None:
    return _worst(
        (chain[key], f"face {face} by {' → '.join(chain['groups'])}")
        for face, chains in report["chains"].items()
        if len(chains) > 1
        for chain in chains
    )


def _result(report: dict) -> str:
    summary, options, camera = report["summary"], report["options"], report["camera"]
    sigma, chain = _largest_sigma(report, "translation_sigma_um"), _worst_chain(report, "translation_um")
    ppm = max((abs(group["scale"]["difference_ppm"]) for group in report["groups"]), default=None)
    sizes = " × ".join(str(size) for size in camera["size_px"])
    tiles = [
        (number(summary["residual_rms_px"], 4), "px", "residual, RMS per axis"),
        (number(summary["sigma0"], 2), "", "σ₀ of the joint adjustment"),
        (number(summary["sigma_factor"], 2), "×", _factor_in_words(summary["sigma_factor"])),
        (number(sigma and sigma[0], 1), "µm", "largest σ of a face's position"),
        (number(chain and chain[0], 1), "µm", "largest disagreement of chains"),
        (number(ppm, 1), "ppm", "largest difference of λ by rows"),
    ]
    cards = "".join(f"<div><b>{v}</b> {unit}<span>{escape(text)}</span></div>" for v, unit, text in tiles)
    solve = {"joint": "joint: one adjustment over all groups", "chain": "chain: group by group, then combined"}
    frame = {"plane": "plane: Z from the plane of all circles", "three-point": "three-point: from three circles"}
    left, last = report["left_out"], summary["last_move_px"]
    rows = [
        ["Solve", solve.get(options["solve"], options["solve"])],
        ["Face frames", frame.get(options["frame"], options["frame"])],
        ["Eccentricity", "corrected" if options["eccentricity"] else "off (uncorrected control)"],
        ["Reference face", report["reference_face"]],
        ["Faces not seen", join(summary["faces_not_seen"]) if summary["faces_not_seen"] else "none"],
        ["Centres observed", f"{summary['observations']}, redundancy {summary['redundancy'] or NONE}"],
        ["Last step of the joint adjustment", NONE if last is None else f"{last:.1g} px"],
        ["Left out", f"{len(left['files'])} files, {len(left['images'])} images, {len(left['circles'])} circles"],
        ["Camera, as given", f"{camera['model']}, {sizes} px"],
        ["Focal lengths (px)", ", ".join(number(v, 4) for v in camera["focal_px"])],
        ["Principal point (px)", ", ".join(number(v, 4) for v in camera["centre_px"]) + " (pixel centres integer)"],
        ["Distortion", ", ".join(f"{v:.8g}" for v in camera["distortion"])],
        ["Program", f"stcal {report['version']}"],
    ]
    return f'<div class="tiles">{cards}</div>\n{table(["<Setting", "<Value"], rows, css="text facts")}'


def _trust(report: dict) -> str:
    summary = report["summary"]
    sigma = "<strong>σ hold for the given intrinsics and the given pitch of the board.</strong> An error of the camera "
    sigma += "calibration, or of the pitch as a whole (100 ppm is 4 K on aluminium), is not in them,"
    if report["options"]["solve"] != "joint":
        sigma = "<strong>No σ were computed,</strong> because the solve was group by group; look at the chains. All "
        sigma += "holds for the given intrinsics: an error of the camera calibration goes into the faces,"
    words = f"<p>Group by group, {escape(_factor_in_words(summary['sigma_factor']))}."
    if summary["sigma0"] is not None:
        words += (
            " The joint adjustment multiplies the centres' σ by that factor and leaves "
            f"σ₀ = {number(summary['sigma0'], 2)}; near 1, groups and boards agree with one another. "
            "The σ of the faces include both factors."
        )
    single = [face for face, chains in report["chains"].items() if len(chains) == 1]
    alone = ""
    if single:
        alone = f"<p>Reached by one way only, so that no second way confirms them: face {escape(join(single))}.</p>\n"
    return (
        f"<p>{sigma} and residuals hardly show it.</p>\n{words}</p>\n"
        f"{table(['<Check', 'Value', '<Where', '<Remark'], _checks(report), css='text')}{alone}"
    )


def _checks(report: dict) -> list[list[str]]:
    """Rows of check, worst value, where, remark."""
    board = _worst((g["scale"]["board_rms_um"], f"group {g['name']}") for g in report["groups"])
    ppm = _worst((abs(g["scale"]["difference_ppm"]), f"group {g['name']}") for g in report["groups"])
    flat = _worst((face["plane_rms_um"], f"face {name}") for name, face in report["faces"].items())
    single = _worst((row["max_px"], f"{row['image']}, {row['worst']}") for row in report["residuals_by_image"])
    over = f"{number(1e-3 * ppm[0] * _size_mm(report), 1)} µm over the target's diagonal" if ppm else ""
    parts = "each way uses a part of the images only, so it scatters more than the result"
    return [
        [name, number(found and found[0], digits), found[1] if found else NONE, remark if found else "not computed"]
        for name, found, digits, remark in (
            ("σ of a face's position (µm)", _largest_sigma(report, "translation_sigma_um"), 1, "largest of X, Y, Z"),
            ("σ of a face's rotation (mdeg)", _largest_sigma(report, "rotation_sigma_mdeg"), 2, "largest of X, Y, Z"),
            ("Disagreement of chains, position (µm)", _worst_chain(report, "translation_um"), 1, parts),
            ("Disagreement of chains, rotation (mdeg)", _worst_chain(report, "rotation_mdeg"), 2, "likewise"),
            ("Circles off their plane, RMS (µm)", flat, 1, "a face that is not flat, or noise"),
            ("Board residual, RMS (µm)", board, 1, "the group's model against the board's grid"),
            ("λ by rows against least squares (ppm)", ppm, 1, over),
            ("Residual (px)", single, 4, "one centre in one image"),
        )
    ]


# --- faces ------------------------------------------------------------------------------------------------------------


def _faces(report: dict) -> str:
    columns = ["<Face", *("X", "Y", "Z") * 3, "found", "of design", "Plane RMS (µm)", "Images", "<Groups"]
    heads = [
        ("", 1),
        ("Position (mm)", 3),
        ("σ of position (µm)", 3),
        ("σ of rotation about (mdeg)", 3),
        ("Circles", 2),
    ]
    rows, axes = [], []
    for name, face in report["faces"].items():
        datum = name == report["reference_face"]
        sigma = [number(v, 1) for v in face["translation_sigma_um"] or [None] * 3]
        sigma += [number(v, 2) for v in face["rotation_sigma_mdeg"] or [None] * 3]
        rows.append(
            [
                f"{name} (datum)" if datum else name,
                *[number(v, 4) for v in face["translation_mm"]],
                *(["0"] * 6 if datum and face["translation_sigma_um"] else sigma),
                face["circles"],
                face["circles_of_design"],
                number(face["plane_rms_um"], 1),
                face["images"],
                join(face["groups"]),
            ]
        )
        matrix = face["target_from_face"]
        axes.append([name, *[number(matrix[i][j], 7) for j in range(3) for i in range(3)]])
        axes[-1].append(number(face["angle_to_reference_deg"], 4))
    spans = [("", 1), ("X axis of the face", 3), ("Y axis of the face", 3), ("Z axis: outward normal", 3), ("", 1)]
    between = [
        [f"{row['a']} – {row['b']}", *cells(row, "distance_mm:4 distance_sigma_um:1 angle_deg:4")]
        for row in report["between_faces"]
    ]
    return (
        f"<p>Pose of each face in the target frame, which is the frame of face {escape(report['reference_face'])}: "
        "the position is that of the face's origin circle, σ are one standard deviation.</p>\n"
        f"{table(columns, rows, [*heads, ('', 3)])}"
        "<h3>Rotation</h3>\n<p>The axes of each face in the target frame: the columns of its rotation matrix.</p>\n"
        f"{table(['<Face', *('x', 'y', 'z') * 3, 'Angle to datum (°)'], axes, spans)}"
        '<div class="columns"><div><h3>Between faces</h3>\n<p>Distance of the origins, angle of the normals.</p>\n'
        f"{table(['<Faces', 'Distance (mm)', 'σ (µm)', 'Angle (°)'], between)}</div>"
        f"<div><h3>Chains</h3>\n{_chains(report)}</div></div>\n"
    )


def _chains(report: dict) -> str:
    rows = [
        [face, " → ".join(way["faces"]), " → ".join(way["groups"]), *cells(way, "translation_um:1 rotation_mdeg:2")]
        for face, chains in report["chains"].items()
        for way in chains
    ]
    columns = ["<Face", "<Way", "<By groups", "Position off (µm)", "Rotation off (mdeg)"]
    text = "<p>Ways to each face through single groups, and how far each is off the combined pose.</p>\n"
    return text + (table(columns, rows) if rows else "<p>No face but the datum.</p>\n")


# --- scale and picture in space ---------------------------------------------------------------------------------------


def _scale(report: dict) -> str:
    scales = {group["name"]: group["scale"] for group in report["groups"]}
    vectors = [vector for scale in scales.values() for vector in scale["board_residuals_um"].values()]
    reach = max((math.hypot(*vector[:2]) for vector in vectors), default=0.0)
    height = max((abs(vector[2]) for vector in vectors), default=0.0)
    rows = [
        [
            name,
            *cells(scale, "mm_per_unit:6 mm_per_unit_rows:6"),
            " and ".join(str(row) for row in scale["rows"]),
            *cells(scale, "difference_ppm:1 sigma_ppm:1 dots board_mean_um:1 board_rms_um:1"),
            number(max((math.hypot(*v) for v in scale["board_residuals_um"].values()), default=None), 1),
        ]
        for name, scale in scales.items()
    ]
    columns = ["<Group", "λ, least squares (mm/unit)", "λ, by rows (mm/unit)", "Rows", "Difference (ppm)", "σ (ppm)"]
    columns += ["Dots", "Residual, mean (µm)", "Residual, RMS (µm)", "Residual, max (µm)"]
    plots = "".join(
        plot(
            figures.board_residuals(scale["board_residuals_um"], reach, height),
            f"Residual vectors of the board, group {name}",
            f"Group {escape(name)}: RMS {number(scale['board_rms_um'], 1)} µm",
        )
        for name, scale in scales.items()
    )
    return (
        "<p>λ turns a group's model into mm, by least squares over all dots of the board, and by rows as "
        "published (first and last row, all pairs). σ is that of λ from the board's stated σ.</p>\n"
        f"{table(columns, rows)}<h3>Board residuals</h3>\n<p>Reconstructed minus design, in the board's frame, on the "
        "board's grid; one scale for all groups. Arrows show x and y, colour shows z.</p>\n"
        f'<div class="plots">{plots}</div>\n'
    )


def _space(report: dict, colours: dict[str, str]) -> str:
    scene, faces = report["scene"], report["faces"]
    texts = ("Cameras, boards and target (black)", "Circles of the target, frames of its faces")
    plots = "".join(
        plot(figures.scene_view(scene, report["camera"], colours, azimuth), f"{texts[0]}{side}", f"{texts[0]}{side}")
        + plot(figures.target_view(scene["circles"], faces, azimuth), f"{texts[1]}{side}", f"{texts[1]}{side}")
        for azimuth, side in ((-58, ""), (122, ", from the other side"))
    )
    return (
        "<p>All in the target frame. Axes of the face frames: x red, y green, z blue; the name of a face stands at the "
        f'end of its normal.</p>\n{legend(colours)}<div class="plots">{plots}</div>\n'
    )


# --- residuals --------------------------------------------------------------------------------------------------------


def _residuals(report: dict, colours: dict[str, str]) -> str:
    images, labels = report["residuals_by_image"], report["residuals_by_label"]
    rows = [
        [
            i,
            row["image"],
            Html(swatch(row["group"], colours.get(row["group"], ""))),
            *cells(row, "observations rms_px:4 max_px:4 worst"),
        ]
        for i, row in enumerate(images, 1)
    ]
    columns = ["No.", "<Image", "<Group", "Centres", "RMS (px)", "Max (px)", "<Worst label"]
    by_face: dict[tuple[bool, str], list] = {}
    for row in labels:
        plane = parse_label(row["label"]).plane
        key = (True, f"Board, group {row['group']}") if plane == BOARD else (False, f"Face {plane}")
        by_face.setdefault(key, []).append(row)
    board = "".join(_labels(key, own) for (on_board, key), own in by_face.items() if on_board)
    target = "".join(_labels(key, own) for (on_board, key), own in by_face.items() if not on_board)
    worst = max(labels, key=lambda row: row["rms_px"], default=None)
    text = "RMS is per axis, max is the length of the largest vector."
    if worst:
        where = f" of group {worst['group']}" if worst["group"] else ""
        text += f" The worst label is {worst['label']}{where} with {number(worst['rms_px'], 4)} px RMS."
    chart = plot(
        figures.image_bars(images, colours), "Residuals by image", "Bars: RMS of the image; ticks: its largest", "wide"
    )
    listing = table(columns, rows)
    if len(rows) > FIRST_IMAGES:
        listing = fold(f"All {len(rows)} images", listing)
    return (
        f"<p>{escape(text)}</p>\n<h3>By image</h3>\n{legend(colours)}{chart}{listing}"
        f'<h3>By label</h3>\n<div class="columns small">{target}</div>\n'
        + fold("Dots of the board, by group", f'<div class="columns small">{board}</div>')
    )


def _labels(title: str, rows: list[dict]) -> str:
    lines = [cells(row, "label observations rms_px:4 max_px:4") for row in rows]
    return f"<div><h4>{escape(title)}</h4>{table(['<Label', 'Images', 'RMS (px)', 'Max (px)'], lines)}</div>\n"


# --- pairs, left out, overlays ----------------------------------------------------------------------------------------


def _pairs(report: dict) -> str:
    groups = [
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
    limit = number(report["options"]["max_pair_angle_deg"], 1)
    head = ["<Group", "Images mapped", "<Faces", "Points", "<Chosen pair", "Angle (°)", "<Started from", "Rounds"]
    parts = [
        "<p>Each group starts from the pair of images with the largest median ray angle that is still safe "
        f"({limit}° at most). In front is the share of points before both cameras, forward that of the motion along "
        f"the optical axis.</p>\n{table(head, groups)}"
    ]
    columns = ["<First", "<Second", "Labels shared", "Median angle (°)", "In front", "Forward", "<Verdict"]
    for group in report["groups"]:
        rows = [
            cells(pair, "first second shared median_angle_deg:2 in_front:2 forward:2 verdict")
            for pair in group["pairs"]
        ]
        content = table(columns, rows[:FIRST_PAIRS])
        if len(rows) > FIRST_PAIRS:
            content += fold(f"{len(rows) - FIRST_PAIRS} more pairs", table(columns, rows[FIRST_PAIRS:]))
        parts.append(fold(f"Group {group['name']}: {len(rows)} pairs", content))
    return "".join(parts)


def _left_out(report: dict) -> str:
    left, missing = report["left_out"], report["summary"]["faces_not_seen"]
    circles: dict[tuple[str, str], list[str]] = {}
    for each in left["circles"]:
        circles.setdefault((each["image"], each["reason"]), []).append(each["label"])
    several = [[image, len(labels), join(labels), reason] for (image, reason), labels in circles.items()]
    parts = []
    for title, columns, rows in (
        ("Files", ["<File", "<Reason"], [cells(each, "name reason") for each in left["files"]]),
        ("Images", ["<Image", "<Reason"], [cells(each, "name reason") for each in left["images"]]),
        ("Circles", ["<Image", "Number", "<Circles", "<Reason"], several),
        ("Notes on images", ["<Image", "<Note"], [cells(each, "image note") for each in left["notes"]]),
        ("Notes on the whole run", ["<No.", "<Note"], [[i, note] for i, note in enumerate(report["notes"], 1)]),
    ):
        if rows:
            parts.append(f"<h3>{title}</h3>\n{table(columns, rows, css='text')}")
    if missing:
        parts.append(f"<p>Faces of the design not seen: {escape(join(missing))}.</p>\n")
    return "".join(parts) or "<p>Nothing was left out.</p>\n"


def shown_overlays(report: dict) -> list[str]:
    """Names of the images whose overlays the page shows: all, or of a large set those that most deserve a look."""
    names = [image["name"] for image in report["images"]]
    if len(names) <= FIRST_IMAGES:
        return names
    worst = {row["image"]: row["max_px"] for row in report["residuals_by_image"]}
    told = {each["image"] for each in report["left_out"]["notes"]}
    ranked = sorted(names, key=lambda name: (name in worst, name not in told, -worst.get(name, 0.0)))
    chosen = set(ranked[:FIRST_IMAGES])
    return [name for name in names if name in chosen]


def _overlays(report: dict, overlays: dict[str, bytes]) -> str:
    mapped = {row["image"]: row for row in report["residuals_by_image"]}
    names = list(overlays)
    frames = []
    for i, name in enumerate(names):
        own = mapped.get(name)
        says = f"{own['observations']} centres, {number(own['rms_px'], 4)} px RMS" if own else "not mapped"
        text = f"<b>{escape(name)}</b> {says}"
        uri = "data:image/jpeg;base64," + base64.b64encode(overlays[name]).decode()
        back, on = (i - 1) % len(names), (i + 1) % len(names)
        frames.append(
            f'<div class="cell" id="cell-{i}"><figure class="photo" id="photo-{i}"><a class="open" href="#photo-{i}">'
            f'<img src="{uri}" alt="Overlay of {escape(name)}"></a><figcaption>{text}'
            f'<span class="steps"><a href="#photo-{back}">previous</a> <a href="#photo-{on}">next</a> '
            f'<a href="#cell-{i}">close</a></span></figcaption></figure></div>\n'
        )
    if not frames:
        return "<p>There are none.</p>\n"
    rest = len(report["images"]) - len(names)
    more = f" Images left out, with notes or with large residuals; the other {rest} are in overlays/." if rest else ""
    return (
        f'<p>Circles found and their labels; click to enlarge.{more}</p>\n<div class="grid">{"".join(frames)}</div>\n'
    )
