"""Reports of hand-eye calibrations, of one camera or of a rig, for the terminal and as a page."""

from itertools import combinations

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import FRAMES
from stcal.handeye.judge.observability import Observability
from stcal.handeye.judge.remarks import Aside
from stcal.handeye.report.figures import (
    BAD,
    GOOD,
    by_robot,
    corner_figure,
    image_coverage,
    image_figure,
    overlays,
    pose_bars,
    turns_between,
    turns_figure,
)
from stcal.handeye.report.outcome import ArmFound, Outcome, RigOutcome, Verdict, asides, judged, rig_judged
from stcal.handeye.result import HandEye
from stcal.handeye.solve import FACTORS
from stcal.handeye.validate import Compared
from stcal.io.cameras.model import PARAMETER_NAMES, parameter_names
from stcal.report.figure import uri
from stcal.report.page import render, verdict
from stcal.report.text import HEADS, NONE, number, text_table, transform_rows

ERRORS = {
    "rotation_rad": ("rotation °", np.degrees(1.0), 4),
    "translation_mm": ("board's origin mm", 1.0, 3),
    "board_mm": ("3-D at the board mm", 1.0, 3),
    "pose_mm": ("3-D by pose mm", 1.0, 3),
}
"""Heads, unit factors and digits of the errors on held-out poses."""
SIGMA_NAMES = {
    "corner_px": ("corner in the image", "px", 1.0),
    "robot_rad": ("robot, rotation", "°", np.degrees(1.0)),
    "robot_mm": ("robot, position", "mm", 1.0),
    "camera_rad": ("board's pose, rotation", "°", np.degrees(1.0)),
    "camera_mm": ("board's pose, position", "mm", 1.0),
    "camera_factor": ("board's pose", "times its own σ", 1.0),
    "board_mm": ("corner on the board", "mm", 1.0),
    "arm_rad": ("axis of the arm, direction", "°", np.degrees(1.0)),
    "arm_mm": ("axis of the arm, place", "mm", 1.0),
    **{key: (f"camera file, {name}", "times its σ", 1.0) for key, name in FACTORS.items()},
}
VERDICTS = {"good": "#1b7837", "use with care": "#b26a00", "do not use": "#b3261e"}
"""Colours of the verdicts."""


def outcome_text(outcome: Outcome) -> str:
    """Returns the report for the terminal."""
    result, frames = outcome.result, FRAMES[outcome.result.setup]
    lines = [_headline(outcome), f"verdict: {judged(outcome).sentence()}"]
    for name, pose, covariance in _transforms(result):
        lines += ["", *text_table([["<" + name, *HEADS[1:]], *transform_rows(pose, covariance)])]
    turn, shift = result.rms()
    if outcome.time_offset is not None:
        lines += ["", outcome.time_offset.in_words()]
    lines += ["", f"residuals (RMS): {np.degrees(turn):.4f}°, {shift:.3f} mm at the board's origin"]
    if outcome.held_out is not None:
        lines.append(f"held out ({_splits_text(outcome)}): {means_text(outcome.held_out.means())}")
        lines += [f"held out, {text}" for text in _agreeing_text(outcome)]
    if outcome.motions is not None:
        lines += ["", _motions_text(outcome), *text_table(_motion_cells(outcome)), ""]
    lines += [f"σ of {text}: {value} ({how})" for text, value, how in sigma_rows(outcome)]
    if result.sigma_scale is not None:
        lines.append(scale_text(outcome, result.sigma_scale))
    if result.observability is not None:
        lines.append(turns_text(result.observability))
    if outcome.choice is not None:
        lines += ["", *text_table(_choice_cells(outcome))]
    if outcome.arm is not None:
        lines += ["", *text_table(_arm_cells(outcome.arm))]
    if outcome.sentence():
        lines += ["", outcome.sentence()]
    if outcome.compared:
        lines += ["", f"Methods, on the same {_splits_text(outcome)} held out; off: from {frames.camera} above"]
        lines += text_table(_compared_cells(outcome))
    return "\n".join(lines)


def _motions_text(outcome: Outcome) -> str:
    motions = outcome.motions
    return f"motions predicted by those before (Jin et al., eqs. 24–26): fitted to {motions.fitted}" if motions else ""


