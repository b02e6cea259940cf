"""Figure of residuals by joint."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stcal.report.document import Html, plot
from stcal.report.svg import COLOURS, INK, Axes, Drawing, limits
from stcal.robot.identification.adjustment import Observed, State, as_seen, tips_of
from stcal.robot.identification.unexplained import Finding
from stcal.robot.kinematics.forward import joint_motions

LEAST_MOTION = 1e-6
"""Share of the largest motion of the tool below which a joint counts as not moving it."""
FEW = 200
"""Number of rows beyond which points are drawn small."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Residuals for a figure: (r, 6), (r, 3) or (r, 1) measured minus modelled, rad and mm in the world's axes, of the
    observations ``seen`` by ``state``; ``good`` : (r,) mask of the rows that are not errors."""

    state: State
    seen: Observed
    residuals: np.ndarray
    good: np.ndarray
    colour: str = COLOURS[0]


def joints_figure(shown: Drawn, findings: Iterable[Finding]):
    """Returns a figure of good rows' residuals along each joint's motion by its value, with the findings' curves."""
    observations, chain, tip = shown.seen, shown.state.chain, tips_of(shown.state, shown.seen.data)
    data = observations.data
    twists = joint_motions(chain, data.q, tip, data.conditions) * chain.carries(data.targets)[:, :, None]
    values, n = data.q @ chain.coupling.T, len(chain)
    errors = shown.residuals[:, -3:]
    across = min(n, 3)
    down = -(-n // across)
    turns_of = {finding.joint: finding.turns for finding in reversed(tuple(findings))}
    points = []
    for i, (twist, sliding) in enumerate(zip(twists, chain.prismatic, strict=True)):
        motion = as_seen(shown.state, observations, tip, twist[:, :, None])[:, -errors.shape[1] :, 0]
        size = np.linalg.norm(motion, axis=1)
        moves = shown.good & (size > LEAST_MOTION * max(size.max(), 1e-300))
        along = np.einsum("rw,rw->r", motion[moves], errors[moves]) / size[moves]
        at = values[observations.first[moves], i] * (1 if sliding else np.degrees(1))
        points.append((at, along, "mm" if sliding else "deg"))
    y = limits(np.concatenate([along for _, along, _ in points]))
    drawing = Drawing(9, 0.35 + 1.75 * down)
    boxes = drawing.panels(across, down, gap=34)
    for i, (box, (at, along, unit)) in enumerate(zip(boxes, points, strict=False)):
        axes = Axes(drawing, box, limits(at), y)
        axes.frame(f"joint {i + 1}, {unit}", "" if i % across else "along its motion, mm")
        axes.level(0, "#9aa0a8")
        axes.marks(at, along, "dot", 3 if len(at) <= FEW else 1.4, shown.colour)
        if turns_of.get(i + 1) and len(at) > 3:
            fitted = np.linalg.lstsq(_wave(at, turns_of[i + 1]), along, rcond=None)[0]
            x = np.linspace(at.min(), at.max(), 100)
            axes.lines([(x, _wave(x, turns_of[i + 1]) @ fitted)], INK, 1.2)
    return drawing


def _wave(degrees: np.ndarray, turns: int) -> np.ndarray:
    """Returns a constant, a cosine and a sine, (m, 3), with ``turns`` periods a turn."""
    angle = turns * np.radians(degrees)
    return np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)


def residual_plot(shown: Drawn, findings: Iterable[Finding]) -> Html:
    """Returns the figure of residuals by joint."""
    caption = "Residual along each joint's own motion, by the joint's value; a curve where residuals go with its angle"
    return plot(lambda: joints_figure(shown, findings), "Residuals by joint", caption)
