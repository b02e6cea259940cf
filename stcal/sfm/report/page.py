"""The page of a run."""

import math
from collections.abc import Callable, Mapping

from stcal.labels import BOARD, parse_label
from stcal.parallel import run_briefly
from stcal.report.page import render, swatch, verdict
from stcal.report.text import NONE, cells, join, number
from stcal.sfm.report import figures
from stcal.sfm.report.compare import comparison_cells
from stcal.sfm.report.figures import FIRST_IMAGES, Residuals, photographs, space_parts
from stcal.sfm.report.judgement import CHANCE, Judgement, judgement_of, without_sigma

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


def crosscheck_values(check: dict) -> dict:
    """Returns the section ``crosscheck`` of ``report.json`` as the template shows it."""
    limits = check["tolerances"]
    allowed = [f"{limits[key]:g} {unit} {object_name}" for key, unit, object_name in LIMITS if limits[key] is not None]
    faces: dict[str, list[tuple[float, str]]] = {}
    for label, value in check["mapping"]["circles_um"].items():
        faces.setdefault(parse_label(label).plane, []).append((value, label))
    sigmas = check["mapping"]["circles_sigmas"]
    programs = {
        "native": f"COLMAP {check['native']}",
        "pycolmap": f"pycolmap {check['pycolmap']}",
        "run": "this result",
    }
    return {
        "allowed": allowed,
        "models": [
            [name, check["images"][key], number(check["residual_rms_px"][key], 4)] for key, name in programs.items()
        ],
        "faces": [_face_row(check, face) for face in check["mapping"]["faces"]],
        "circles": [
            [face, len(rows), number(sum(v for v, _ in rows) / len(rows), 3), number(max(rows)[0], 3), max(rows)[1]]
            for face, rows in sorted(faces.items())
        ],
        "single": [
            [label, number(value, 3), number(sigmas.get(label), 2)]
            for label, value in check["mapping"]["circles_um"].items()
        ],
        "worst_camera": max(check["mapping"]["cameras"], key=lambda row: row["sigmas"], default=None),
    }


def _face_row(check: dict, face: str) -> list[str]:
    """Returns the row of a face: position, rotation and σ of each comparison."""
    row = [face]
    for key in COMPARISONS:
        entry = check[key]["faces"].get(face)
        row += [*cells(entry, "translation_um:3 rotation_mdeg:3"), number(entry["sigmas"], 2)] if entry else [NONE] * 3
    return row


COLOURS = {"passed": "#1b7837", "suspicious": "#b26a00", "failed": "#b3261e", "not possible": "#556270"}
ORDER = ("failed", "suspicious", "passed", "not possible")
FIRST_NAMES = 6
"""Number of names that a row has room for."""


def count_verdicts(verdicts: list[str]) -> str:
    """Returns the number of checks with each verdict as ``2 failed, 13 passed``, the worst first."""
    return ", ".join(f"{verdicts.count(v)} {v}" for v in ORDER if v in verdicts) or "none"


def checks_values(checks: list[dict]) -> dict:
    """Returns the section ``checks`` of ``report.json`` as the template shows it."""
    ranked = sorted(checks, key=lambda check: ORDER.index(check["verdict"]))
    rows = [
        [
            check["title"],
            verdict(check["verdict"], COLOURS[check["verdict"]]),
            *(_number(check["measured"][0]) if check["measured"] else [NONE, NONE]),
            _names(check),
            check["reason"],
            check["remedy"],
        ]
        for check in ranked
    ]
    measured = [
        [check["title"], m["name"], *_number(m), NONE if m["probability"] is None else f"{m['probability']:.1g}"]
        for check in ranked
        for m in check["measured"]
    ]
    verdicts = count_verdicts([check["verdict"] for check in checks])
    return {"verdicts": verdicts, "check_rows": rows, "measured": measured, "chance": CHANCE}


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