def _motion_cells(outcome: Outcome) -> list[list[str]]:
    """Returns heads, one row per held-out motion, and the means."""
    motions = outcome.motions
    if motions is None:
        return []
    rows = [
        [f"{first} → {second}", number(shift, 3), number(np.degrees(turn), 4)]
        for (first, second), shift, turn in zip(
            motions.names, motions.translation_mm, motions.rotation_rad, strict=True
        )
    ]
    means = ["mean", number(motions.translation_mm.mean(), 3), number(np.degrees(motions.rotation_rad.mean()), 4)]
    return [["<motion held out", "mm", "°"], *rows, means]


def scale_text(outcome: Outcome, sigma_scale: float) -> str:
    """Returns the estimated size of the board and its σ, in words."""
    result = outcome.result
    if outcome.unit_mm is not None:
        unit, sigma = outcome.unit_mm * result.scale, outcome.unit_mm * sigma_scale
        return f"model: its unit is {unit:.6g} ± {sigma:.2g} mm"
    text = f"board: {result.scale:.5f} ± {sigma_scale:.5f} times its stated size"
    if outcome.pitch_mm is None:
        return text
    pitch, sigma = outcome.pitch_mm * result.scale, outcome.pitch_mm * sigma_scale
    return f"{text}: pitch {pitch:.4f} ± {sigma:.4f} mm, stated {outcome.pitch_mm:g} mm"


def _headline(outcome: Outcome) -> str:
    result, bad = outcome.result, outcome.outliers()
    without = f", without {len(bad)} that contradict{'s' * (len(bad) == 1)} them: {', '.join(bad)}" if bad else ""
    return f"{result.setup}, {result.method}: {len(result.names) - len(bad)} poses{without}"


def _transforms(result: HandEye) -> list[tuple[str, Rigid, np.ndarray | None]]:
    covariances = (result.covariance, result.stand_covariance)
    return [(*item, covariance) for item, covariance in zip(result.transforms.items(), covariances, strict=True)]


def _splits_text(outcome: Outcome) -> str:
    every = (outcome.held_out, *(each.held_out for each in outcome.compared))
    known = [found.rows.shape for found in every if found is not None]
    return f"{known[0][0]} × {known[0][1]} of {len(outcome.result.names)} poses" if known else "no poses"


def _agreeing_text(outcome: Outcome) -> list[str]:
    """Returns the errors without outliers in words, or nothing if there are no outliers."""
    bad = outcome.result.outliers
    means = outcome.held_out.means(~bad) if bad.any() and outcome.held_out is not None else {}
    return [f"without the {bad.sum()} left out above: {means_text(means)}"] if means else []


def means_text(means: dict[str, float]) -> str:
    parts = []
    for name, mean in means.items():
        head, unit, digits = ERRORS[name]
        quantity, _, ending = head.rpartition(" ")
        parts.append(f"{quantity} {number(mean * unit, digits)}{ending if ending == '°' else f' {ending}'}")
    return ", ".join(parts)


def sigma_rows(outcome: Outcome) -> list[list[str]]:
    """Returns one row per σ: the quantity, its σ with unit, and whether it was estimated or stated."""
    rows = []
    for name, value in outcome.result.sigma.items():
        text, unit, factor = SIGMA_NAMES[name]
        if name == "corner_px" and outcome.own_sigmas:
            unit = "times its own σ"
        how = "estimated" if name in outcome.result.estimated else "stated"
        rows.append([text, f"{value * factor:.3g}{unit if unit == '°' else f' {unit}'}", how])
    return rows


def turns_text(seen: Observability) -> str:
    turns = ", ".join(f"{t:.1f}°" for t in np.degrees(seen.turns_rad))
    return f"the flange turns between poses by {turns} (RMS) about its principal axes"


def _compared_cells(outcome: Outcome) -> list[list[str]]:
    """Returns heads, and one row per method: mean errors on held-out poses, and distance from the result."""
    kinds = [name for name in ERRORS if any(c.held_out and name in c.held_out.means() for c in outcome.compared)]
    rows = []
    for each in outcome.compared:
        means = each.held_out.means() if each.held_out else {}
        cells = [number(means.get(n, np.nan) * ERRORS[n][1], ERRORS[n][2]) for n in kinds]
        rows.append([each.method, *cells, *_off(each, outcome.result), each.reason])
    rows.insert(0, ["<method", *(ERRORS[name][0] for name in kinds), "off mm", "off °", "<"])
    return rows if any(row[-1] for row in rows[1:]) else [row[:-1] for row in rows]


