"""Uncertainty budget of a run: sources with the conditions stated for them, and how they combine to expanded
uncertainties of faces and of the target's largest distances."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date, time
from itertools import combinations, combinations_with_replacement, product
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.random import Generator
from pydantic import BeforeValidator, Field
from scipy.linalg import null_space
from scipy.spatial.distance import cdist
from scipy.special import ndtr, stdtrit

from stcal.boards.board_designs import TAG_SIGMA_MM
from stcal.boards.board_file import BoardSizeEntry, SizeEntry
from stcal.design import DOTS_SIGMA_MM, BoardDesign, StatedSize, faces_of_known_shape, known_distances
from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.io.json import Finite, Part
from stcal.io.toml import Strict, load_toml
from stcal.labels import CircleLabel
from stcal.sfm.adjust import uncertainty
from stcal.sfm.adjust.calibration import FLATNESS_MM, rim_covariance_mm2
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.adjust.uncertainty import Contributions, Derivatives, contributions_of, derivatives
from stcal.sfm.data.group_model import MetricModel, rows_by
from stcal.sfm.mapping.incremental import widest_angle_rad
from stcal.sfm.runs.saved import SavedRun, adjusted_run

FIELDS = {
    "number": "certificate number",
    "laboratory": "laboratory",
    "address": "its address",
    "place": "place of calibration",
    "customer": "customer",
    "item": "item",
    "maker": "maker",
    "type": "type",
    "serial": "serial number",
    "condition": "condition of the item",
    "method": "method",
    "instrument": "instrument",
    "operator": "performed by",
    "date": "date of calibration",
    "issued": "date of issue",
    "authorised": "authorised by",
    "traceability": "traceability",
}
"""Fields of the head of a budget with their words, in the order of a certificate; empty if they are not given."""
LONGEST_TEXT = 500
DEFAULT = "; the default, which `design` writes too: measure it and state it"  # words for a σ that nobody has changed


Text = Annotated[
    str,
    BeforeValidator(lambda value: str(value) if isinstance(value, date | time) else value),  # as TOML has them
    Field(max_length=LONGEST_TEXT),
]
FieldName = Annotated[str, Field(min_length=1, max_length=60)]


class StatementFile(Strict):
    """The file of ``--statement``."""

    one_thermometer: bool = False
    fields: dict[FieldName, Text] = Field(default_factory=dict)
    board: BoardSizeEntry = BoardSizeEntry()
    target: SizeEntry = SizeEntry()


@dataclass(frozen=True, slots=True)
class Statement:
    board: StatedSize
    target: StatedSize
    origin: dict[tuple[str, str], str]  # the file that states a value, by ``board`` or ``target`` and key
    fields: dict[str, str]  # of the head by name
    one_thermometer: bool = False  # True if the temperatures of both err alike


def statement_of(own: StatedSize, path: str | Path | None = None, given: Mapping[str, str] | None = None) -> Statement:
    """Statement of a run: ``own`` of its ``board.toml``, overridden by the file, whose fields ``given`` overrides."""
    file = load_toml(path, StatementFile, "statement", "give a TOML file") if path else StatementFile()
    sizes: dict[str, StatedSize] = {}
    origin: dict[tuple[str, str], str] = {}
    for body, first, second in (("board", own, file.board.stated()), ("target", StatedSize(), file.target.stated())):
        values = {key: value for key, value in asdict(second).items() if value is not None}
        sizes[body] = replace(first, **values)
        origin |= {(body, key): str(path) if key in values else "board.toml" for key in asdict(first)}
    for name, value in (given or {}).items():
        if not name or len(name) > 60 or len(value) > LONGEST_TEXT:
            fault = f"--field {name[:20]}: {len(f'{name}={value}')} characters"
            raise InputError("E-OPTION-VALUE", f"{fault}; up to 60 for a name, {LONGEST_TEXT} for a value")
    named = file.fields | dict(given or {})
    named |= {name: "" for name in FIELDS if name not in named}
    return Statement(sizes["board"], sizes["target"], origin, named, file.one_thermometer)


def fields_of(given: Sequence[str]) -> dict[str, str]:
    """Parses ``NAME=VALUE`` into a dictionary; an error without ``=``, or for a name given twice."""
    values: dict[str, str] = {}
    for text in given:
        name, sign, value = (word.strip() for word in text.partition("="))
        if not sign or not name:
            raise InputError("E-OPTION-VALUE", f"--field {text!r}: NAME=VALUE needed, such as operator='A. Smith'")
        if name in values:
            raise InputError("E-OPTION-REPEATED", f"--field {name}: given twice; give it once")
        values[name] = value
    return values


Origin = Literal["estimated", "stated", "assumed", "not stated", "not known"]
PPM = 1e-6
REFERENCE_C = 20.0  # reference temperature of ISO 1:2022, used unless another one is stated


@dataclass(frozen=True, slots=True, eq=False)
class BudgetSource:
    """A row of the budget."""

    key: str  # name in files
    title: str  # name in tables
    evaluation: Literal["A", "B"]  # statistics of this run, or other knowledge
    origin: Origin  # where the input's σ comes from, explained in ``words``
    words: str
    sigma: float | None  # in ``unit``, None if it is not one number
    unit: str
    covariance_mm2: np.ndarray  # (3c, 3c) of the circles due to this input alone

    def __post_init__(self):
        freeze(self, "covariance_mm2", (None, None), f"{self.key}: covariance")


def sources_of(
    contributions: Contributions,
    camera: Camera,  # as given to the run, with the covariance that its file states
    board: BoardDesign,
    flatness_mm: float | None,
    refined: bool,  # whether its intrinsics were adjusted
    statement: Statement,
    camera_given: bool = True,  # False if the camera was found from the photographs
) -> tuple[BudgetSource, ...]:
    """Returns all rows of the budget, also for inputs that are not stated, so that the reader sees what is left out."""
    return (
        *_of_adjustment(contributions, board, flatness_mm),
        _intrinsics(contributions, camera, refined, camera_given),
        *(_of_statement(contributions, statement) if board.rows else ()),
    )


def _of_adjustment(found: Contributions, board: BoardDesign, flatness_mm: float | None) -> Iterator[BudgetSource]:
    """Yields the rows of what the adjustment takes as observations, but the intrinsics."""
    joint, factor, sigma_px = found.joint, found.joint.sigma_scale, found.centre_sigma_px
    faces, known = faces_of_known_shape(board), known_distances(board)
    stated: tuple[Origin, str] = "estimated", "residuals; RMS per axis"

    def row(key: str, title: str, kind: str, own: tuple[Origin, str], sigma: float | None, unit="µm") -> BudgetSource:
        evaluation = "A" if own[0] == "estimated" else "B"
        return BudgetSource(key, title, evaluation, *own, sigma, unit, found.covariance_mm2[kind])

    def or_default(words: str, default: bool) -> tuple[Origin, str]:
        return ("assumed", words + DEFAULT) if default else ("stated", words)

    title = "corners and centres of faces" if faces else "centres of circles"
    yield row("circle_centres", title, uncertainty.CIRCLES, stated, sigma_px[uncertainty.CIRCLES], "px")
    if board.rows:
        yield row("dot_centres", "centres of dots", uncertainty.DOTS, stated, sigma_px[uncertainty.DOTS], "px")
        common = f"{100 * joint.board_common:.0f} % of it common to all groups"
        words = f"sigma_mm of board.toml × σ₀ {factor:.3f}; {common if joint.board_common else 'each group its own'}"
        stated = or_default(words, board.sigma_mm == DOTS_SIGMA_MM)
        yield row("board_dots", "places of dots", uncertainty.BOARD, stated, 1e3 * board.sigma_mm * factor)
    if faces:
        own, within = joint.print_factor * factor, max(face.sigma_mm or 0.0 for face in faces)
        words = f"sigma_mm of target.toml × {own:.2f}, in the plane; off it --flatness"
        stated = or_default(words, within == TAG_SIGMA_MM)
        yield row("print", "print of faces", uncertainty.PRINT, stated, 1e3 * within * own)
        largest = max(faces, key=lambda face: face.size_sigma)
        sigma, edges = largest.size_sigma, "a common displacement of the edges of all tags"
        stated = "assumed" if sigma else "not stated", f"no size_sigma_mm; {edges if sigma else 'taken as exact'}"
        if sigma > 0 and largest.edge_share < 1:
            stated = "stated", "size_sigma_mm" + (f", and {edges}" if largest.edge_share else "")
        yield row("print_size", "size of print", uncertainty.SIZES, stated, 1e6 * sigma if sigma else None, "ppm")
    if known and known[0].drawn:
        stated = "not known", "nothing of known size was in view: only the shape is known"
        yield row("distances", "size", uncertainty.DISTANCES, stated, None)
    elif known:
        stated = "stated", f"[[scale]] of target.toml, {len(known)} in all; the largest σ"
        largest_mm = max(each.sigma_mm for each in known)
        yield row("distances", "known distances", uncertainty.DISTANCES, stated, 1e3 * largest_mm * factor)
    if not faces or found.covariance_mm2[uncertainty.FLATNESS].any():
        words, sigma_um = f"--flatness of the run × σ₀ {factor:.3f}", None
        stated = "not stated", "--flatness off: faces need not be flat"
        if flatness_mm is not None:
            is_default, sigma_um = flatness_mm == FLATNESS_MM, 1e3 * flatness_mm * factor
            stated = ("assumed", f"the default of {words}") if is_default else ("stated", words)
        yield row("flatness", "flatness of faces", uncertainty.FLATNESS, stated, sigma_um)


def _intrinsics(contributions: Contributions, camera: Camera, refined: bool, camera_given: bool) -> BudgetSource:
    covariance = contributions.covariance_mm2[uncertainty.INTRINSICS]
    if not camera_given:
        words = "found from these photographs, without a camera file; adjusted with all else"
        return BudgetSource("intrinsics", "intrinsics", "A", "estimated", words, None, "", covariance)
    origin: Origin = "stated" if camera.covariance is not None else "assumed" if refined else "not stated"
    if refined:
        words = f"adjusted; σ before that of {'the camera file' if origin == 'stated' else 'a calibration of some age'}"
    else:
        words = "fixed; σ of the camera file" if origin == "stated" else "fixed; no σ in the camera file"
        effect = contributions.by_intrinsics @ intrinsic_basis(camera.colmap_model)
        covariance = np.zeros_like(covariance) if camera.covariance is None else effect @ camera.covariance @ effect.T
    return BudgetSource("intrinsics", "intrinsics", "B", origin, words, None, "", covariance)


def _of_statement(found: Contributions, statement: Statement) -> Iterator[BudgetSource]:
    """Yields the rows of what the user states; an input of which something is not stated is exact."""

    def row(key: str, title: str, unit: str, absent: Sequence[str], words: str, sigma, effect_ppm) -> BudgetSource:
        covariance = np.outer(PPM * effect_ppm, PPM * effect_ppm)  # of one σ on the circles
        if absent:
            return BudgetSource(key, title, "B", "not stated", f"no {' and '.join(absent)}", None, unit, 0 * covariance)
        return BudgetSource(key, title, "B", "stated", words, sigma, unit, covariance)

    def said(body: str, name: str) -> str:
        return f"{name} of {statement.origin[body, name]}"

    name, sigma, grown = "pitch_sigma_ppm", statement.board.pitch_sigma_ppm, found.joint.xyz_model
    absent, effect = [name] * (sigma is None), (sigma or 0.0) * found.by_scale
    yield row("board_pitch", "board's pitch", "ppm", absent, said("board", name), sigma, effect)
    together: list[tuple[str, StatedSize, np.ndarray]] = []  # with the effect of both temperatures
    for body, stated, by_size in (
        ("board", statement.board, found.by_scale),
        ("target", statement.target, -(grown - grown.mean(0)).ravel()),
    ):
        warmed = (stated.temperature_sigma_k or 0.0) * (stated.expansion_ppm_per_k or 0.0) * by_size
        together.append((body, stated, warmed))
        for key, name, needed, factor, unit in (
            ("temperature", "temperature_sigma_k", "expansion_ppm_per_k", stated.expansion_ppm_per_k, "K"),
            ("expansion", "expansion_sigma_ppm_per_k", "temperature_c", warmer_k(stated), "ppm/K"),
        ):
            if key == "temperature" and statement.one_thermometer:
                continue
            sigma = getattr(stated, name)
            absent = [name] * (sigma is None) + [needed] * (factor is None)
            effect = (sigma or 0.0) * (factor or 0.0) * by_size
            yield row(f"{body}_{key}", f"{body}'s {key}", unit, absent, said(body, name), sigma, effect)
    if statement.one_thermometer:  # an error common to both (JCGM 100, 5.2.2, r = 1), nearly nil if both expand alike
        names = ("temperature_sigma_k", "expansion_ppm_per_k")
        absent = [f"{name} of [{body}]" for body, own, _ in together for name in names if getattr(own, name) is None]
        sigmas = {stated.temperature_sigma_k for _, stated, _ in together}
        words = "temperature_sigma_k of both, one_thermometer: fully correlated"
        title, sigma = "temperature of board and target", sigmas.pop() if len(sigmas) == 1 else None
        yield row("temperature", title, "K", absent, words, sigma, sum(effect for *_, effect in together))


def warmer_k(stated: StatedSize) -> float | None:
    """Returns the temperature in the photographs minus the reference temperature, or None if it is not stated."""
    return None if stated.temperature_c is None else stated.temperature_c - reference_temperature_c(stated)


def reference_temperature_c(stated: StatedSize) -> float:
    """Returns the temperature at which the size of a body is to be stated: the given one, or 20 °C."""
    return REFERENCE_C if stated.reference_temperature_c is None else stated.reference_temperature_c


@dataclass(frozen=True, slots=True)
class StatedConditions:
    """The temperature for which lengths and positions hold, and what they are corrected by for that."""

    size_known: bool  # False if nothing of known size was in view
    correction: float  # relative, 0 for none
    temperature_c: float | None  # of the target, None if it is not known
    words: str  # the same as a sentence without its stop


def conditions_of(statement: Statement, board: BoardDesign) -> StatedConditions:
    """Returns the temperature for which lengths hold, and their correction for the expansion of the board and, only
    with it, of the target: that starts from the length at the photographs' temperature. A size stated of the target
    itself holds at its reference temperature (ISO 1), so that no expansion enters."""
    if any(known.drawn for known in known_distances(board)):
        words = "Only the shape is known, as nothing of known size was in view: no length and no position holds in mm"
        return StatedConditions(False, 0.0, None, words)
    target, holds = statement.target, "Lengths and positions hold at"
    wanted, photographed = reference_temperature_c(target), target.temperature_c
    if not board.rows:
        own = "as the sizes stated of the target do (ISO 1); they are its own, so that no expansion enters"
        return StatedConditions(True, 0.0, wanted, f"{holds} {wanted:g} °C, {own}")
    of_board, of_target = _growth(statement.board), _growth(target)
    total = (of_board or 0.0) - (of_target or 0.0 if of_board is not None else 0.0)
    corrected = f", with a correction of {total / PPM:+.1f} ppm for the stated expansion" if total else ""
    if of_board is not None and of_target is not None:
        return StatedConditions(True, total, wanted, f"{holds} {wanted:g} °C{corrected}")
    there = "the temperature" if photographed is None else f"{photographed:g} °C,"
    why = ": expansion and temperature of the target are not both stated"
    if of_board is None:
        unstated = "expansion and temperature of the board are not both stated"
        uncorrected = "without them the target's are not corrected for"
        why = f", as far as the board's grid had the size of its file there: {unstated}, and {uncorrected}"
    words = f"{holds} {there} at which the target was photographed{corrected}{why}"
    return StatedConditions(True, total, photographed, words)


def _growth(stated: StatedSize) -> float | None:
    """Returns the relative expansion of a body since its reference temperature; None if it is not known."""
    warmer = warmer_k(stated)
    if 0.0 in (warmer, stated.expansion_ppm_per_k):
        return 0.0
    if warmer is None or stated.expansion_ppm_per_k is None:
        return None
    return stated.expansion_ppm_per_k * PPM * warmer


COVERAGE_FACTOR = 2.0  # coverage factor k for infinitely many degrees of freedom
BY_CHANCE = 2 * float(ndtr(-COVERAGE_FACTOR))
"""Probability that an error is beyond U by chance, and that any length of a test is beyond the limit."""
LONGEST_DISTANCES = 5  # number of distances in a budget
DRAWS = 100_000  # number of random draws for the coverage (JCGM 101:2008)
Kind = Literal["position", "rotation", "angle", "distance"]
PARALLEL = 1e-3
"""Sine of an angle between two axes below which both directions across them count, as none of them leads its change."""


def coverage_factor(freedom: float) -> float:
    """Returns k for effective degrees of freedom: Student's, for the coverage 95.45 % (JCGM 100, G.3)."""
    return float(-stdtrit(freedom, BY_CHANCE / 2)) if np.isfinite(freedom) else COVERAGE_FACTOR