SIDES = {-58: "", 122: ", from the other side"}
"""Azimuths from which target and cameras are drawn."""
FIRST_PAIRS = 15
"""Number of rows that the page has room for."""
SOLVES = {
    "joint": "joint: one adjustment over all groups",
    "chain": "chain: group by group, then combined",
    "paper": "paper: as published by Zhang & Wei (2017), for comparison",
}
SCALES = {"board": "the board", "faces": "printed size of the faces", "distances": "known distances"}
VERDICTS = {"yes": "passed", "with care": "suspicious", "no": "failed"}
"""Verdict of a check that has the colour of each judgement."""
FRAMES = {"plane": "plane: Z from the plane of all circles", "three-point": "three-point: from three circles"}


def report_html(
    report: dict,
    overlays: dict[str, bytes],
    residuals: Mapping[str, Residuals] | None = None,
    reload_s: int | None = None,
    gone: int = 0,
) -> str:
    """Returns the page.

    Parameters
    ----------
    report : result of :func:`stcal.sfm.runs.output.report_of`
    overlays : JPEG by image name
    residuals : centres and their residuals by image name, px; none are drawn if None
    reload_s : seconds after which the page reloads itself; never if None
    gone : number of overlays that are no longer in the run's folder
    """
    judgement = Judgement.model_validate(report.get("judgement") or judgement_of(report).model_dump())
    if judgement.verdict == "no":
        report = without_sigma(report)
    colours = figures.group_colours([group["name"] for group in report["groups"]])
    boards, views, bars = _drawn(report, colours)
    return render(
        "sfm/report/page.html.jinja",
        report=report,
        reload_s=reload_s,
        colours=colours,
        factor=_factor_in_words(report["summary"]["sigma_factor"]),
        judgement=_judgement(judgement),
        headline=_headline(report),
        settings=_settings(report),
        worst_values=_worst_values(report),
        single_way=[face for face, chains in report["chains"].items() if len(chains) == 1],
        **_faces(report),
        scales=_scales(report),
        boards=boards,
        space=space_parts(report, colours),
        views=views,
        **_residuals(report, colours),
        bars=bars,
        first_images=FIRST_IMAGES,
        starts=_starts(report),
        first_pairs=FIRST_PAIRS,
        circles_left_out=_circles_left_out(report),
        notes=list(enumerate(report["notes"], 1)),
        **(checks_values(report["checks"]) if "checks" in report else {}),
        **({"compared": comparison_cells(report["comparison"])} if "comparison" in report else {}),
        **({"cross": crosscheck_values(report["crosscheck"])} if "crosscheck" in report else {}),
        photographs=photographs(report, overlays, residuals or {}),
        rest=len(report["images"]) - len(overlays) - gone,
        gone=gone,
    )


def _drawn(report: dict, colours: dict[str, str]) -> tuple[dict[str, str], list[tuple[str, str, str]], str]:
    """Returns the plots: the boards' residuals by group, views from two sides, and bars of the images.

    A view is (cameras, target, words for its side).
    """
    scene = report["scene"]
    boards, jobs = _boards(report), []
    jobs += [(figures.board_residuals, *board) for board in boards.values()]
    for azimuth in SIDES:
        jobs.append((figures.scene_view, scene, report["camera"], colours, azimuth))
        jobs.append((figures.target_view, scene["circles"], report["faces"], azimuth))
    drawn = run_briefly(_draw, [*jobs, (figures.image_bars, report["residuals_by_image"], colours)])
    n = len(boards)
    views = [(drawn[n + 2 * i], drawn[n + 2 * i + 1], side) for i, side in enumerate(SIDES.values())]
    return dict(zip(boards, drawn, strict=False)), views, drawn[-1]


def _draw(figure: Callable[..., str], *arguments) -> str:
    return figure(*arguments)


# --- result and trust -------------------------------------------------------------------------------------------------


def _size_mm(report: dict) -> float:
    """Returns the diagonal of the box around the target's circles."""
    circles = list(report["scene"]["circles"].values())
    return math.dist(*[[pick(axis) for axis in zip(*circles, strict=True)] for pick in (min, max)]) if circles else 0.0


