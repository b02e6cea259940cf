"""The report of a registration, page and pictures, and its result file: the keys are those of the result."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator
from pydantic import Field as Key

from stcal.geometry.arrays import rms
from stcal.geometry.rigid import Affine, Rigid, Similarity
from stcal.io.json import Finite, Matrix, Matrix4, Named, Points, ResultFile, Rows, Vector3
from stcal.parallel import one_thread
from stcal.register.registered import Alternative, ErrorFigures, HeldOutPoints
from stcal.register.registration import Liu2017Options, orthogonal_samples
from stcal.register.workspace import Cubes, Field, Findings
from stcal.report.document import Answer, Block, Document, Section, Table, alarms, legend, page_only, plot
from stcal.report.svg import COLOURS, Axes, Drawing, round_below
from stcal.report.text import NONE, number

FEW_ROWS = 24
"""Largest number of rows that are all listed. Of more, only the outliers and some inliers are."""
WORST = 5  # number of inliers that are then listed, those with the largest residuals


def registration_report(found: Findings, more: Sequence[Section] = ()) -> Document:
    """Returns the report of ``register``. ``more`` : sections to insert before the rows."""
    count, outliers = len(found), len(found.outliers)
    cut = "" if found.threshold_mm is None else f", threshold {found.threshold_mm:.4g} mm"
    groups = f"{count - outliers} inliers, {outliers} outliers"
    about = f"{found.pairs}: {count} point pairs, {found.model}, {found.method}{cut}: {groups}"
    errors, held = [("residuals of the inliers", found.inlier_errors)], found.held_out
    if held is not None:
        errors.append((f"held out ({held.folds} folds), inliers", held.of_inliers))
        if held.of_inliers.points < held.of_all.points:
            errors.append((f"held out ({held.folds} folds), all", held.of_all))
    answer = [
        page_only(alarms(found.notes[1:])),
        matrix_table("b_from_a", found.b_from_a.matrix()),
        *_sigma_lines(found),
        error_table("lengths of errors, mm", errors),
    ]
    space = [
        legend({"inlier": COLOURS[0], **({"outlier": COLOURS[1]} if outliers else {})}),
        plot(
            lambda: space_figure(found),
            "residuals in three views",
            "Points in frame b and their residuals b − b_from_a a, enlarged; arrows of far outliers are cut",
        ),
    ]
    return Document(
        "Registration",
        about,
        [
            Section("Result", answer, terminal=True),
            Section("Residuals in space", space),
            Section("Where it holds", _where_it_holds(found), terminal=True),
            *more,
            Section("Rows", ["" if outliers else "no outliers", _rows(found)], terminal=True),
        ],
        [_verdict(found)],
    )


def _verdict(found: Findings) -> Answer:
    """Returns whether the transform may be used: with care where another fits as well, or a note or a field says so."""
    held = None if found.held_out is None else found.held_out.of_inliers
    if found.notes:
        doubt = found.notes[0]
    elif found.field is not None and found.field.seen:
        doubt = f"residuals are systematic, {found.field.size_mm:.2g} mm RMS over the workspace"
    elif held is None:
        doubt = "no pairs were held out: nothing but the fit itself shows the errors"
    elif found.method == "least-squares":
        doubt = "least squares takes every pair as right; without --method, wrong ones are found"
    else:
        said = f"inliers that are held out are missed by {held.rms_mm:.3g} mm RMS, {held.max_mm:.3g} at most"
        return Answer("yes", said)
    return Answer("with care", doubt)


def matrix_table(name: str, matrix: np.ndarray) -> Table:
    """Returns a 4×4 matrix: the images of the axes, and the origin."""
    rows = [[axis, *(f"{v:.9f}" for v in row[:3]), f"{row[3]:.4f}"] for axis, row in zip("xyz ", matrix, strict=True)]
    return Table([f"<{name}", "x axis", "y axis", "z axis", "origin, mm"], rows)


def error_table(head: str, errors: Sequence[tuple[str, ErrorFigures]]) -> Table:
    """Returns a row of figures for each name."""
    rows = [[name, str(e.points), *(number(v, 4) for v in (e.mean_mm, e.rms_mm, e.max_mm))] for name, e in errors]
    return Table([f"<{head}", "points", "mean", "RMS", "max"], rows)


def _sigma_lines(found: Findings) -> list[str]:
    """Returns lines on σ of the transform, and on its scale or shear."""
    sigma = np.sqrt(np.diag(found.covariance))

    def three(values: np.ndarray) -> str:
        return ", ".join(f"{v:.3g}" for v in values)

    if isinstance(found.b_from_a, Affine):
        lines = [f"scales {' '.join(f'{s:.6f}' for s in found.scales)}: a frame of the same unit has 1 1 1"]
    else:
        lines = [f"σ of its rotation about x, y, z: {three(1e3 * np.degrees(sigma[:3]))} mdeg"]
    if isinstance(found.b_from_a, Similarity):
        lines.append(f"scale {found.b_from_a.scale:.8f} ± {sigma[6] * found.b_from_a.scale:.2g}")
    for place, xyz in (("the middle of the inliers", found.xyz_a[found.inliers].mean(0)), ("a's origin", np.zeros(3))):
        lines.append(f"σ of a transformed point at {place}, along x, y, z: {three(found.sigma_mm_at(xyz))} mm")
    redundancy = f", {found.redundancy:.0f} degrees of freedom" if np.isfinite(found.redundancy) else ""
    factor = "" if found.sigma_factor is None else f", {found.sigma_factor:.2f} of the σ given"
    return [*lines, f"σ of a coordinate {found.sigma_mm:.4g} mm{factor}{redundancy}"]


def _rows(found: Findings) -> Table:
    """Returns the residuals of all rows; of many rows those of outliers, and the largest of inliers."""
    rows, length = np.arange(len(found)), found.length_mm
    if len(found) > FEW_ROWS:
        inliers = np.flatnonzero(found.inliers)
        rows = np.concatenate([inliers[np.argsort(-length[inliers], kind="stable")][:WORST], found.outliers])
    cells = []
    for row in rows.tolist():
        values = (number(float(v), 4) for v in (*found.residuals[row], length[row]))
        cells.append([f"line {found.lines[row]}", "inlier" if found.inliers[row] else "OUTLIER", *values])
    return Table(["<residual, mm", "<", "x", "y", "z", "length"], cells)


UNRELATED = 0.1
"""Ratio of residuals to the spread of the points, both RMS, beyond which the transform explains no measurement: the
coarsest instruments reach a hundredth of their range."""


def _field_sentence(found: Findings, field: Field) -> str:
    """Returns a sentence on whether residuals are more than noise."""
    residuals = found.residuals[found.inliers]
    xyz_b = found.b_from_a @ found.xyz_a[found.inliers] + residuals
    share = float(np.sqrt((residuals**2).sum() / ((xyz_b - xyz_b.mean(0)) ** 2).sum()))
    if share > UNRELATED:
        return (
            f"residuals are {100 * share:.0f} % of the spread of the points, {100 * UNRELATED:.0f} % at most of points "
            "that correspond: the rows are not the same points in both frames, or not in the same order or unit; do "
            "not use this transform"
        )
    if not field.seen:
        noise = f"noise of σ {field.noise_mm:.3g} mm (chance of as much structure: {field.p_value:.2g})"
        return f"no systematic residuals seen: they look like {noise}"
    back = len(field.taken_back)
    taken = f"; {back} of the outliers follow{'s' * (back == 1)} it" if back else ""
    return (
        f"residuals are systematic: {field.size_mm:.3g} mm RMS change smoothly over {field.length_mm:.0f} mm, beside "
        f"noise of σ {field.noise_mm:.3g} mm; a point left out errs by {field.plain.mean_mm:.3g} mm on average, by "
        f"{field.corrected.mean_mm:.3g} mm with this field of the others taken off{taken}; σ of the transform, which "
        "takes residuals as independent, are too small"
    )


def _where_it_holds(found: Findings) -> list[Block]:
    """Returns whether residuals are systematic, and errors in cubes about the middle of the points."""
    field, reach = found.field, found.cubes
    blocks: list[Block] = []
    if field is not None:
        blocks.append(_field_sentence(found, field))

        def figure() -> Drawing:
            places, error = field.grid["xyz_a_mm"], field.grid["error_mm"]
            return _views(found.b_from_a @ places, error, np.ones(len(places), bool))

        if field.seen:
            about = "Systematic error to expect of the transform at places in and around the points, enlarged, frame b"
            blocks.append(plot(figure, "systematic error over the workspace", about))
    if reach is not None:
        middle = " ".join(f"{v:.1f}" for v in reach.middle)
        explained = (
            f"Cubes about ({middle}) mm, along the axes of a. The transform is fitted again to the points in one cube "
            "and tried on those of all; the points that it is fitted to are held out in turn"
        )
        blocks.append(page_only(explained))
        inner = [(side, e.max_mm) for side, e in zip(reach.sides_mm, reach.errors[0], strict=True) if e]
        if reach.errors[0][0] is not None and len(inner) > 1:
            (first, _), *outer = inner
            most = np.maximum.accumulate([error for _, error in inner])
            farther = (f", {error:.3g} mm to {side:g} mm" for (side, _), error in zip(outer, most[1:], strict=True))
            blocks.append(
                f"fitted in the cube of {first:g} mm it holds within {most[0]:.3g} mm there{''.join(farther)}"
            )
        rows = []
        for side, row in zip(reach.sides_mm, reach.errors, strict=True):
            errors = [
                [str(e.points), number(e.mean_mm, 4), number(e.max_mm, 4)] if e else ["0", NONE, NONE] for e in row
            ]
            rows.append([f"{side:g} mm", *chain.from_iterable(errors)])
        sides = [f"{side:g}" for side in reach.sides_mm]
        over = [("", 1), (f"inner {sides[0]} mm:", 3), *((f"{a} … {b} mm:", 3) for a, b in pairwise(sides))]
        blocks.append(Table(["<fitted in the cube of", *["points", "mean", "max"] * len(rows)], rows, over))
    return blocks or [page_only("Too few points to tell")]


VIEWS = ((0, 1), (0, 2), (1, 2))  # horizontal and vertical axis of each view
MOST_ARROWS = 1500
ARROW_SHARE, FEW = 0.12, 80
"""Length of the inliers' RMS residual as a share of the picture's side; number of points above which it shrinks."""


def space_figure(found: Findings) -> Drawing:
    """Returns three views of the points in frame b with their residuals, enlarged; of many points, a selection."""
    rows = np.arange(len(found))
    if len(rows) > MOST_ARROWS:
        bad, good = found.outliers[: MOST_ARROWS // 3], np.flatnonzero(found.inliers)
        rows = np.concatenate([good[np.linspace(0, len(good) - 1, MOST_ARROWS - len(bad)).astype(int)], bad])
    return _views(found.b_from_a @ found.xyz_a[rows], found.residuals[rows], found.inliers[rows])


def _views(place: np.ndarray, error: np.ndarray, inlier: np.ndarray) -> Drawing:
    """Returns three views of places (n, 3) with errors (n, 3) as arrows, mm; those of outliers are cut."""
    side = float(np.ptp(place, axis=0).max()) or 1.0
    crowded = min(1.0, FEW / len(place)) ** (1 / 3)
    length = np.maximum(np.linalg.norm(error, axis=1), 1e-300)
    scale = round_below(ARROW_SHARE * crowded * side / max(rms(length[inlier]), 1e-12))
    longest = np.where(inlier, np.inf, 0.3 * side)  # longer arrows of outliers are cut
    arrow = scale * error * np.minimum(1, longest / (scale * length))[:, None]
    middle = (place.min(0) + place.max(0)) / 2
    reach = np.abs(np.concatenate([place, place + arrow]) - middle).max(0) * 1.06 + 0.01 * side
    drawing = Drawing(10.2, 3.7)
    for box, (i, j) in zip(drawing.panels(3, left=54, top=14, gap=50), VIEWS, strict=True):
        axes = Axes.equal(drawing, box, np.array([middle - reach, middle + reach])[:, [i, j]], 0)
        axes.frame(f"{'xyz'[i]} of b, mm", f"{'xyz'[j]} of b, mm")
        for own, colour in ((inlier, COLOURS[0]), (~inlier, COLOURS[1])):
            axes.arrows(place[own][:, [i, j]], arrow[own][:, [i, j]], 1.1, colour)
            axes.marks(*place[own][:, [i, j]].T, kind="dot", size=2.5, colour=colour)
    drawing.words((drawing.width - 6, 7), f"{scale:,g} times", anchor="end")
    return drawing


@one_thread()
def sample_size_section(xyz_a: np.ndarray, xyz_b: np.ndarray, options: Liu2017Options, seed: int) -> Section:
    """Returns the paper's figure 6 for these points: samples of every even size N from 4 to 40."""
    rows, tries = [], min(options.tries, 200)
    for points in range(4, min(41, len(xyz_a)), 2):
        samples = orthogonal_samples(xyz_a, xyz_b, replace(options, sample=points, tries=tries), seed)
        shares = np.array([(np.delete(error, own) < options.limit_mm).mean() for own, _, error in samples])
        best, median = (100 * shares.max(), 100 * np.median(shares)) if len(shares) else (np.nan, np.nan)
        acceptable = f"{(shares > options.share).sum()} of {tries}"
        rows.append([points, number(best, 1), number(median, 1), len(shares), acceptable])
    told = (
        "Samples of every size, as in figure 6 of Liu et al. (2017): the share of the other points within "
        f"{options.limit_mm:g} mm of what the sample says. A sample is acceptable with more than "
        f"{100 * options.share:g} %; samples whose 3×3 part is not orthogonal are not used"
    )
    heads = ["points", "best (%)", "median (%)", "orthogonal", "acceptable"]
    return Section("Size of the sample", [told, Table(heads, rows)])


