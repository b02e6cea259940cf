"""Combination of the sources to combined and expanded uncertainties of faces and of the target's largest distances."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.labels import CircleLabel
from stcal.sfm.adjust.calibration import rim_covariance_mm2
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.adjust.uncertainty import Contributions, Derivatives, contributions_of, derivatives
from stcal.sfm.budget.sources import BudgetSource, StatedConditions, Statement, conditions_of, sources_of, statement_of
from stcal.sfm.data.group_model import MetricModel
from stcal.sfm.runs.run_result import SavedRun
from stcal.sfm.runs.saved import adjusted_run

COVERAGE_FACTOR = 2.0
LONGEST = 5
"""Number of distances in a budget."""
DRAWS = 100_000
"""Number of random draws for the coverage (JCGM 101:2008)."""
Kind = Literal["position", "rotation", "distance"]


@dataclass(frozen=True, slots=True, eq=False)
class Measurand:
    """A face's position or rotation in the target frame, or a distance between two circles. The uncertainty of three
    numbers is the root of the summed variances."""

    kind: Kind
    name: str  # the face, or ``a – b``
    circles: tuple[CircleLabel, ...]
    length_mm: float | None  # of a distance, else None
    jacobian: np.ndarray  # (r, 3c) by the circles, mm or rad
    designed: np.ndarray  # (r, d) by the frame circles that were not mapped

    def __post_init__(self):
        freeze(self, "jacobian", (None, None), f"{self.name}: jacobian")
        freeze(self, "designed", (None, None), f"{self.name}: designed")

    def covariance(self, source: BudgetSource, designed_sigma_mm: float) -> np.ndarray:
        """Covariance (r, r) from one source; ``designed_sigma_mm`` matters only for the source of placed circles."""
        if source.key == PLACED:
            return designed_sigma_mm**2 * self.designed @ self.designed.T
        return self.jacobian @ source.covariance_mm2 @ self.jacobian.T


PLACED = "placed_circles"


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """The uncertainty of one measurand, mm or rad."""

    measurand: Measurand
    contributions: dict[str, float]  # by key of the source
    covariance: np.ndarray
    standard: float  # combined standard uncertainty
    expanded: float  # with k = 2
    coverage: float  # simulated, of ``expanded``
    freedom: float  # effective degrees of freedom (Welch–Satterthwaite, JCGM 100 G.4)


@dataclass(frozen=True, slots=True, eq=False)
class GroupViews:
    """Number of photographs of a group, and the largest angle between two of their axes."""

    group: str
    images: int
    spread_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """The uncertainty budget of a run."""

    joint: JointResult
    reference_face: str
    sources: tuple[BudgetSource, ...]
    rows: tuple[Row, ...]
    circles_covariance_mm2: np.ndarray  # (c, 3, 3) by circle of ``joint``, target frame
    views: tuple[GroupViews, ...]
    statement: Statement
    conditions: StatedConditions  # for which lengths hold; their correction is not applied to the run's result

    def of_kind(self, kind: Kind) -> list[Row]:
        """Returns the rows of one kind."""
        return [row for row in self.rows if row.measurand.kind == kind]


def budget_of_run(run: SavedRun, statement: Statement | None = None) -> Budget:
    """Returns the budget of a run that was solved jointly; without a statement, with what ``board.toml`` states."""
    if run.faces.solve != "joint" or not run.faces.eccentricity:
        raise InputError(
            "E-BUDGET-NO-COVARIANCE",
            f"run {run.folder}: solved by {run.faces.solve}, which states no covariance; run again with --solve joint",
        )
    adjusted, board, options = adjusted_run(run), run.board_design, run.options
    found = contributions_of(adjusted.state)
    own = derivatives(found.joint, adjusted.start, run.target_design, run.faces.frame)
    stated = statement or statement_of(board.stated)
    heights, sigma_mm = run.rims_mm()
    rims: tuple[BudgetSource, ...] = ()
    if heights:
        row = ("estimated", "from radii by tilt, --rim") if sigma_mm else ("not stated", "rim_mm of target.toml")
        covariance = rim_covariance_mm2(found.joint, own.target_from_face, heights, sigma_mm)
        rims = (BudgetSource("rims", "rims before the circles", "A", *row, 1e3 * sigma_mm or None, "µm", covariance),)
    reference, camera_given = run.faces.reference_face, run.report["summary"].get("camera_given", True)
    return budget(
        found, own, run.camera, board, options.flatness_mm, options.refine_camera, stated, reference, rims, camera_given
    )


def budget(
    found: Contributions,
    own: Derivatives,
    camera: Camera,
    board,
    flatness_mm: float | None,
    refined: bool,
    statement: Statement,
    reference_face: str,
    more: tuple[BudgetSource, ...] = (),
    camera_given: bool = True,
) -> Budget:
    """Returns the budget of an adjustment, as :func:`stcal.sfm.budget.sources.sources_of`; ``more``: further rows."""
    sources = sources_of(found, camera, board, flatness_mm, refined, statement, camera_given) + more
    if own.circles_designed.shape[2]:
        words = "not mapped; their places are those of the design, with errors as large as those of the mapped ones"
        size, sigma_um = own.circles.shape[-1], 1e3 * own.designed_sigma_mm
        none = np.zeros((size, size))  # it moves faces, not circles
        sources += (BudgetSource(PLACED, "frame circles placed", "A", "estimated", words, sigma_um, "µm", none),)
    rng, joint = np.random.default_rng(0), found.joint
    # Where photographs differ more than their pixels explain, it is they that are counted.
    freedom = joint.redundancy if joint.differ <= 1 else sum(len(model.images) for model in joint.models)
    rows = [
        _row(measurand, sources, own.designed_sigma_mm, freedom, rng)
        for measurand in measurands(found.joint, own, reference_face)
    ]
    views = tuple(_view(model) for model in found.joint.models)
    circles = own.circle_covariance(np.sum([source.covariance_mm2 for source in sources], axis=0))
    conditions = conditions_of(statement, board)
    return Budget(found.joint, reference_face, sources, tuple(rows), circles, views, statement, conditions)


def measurands(joint: JointResult, own: Derivatives, reference_face: str) -> list[Measurand]:
    """Returns positions and rotations of all faces except the reference face, and the longest distances."""
    other_faces = [face for face in own.target_from_face if face != reference_face]
    kinds: tuple[tuple[Kind, slice], ...] = (("position", slice(3, 6)), ("rotation", slice(0, 3)))
    poses = [
        Measurand(kind, face, (), None, own.faces[face][rows], own.face_designed[face][rows])
        for kind, rows in kinds
        for face in other_faces
    ]
    return poses + [distance(joint, a, b) for a, b in longest_of(joint.labels, joint.xyz_model)[:LONGEST]]


def longest_of(labels: Sequence[CircleLabel], xyz: np.ndarray) -> list[tuple[int, int]]:
    """Returns, for every two faces and within each, the two circles farthest apart, the longest distance first."""
    faces: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        faces.setdefault(label.face, []).append(i)
    pairs = []
    for a, b in combinations_with_replacement(faces, 2):
        ends = combinations(faces[a], 2) if a == b else ((i, j) for i in faces[a] for j in faces[b])
        pairs += sorted(ends, key=lambda pair: -float(np.linalg.norm(xyz[pair[0]] - xyz[pair[1]])))[:1]
    return sorted(pairs, key=lambda pair: -float(np.linalg.norm(xyz[pair[0]] - xyz[pair[1]])))


def distance(joint: JointResult, i: int, j: int) -> Measurand:
    """Returns the measurand of the distance between two circles."""
    difference = joint.xyz_model[j] - joint.xyz_model[i]
    length = float(np.linalg.norm(difference))
    jacobian = np.zeros((1, joint.xyz_model.size))
    jacobian[0, 3 * j : 3 * j + 3] = difference / length
    jacobian[0, 3 * i : 3 * i + 3] = -difference / length
    ends = joint.labels[i], joint.labels[j]
    return Measurand("distance", f"{ends[0]} – {ends[1]}", ends, length, jacobian, np.zeros((1, 0)))


def _row(
    measurand: Measurand,
    sources: Sequence[BudgetSource],
    designed_sigma_mm: float,
    freedom: int,
    rng: np.random.Generator,
) -> Row:
    covariances = {source.key: measurand.covariance(source, designed_sigma_mm) for source in sources}
    covariance = np.sum(list(covariances.values()), axis=0)
    variance = float(np.trace(covariance))
    estimated = sum(float(np.trace(covariances[source.key])) for source in sources if source.evaluation == "A")
    standard = float(np.sqrt(variance))
    values, vectors = np.linalg.eigh(covariance)
    errors = rng.standard_normal((DRAWS, len(values))) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return Row(
        measurand,
        {key: float(np.sqrt(max(np.trace(source), 0.0))) for key, source in covariances.items()},
        covariance,
        standard,
        COVERAGE_FACTOR * standard,
        float((np.linalg.norm(errors, axis=1) <= COVERAGE_FACTOR * standard).mean()),
        max(freedom, 1) * (variance / estimated) ** 2 if estimated else np.inf,
    )


def _view(model: MetricModel) -> GroupViews:
    axes = np.array([pose.rotation[2] for pose in model.camera_from_model])
    spread = np.arccos(np.clip((axes @ axes.T).min(), -1, 1))
    return GroupViews(model.group, len(model.images), float(np.degrees(spread)))
