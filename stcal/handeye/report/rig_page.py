"""Report of a hand-eye calibration of a rig."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from stcal.handeye.data.pairs import FRAMES
from stcal.handeye.report.outcome import RigOutcome, asides, rig_judged
from stcal.handeye.report.page import (
    EXPLAINED,
    adjusted,
    coverage_blocks,
    findings_fold,
    means_text,
    photograph_blocks,
    pose_blocks,
    remark_blocks,
    scale_text,
    sigma_rows,
    transform_blocks,
    turns_text,
    verdict_blocks,
)
from stcal.handeye.result import HandEye
from stcal.handeye.rig import RigHeldOut
from stcal.report.document import (
    Block,
    Document,
    Html,
    Section,
    Table,
    fold,
    html,
    page_only,
    subheading,
    tiles,
)
from stcal.report.text import NONE, number


def rig_report(outcome: RigOutcome) -> Document:
    """Returns the report of ``handeye rig``."""
    rig, frames, first = outcome.rig, FRAMES[outcome.rig.setup], outcome.rig.cameras[0]
    cameras = [
        block
        for name, camera in zip(rig.names, rig.cameras, strict=True)
        for block in transform_blocks(f"{frames.mount}_from_{name}", camera.mount_from_camera, camera.covariance)
    ]
    relative = [
        block
        for one, two in combinations(rig.names, 2)
        for block in transform_blocks(f"{one}_from_{two}", *rig.relative(one, two))
    ]
    answer: list[Block] = [
        tiles(_rig_tiles(outcome)),
        *cameras,
        *transform_blocks(frames.board, rig.stand_from_board, first.stand_covariance),
        page_only(EXPLAINED),
        Table(["<what errs, and by how much", "σ", "<"], _shared_sigmas(outcome)),
        "" if first.sigma_scale is None else scale_text(outcome.cameras[0], first.sigma_scale),
        "" if first.observability is None else turns_text(first.observability),
        *remark_blocks(asides(outcome), outcome.understood),
        findings_fold(rig_judged(outcome)),
    ]
    alone: list[Block] = [
        _cameras(outcome),
        page_only(
            "σ of a camera's place and turn in their worst directions, by the adjustment of all cameras, and by that "
            "of this camera alone"
        ),
    ]
    if outcome.held_out is not None:
        alone += [
            f"poses of the robot held out ({_rig_splits_text(outcome)}), 3-D at the board, all cameras or each alone",
            _held_out(outcome.rig.names, outcome.held_out),
            page_only(
                "Each time all cameras together, and each by itself, are solved for with the images of the other "
                "poses, and predict where the board is in the images of those held out: the distance from each corner "
                "to the point where the camera's ray to it meets the board as placed by the robot. Gain: by how much "
                "the error is smaller with all cameras together"
            ),
        ]
    told = page_only("From the joint covariance: errors of board and robot that are common to both cameras cancel")
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
        banner=verdict_blocks(rig_judged(outcome)),
    )


def _camera(outcome: RigOutcome, k: int) -> list[Block]:
    """Returns residuals, adjusted parameters, coverage and photographs of a camera of the rig."""
    name, camera, camera_outcome = outcome.rig.names[k], outcome.rig.cameras[k], outcome.cameras[k]
    turn, shift = camera.rms()
    errors = {} if camera_outcome.held_out is None else camera_outcome.held_out.means()
    heads = ["<image", "rotation °", "mm", "x mm", "y mm", "z mm", "corners px", "<"]
    parameters = Table(["<", "value", "± σ", "<unit"], adjusted(camera_outcome) or [])
    caption = f"By how much the chain through each image of {name} misses the board"
    return [
        subheading(name),
        f"residuals (RMS): {np.degrees(turn):.4f}°, {shift:.3f} mm at the board's origin",
        f"held out: {means_text(errors)}" if errors else "",
        *pose_blocks(camera, heads, caption, len(camera_outcome.outliers())),
        fold("Camera, as adjusted (first pixel's centre at 0, 0)", parameters),
        Html(lambda: html(*coverage_blocks(camera_outcome))),
        fold("Photographs with their corners", *photograph_blocks(camera_outcome)),
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


def _cameras(outcome: RigOutcome) -> Table:
    """Returns a row per camera: images, σ of corners, residuals, σ of its pose jointly and alone."""
    heads = ["<camera", "images", "corner σ", "<", "residual °", "residual mm"]
    heads += ["σ place mm", "alone mm", "σ turn °", "alone °"]
    rows = []
    every = zip(outcome.rig.names, outcome.rig.cameras, outcome.cameras, outcome.alone, strict=True)
    for name, camera, camera_outcome, alone in every:
        turn, shift = camera.rms()
        unit = "× its own" if camera_outcome.own_sigmas else "px"
        joint, single = _worst(camera, outcome.widened), _worst(alone)
        cells = [str(int((~camera.outliers).sum())), number(camera.sigma["corner_px"], 3), unit]
        cells += [number(np.degrees(turn), 4), number(shift, 3)]
        rows.append([name, *cells, joint[1], single[1], joint[0], single[0]])
    return Table(heads, rows, css="text")


def _worst(result: HandEye | None, widened: float = 1.0) -> tuple[str, str]:
    """Returns σ of rotation (°) and place (mm) in their worst directions, from the adjustment, before widening."""
    if result is None or result.covariance is None:
        return NONE, NONE
    parts = result.covariance[:3, :3], result.covariance[3:, 3:]
    turn, place = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) / widened for part in parts)
    return number(np.degrees(turn), 4), number(place, 3)


def _held_out(names: Sequence[str], held_out: RigHeldOut) -> Table:
    """Returns a row per camera: errors on held-out poses, of all cameras together and of each alone."""
    rows = []
    for name, held in zip(names, held_out.cameras, strict=True):
        joint, alone, gain = held.means(), held.means("alone"), held.gain()
        columns = [(joint, "board_mm", 1.0, 3), (alone, "board_mm", 1.0, 3)]
        columns += [(joint, "rotation_rad", np.degrees(1.0), 4), (alone, "rotation_rad", np.degrees(1.0), 4)]
        cells = [number(means.get(key, np.nan) * unit, digits) for means, key, unit, digits in columns]
        gain_text = "cannot be found alone" if gain is None else f"{round(100 * gain)} %"
        rows.append([name, str(len(held.view)), *cells[:2], gain_text, *cells[2:]])
    return Table(["<camera", "views", "together mm", "alone mm", "<gain", "together °", "alone °"], rows, css="text")


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
