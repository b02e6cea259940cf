"""The page and the sentences of the whole."""

import numpy as np

from stcal.report.figure import COLOURS, calm, new_figure, uri
from stcal.report.page import render
from stcal.report.text import number
from stcal.robot.use.compensation import (
    compensated_summary,
)
from stcal.sfm.measurement.output import summary
from stcal.workflows.from_photos.result import DRAWING, FromPhotos

PAGES = {
    "poses.html": "Poses of the target in the photographs",
    "axes.html": "Axes by the axis method",
    "identified.html": "Identification of the arm",
    "compensated.html": "Joint values for the targets",
}
MOST_NOTES, MOST_TARGETS = 20, 20


def story(result: FromPhotos) -> list[str]:
    """What was done and found, a sentence a step."""
    identified, least = result.identified, list(result.errors.values())[-1]
    said = [*summary(result.measured), f"{len(result.data)} poses have joint values"]
    if result.axes is None:
        said.append(f"the axis method was left out: {result.without_axes}")
    else:
        spans = [
            f"{np.degrees(fit.span):.0f}°" if len(fit.gain) != 2 else f"{fit.span:.0f} mm" for fit in result.axes.fits
        ]
        said.append(f"every joint is swept by itself, over {', '.join(spans)}: axis method")
    said.append(
        f"identified: {identified.rank} parameters; position errors {result.errors[DRAWING].rms:.3g} mm RMS as drawn, "
        f"{least.rms:.3g} mm {'of rows held out' if identified.held_out else 'of the same rows'}"
    )
    if result.compensated is not None:
        said += [line[0].lower() + line[1:] for line in compensated_summary(result.compensated)]
        said += _at_targets(result)
    return said


def _at_targets(result: FromPhotos) -> list[str]:
    """What the identified arm is expected to err by there, and how far the joints move."""
    said, sigma, moves = [], result.sigma_mm(), result.moves()
    known, moved = sigma[np.isfinite(sigma)], moves[np.isfinite(moves).all(axis=1)]
    here = result.identified.predicted
    if len(known) and here is not None:
        said.append(
            f"predicted σ of the tool's position there: {known.min():.2g} to {known.max():.2g} mm; at the measured "
            f"rows {np.sqrt((here.here_mm**2).mean()):.2g} mm RMS"
        )
    if len(moved):
        most = _shown(result, np.abs(moved).max(axis=0))
        each = [f"{number(v, 4)}{unit}" for v, unit in zip(most, _units(result), strict=True)]
        said.append(f"joints move by up to {', '.join(each)}")
    return said


def _units(result: FromPhotos) -> list[str]:
    """Of each joint's values, as shown."""
    return [" mm" if sliding else "°" for sliding in result.nominal.prismatic]


def _shown(result: FromPhotos, values: np.ndarray) -> np.ndarray:
    """Joint values (…, n) in those."""
    return np.where(result.nominal.prismatic, values, np.degrees(values))


def from_photos_page(result: FromPhotos, names: tuple[str, ...]) -> str:
    """The report: the story, errors of each model of the arm, and where the rest is; ``names`` : of the other files."""
    found, last = result.compensated, list(result.errors.values())[-1]
    before = None if found is None or not found.compared().any() else found.before_mm[found.compared()]
    tiles = [
        (str(len(result.data)), "", "poses measured, with joint values"),
        (number(result.errors[DRAWING].rms, 3), "mm RMS", "position error of the arm as drawn"),
        (number(last.rms, 3), "mm RMS", list(result.errors)[-1]),
    ]
    if before is not None:
        tiles.append(
            (number(float(np.sqrt((before**2).mean())), 3), "mm RMS", "taken away at the targets, base included")
        )
    notes = [
        *result.notes,
        *(f"{each.name}: {each.reason}" for each in result.measured.left_out),
        *result.identified.notes,
        *([] if found is None else found.notes()),
    ]
    return render(
        "workflows/from_photos/page.html.jinja",
        robot=result.nominal.name,
        images=result.images,
        figures=tiles,
        story=story(result),
        errors=[
            [name, str(each.rows), *(number(v, 4) for v in (each.mean, each.rms, each.p95, each.max))]
            for name, each in result.errors.items()
        ],
        drawn=uri(_figure(result)),
        heads=[f"J{i}, {unit.strip()}" for i, unit in enumerate(_units(result), 1)],
        targets=_target_rows(result),
        more_targets=0 if found is None else max(len(found) - MOST_TARGETS, 0),
        pages=[(name, PAGES[name]) for name in names if name in PAGES],
        files=[name for name in names if not name.endswith(".html")],
        notes=notes[:MOST_NOTES],
        more=max(len(notes) - MOST_NOTES, 0),
    )


def _target_rows(result: FromPhotos) -> list[list[str]]:
    """Of each target what its nominal joint values err by, the predicted σ, and by how much the joints move."""
    found = result.compensated
    if found is None:
        return []
    moves, sigma = _shown(result, result.moves()), result.sigma_mm()
    return [
        [
            str(found.targets.lines[i]),
            found.found.status[i],
            *(number(float(v), 4) for v in (found.before_mm[i], sigma[i], *moves[i])),
        ]
        for i in range(min(MOST_TARGETS, len(found)))
    ]


def _figure(result: FromPhotos):
    """Mean, RMS and largest error of each model, on a scale of powers of ten."""
    figure = new_figure(8, 0.5 * len(result.errors) + 0.9)
    axes = figure.add_subplot()
    for place, each in enumerate(result.errors.values()):
        axes.plot([each.median, each.max], [place, place], color=COLOURS[0], lw=1.2)
        axes.plot([each.rms], [place], "o", color=COLOURS[0], ms=6, label="RMS" if not place else None)
        axes.plot([each.max], [place], "|", color=COLOURS[1], ms=10, mew=2, label="largest" if not place else None)
    axes.set_yticks(range(len(result.errors)), list(result.errors), fontsize=8)
    axes.set_ylim(len(result.errors) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlabel("position error of a row, mm", fontsize=8)
    axes.legend(fontsize=7.5, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
    calm(axes)
    figure.subplots_adjust(left=0.3, right=0.97, bottom=0.5 / (0.5 * len(result.errors) + 0.9), top=0.86)
    return figure
