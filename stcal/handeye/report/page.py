"""Reports of hand-eye calibrations, of one camera or of a rig."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from stcal.geometry.camera import PARAMETER_NAMES, parameter_names
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import FRAMES
from stcal.handeye.judge.observability import Observability
from stcal.handeye.judge.remarks import Aside
from stcal.handeye.report.figures import (
    BAD,
    GOOD,
    by_robot,
    corner_figure,
    enlargement,
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
from stcal.report.document import (
    Block,
    Document,
    Html,
    Printed,
    Section,
    Table,
    bullets,
    fold,
    html,
    legend,
    macro,
    page_only,
    plot,
    plots,
    sentence,
    subheading,
    tiles,
    tone_of,
)
from stcal.report.document import Verdict as VerdictWord
from stcal.report.text import HEADS, NONE, number, transform_rows

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


def outcome_report(outcome: Outcome) -> Document:
    """Returns the report of ``handeye`` for one camera."""
    result, frames = outcome.result, FRAMES[outcome.result.setup]
    turn, shift = result.rms()
    held_out = []
    if outcome.held_out is not None:
        held_out = [f"held out ({_splits_text(outcome)}): {means_text(outcome.held_out.means())}"]
        held_out += [f"held out, {text}" for text in _agreeing_text(outcome)]
    camera = adjusted(outcome)
    answer: list[Block] = [
        tiles(_tiles(outcome)),
        *(block for item in _transforms(result) for block in _transform(*item)),
        page_only(EXPLAINED),
        "" if outcome.time_offset is None else f"{outcome.time_offset.in_words()}; the σ above hold that of the offset",
        f"residuals (RMS): {np.degrees(turn):.4f}°, {shift:.3f} mm at the board's origin",
        *held_out,
        outcome.sentence(),
        Table(["<what errs, and by how much", "σ", "<"], sigma_rows(outcome)),
        "" if result.sigma_scale is None else scale_text(outcome, result.sigma_scale),
        "" if result.observability is None else turns_text(result.observability),
        fold("Camera, as adjusted (first pixel's centre at 0, 0)", Table(["<", "value", "± σ", "<unit"], camera or [])),
        *_remarks([note for note in outcome.all_notes() if isinstance(note, Aside)], outcome.understood),
        _findings(judged(outcome)),
    ]
    heads = ["<pose", "rotation °", "mm", "x mm", "y mm", "z mm", *(["corners px"] if result.reprojection else []), "<"]
    return Document(
        f"Hand-eye calibration: {frames.camera}",
        f"{outcome.where}: {_headline(outcome)}",
        [
            Section("Result", answer, terminal=True),
            Section("What was tried", _tried(outcome), terminal=True),
            Section("The arm", _arm(outcome.arm), terminal=True),
            Section("Methods", _methods(outcome), terminal=True),
            Section("Motions held out", _motions(outcome), terminal=True),
            Section(
                "Poses",
                _poses(
                    result, heads, "By how much the chain through each pose misses the board", len(outcome.outliers())
                ),
            ),
            Section("Coverage of the image", [Html(lambda: html(*_coverage(outcome)))]),
            Section("What the motions tell", _turns(outcome)),
            Section("Overlays", _photographs(outcome)),
            Section("Left out", [page_only(Table(["<image", "<reason"], outcome.left_out))]),
        ],
        banner=_verdict(judged(outcome)),
    )


EXPLAINED = (
    "The rotation vector is axis times angle, no roll, pitch and yaw. σ are of turns about the axes, and of shifts "
    "along the axes, of the frame named first"
)
CHANCE = (
    "Care is advised for what happens by chance in one calibration of a thousand, use advised against for what "
    "happens in one of a hundred thousand, and where the transform has more than half, or nine tenths, of the "
    "variance of a prediction. Whether the millimetres above are few enough, the task tells"
)


def _verdict(found: Verdict) -> list[Block]:
    """Returns the verdict with its reasons and remedies."""
    reasons = [sentence(": ".join(filter(None, (finding.said, finding.remedy)))) for finding in found.reasons()]
    return [Printed([f"verdict: {found.sentence()}"]), macro("judged", found.word, tone_of(found.word), reasons)]


def _findings(found: Verdict) -> Block:
    """Returns the findings that the verdict rests on, folded."""
    rows = [[f.title, VerdictWord(f.word), f.value or NONE, f.limit or NONE, f.said] for f in found.findings]
    table = Table(["<Judged", "<Verdict", "Value", "Limit", "<Found"], rows, css="text")
    return fold("What the verdict rests on", table, CHANCE)


def _remarks(notes: Sequence[str], understood: Sequence[str]) -> list[Block]:
    blocks: list[Block] = [subheading("To know"), bullets(notes)] if notes else []
    return blocks + ([subheading("What the files were taken for"), bullets(understood)] if understood else [])


def _transform(name: str, pose: Rigid, covariance: np.ndarray | None) -> list[Block]:
    """Returns a transform with σ, and its matrix, folded."""
    matrix = "\n".join(" ".join(f"{v:14.9f}" for v in row) for row in pose.matrix())
    table = Table(["<" + name, *HEADS[1:]], transform_rows(pose, covariance))
    return [table, fold(f"{name}: 4×4 matrix, mm", macro("verbatim", matrix))]


def _tried(outcome: Outcome) -> list[Block]:
    return (
        [
            _rows(_choice_cells(outcome)),
            page_only(
                "Each way solves with the other poses and predicts where the board is in those held out. The best "
                "is taken, unless one that trusts the files more, or knows its σ, is behind it by no more than chance. "
                "The errors above are those of the choice as a whole: in each split "
                "of the way that the errors on all other poses name"
            ),
        ]
        if outcome.choice
        else []
    )


def _arm(arm: ArmFound | None) -> list[Block]:
    return (
        [
            _rows(_arm_cells(arm)),
            page_only(
                "By how much each axis is off the robot's file, and σ: turns (rx, ry) and shifts (x, y) of the joint's "
                "frame, one after the other from the base. What poses do not tell stays near 0 by the σ of all axes, "
                "which is estimated"
            ),
        ]
        if arm
        else []
    )


def _methods(outcome: Outcome) -> list[Block]:
    if not outcome.compared:
        return []
    cells = _compared_cells(outcome)
    board = (
        " 3-D at the board: how far from each corner the ray on which the camera saw it meets the board where the "
        "robot has put it; by pose: distance from the corners by the pose that the image gives alone."
    )
    return [
        f"means over the same {_splits_text(outcome)} held out; off: from {FRAMES[outcome.result.setup].camera} above",
        _rows(cells),
        page_only(
            "Each time all methods solve with the others and predict where the board is."
            f"{board if ERRORS['board_mm'][0] in cells[0] else ''}"
        ),
    ]


def _motions(outcome: Outcome) -> list[Block]:
    return [_motions_text(outcome), _rows(_motion_cells(outcome))] if outcome.motions else []


def _rows(cells: list[list[str]]) -> Table:
    """Returns the table of cells whose first row holds the heads."""
    return Table(cells[0], cells[1:], css="text")


def _poses(result: HandEye, heads: list[str], caption: str, contradicting: int) -> list[Block]:
    """Returns the chart of each pose's residuals, and their table, folded."""
    colours = {"used": GOOD, "left out, contradicting the others": BAD} if contradicting else {}
    rows = pose_rows(result)
    return [
        legend(colours),
        macro("pose_chart", lambda: pose_bars(result), caption),
        fold(f"{len(rows)} {'images' if heads[0] == '<image' else 'poses'}", Table(heads, rows)),
    ]