FIGURES = "`points`, `mean_mm`, `rms_mm`, `max_mm`"
Marks = Annotated[list[bool], BeforeValidator(lambda marks: np.asarray(marks, bool).tolist())]
Rounded = Annotated[Points, BeforeValidator(lambda values: np.round(values, 9))]
"""Residuals, mm: there may be a million."""
TransformMatrix = Annotated[
    Matrix4, BeforeValidator(lambda given: given.matrix() if isinstance(given, Rigid | Similarity | Affine) else given)
]
OF_ROBOT = Named(
    "b_from_base identified.rank identified.names identified.undetermined identified.weighting.sigma_mm off_mm better "
    "folds rows transform_mm kinematics_mm wild transform kinematics"
)
"""Of base and kinematics, solved in addition to the transform: :class:`stcal.workflows.RegisteredRobot`."""
OF_FIELD = Named("seen p_value length_mm size_mm noise_mm rows taken_back plain corrected sigma_ratio grid")


class RegistrationFile(ResultFile):
    """Result file of ``register``; lengths in mm, angles in rad; rows are those of the file of points, from 0."""

    format: Literal["stcal registration 1"] = Key(description="the file's form and its version")
    pairs: str = Key(description="the file of the points")
    model: str = Key(description="as asked for (`liu2017` is always affine)")
    method: str = Key(description="as asked for")
    b_from_a: TransformMatrix = Key(description="row-major: `xyz_b = b_from_a @ xyz_a`")
    covariance: Matrix = Key(
        description="of a left perturbation in the axes of b (rotation about the origin of a, translation of that "
        "origin, then the relative scale of a similarity), or of the rows of the 3×4 matrix of an affine transform"
    )
    covariance_of: list[str] = Key(description="names of its rows: `rx_rad … z_mm`, `scale`, `m11 … m34_mm`")
    scales: Vector3 = Key(description="ratios of lengths in b to those in a, along three axes")
    sigma_mm: float = Key(description="σ per axis of a residual, estimated")
    redundancy: Finite = Key(description="degrees of freedom of the σ that the covariance rests on (null: given)")
    sigma_factor: float | None = Key(description="by how much residuals exceed the σ given with the data")
    scaled: bool = Key(description="whether the covariance rests on the residuals")
    threshold_mm: float | None = Key(description="inliers are nearer than this; null by least squares")
    inlier_errors: Annotated[ErrorFigures, Named()] = Key(description=f"lengths of the inliers' residuals: {FIGURES}")
    held_out: Annotated[HeldOutPoints, Named()] | None = Key(
        description=f"`folds`; `rows` and `error_mm` of each point tried; {FIGURES} `of_inliers` and `of_all`"
    )
    ambiguous: bool = Key(description="whether `alternative` is about as good")
    alternative: Annotated[Alternative, Named()] | None = Key(
        description="another transform that other points agree on: `b_from_a`, `rows`, `apart_mm` (RMS), `turn_rad`"
    )
    notes: list[str] = Key(description="what to look at")
    seed: int = Key(description="of the random samples")
    samples: int = Key(description="how many were drawn, 0: all there are")
    lines: Rows = Key(description="for each row of the file its line")
    inliers: Marks = Key(description="whether it is an inlier")
    residuals: Rounded = Key(description="b − b_from_a a, frame b")
    outliers: Rows = Key(description="rows of the outliers, the farthest first")
    field: Annotated[Field, OF_FIELD] | None = Key(
        description="systematic residuals over the workspace, null with too few points: `seen` (chance below 1 %), "
        "`p_value`; `size_mm` RMS length, `length_mm` over which they change, `noise_mm` σ per axis beside them; "
        "`rows` used (at most 500), `taken_back` rows of outliers that follow the field of the others; "
        f"{FIGURES} of errors of points by the transform, `plain`, and by transform and field, `corrected`, "
        "fitted to the others, and "
        "`sigma_ratio`, RMS of the latter over their σ; `grid`: `xyz_a_mm` in frame a (7³ places over the box of the "
        "points and a quarter beyond), `error_mm` to expect of b − b_from_a a there, frame b, and its `sigma_mm` per "
        "axis"
    )
    cubes: Annotated[Cubes, Named()] | None = Key(
        description="null with too few points: `middle` in a and `sides_mm` of cubes along the axes of a; in row i and "
        f"column j of `errors`: {FIGURES} of the fit in cube i at the points of cube j that are not in cube j − 1; "
        "points that the fit used are held out in turn"
    )
    robot: Annotated[Any, OF_ROBOT] | None = Key(
        None,
        description="with `--robot`: `b_from_base` of the identified robot; `identified`: `rank`, `names`, "
        "`undetermined`, and `weighting` with `sigma_mm`, as of `identify`; `off_mm`: RMS of a off the robot file's "
        "positions after a rigid fit; `better` than the transform, held out; `folds`, `rows`, `transform_mm`, "
        "`kinematics_mm` of each row held out, `wild`: outliers of both; without these, errors of `transform` and "
        f"`kinematics`: {FIGURES}",
    )