def _factor_in_words(factor: float) -> str:
    if 0.95 <= factor <= 1.05:
        return "residuals are as large as the centres' own σ"
    return f"residuals are {factor:.1f} times the centres' own σ"


def _worst(found) -> tuple[float, str] | None:
    return max(found, key=lambda candidate: candidate[0], default=None)


def _largest_sigma(report: dict, key: str) -> tuple[float, str] | None:
    return _worst((max(face[key]), f"face {name}") for name, face in report["faces"].items() if face[key] is not None)


def _worst_chain(report: dict, key: str) -> tuple[float, str] | None:
    return _worst(
        (chain[key], f"face {face} by {' → '.join(chain['groups'])}")
        for face, chains in report["chains"].items()
        if len(chains) > 1
        for chain in chains
    )


def _judgement(judgement: Judgement) -> dict:
    """Returns colour and sentences."""
    return {
        "colour": COLOURS[VERDICTS[judgement.verdict]],
        "answers": judgement.answers(),
        "refused": judgement.verdict == "no",
    }


def _headline(report: dict) -> list[tuple[str, str, str]]:
    """Returns (value, unit, description) of the tiles."""
    summary = report["summary"]
    sigma = _largest_sigma(report, "translation_sigma_um")
    ppm = max((abs(group["scale"]["difference_ppm"]) for group in report["groups"]), default=None)
    return [
        (number(summary["residual_rms_px"], 4), "px", "residual, RMS per axis"),
        (number(summary["sigma0"], 2), "", "σ₀ of the joint adjustment"),
        (number(summary["sigma_factor"], 2), "×", _factor_in_words(summary["sigma_factor"])),
        (number(sigma and sigma[0], 1), "µm", "largest σ of a face's position"),
        (number(ppm, 1), "ppm", "largest difference of λ by rows"),
    ]


def _settings(report: dict) -> list[list[str]]:
    summary, options, camera = report["summary"], report["options"], report["camera"]
    left_out, last_move = report["left_out"], summary["last_move_px"]
    sizes = " × ".join(str(size) for size in camera["size_px"])
    solve, frame = str(options["solve"]), str(options["frame"])
    return [
        ["Solve", SOLVES.get(solve, solve)],
        ["Face frames", FRAMES.get(frame, frame)],
        ["Eccentricity", "corrected" if options["eccentricity"] else "off (uncorrected control)"],
        *([["Surface", f"luminous, behind rims of {rim:.3f} mm"]] if (rim := summary.get("rim_mm")) else []),
        ["Reference face", report["reference_face"]],
        ["Faces not seen", join(summary["faces_not_seen"]) if summary["faces_not_seen"] else "none"],
        ["Centres observed", f"{summary['observations']}, redundancy {summary['redundancy'] or NONE}"],
        ["Last step of the joint adjustment", NONE if last_move is None else f"{last_move:.1g} px"],
        [
            "Left out",
            f"{len(left_out['files'])} files, {len(left_out['images'])} images, {len(left_out['circles'])} circles",
        ],
        ["Scale", join([SCALES[source] for source in summary.get("scale_from", ["board"])])],
        [
            "Camera, as given" if summary.get("camera_given", True) else "Camera, found from the photographs",
            f"{camera['model']}, {sizes} px",
        ],
        ["Focal lengths (px)", ", ".join(number(v, 4) for v in camera["focal_px"])],
        ["Principal point (px)", ", ".join(number(v, 4) for v in camera["centre_px"]) + " (pixel centres integer)"],
        ["Distortion", ", ".join(f"{v:.8g}" for v in camera["distortion"])],
        ["Program", f"stcal {report['version']}"],
    ]


