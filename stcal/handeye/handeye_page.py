"""Report of a hand-eye calibration, with figures of residuals and of the coverage of the image."""

import numpy as np

from stcal.geometry.camera import Camera
from stcal.handeye.choose import ChosenWay
from stcal.handeye.data.corner_views import Views
from stcal.handeye.data.pose_pairs import FRAMES, HandEyePoses, Loop
from stcal.handeye.handeye_pipeline import Outcome, judged
from stcal.handeye.handeye_problem import FACTORS, HandEye
from stcal.handeye.remarks import Aside, spoken
from stcal.handeye.validate import HeldOutMotions, as_adjusted, poses_by_robot
from stcal.report.camera_figures import mean_residuals_figure, means_of_cells, shown
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
    subheading,
    tiles,
    verdict_word,
)
from stcal.report.svg import COLOURS, Axes, Drawing, count_ticks, limits
from stcal.report.text import HEADS, NONE, number, transform_rows

DEGREE = np.degrees(1.0)
ERRORS = {
    "rotation_rad": ("rotation °", DEGREE, 4),
    "translation_mm": ("board's origin mm", 1.0, 3),
    "board_mm": ("3-D at the board mm", 1.0, 3),
    "pose_mm": ("3-D by pose mm", 1.0, 3),
}
"""Heads, unit factors and digits of the errors on held-out poses."""
CELLS = (16, 12)  # number of cells across and down the image, in which corners are counted
GOOD, BAD = COLOURS[0], COLOURS[1]
SIGMA_NAMES = {
    "corner_px": ("corner in the image", "px", 1.0),
    "robot_rad": ("robot, rotation", "°", DEGREE),
    "robot_mm": ("robot, position", "mm", 1.0),
    "camera_rad": ("board's pose, rotation", "°", DEGREE),
    "camera_mm": ("board's pose, position", "mm", 1.0),
    "camera_factor": ("board's pose", "times its own σ", 1.0),
    "board_mm": ("corner on the board", "mm", 1.0),
    **{key: (f"camera file, {name}", "times its σ", 1.0) for key, name in FACTORS.items()},
}


def _splits_text(outcome: Outcome) -> str:
    every = (outcome.held_out, *(each.held_out for each in outcome.compared))
    known = [found.rows.shape for found in every if found is not None]
    return f"{known[0][0]} × {known[0][1]} of {len(outcome.result.names)} poses" if known else "no poses"


def means_text(means: dict[str, float]) -> str:
    parts = []
    for name, mean in means.items():
        head, unit, digits = ERRORS[name]
        quantity, _, ending = head.rpartition(" ")
        parts.append(f"{quantity} {number(mean * unit, digits)}{ending if ending == '°' else f' {ending}'}")
    return ", ".join(parts)