def _coverage(outcome: Outcome) -> list[Block]:
    """Returns how much of the image the board covered, with the residuals over it."""
    views, pairs, board = outcome.views, outcome.pairs, outcome.result.reprojection
    if views is None or pairs is None:
        return []
    if board is None:
        measured = np.concatenate([view.xy_px for view in views.views])
        residuals = np.concatenate(by_robot(outcome.result, pairs, views)) - measured
    else:
        used = [views.views[i].xy_px for i in np.unique(board.view)]
        measured, residuals = np.concatenate(used), board.residuals_px
    finite = np.isfinite(residuals).all(1)
    size, residuals = (views.camera.width, views.camera.height), residuals[finite]
    covered, factor = image_coverage(views), enlargement(residuals, views.camera.width)
    by = "the adjustment" if board is not None else "robot and transforms"
    return [
        f"The board lay over {covered.share:.0%} of the image in one photograph or another. Where it never was, "
        "nothing checks the distortion of the lens",
        plots(
            plot(
                lambda: image_figure(size, covered, measured[finite], residuals),
                "coverage of the image",
                f"Darker: the board lay there more often; lines: residuals by {by}, {factor:g} times enlarged",
                "",
            ),
            None
            if board is None
            else plot(
                lambda: corner_figure(board), "residuals of corners", "Corners: projected minus seen; circle: 95 %", ""
            ),
        ),
    ]