def _arm_cells(arm: ArmFound) -> list[list[str]]:
    """Returns heads, and one row per axis: its deviation from the robot's file, and σ."""
    cells_of_axis: dict[str, list[str]] = {}
    for name, value, sigma in zip(arm.names, arm.parameters, arm.sigma, strict=True):
        axis, component = name.split()
        unit, factor, digits = ("°", np.degrees(1.0), 4) if component.startswith("r") else ("mm", 1.0, 3)
        text = f"{component} {number(value * factor, digits)} ± {number(sigma * factor, digits)} {unit}"
        cells_of_axis.setdefault(axis, []).append(text)
    width = max(len(cells) for cells in cells_of_axis.values())
    rows = [[axis, *cells, *[""] * (width - len(cells))] for axis, cells in cells_of_axis.items()]
    return [[f"<axis of {arm.robot}", "off its file", *[""] * (width - 1)], *rows]


def _choice_cells(outcome: Outcome) -> list[list[str]]:
    """Returns heads, and one row per way of solving that was tried."""
    choice = outcome.choice
    if choice is None:
        return []
    rows = [["<solved by", "held out mm", "splits", "<"]]
    for each in choice.tried:
        outcome_of_way = "taken" if each.candidate == choice.chosen else each.reason
        rows.append([each.candidate.name, number(each.mean_mm(), 3), str(len(each.error_mm)), outcome_of_way])
    return rows


def _off(each: Compared, result: HandEye) -> list[str]:
    if each.result is None:
        return [NONE, NONE]
    off = result.mount_from_camera.inverse() @ each.result.mount_from_camera
    return [number(float(np.linalg.norm(off.translation)), 3), number(np.degrees(off.angle_rad()), 4)]


def outcome_page(outcome: Outcome) -> str:
    """Returns the report as a page."""
    result = outcome.result
    compared = _compared_cells(outcome)
    observability = result.observability
    return render(
        "handeye/report/page.html.jinja",
        outcome=outcome,
        camera=FRAMES[result.setup].camera,
        counts=_headline(outcome),
        headline=_tiles(outcome),
        agreeing=_agreeing_text(outcome) if outcome.held_out is not None else [],
        notes=[note for note in outcome.all_notes() if isinstance(note, Aside)],
        heads=HEADS,
        transforms=[
            (name, transform_rows(pose, covariance), matrix_text(pose))
            for name, pose, covariance in _transforms(result)
        ],
        sigmas=sigma_rows(outcome),
        adjusted=adjusted(outcome),
        compared=compared,
        splits=_splits_text(outcome),
        choice=_choice_cells(outcome),
        arm=_arm_cells(outcome.arm) if outcome.arm else [],
        sentence=outcome.sentence(),
        predicted=_motion_cells(outcome),
        predicted_text=_motions_text(outcome),
        board_seen=ERRORS["board_mm"][0] in compared[0],
        good=GOOD,
        bad=BAD,
        bars=pose_bars(result),
        poses=pose_rows(result),
        **verdict_parts(judged(outcome)),
        **coverage(outcome),
        motions=observability and _motion_rows(observability),
        sigma_deg=observability and np.degrees(observability.sigma_rad),
    )


def verdict_parts(found: Verdict) -> dict:
    """Returns the verdict's word and colour, its reasons with remedies, and rows of all findings, for the template."""
    rows = [
        [
            finding.title,
            verdict(finding.word, VERDICTS[finding.word]),
            finding.value or NONE,
            finding.limit or NONE,
            finding.said,
        ]
        for finding in found.findings
    ]
    reasons = [": ".join(filter(None, (finding.said, finding.remedy))) for finding in found.reasons()]
    return {"word": found.word, "verdict_colour": VERDICTS[found.word], "reasons": reasons, "findings": rows}