def effective_freedom(variance: float, estimated: float, freedom: float) -> float:
    """Returns the effective degrees of freedom of a variance of which the part of type A, ``estimated``, has
    ``freedom`` (Welch–Satterthwaite, JCGM 100, G.4)."""
    return freedom * (variance / estimated) ** 2 if estimated else np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Measurand:
    """A face's position or rotation in the target frame, the angle between the Z axes of two faces, or a distance
    between two circles. The uncertainty of three numbers is the root of the summed variances."""

    kind: Kind
    of: tuple[str, ...]  # the face, two faces, or two circles
    jacobian: np.ndarray  # (r, 3c) by the circles, mm or rad; or (r, 3c + d) as of :class:`Derivatives`
    value: float = 0.0  # of an angle, rad, or a distance, mm

    def __post_init__(self):
        freeze(self, "jacobian", (None, None), f"{self.name}: jacobian")

    @property
    def name(self) -> str:
        return " – ".join(self.of)

    @property
    def unit(self) -> float:
        """Factor from mm to µm, or from rad to mdeg."""
        return 1e3 if self.kind in ("position", "distance") else 1e3 * float(np.degrees(1.0))

    def covariance(self, source: BudgetSource) -> np.ndarray:
        """Covariance (r, r) from one source, of circles, or of these and of those placed by the design."""
        n = min(len(source.covariance_mm2), self.jacobian.shape[1])
        return self.jacobian[:, :n] @ source.covariance_mm2[:n, :n] @ self.jacobian[:, :n].T


