"""Figures of residuals, by joint and in space."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stcal.geometry.rigid import Poses, Rigid
from stcal.report.document import Html, plot
from stcal.report.svg import COLOURS, INK, SMALL, Axes, Drawing, limits, round_below
from stcal.robot.identification.adjustment import Observed, State, as_seen, tips_of
from stcal.robot.identification.unexplained import Finding
from stcal.robot.kinematics.forward import joint_motions

ARROW_SHARE, LONGEST_SHARE = 0.12, 0.3
"""Lengths of a typical residual and of the longest one drawn, as shares of the picture's side."""
FEW_ARROWS = 60
"""Number of arrows beyond which they are drawn shorter and thinner."""
LEAST_MOTION = 1e-6
"""Share of the largest motion of the tool below which a joint counts as not moving it."""
FEW = 200
"""Number of rows beyond which points are drawn small."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Residuals for a figure. ``residuals`` : (r, 6), (r, 3) or (r, 1) measured minus modelled, rad and mm in the
    world's axes, of the observations ``seen`` by ``state``; ``good`` : (r,) mask of the rows that are not errors."""

    state: State
    world_from_base: Rigid
    seen: Observed
    residuals: np.ndarray
    good: np.ndarray
    colour: str = COLOURS[0]

    def tips(self) -> Poses:
        """Returns world_from_tool of the rows of the file."""
        return tips_of(self.state, self.seen.data)


def joints_figure(shown: Drawn, findings: Iterable[Finding]):
    """Returns a figure of good rows' residuals along each joint's motion by its value, with the findings' curves."""
    observations, chain, tip = shown.seen, shown.state.chain, shown.tips()
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


def residual_plots(shown: Drawn, findings: Iterable[Finding]) -> list[Html | None]:
    """Returns the figures of residuals by joint and, of positions, in space."""
    caption = "Residual along each joint's own motion, by the joint's value; a curve where residuals go with its angle"
    in_space = "Residuals (measured minus modelled), exaggerated, from above and from the side; bar: their scale"
    if not shown.good.all():
        in_space += f"; in the other colour: {(~shown.good).sum()} that are not fitted"
    return [
        plot(lambda: joints_figure(shown, findings), "Residuals by joint", caption),
        None if shown.seen.kind == "distance" else plot(lambda: space_figure(shown), "Residuals in space", in_space),
    ]


def space_figure(shown: Drawn):
    """Returns a figure of the residuals of positions from above and from the side, exaggerated, with a scale bar."""
    good, colour, base_from_world = shown.good, shown.colour, shown.world_from_base.inverse()
    place = base_from_world @ shown.tips().translation
    errors = shown.residuals[:, -3:] @ base_from_world.rotation.T
    length = np.linalg.norm(errors, axis=1)
    side = float(np.ptp(place, axis=0).max()) or 1.0
    crowded = min(1.0, FEW_ARROWS / len(place)) ** (1 / 3)
    scale = round_below(ARROW_SHARE * crowded * side / max(float(np.sqrt((length[good] ** 2).mean())), 1e-12))
    cut = np.minimum(1, LONGEST_SHARE * side / np.maximum(scale * length, 1e-300))
    ends = place + scale * errors * cut[:, None]
    bar = round_below(1.5 * ARROW_SHARE * crowded * side / scale)
    drawing = Drawing(9, 4.4)
    for box, (i, j) in zip(drawing.panels(2, left=54, top=18, gap=54), ((0, 1), (0, 2)), strict=True):
        every = np.concatenate([place, ends])[:, [i, j]]
        low = every.min(0) - 0.08 * side
        axes = Axes.equal(drawing, box, np.vstack([every, low]), 0.04)
        axes.frame(f"{'xyz'[i]} of the base, mm", f"{'xyz'[j]} of the base, mm", "xy")
        for mask, arrow_colour in ((good, colour), (~good, COLOURS[1] if colour != COLOURS[1] else COLOURS[0])):
            start = place[mask][:, [i, j]]
            axes.arrows(start, ends[mask][:, [i, j]] - start, 1.3 * crowded, arrow_colour)
            axes.marks(*start.T, kind="dot", size=2, colour=arrow_colour)
        axes.lines([((low[0], low[0] + scale * bar), (low[1], low[1]))], INK, 2)
        axes.words(low[0], low[1], f"{bar:g} mm", (0, -7), anchor="start")
    cut_off = f"; cut, as they are too long: {(cut < 1).sum()}" if (cut < 1).any() else ""
    drawing.words((drawing.width - 6, 8), f"{scale:g} times{cut_off}", SMALL + 1, "end")
    return drawing