def coverage(outcome: Outcome) -> dict:
    """Returns figures of image coverage, corners and turns, and overlays; None or empty if there is nothing to show."""
    shown, missing = overlays(outcome)
    content: dict = {"image": None, "corners": None, "turns": None, "overlays": shown, "missing": missing}
    views, pairs, board = outcome.views, outcome.pairs, outcome.result.reprojection
    if board is not None:
        content["corners"] = uri(corner_figure(board))
    if pairs is not None:
        content["turns"] = uri(turns_figure(turns_between(pairs), outcome.result.observability))
    if views is None or pairs is None:
        return content
    if board is None:
        measured = np.concatenate([view.xy_px for view in views.views])
        residuals = np.concatenate(by_robot(outcome.result, pairs, views)) - measured
    else:
        used = [views.views[i].xy_px for i in np.unique(board.view)]
        measured, residuals = np.concatenate(used), board.residuals_px
    finite = np.isfinite(residuals).all(1)
    covered = image_coverage(views)
    size = views.camera.width, views.camera.height
    figure, factor = image_figure(size, covered, measured[finite], residuals[finite])
    source = "the adjustment" if board is not None else "robot and transforms"
    content["image"] = uri(figure), f"{covered.share:.0%}", f"{factor:g}", source
    return content


def matrix_text(pose: Rigid) -> str:
    return "\n".join(" ".join(f"{v:14.9f}" for v in row) for row in pose.matrix())


def _tiles(outcome: Outcome) -> list[tuple[str, str, str]]:
    """Returns the tiles of the headline: (value, unit, text)."""
    result, tiles = outcome.result, []
    if outcome.held_out is not None:
        means = outcome.held_out.means()
        name = "board_mm" if "board_mm" in means else "translation_mm"
        where = "3-D error at the board" if name == "board_mm" else "error of the board's origin"
        tiles.append((f"{means[name]:.3f} mm", "", f"{where}, on poses held out ({_splits_text(outcome)})"))
        turn = np.degrees(means["rotation_rad"])
        tiles.append((f"{turn:.3f}°", "", "error of rotation, on poses held out"))
    if result.covariance is not None:
        sigma = np.sqrt(np.linalg.eigvalsh(result.covariance[3:, 3:])[-1])
        tiles.append((f"{sigma:.3f} mm", "", "σ of the camera's place, in its worst direction"))
    turn, shift = result.rms()
    tiles.append((f"{shift:.3f} mm", "", f"RMS residual at the board's origin, and {np.degrees(turn):.3f}°"))
    if (offset := outcome.time_offset) is not None:
        said = f"robot's clock minus camera's, ± {1e3 * offset.sigma_s:.2g} ms"
        tiles.append((f"{1e3 * offset.seconds:.2f} ms", "", said))
    if result.sigma_scale is not None:
        pitch = "" if outcome.pitch_mm is None else f": pitch {outcome.pitch_mm * result.scale:.3f} mm"
        tiles.append(
            (f"{result.scale:.4f}", "", f"times its stated size is the board, ± {result.sigma_scale:.4f}{pitch}")
        )
    return tiles


def adjusted(outcome: Outcome) -> list[list[str]] | None:
    """Returns rows of the camera's parameters, or None if they were not adjusted."""
    adjustment = outcome.result.reprojection
    if adjustment is None or adjustment.camera_covariance is None:
        return None
    sigma = dict(
        zip(parameter_names(outcome.colmap_model), np.sqrt(np.diag(adjustment.camera_covariance)), strict=True)
    )
    rows = []
    for name, value in zip(PARAMETER_NAMES, adjustment.camera.parameters(), strict=True):
        sigma_of_parameter = sigma.get(name, sigma.get("f") if name in ("fx", "fy") else None)
        if value or sigma_of_parameter:
            digits, unit = (3, "px") if name[0] in "fc" else (6, "")
            rows.append([name, number(value, digits), number(sigma_of_parameter, digits), unit])
    return rows


def pose_rows(result: HandEye) -> list[list[str]]:
    turn, shift = (np.linalg.norm(part, axis=1) for part in (result.residuals[:, :3], result.residuals[:, 3:]))
    rows = []
    for i, name in enumerate(result.names):
        row = [name, number(np.degrees(turn[i]), 4), number(shift[i], 3)]
        row += [number(v, 3) for v in result.residuals[i, 3:]]
        if result.reprojection is not None:
            row.append(number(result.reprojection.rms_px(i), 3))
        rows.append([*row, "left out" if result.outliers[i] else ""])
    return rows


def _motion_rows(seen: Observability) -> list[list[str]]:
    return [
        [str(i + 1), *(number(v, 3) for v in axis), number(np.degrees(turn), 2)]
        for i, (axis, turn) in enumerate(zip(seen.axes, seen.turns_rad, strict=True))
    ]