class Uncertainty(Part):
    axes: list[float] = Field(description="combined standard uncertainties of x, y, z, or of the length")
    contributions: dict[str, float] = Field(description="to `standard`, by key of the source")
    standard: float = Field(description="combined standard uncertainty of all of them together")
    coverage_factor: float = Field(2.0, description="k, by the effective degrees of freedom")
    expanded: float = Field(description="expanded uncertainty, k times `standard`")
    coverage: float = Field(description="of `expanded`, by simulation")
    degrees_of_freedom: Finite = Field(description="effective ones, null for infinitely many")

    @classmethod
    def of(cls, measurand: Measurand, sources: Sequence[BudgetSource], freedom: int, rng: Generator) -> Self:
        """Returns the uncertainty in the unit of the measurand."""
        parts = {source.key: measurand.unit**2 * measurand.covariance(source) for source in sources}
        covariance = np.sum(list(parts.values()), axis=0)
        variance = float(np.trace(covariance))
        estimated = sum(float(np.trace(parts[source.key])) for source in sources if source.evaluation == "A")
        standard, effective = float(np.sqrt(variance)), effective_freedom(variance, estimated, freedom)
        k = coverage_factor(effective)
        values, vectors = np.linalg.eigh(covariance)
        errors = rng.standard_normal((DRAWS, len(values))) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        # The estimated variance scatters about the true one.
        drawn = np.sqrt(rng.chisquare(effective, DRAWS) / effective) if np.isfinite(effective) else 1.0
        return cls(
            axes=np.sqrt(np.diag(covariance)).tolist(),
            contributions={key: float(np.sqrt(max(np.trace(part), 0.0))) for key, part in parts.items()},
            standard=standard,
            coverage_factor=k,
            expanded=k * standard,
            coverage=float((np.linalg.norm(errors, axis=1) <= k * standard * drawn).mean()),
            degrees_of_freedom=effective,
        )

    def share(self, key: str) -> float:
        return (self.contributions[key] / self.standard) ** 2 if self.standard else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class GroupViews:
    """Number of photographs of a group, and the largest angle between two of their axes."""

    group: str
    images: int
    spread_deg: float

    @classmethod
    def of(cls, model: MetricModel) -> "GroupViews":
        spread_rad = widest_angle_rad(np.array([pose.rotation[2] for pose in model.camera_from_model]))
        return cls(model.group, len(model.images), float(np.degrees(spread_rad)))


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """The uncertainty budget of a run."""

    joint: JointResult
    reference_face: str
    sources: tuple[BudgetSource, ...]
    rows: tuple[tuple[Measurand, Uncertainty], ...]
    circles_covariance_mm2: np.ndarray  # (c, 3, 3) by circle of ``joint``, target frame
    circles_freedom: np.ndarray  # (c,) effective degrees of freedom of the circles
    freedom: int  # degrees of freedom of what this run estimates
    views: tuple[GroupViews, ...]
    statement: Statement
    conditions: StatedConditions  # for which lengths hold; their correction is not applied to the run's result