def _turns(outcome: Outcome) -> list[Block]:
    """Returns what the rotations between poses tell of the transform."""
    pairs, seen = outcome.pairs, outcome.result.observability
    if seen is None:
        return []
    picture = (
        "Left: the axes about which the flange turned between two poses each, in its own frame, on a half sphere seen "
        "along Z (equal areas; circles: 30° and 60° from Z); 1, 2, 3: the principal axes. Right: by how much it turned"
    )
    rows = [
        [str(i), *(number(v, 3) for v in axis), number(np.degrees(turn), 2)]
        for i, (axis, turn) in enumerate(zip(seen.axes, seen.turns_rad, strict=True), 1)
    ]
    return [
        plot(lambda: turns_figure(turns_between(pairs), seen), "rotations between poses", picture) if pairs else None,
        Table(["axis", "x", "y", "z", "turn ° (RMS)"], rows),
        "The principal axes of all rotations between poses, in the flange's frame, and the RMS turn about each. The "
        "transform is known well where the second turn is large; where it is 0, the camera's place slides along the "
        "first axis. From poses of a common camera (1 mrad, 0.5 mm) these motions give σ of "
        f"{np.degrees(seen.sigma_rad):.3f}° and {seen.sigma_mm:.2f} mm in the worst direction",
    ]


def _photographs(outcome: Outcome) -> list[Block]:
    """Returns some photographs with their corners; read when the page is written."""
    if outcome.pairs is None or outcome.views is None or outcome.folder is None:
        return []

    def photographs():
        shown, missing = overlays(outcome)
        explained = (
            "Circles: corners as measured. Lines lead to where they would be by the robot's pose as it was reported "
            "and the transforms above, enlarged: what robot, transforms, camera and board miss together"
        )
        pictures = plots(*(macro("corner_photo", photo) for photo in shown))
        return html(explained if shown else "", pictures, *missing)

    return [Html(photographs)]


def _tiles(outcome: Outcome) -> list[tuple[str, str, str]]:
    """Returns the tiles of the headline: (value, unit, text)."""
    result, headline = outcome.result, []
    if outcome.held_out is not None:
        means = outcome.held_out.means()
        name = "board_mm" if "board_mm" in means else "translation_mm"
        where = "3-D error at the board" if name == "board_mm" else "error of the board's origin"
        headline.append((f"{means[name]:.3f} mm", "", f"{where}, on poses held out ({_splits_text(outcome)})"))
        turn = np.degrees(means["rotation_rad"])
        headline.append((f"{turn:.3f}°", "", "error of rotation, on poses held out"))
    if result.covariance is not None:
        sigma = np.sqrt(np.linalg.eigvalsh(result.covariance[3:, 3:])[-1])
        headline.append((f"{sigma:.3f} mm", "", "σ of the camera's place, in its worst direction"))
    turn, shift = result.rms()
    headline.append((f"{shift:.3f} mm", "", f"RMS residual at the board's origin, and {np.degrees(turn):.3f}°"))
    if (offset := outcome.time_offset) is not None:
        said = f"robot's clock minus camera's, ± {1e3 * offset.sigma_s:.2g} ms"
        headline.append((f"{1e3 * offset.seconds:.2f} ms", "", said))
    if result.sigma_scale is not None:
        pitch = "" if outcome.pitch_mm is None else f": pitch {outcome.pitch_mm * result.scale:.3f} mm"
        headline.append(
            (f"{result.scale:.4f}", "", f"times its stated size is the board, ± {result.sigma_scale:.4f}{pitch}")
        )
    return headline


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