def rig_text(outcome: RigOutcome) -> str:
    """Returns the report for the terminal."""
    rig, frames = outcome.rig, FRAMES[outcome.rig.setup]
    lines = [_rig_headline(outcome), f"verdict: {rig_judged(outcome).sentence()}"]
    for name, camera in zip(rig.names, rig.cameras, strict=True):
        rows = transform_rows(camera.mount_from_camera, camera.covariance)
        lines += ["", *text_table([[f"<{frames.mount}_from_{name}", *HEADS[1:]], *rows])]
    for first, second in combinations(rig.names, 2):
        lines += [
            "",
            *text_table([[f"<{first}_from_{second}", *HEADS[1:]], *transform_rows(*rig.relative(first, second))]),
        ]
    rows = transform_rows(rig.stand_from_board, rig.cameras[0].stand_covariance)
    lines += ["", *text_table([["<" + frames.board, *HEADS[1:]], *rows])]
    lines += ["", *text_table(_camera_cells(outcome))]
    if outcome.held_out is not None:
        lines += [
            "",
            f"Poses of the robot held out ({_rig_splits_text(outcome)}), 3-D at the board, all cameras or each alone",
        ]
        lines += text_table(_held_out_cells(outcome))
    lines += ["", *(f"σ of {text}: {value} ({how})" for text, value, how in _shared_sigmas(outcome))]
    first_camera = rig.cameras[0]
    if first_camera.sigma_scale is not None:
        lines.append(scale_text(outcome.cameras[0], first_camera.sigma_scale))
    if first_camera.observability is not None:
        lines.append(turns_text(first_camera.observability))
    return "\n".join(lines)


def _rig_headline(outcome: RigOutcome) -> str:
    rig = outcome.rig
    images = sum(int((~camera.outliers).sum()) for camera in rig.cameras)
    bad = [name for name, out in zip(rig.poses, rig.outliers, strict=True) if out]
    bad += [f"{n}: {i}" for n, c in zip(rig.names, outcome.cameras, strict=True) for i in c.outliers()]
    without = f", without {len(bad)} that contradict the others: {', '.join(bad)}" if bad else ""
    cameras = f"{len(rig.names)} camera{'s' * (len(rig.names) > 1)}"
    return f"{rig.setup}: {cameras}, {images} images from {len(rig.poses)} poses of the robot{without}"


def _rig_splits_text(outcome: RigOutcome) -> str:
    held = outcome.held_out
    return "" if held is None else f"{held.rows.shape[0]} × {held.rows.shape[1]} of {len(outcome.rig.poses)}"


def _camera_cells(outcome: RigOutcome) -> list[list[str]]:
    """Returns heads, and one row per camera: images, σ of corners, residuals, σ of its pose jointly and alone."""
    rows = [
        [
            "<camera",
            "images",
            "corner σ",
            "<",
            "residual °",
            "residual mm",
            "σ place mm",
            "alone mm",
            "σ turn °",
            "alone °",
        ]
    ]
    for name, camera, camera_outcome, alone in zip(
        outcome.rig.names, outcome.rig.cameras, outcome.cameras, outcome.alone, strict=True
    ):
        turn, shift = camera.rms()
        unit = "× its own" if camera_outcome.own_sigmas else "px"
        joint, single = _worst(camera, outcome.widened), _worst(alone)
        cells = [str(int((~camera.outliers).sum())), number(camera.sigma["corner_px"], 3), unit]
        cells += [number(np.degrees(turn), 4), number(shift, 3)]
        rows.append([name, *cells, joint[1], single[1], joint[0], single[0]])
    return rows


def _worst(result: HandEye | None, widened: float = 1.0) -> tuple[str, str]:
    """Returns σ of rotation (°) and place (mm) in their worst directions, from the adjustment, before widening."""
    if result is None or result.covariance is None:
        return NONE, NONE
    parts = result.covariance[:3, :3], result.covariance[3:, 3:]
    turn, place = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) / widened for part in parts)
    return number(np.degrees(turn), 4), number(place, 3)