def outcome_report(outcome: Outcome) -> Document:
    result, frames, found = outcome.result, FRAMES[outcome.result.setup], judged(outcome)
    turn, shift = result.rms()
    held_out, bad, seen = outcome.held_out, outcome.outliers(), result.observability
    means = {f"held out ({_splits_text(outcome)}), mean": held_out.means() if held_out else {}}
    if held_out and bad:
        means[f"held out, mean without the {len(bad)} left out above"] = held_out.means(~result.outliers)
    turns = ", ".join(f"{turn:.1f}°" for turn in np.degrees(seen.turns_rad)) if seen else ""
    transforms: list[Block] = []
    covariances = (result.covariance, result.stand_covariance)
    for (name, pose), covariance in zip(result.transforms.items(), covariances, strict=True):
        matrix = "\n".join(" ".join(f"{v:14.9f}" for v in row) for row in pose.matrix())
        transforms.append(Table(["<" + name, *HEADS[1:]], transform_rows(pose, covariance)))
        transforms.append(fold(f"{name}: 4×4 matrix, mm", macro("verbatim", matrix)))
    sigmas = []
    for name, value in result.sigma.items():
        text, unit, factor = SIGMA_NAMES[name]
        unit = "times its own σ" if name == "corner_px" and outcome.own_sigmas else unit
        how = "estimated" if name in result.estimated else "stated"
        sigmas.append([text, f"{value * factor:.3g}{unit if unit == '°' else f' {unit}'}", how])
    judged_by = [[f.title, verdict_word(f.word), f.value or NONE, f.limit or NONE, f.said] for f in found.findings]
    judgements = Table(["<Judged", "<Verdict", "Value", "Limit", "<Found"], judged_by, css="text")
    asides = [note for note in outcome.all_notes() if isinstance(note, Aside)]
    told = {"To know": asides, "What the files were taken for": outcome.given.understood}
    camera, adjusted = "", result.reprojection
    if adjusted is not None and adjusted.camera_covariance is not None:
        lens = Camera.of(adjusted.camera, outcome.colmap_model, adjusted.camera_covariance)
        camera = macro("verbatim", "\n".join(shown(lens)))
    answer: list[Block] = [
        tiles(_tiles(outcome)),
        *transforms,
        page_only(EXPLAINED),
        "" if outcome.time_offset is None else f"{outcome.time_offset.in_words()}; the σ above hold that of the offset",
        f"residuals (RMS): {np.degrees(turn):.4f}°, {shift:.3f} mm at the board's origin",
        *(f"{what}: {means_text(each)}" for what, each in means.items() if each),
        outcome.sentence(),
        Table(["<what errs, and by how much", "σ", "<"], sigmas),
        _scale_text(outcome),
        f"the flange turns between poses by {turns} (RMS) about its principal axes" if turns else "",
        fold("Camera, as adjusted", camera),
        *(block for title, lines in told.items() if lines for block in (subheading(title), bullets(lines))),
        fold("What the verdict rests on", judgements, CHANCE),
    ]
    heads = ["<pose", "rotation °", "mm", "x mm", "y mm", "z mm", *(["corners px"] if result.reprojection else []), "<"]
    rows = _pose_rows(result)
    poses: list[Block] = [
        legend({"used": GOOD, "left out, contradicting the others": BAD} if bad else {}),
        plot(lambda: pose_bars(result), "By how much the chain through each pose misses the board"),
        fold(f"{len(rows)} poses", Table(heads, rows)),
    ]
    without = f", without {len(bad)} that contradict{'s' * (len(bad) == 1)} them: " + ", ".join(map(spoken, bad))
    reasons = [": ".join(filter(None, (each.said, each.remedy))) for each in found.reasons()]
    return Document(
        f"Hand-eye calibration: {frames.camera}",
        f"{outcome.given.where}: {result.setup}, {result.method}: {len(rows) - len(bad)} poses{without if bad else ''}",
        [
            Section("Result", answer, terminal=True),
            Section("What was tried", _tried(outcome.choice), terminal=True),
            Section("Methods", _methods(outcome), terminal=True),
            Section("Motions held out", _motions(outcome.motions), terminal=True),
            Section("Poses", poses),
            Section("Coverage of the image", [Html(lambda: html(*_coverage(outcome)))]),
            Section("Left out", [page_only(Table(["<image", "<reason"], outcome.given.left_out))]),
        ],
        banner=[
            found.answer(),
            Printed([f"what to do: {remedy}" for remedy in found.remedies()]),
            bullets(reasons) if any(each.remedy for each in found.reasons()) else None,
        ],
    )


EXPLAINED = (
    "The rotation vector is axis times angle, not roll, pitch and yaw. σ are those of rotations about the axes, and "
    "of translations along the axes, of the frame named first"
)
CHANCE = (
    "Care is advised for what happens by chance in one calibration of a thousand, and use is advised against for what "
    "happens in one of a hundred thousand. The same holds if the transform has more than half, or nine tenths, of the "
    "variance of a prediction. Whether the errors in mm above are small enough depends on the task"
)


def _tried(choice: ChosenWay | None) -> list[Block]:
    """Returns a table with a row per way of solving that was tried."""
    if choice is None:
        return []
    how = {each.candidate: each.reason for each in choice.tried} | {choice.chosen: "taken"}
    rows = [[w.candidate.name, number(w.mean_mm, 3), str(len(w.error_mm)), how[w.candidate]] for w in choice.tried]
    return [
        Table(["<solved by", "held out mm", "splits", "<"], rows, css="text"),
        page_only(
            "Each way solves with the other poses, and predicts the board in the poses held out. The best is "
            "taken, unless one that trusts the files more, or states σ, is behind it by no more than chance. The "
            "errors above are those of the whole procedure: in each split, the way is chosen by the errors on all "
            "other poses"
        ),
    ]


def _methods(outcome: Outcome) -> list[Block]:
    """Returns a table with a row per method: mean errors on held-out poses, and distance from the result."""
    if not outcome.compared:
        return []
    means = [each.held_out.means() if each.held_out else {} for each in outcome.compared]
    kinds = [name for name in ERRORS if any(name in own for own in means)]
    inverse, rows, failed = outcome.result.mount_from_camera.inverse(), [], any(e.reason for e in outcome.compared)
    for each, own in zip(outcome.compared, means, strict=True):
        far = [NONE, NONE]
        if each.result is not None:
            off = inverse @ each.result.mount_from_camera
            far = [number(float(np.linalg.norm(off.translation)), 3), number(np.degrees(off.angle_rad()), 4)]
        cells = [number(own.get(n, np.nan) * ERRORS[n][1], ERRORS[n][2]) for n in kinds]
        rows.append([each.method, *cells, *far, *[each.reason] * failed])
    heads = ["<method", *(ERRORS[name][0] for name in kinds), "off mm", "off °", *["<"] * failed]
    board = (
        " 3-D at the board: the distance from each corner to the point where the camera's ray to it meets the board "
        "as placed by the robot; by pose: distance from the corners by the pose that the image gives alone."
    )
    more = board if "board_mm" in kinds else ""
    return [
        f"means over the same {_splits_text(outcome)} held out; off: from {FRAMES[outcome.result.setup].camera} above",
        Table(heads, rows, css="text"),
        page_only(f"Each time all methods solve with the others and predict where the board is.{more}"),
    ]