def budget_of_run(run: SavedRun, statement: Statement | None = None) -> Budget:
    """Returns the budget of a run that was solved jointly; without a statement, with what ``board.toml`` states."""
    if run.faces.solve != "joint" or not run.faces.eccentricity:
        fault = f"run {run.folder}: solved by {run.faces.solve}, which states no covariance"
        raise InputError("E-BUDGET-NO-COVARIANCE", f"{fault}; run again with --solve joint")
    (state, start), board, options = adjusted_run(run), run.board_design, run.options
    found = contributions_of(state)
    own = derivatives(found.joint, start, run.target_design, run.faces.frame)
    stated, camera_given = statement or statement_of(board.stated), run.report["summary"].get("camera_given", True)
    sources = sources_of(found, run.camera, board, options.flatness_mm, options.refine_camera, stated, camera_given)
    heights, sigma_mm = run.rims_mm()
    if heights:
        row = ("estimated", "from radii by tilt, --rim") if sigma_mm else ("not stated", "rim_mm of target.toml")
        covariance = rim_covariance_mm2(found.joint, own.target_from_face, heights, sigma_mm)
        rims = BudgetSource("rims", "rims before the circles", "A", *row, 1e3 * sigma_mm or None, "µm", covariance)
        sources = (*sources, rims)
    return budget(found.joint, own, sources, board, stated, run.faces.reference_face)


