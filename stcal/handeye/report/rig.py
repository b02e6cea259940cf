"""Report of a rig's calibration, for the terminal and as a page."""

from itertools import combinations

import numpy as np

from stcal.handeye.data.loop import FRAMES
from stcal.handeye.report.figures import BAD, GOOD, pose_bars
from stcal.handeye.report.outcome import RigOutcome, asides, rig_judged
from stcal.handeye.report.page import (
    adjusted,
    coverage,
    matrix_text,
    means_text,
    pose_rows,
    scale_text,
    sigma_rows,
    turns_text,
    verdict_parts,
)
from stcal.handeye.result import HandEye
from stcal.report.page import render
from stcal.report.text import HEADS, NONE, number, text_table, transform_rows


def rig_text(outcome: RigOutcome) -> str:
    """Returns the report for the terminal."""
    rig, frames = outcome.rig, FRAMES[outcome.rig.setup]
    lines = [_headline(outcome), f"verdict: {rig_judged(outcome).sentence()}"]
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
            f"Poses of the robot held out ({_splits_text(outcome)}), 3-D at the board, all cameras or each alone",
        ]
        lines += text_table(_held_out_cells(outcome))
    lines += ["", *(f"σ of {text}: {value} ({how})" for text, value, how in _shared_sigmas(outcome))]
    first_camera = rig.cameras[0]
    if first_camera.sigma_scale is not None:
        lines.append(scale_text(outcome.cameras[0], first_camera.sigma_scale))
    if first_camera.observability is not None:
        lines.append(turns_text(first_camera.observability))
    return "\n".join(lines)


def _headline(outcome: RigOutcome) -> str:
    rig = outcome.rig
    images = sum(int((~camera.outliers).sum()) for camera in rig.cameras)
    bad = [name for name, out in zip(rig.poses, rig.outliers, strict=True) if out]
    bad += [f"{n}: {i}" for n, c in zip(rig.names, outcome.cameras, strict=True) for i in c.outliers()]
    without = f", without {len(bad)} that contradict the others: {', '.join(bad)}" if bad else ""
    cameras = f"{len(rig.names)} camera{'s' * (len(rig.names) > 1)}"
    return f"{rig.setup}: {cameras}, {images} images from {len(rig.poses)} poses of the robot{without}"


def _splits_text(outcome: RigOutcome) -> str:
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
        counts=_headline(outcome),
        headline=_tiles(outcome),
        notes=asides(outcome),
        heads=HEADS,
        cameras=cameras,
        relative=relative,
        stand=(transform_rows(rig.stand_from_board, first_camera.stand_covariance), matrix_text(rig.stand_from_board)),
        table_of_cameras=_camera_cells(outcome),
        held=_held_out_cells(outcome) if outcome.held_out else [],
        splits=_splits_text(outcome),
        sigmas=_shared_sigmas(outcome),
        scale=scale_text(outcome.cameras[0], first_camera.sigma_scale) if first_camera.sigma_scale is not None else "",
        good=GOOD,
        bad=BAD,
        left_out=outcome.left_out(),
        **verdict_parts(rig_judged(outcome)),
    )


def _tiles(outcome: RigOutcome) -> list[tuple[str, str, str]]:
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