def _motions(motions: HeldOutMotions | None) -> list[Block]:
    """Returns a table with a row per held-out motion, and the means."""
    if motions is None:
        return []
    names = [*(" → ".join(pair) for pair in motions.names), "mean"]
    errors = np.column_stack([motions.translation_mm, np.degrees(motions.rotation_rad)])
    errors = [*errors, errors.mean(0)]
    rows = [[name, number(mm, 3), number(deg, 4)] for name, (mm, deg) in zip(names, errors, strict=True)]
    said = f"motions predicted by those before (Jin et al., eqs. 24–26): fitted to {motions.fitted}"
    return [said, Table(["<motion held out", "mm", "°"], rows, css="text")]


def _coverage(outcome: Outcome) -> list[Block]:
    """Returns how much of the image the board covered, with the mean residuals over it."""
    views, board = outcome.given.views, outcome.result.reprojection
    if views is None:
        return []
    measured, by = np.concatenate([view.xy_px for view in views.views]), "robot and transforms"
    if board is None:
        residuals = np.concatenate(by_robot(outcome.result, outcome.given.pairs, views)) - measured
    else:
        measured, by = np.concatenate([views.views[i].xy_px for i in np.unique(board.view)]), "the adjustment"
        residuals = board.residuals_px
    size, finite = (views.camera.width, views.camera.height), np.isfinite(residuals).all(1)
    mean, count = means_of_cells(measured[finite], residuals[finite], CELLS, size)
    said = f"Mean residuals by {by} in cells of the image, and numbers of corners"
    return [
        f"Corners were seen in {(count > 0).mean():.0%} of the cells of the image. Where they never were, nothing "
        "checks the distortion of the lens",
        plots(plot(lambda: mean_residuals_figure(mean, count, CELLS, size), "coverage of the image", said, "")),
    ]


def _scale_text(outcome: Outcome) -> str:
    """Returns the estimated size of the board and its σ, in words; empty where it was not solved for."""
    scale, sigma, pitch = outcome.result.scale, outcome.result.sigma_scale, outcome.given.pitch_mm
    if sigma is None:
        return ""
    text = f"board: {scale:.5f} ± {sigma:.5f} times its stated size"
    return text if pitch is None else f"{text}: pitch {pitch * scale:.4f} ± {pitch * sigma:.4f} mm, stated {pitch:g} mm"


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
    return headline


def _pose_rows(result: HandEye) -> list[list[str]]:
    adjusted, rows = result.reprojection, []
    for i, (name, off) in enumerate(zip(result.names, result.residuals, strict=True)):
        turn, shift = np.linalg.norm(off.reshape(2, 3), axis=1)
        row = [name, number(np.degrees(turn), 4), *(number(v, 3) for v in (shift, *off[3:]))]
        row += [] if adjusted is None else [number(adjusted.rms_px(i), 3)]
        rows.append([*row, "left out" if result.outliers[i] else ""])
    return rows


def by_robot(result: HandEye, pairs: HandEyePoses, views: Views) -> list[np.ndarray]:
    """Returns the corners (k, 2) px of each view by the robot's reported pose, NaN behind the camera."""
    adjusted, poses = as_adjusted(result, views), poses_by_robot(result, Loop.of(pairs, result.setup))
    return [adjusted.camera.project(pose @ v.xyz_board) for v, pose in zip(adjusted.views, poses, strict=True)]


def pose_bars(result: HandEye) -> Drawing:
    """Draws each pose's residuals: rotation, board's origin, and corner RMS if corners were adjusted."""
    turn, shift = np.linalg.norm(result.residuals.reshape(-1, 2, 3), axis=2).T
    rows = {"rotation, °": np.degrees(turn), "origin, mm": shift}
    if result.reprojection is not None:
        rows["corners, px"] = np.array([result.reprojection.rms_px(i) for i in range(len(result.names))])
    drawing = Drawing(9.4, 0.6 + 1.2 * len(rows))
    for box, (label, values) in zip(drawing.panels(1, len(rows), gap=26), rows.items(), strict=True):
        axes = Axes(drawing, box, (0.4, len(values) + 0.6), limits(values, low=0))
        axes.frame("pose, in order", label, "y", count_ticks(1, len(values)))
        for colour, rows_of in ((GOOD, ~result.outliers), (BAD, result.outliers)):
            shown = np.flatnonzero(rows_of & np.isfinite(values))
            bars = [((i + 0.6, i + 0.6, i + 1.4, i + 1.4), (0, values[i], values[i], 0)) for i in shown]
            axes.lines(bars, fill=colour)
    return drawing