def rig_report(outcome: RigOutcome) -> Document:
    """Returns the report of ``handeye rig``."""
    rig, frames, first = outcome.rig, FRAMES[outcome.rig.setup], outcome.rig.cameras[0]
    cameras = [
        block
        for name, camera in zip(rig.names, rig.cameras, strict=True)
        for block in _transform(f"{frames.mount}_from_{name}", camera.mount_from_camera, camera.covariance)
    ]
    relative = [
        block
        for one, two in combinations(rig.names, 2)
        for block in _transform(f"{one}_from_{two}", *rig.relative(one, two))
    ]
    answer: list[Block] = [
        tiles(_rig_tiles(outcome)),
        *cameras,
        *_transform(frames.board, rig.stand_from_board, first.stand_covariance),
        page_only(EXPLAINED),
        Table(["<what errs, and by how much", "σ", "<"], _shared_sigmas(outcome)),
        "" if first.sigma_scale is None else scale_text(outcome.cameras[0], first.sigma_scale),
        "" if first.observability is None else turns_text(first.observability),
        *_remarks(asides(outcome), outcome.understood),
        _findings(rig_judged(outcome)),
    ]
    alone: list[Block] = [
        _rows(_camera_cells(outcome)),
        page_only(
            "σ of a camera's place and turn in their worst directions, as the adjustment of all cameras and that of "
            "this one alone have them"
        ),
    ]
    if outcome.held_out is not None:
        alone += [
            f"poses of the robot held out ({_rig_splits_text(outcome)}), 3-D at the board, all cameras or each alone",
            _rows(_held_out_cells(outcome)),
            page_only(
                "Each time all cameras together, and each by itself, are solved for with the images of the other "
                "poses, and predict where the board is in the images of those held out: how far from each corner the "
                "ray on which the camera saw it meets the board where the robot has put it. Gain: by how much that is "
                "less together"
            ),
        ]
    told = page_only("From the joint covariance: what board and robot do to both cameras alike does not count")
    return Document(
        f"Hand-eye calibration of a rig: {', '.join(rig.names)}",
        f"{outcome.where}: {_rig_headline(outcome)}",
        [
            Section("Result", answer, terminal=True),
            Section("The cameras in each other", [*relative, told] if relative else [], terminal=True),
            Section("Together, and each alone", alone, terminal=True),
            Section("Cameras", [block for k in range(len(rig.names)) for block in _camera(outcome, k)]),
            Section("Left out", [Table(["<camera", "<image", "<reason"], outcome.left_out())]),
        ],
        banner=_verdict(rig_judged(outcome)),
    )


def _camera(outcome: RigOutcome, k: int) -> list[Block]:
    """Returns residuals, adjusted parameters, coverage and photographs of a camera of the rig."""
    name, camera, own = outcome.rig.names[k], outcome.rig.cameras[k], outcome.cameras[k]
    turn, shift = camera.rms()
    errors = {} if own.held_out is None else own.held_out.means()
    heads = ["<image", "rotation °", "mm", "x mm", "y mm", "z mm", "corners px", "<"]
    parameters = Table(["<", "value", "± σ", "<unit"], adjusted(own) or [])
    caption = f"By how much the chain through each image of {name} misses the board"
    return [
        subheading(name),
        f"residuals (RMS): {np.degrees(turn):.4f}°, {shift:.3f} mm at the board's origin",
        f"held out: {means_text(errors)}" if errors else "",
        *_poses(camera, heads, caption, len(own.outliers())),
        fold("Camera, as adjusted (first pixel's centre at 0, 0)", parameters),
        Html(lambda: html(*_coverage(own))),
        fold("Photographs with their corners", *_photographs(own)),
    ]


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


def _rig_tiles(outcome: RigOutcome) -> list[tuple[str, str, str]]:
    """Returns the tiles of the headline: (value, unit, text)."""
    rig, headline = outcome.rig, []
    if outcome.held_out is not None:
        for name, held in zip(rig.names, outcome.held_out.cameras, strict=True):
            if means := held.means():
                gain = held.gain()
                comparison = (
                    "" if gain is None else f", {number(held.means('alone')['board_mm'], 3)} mm if solved alone"
                )
                headline.append(
                    (f"{means['board_mm']:.3f} mm", "", f"{name}: 3-D error at the board, held out{comparison}")
                )
    sigma = rig.cameras[0].sigma
    if "robot_mm" in sigma:
        robot = f"σ of the robot's poses an axis, and {np.degrees(sigma.get('robot_rad', 0)):.3f}°"
        headline.append((f"{sigma['robot_mm']:.3f} mm", "", robot))
    return headline
