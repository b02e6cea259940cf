"""Tables of an uncertainty budget, which its report and its certificate share."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from stcal.io.files import RUN_MARKER
from stcal.report.document import Block, Table, page_only, subheading
from stcal.report.text import NONE, number, significant
from stcal.sfm.budget.budget_file import BudgetFile, LengthTest, SourceRow
from stcal.sfm.budget.combine import Uncertainty

WHAT_U_IS = (
    "The expanded uncertainty U is the combined standard uncertainty multiplied by the coverage factor k = {k}, "
    "which {why} gives a coverage probability of about 95 % (JCGM 100:2008, GUM). U of x, of y or of z is of that "
    "axis alone"
)
TOGETHER = (
    "; U of a position or rotation as a whole is k times the root of the three variances together, with the coverage "
    "that the tables of contributions say"
)
METHOD = (
    "σ₀ of the final adjustment is {file.sigma0:.3f} (1 if it was smaller) with {file.redundancy} degrees of freedom; "
    "it multiplies all σ. The covariance of each kind of observation goes through the adjustment's inverse to the "
    "circles and to the frames of the faces (JCGM 100, 5.1.2); coverage is by 100 000 draws (JCGM 101). Not in it: "
    "radii of circles and dots, and a shift of centres that all views share"
)
DECISION_RULE = (
    "The error is the measured less the reference length (length measurement error of VDI/VDE 2634 part 1); U is that "
    "of both, E_n the error over it (ISO 13528). Decision rule: the lengths agree if the largest |E_n| is at most "
    "{test.limit:.2f}, which {count} exceed by chance in one of 22 tests"
)
MANY = 1e4  # degrees of freedom that are as good as infinitely many
EXACT_UM = 1e-6
"""σ below which a value is exact by definition, as that of the frame's own origin is up to rounding, µm or mdeg."""
NEGLIGIBLE = 1e-4  # share of u below which a contribution has no sensitivity in the tables


def method(file: BudgetFile) -> str:
    return METHOD.format(file=file)


def what_u_is(file: BudgetFile) -> str:
    """Returns the sentence on U and k, which are of Student's distribution where few photographs count."""
    of_faces = [u for face in file.faces.values() for u in (face.position_um, face.rotation_mdeg) if u is not None]
    others = [*(each.angle_mdeg for each in file.angles), *(each.distance_um for each in file.distances)]
    factors = [each.coverage_factor for each in (*of_faces, *others, *file.circles.values())]
    if not factors:
        return ""
    ends = [f"{end(factors):.2f}" for end in (min, max)]
    normal = ends[1] == f"{file.coverage_factor:.2f}"
    why = "for a normal distribution" if normal else "for Student's distribution with the effective degrees of freedom"
    return WHAT_U_IS.format(k=" to ".join(dict.fromkeys(ends)), why=why) + TOGETHER


def results(file: BudgetFile) -> list[Block]:
    """Returns the tables of positions, rotations, angles, distances and circles with their U."""
    faces, frame = file.faces, f"In the frame of face {file.reference_face}"
    positions = [
        [face, *with_u(e.position_mm, e.position_um.axes, e.position_um.coverage_factor)]
        for face, e in faces.items()
        if e.position_mm is not None and e.position_um is not None
    ]
    rotations = [
        [face, *with_u(e.rotation_vector_deg, e.rotation_mdeg.axes, e.rotation_mdeg.coverage_factor)]
        for face, e in faces.items()
    ]
    angles = [
        ["–".join(each.faces), as_exact(each.angle_deg, 1e-3 * (u := each.angle_mdeg.expanded)), significant(u)]
        for each in file.angles
    ]
    is_corrected = any(own.corrected_mm != own.length_mm for own in file.distances)
    corrected, lengths = ["corrected for what is stated, mm"] * is_corrected, []
    for own in file.distances:
        u, values = own.distance_um.expanded, (own.length_mm, own.corrected_mm)[: 1 + len(corrected)]
        lengths.append(["–".join(own.circles), *(as_exact(v, 1e-3 * u) for v in values), significant(u)])
    circles = [
        [label, *with_u(e.position_mm, e.position_xyz_um, e.coverage_factor)] for label, e in file.circles.items()
    ]
    return [
        frame if faces else None,
        Table(heads("position of face", "mm", "µm"), positions),
        Table(heads("rotation vector of face", "°", "mdeg"), rotations),
        Table(["<angle of faces", "°", "U, mdeg"], angles),
        Table(["<distance of", "as calibrated, mm", *corrected, "U, µm"], lengths),
        Table(heads("circle", "mm", "µm"), circles),
    ]