def _held_out_cells(outcome: RigOutcome) -> list[list[str]]:
    rows = [["<camera", "views", "together mm", "alone mm", "<gain", "together °", "alone °"]]
    if outcome.held_out is None:
        return rows
    for name, held in zip(outcome.rig.names, outcome.held_out.cameras, strict=True):
        joint, alone, gain = held.means(), held.means("alone"), held.gain()
        gain_text = "cannot be found alone" if gain is None else _percent(gain)
        columns = [(joint, "board_mm", 1.0, 3), (alone, "board_mm", 1.0, 3)]
        columns += [(joint, "rotation_rad", np.degrees(1.0), 4), (alone, "rotation_rad", np.degrees(1.0), 4)]
        cells = [number(means.get(key, np.nan) * unit, digits) for means, key, unit, digits in columns]
        rows.append([name, str(len(held.view)), *cells[:2], gain_text, *cells[2:]])
    return rows


def _percent(share: float) -> str:
    return f"{round(100 * share)} %"


def _shared_sigmas(outcome: RigOutcome) -> list[list[str]]:
    """Returns rows of σ: those of robot and board once, those of each camera with its name."""
    rows = []
    for name, camera in zip(outcome.rig.names, outcome.cameras, strict=True):
        for text, value, how in sigma_rows(camera):
            shared = text.startswith("robot") or text.startswith("corner on")
            row = [text if shared else f"{name}, {text}", value, how]
            if row not in rows:
                rows.append(row)
    return sorted(rows, key=lambda row: "," in row[0] and not row[0].startswith("robot"))


def rig_page(outcome: RigOutcome) -> str:
    """Returns the report as a page."""
    rig, frames, first_camera = outcome.rig, FRAMES[outcome.rig.setup], outcome.rig.cameras[0]
    relative = []
    for first, second in combinations(rig.names, 2):
        pose, covariance = rig.relative(first, second)
        relative.append((f"{first}_from_{second}", transform_rows(pose, covariance), matrix_text(pose)))
    cameras = []
    for name, camera, camera_outcome in zip(rig.names, rig.cameras, outcome.cameras, strict=True):
        turn, shift = camera.rms()
        errors = {} if camera_outcome.held_out is None else camera_outcome.held_out.means()
        cameras.append(
            {
                "name": name,
                "transform": f"{frames.mount}_from_{name}",
                "rows": transform_rows(camera.mount_from_camera, camera.covariance),
                "matrix": matrix_text(camera.mount_from_camera),
                "said": f"Residuals (RMS): {np.degrees(turn):.4f}°, {shift:.3f} mm at the board's origin",
                "errors": means_text(errors) if errors else "",
                "adjusted": adjusted(camera_outcome),
                "bars": pose_bars(camera),
                "poses": pose_rows(camera),
                "outliers": camera_outcome.outliers(),
                **coverage(camera_outcome),
            }
        )
    return render(
        "handeye/report/rig.html.jinja",
        outcome=outcome,
        rig=rig,
        board=frames.board,
        counts=_rig_headline(outcome),
        headline=_rig_tiles(outcome),
        notes=asides(outcome),
        heads=HEADS,
        cameras=cameras,
        relative=relative,
        stand=(transform_rows(rig.stand_from_board, first_camera.stand_covariance), matrix_text(rig.stand_from_board)),
        table_of_cameras=_camera_cells(outcome),
        held=_held_out_cells(outcome) if outcome.held_out else [],
        splits=_rig_splits_text(outcome),
        sigmas=_shared_sigmas(outcome),
        scale=scale_text(outcome.cameras[0], first_camera.sigma_scale) if first_camera.sigma_scale is not None else "",
        good=GOOD,
        bad=BAD,
        left_out=outcome.left_out(),
        **verdict_parts(rig_judged(outcome)),
    )


def _rig_tiles(outcome: RigOutcome) -> list[tuple[str, str, str]]:
    """Returns the tiles of the headline: (value, unit, text)."""
    rig, tiles = outcome.rig, []
    if outcome.held_out is not None:
        for name, held in zip(rig.names, outcome.held_out.cameras, strict=True):
            if means := held.means():
                gain = held.gain()
                comparison = (
                    "" if gain is None else f", {number(held.means('alone')['board_mm'], 3)} mm if solved alone"
                )
                tiles.append(
                    (f"{means['board_mm']:.3f} mm", "", f"{name}: 3-D error at the board, held out{comparison}")
                )
    sigma = rig.cameras[0].sigma
    if "robot_mm" in sigma:
        robot = f"σ of the robot's poses an axis, and {np.degrees(sigma.get('robot_rad', 0)):.3f}°"
        tiles.append((f"{sigma['robot_mm']:.3f} mm", "", robot))
    return tiles