def budget(
    joint: JointResult,
    own: Derivatives,
    sources: tuple[BudgetSource, ...],
    board: BoardDesign,
    statement: Statement,
    reference_face: str,
) -> Budget:
    """Returns the budget of an adjustment by its sources."""
    rng = np.random.default_rng(0)
    # Where photographs differ more than their pixels explain, it is they that are counted.
    freedom = max(joint.redundancy if joint.differ <= 1 else sum(len(model.images) for model in joint.models), 1)
    views = tuple(GroupViews.of(model) for model in joint.models)
    circles, estimated = (
        own.circle_covariance(np.sum([each.covariance_mm2 for each in sources if each.evaluation in kinds], axis=0))
        for kinds in ("AB", "A")
    )
    traces = (np.trace(covariances, axis1=1, axis2=2).tolist() for covariances in (circles, estimated))
    freedoms = np.array([effective_freedom(whole, part, freedom) for whole, part in zip(*traces, strict=True)])
    conditions = conditions_of(statement, board)
    if own.design_sigma_mm:
        words = "not mapped; their places are those of the design, with errors as large as those of the mapped ones"
        told = "placed_circles", "frame circles placed", "A", "estimated", words, 1e3 * own.design_sigma_mm, "µm"
        sources += (BudgetSource(*told, own.whole(np.zeros_like(joint.covariance_mm2))),)
    rows = tuple((each, Uncertainty.of(each, sources, freedom, rng)) for each in measurands(joint, own, reference_face))
    return Budget(joint, reference_face, sources, rows, circles, freedoms, freedom, views, statement, conditions)