def inputs(file: BudgetFile, words: bool = False) -> Table:
    """Returns the table of the sources and whether their σ are stated; with ``words`` also where."""
    rows = []
    for each in file.sources:
        sigma = NONE if each.sigma is None else f"{float(f'{each.sigma:.3g}'):g} {each.unit}"
        rows.append([each.title, sigma, each.evaluation, each.origin, *([each.words] if words else ())])
    return Table(["<input", "standard uncertainty", "<type", "<σ is", *(["<from"] if words else ())], rows, css="text")


def contributions(file: BudgetFile) -> list[Block]:
    """Returns the table of contributions of each kind of measurands."""
    faces = file.faces
    positions = {f"face {face}": u for face, each in faces.items() if (u := each.position_um)}
    rotations = {f"face {face}": each.rotation_mdeg for face, each in faces.items()}
    distances = {"–".join(each.circles): each.distance_um for each in file.distances}
    kinds = (
        ("positions of faces, x, y, z together", "µm", positions),
        ("rotations of faces, x, y, z together", "mdeg", rotations),
        ("longest distances", "µm", distances),
    )
    return [
        Table(
            [f"<{title}, {unit}", f"sensitivity, {next(iter(columns))}", *columns],
            [
                *(_source_row(source, unit, columns) for source in file.sources),
                ["combined standard uncertainty u", "", *(number(u.standard, 2) for u in columns.values())],
                ["effective degrees of freedom", "",
                 *(f"{u.degrees_of_freedom:.0f}" if (u.degrees_of_freedom or MANY) < MANY else "∞"
                   for u in columns.values())],
                ["coverage factor k", "", *(f"{u.coverage_factor:.2f}" for u in columns.values())],
                ["expanded uncertainty U", "", *(significant(u.expanded) for u in columns.values())],
                ["coverage of U, simulated, %", "", *(number(100 * u.coverage, 1) for u in columns.values())],
            ],
        )
        for title, unit, columns in kinds
        if columns
    ]  # fmt: skip


def _source_row(source: SourceRow, unit: str, columns: Mapping[str, Uncertainty]) -> list[str]:
    """Returns the contributions of an input, with the sensitivity of the first measurand."""
    own = [u.contributions[source.key] for u in columns.values()]
    first, slope = next(iter(columns.values())), NONE
    if source.sigma and first.standard and own[0] / first.standard > NEGLIGIBLE:
        slope = f"{own[0] / source.sigma:.3g} {unit}/{source.unit}"
    return [source.title, slope, *(NONE if source.origin == "not stated" else number(part, 2) for part in own)]


def length_test(test: LengthTest) -> list[Block]:
    """Returns the verdict of a length test, its decision rule, and its lengths."""
    rows = [
        ["–".join(own.circles), number(own.measured_mm, 4), number(own.reference_mm, 4), number(own.error_um, 2),
         significant(own.expanded_um), number(own.e_n, 2)]
        for own in test.lengths
    ]  # fmt: skip
    count = f"{len(rows)} lengths that agree" if len(rows) > 1 else "a length that agrees"
    against = f"against {Path(test.reference).name}"
    return [
        subheading(f"A{against[1:]}"),
        f"length test {against}: {test.verdict}",
        page_only(DECISION_RULE.format(test=test, count=count)),
        Table(["<length", "measured, mm", "reference, mm", "error, µm", "U, µm", "E_n"], rows),
    ]


def hashes(file: BudgetFile) -> Table:
    """Returns the hashes of the run's files and of its photographs."""
    rows = [
        ["folder of the run", Path(file.run.folder).name],
        ["folder of the photographs", Path(file.run.images).name],
        [f"SHA-256 of {RUN_MARKER}, which has those of all files", file.run.sha256],
        ["SHA-256 of the result file", file.run.faces_sha256],
        ["run made by", f"stcal {file.run.version}"],
        ["budget made by", f"stcal {file.version}"],
    ]
    return facts(rows)


def facts(rows: Sequence[Sequence[str]]) -> Table:
    """Returns a table of names and values."""
    return Table(["<Of", "<"], rows, css="text facts")


def as_exact(value: float, expanded: float) -> str:
    """Returns a value to the last digit of its expanded uncertainty with two digits (JCGM 100, 7.2.6), at most six."""
    stated = significant(expanded)
    return number(value, min(len(stated.partition(".")[2]), 6) if float(stated) else 4)


def with_u(values: Sequence[float], sigma: Sequence[float], k: float) -> list[str]:
    """Returns x, y, z and U of each; ``sigma`` : in a thousandth of the unit."""
    expanded = [k * v if v > EXACT_UM else 0.0 for v in sigma]
    return [*(as_exact(v, 1e-3 * u) for v, u in zip(values, expanded, strict=True)), *map(significant, expanded)]


def heads(of: str, unit: str, unit_of_u: str) -> list[str]:
    """Returns the heads of a table of vectors and of their expanded uncertainties."""
    return [f"<{of}", *(f"{axis}, {unit}" for axis in "xyz"), *(f"U of {axis}, {unit_of_u}" for axis in "xyz")]