def _worst_values(report: dict) -> list[list[str]]:
    """Returns rows of check, worst value, its place, remark."""
    board = _worst((g["scale"]["board_rms_um"], f"group {g['name']}") for g in report["groups"])
    ppm = _worst((abs(g["scale"]["difference_ppm"]), f"group {g['name']}") for g in report["groups"])
    flat = _worst((face["plane_rms_um"], f"face {name}") for name, face in report["faces"].items())
    single = _worst((row["max_px"], f"{row['image']}, {row['worst']}") for row in report["residuals_by_image"])
    over = f"{number(1e-3 * ppm[0] * _size_mm(report), 1)} µm over the target's diagonal" if ppm else ""
    parts = "each way uses a part of the images only, so it scatters more than the result"
    return [
        [name, number(worst and worst[0], digits), worst[1] if worst else NONE, remark if worst else "not computed"]
        for name, worst, digits, remark in (
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


# --- faces and scale --------------------------------------------------------------------------------------------------


def _faces(report: dict) -> dict[str, list]:
    """Returns rows of the poses, of their axes, of distances between faces, and of the ways to each face."""
    poses, axes = [], []
    for name, face in report["faces"].items():
        datum = name == report["reference_face"]
        sigma = [number(v, 1) for v in face["translation_sigma_um"] or [None] * 3]
        sigma += [number(v, 2) for v in face["rotation_sigma_mdeg"] or [None] * 3]
        poses.append(
            [
                f"{name} (datum)" if datum else name,
                *[number(v, 4) for v in face["translation_mm"]],
                *(["0"] * 6 if datum and face["translation_sigma_um"] else sigma),
                *cells(face, "circles circles_of_design plane_rms_um:1 images"),
                join(face["groups"]),
            ]
        )
        matrix = face["target_from_face"]
        axes.append([name, *[number(matrix[i][j], 7) for j in range(3) for i in range(3)]])
        axes[-1].append(number(face["angle_to_reference_deg"], 4))
    between = [
        [f"{row['a']} – {row['b']}", *cells(row, "distance_mm:4 distance_sigma_um:1 angle_deg:4")]
        for row in report["between_faces"]
    ]
    ways = [
        [face, " → ".join(way["faces"]), " → ".join(way["groups"]), *cells(way, "translation_um:1 rotation_mdeg:2")]
        for face, chains in report["chains"].items()
        for way in chains
    ]
    return {"poses": poses, "axes": axes, "between": between, "ways": ways}


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


def _boards(report: dict) -> dict[str, tuple]:
    """Returns the input of the plots of the boards' residuals, by group."""
    residuals = {
        group["name"]: group["scale"]["board_residuals_um"]
        for group in report["groups"]
        if group["scale"].get("source", "board") == "board"
    }
    vectors = [vector for board_residuals in residuals.values() for vector in board_residuals.values()]
    reach = max((math.hypot(*vector[:2]) for vector in vectors), default=0.0)
    height = max((abs(vector[2]) for vector in vectors), default=0.0)
    return {name: (board_residuals, reach, height) for name, board_residuals in residuals.items()}


# --- residuals, pairs, left out ---------------------------------------------------------------------------------------


def _residuals(report: dict, colours: dict[str, str]) -> dict:
    """Returns the residuals: rows by image; by label, grouped face by face and board by board."""
    images, labels = report["residuals_by_image"], report["residuals_by_label"]
    target: dict[str, list] = {}
    board: dict[str, list] = {}
    for row in labels:
        plane = parse_label(row["label"]).plane
        if plane == BOARD:
            board.setdefault(f"Board, group {row['group']}", []).append(row)
        else:
            target.setdefault(f"Face {plane}", []).append(row)
    rows = [
        [
            i,
            row["image"],
            swatch(row["group"], colours.get(row["group"], "")),
            *cells(row, "observations rms_px:4 max_px:4 worst"),
        ]
        for i, row in enumerate(images, 1)
    ]
    return {
        "by_image": rows,
        "target_labels": target,
        "board_labels": board,
        "worst_label": max(labels, key=lambda row: row["rms_px"], default=None),
    }


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