def measurands(joint: JointResult, own: Derivatives, reference_face: str) -> list[Measurand]:
    """Returns positions and rotations of all faces except the reference face, angles, and the longest distances."""
    other_faces = [face for face in own.target_from_face if face != reference_face]
    rows_of: dict[Kind, slice] = {"position": slice(3, 6), "rotation": slice(0, 3)}
    poses = [
        Measurand(kind, (face,), own.faces[face][rows]) for (kind, rows), face in product(rows_of.items(), other_faces)
    ]
    angles = [_angle(own, a, b) for a, b in combinations(own.target_from_face, 2)]
    longest = longest_of(joint.labels, joint.xyz_model)[:LONGEST_DISTANCES]
    return [*poses, *angles, *(distance(joint, a, b) for a, b in longest)]


def _angle(own: Derivatives, a: str, b: str) -> Measurand:
    """Returns the measurand of the angle between two faces' Z axes: it grows by rotations about their common normal."""
    first, second = (own.target_from_face[face].rotation[:, 2] for face in (a, b))
    about = np.cross(first, second)[None]
    about = about / np.linalg.norm(about) if np.linalg.norm(about) > PARALLEL else null_space(first[None]).T
    jacobian = about @ (own.faces[b][:3] - own.faces[a][:3])
    value = float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))
    return Measurand("angle", (a, b), jacobian, value)


def longest_of(labels: Sequence[CircleLabel], xyz: np.ndarray) -> list[tuple[int, int]]:
    """Returns, for every two faces and within each, the two circles farthest apart, the longest distance first."""
    faces = {face: rows.tolist() for face, rows in rows_by(label.face for label in labels).items()}
    apart, pairs = cdist(xyz, xyz), []
    for a, b in combinations_with_replacement(faces, 2):
        ends = combinations(faces[a], 2) if a == b else product(faces[a], faces[b])
        pairs += sorted(ends, key=lambda pair: -apart[pair])[:1]
    return sorted(pairs, key=lambda pair: -apart[pair])


def distance(joint: JointResult, i: int, j: int) -> Measurand:
    difference = joint.xyz_model[j] - joint.xyz_model[i]
    length = float(np.linalg.norm(difference))
    jacobian = np.zeros(joint.xyz_model.shape)
    jacobian[j], jacobian[i] = difference / length, -difference / length
    ends = joint.labels[i], joint.labels[j]
    return Measurand("distance", ends, jacobian.reshape(1, -1), length)
