"""Gates of the ranked pairs for the initial pair: our own, and COLMAP's with our options and with its defaults.

COLMAP's gates are taken from its source (4.2: ``EstimateInitialTwoViewGeometry`` in sfm/incremental_mapper_impl.cc,
``InitializeReconstruction`` and ``Run`` in controllers/incremental_pipeline.cc). COLMAP itself measures their values
here, pair by pair, from the centres of the mapping.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.json import Part, ResultFile
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.mapping.colmap import pycolmap
from stcal.sfm.mapping.database import colmap_camera, image_ids, match_labels, to_colmap_px, write_database
from stcal.sfm.mapping.incremental import LOG_ERRORS_ONLY, SEED, pipeline_options
from stcal.sfm.mapping.pairs import MIN_ANGLE_RAD, MIN_IN_FRONT, MIN_LABELS, PairOptions, PairScore
from stcal.sfm.runs.report import Number, PairRow
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run

MIN_TRIALS = 30
"""Least number of RANSAC trials for the initial pair, a constant of COLMAP and not an option."""
MIN_INLIERS = pycolmap.TwoViewGeometryOptions().min_num_inliers
"""Least number of inliers for any ``init_min_num_inliers``, as COLMAP estimates the initial pair with this default."""
RELAXATIONS = 2
"""Number of times that COLMAP's pipeline halves each limit, inliers and angle, while images are not registered."""


@dataclass(frozen=True, slots=True)
class Gate:
    """A gate for the initial pair.

    ``value``, ``limit`` : measured value and its limit, angles in rad; the gate ``pose`` has COLMAP's name of the
    configuration as value, and no limit.
    """

    name: str
    value: float | str
    limit: float | None
    passed: bool


@dataclass(frozen=True, slots=True)
class GateVerdict:
    """Verdict of COLMAP on a pair.

    ``gates`` : in COLMAP's order, at the limits as given; ``relaxations`` : number of times that COLMAP halves a limit
    until the pair passes, 0 if it passes at once, None if it never passes.
    """

    gates: tuple[Gate, ...]
    relaxations: int | None


@dataclass(frozen=True, slots=True)
class PairGates:
    """A ranked pair with our ``own`` gates, and COLMAP's verdict with our options and with its defaults."""

    score: PairScore
    own: tuple[Gate, ...]
    as_set: GateVerdict
    defaults: GateVerdict


@dataclass(frozen=True, slots=True, eq=False)
class _TwoViews:
    """COLMAP's estimate of one pair.

    ``matches``, ``inliers`` : counts; ``pose`` : None if there is no pose; ``forward`` : |t_z|; ``angle_rad`` : median
    angle between the rays.
    """

    matches: int
    inliers: int
    configuration: str
    pose: pycolmap.Rigid3d | None
    forward: float
    angle_rad: float


@require_arguments
def initial_pairs(run: AnyRun, group: str | None = None) -> dict[str, list[PairGates]]:
    """Returns the ranked candidates for the initial pair of each group, with every gate that they meet.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    group : str, optional
        Name of one group; all groups if None.

    Returns
    -------
    dict of list of PairGates
        Pairs by group, the chosen one first: its ``score``, our ``own`` gates, and COLMAP's with our options
        (``as_set``) and with its ``defaults``; angles in rad.

    Raises
    ------
    InputError
        The run has no such group, or its report lacks the pairs.
    """
    run = saved_run(run)
    ranked = ranked_pairs(run)
    if group is not None and group not in ranked:
        raise InputError("E-RUN-NO-GROUP", f"group {group}: not in run {run.folder}; give one of {', '.join(ranked)}")
    gates_of_group = {}
    for name in ranked if group is None else [group]:
        names = {image for score in ranked[name] for image in (score.first, score.second)}
        images = [image for image in run.observations if image.name in names]
        if len(images) < len(names):
            missing = names - {image.name for image in images}
            raise InputError(
                "E-RUN-DAMAGED", f"{run.folder / 'report.json'}: no image {min(missing)} in labels.csv; run it again"
            )
        gates_of_group[name] = group_gates(images, ranked[name], run.camera, run.options.pairs)
    return gates_of_group


def ranked_pairs(run: SavedRun) -> dict[str, list[PairScore]]:
    """Returns the pairs of a run by group, as the run ranked them, the chosen one first; without their poses.

    Raises InputError if the report has no ranked pairs.
    """
    try:
        return {
            group["name"]: [
                PairScore(
                    pair["first"],
                    pair["second"],
                    int(pair["shared"]),
                    float(np.radians(pair["median_angle_deg"])),
                    float(pair["in_front"]),
                    float(pair["forward"]),
                    None,
                    pair["verdict"],
                )
                for pair in group["pairs"]
            ]
            for group in run.report["groups"]
        }
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            "E-RUN-DAMAGED", f"{run.folder / 'report.json'}: no ranked pairs ({error}); run it again"
        ) from error


def group_gates(
    group: Sequence[ImageObservations],
    ranked: Sequence[PairScore],
    camera: Camera,
    options: PairOptions,
) -> list[PairGates]:
    """Returns the gates of ranked pairs of a group's images.

    ``group`` : all images that are mapped together, as the defaults ignore tracks of two views.
    """
    pycolmap.logging.minloglevel = LOG_ERRORS_ONLY
    native = colmap_camera(camera)
    ids = image_ids(group)
    by_name = {image.name: image for image in group}
    with tempfile.TemporaryDirectory(prefix="stcal-") as scratch:
        database = Path(scratch) / "pairs.db"
        write_database(database, camera, group, np.array(list(combinations(range(len(group)), 2))))
        as_set, defaults = (_Mapping(database, list(by_name), each) for each in (pipeline_options, _defaults))
    rows = []
    for score in ranked:
        a, b = by_name[score.first], by_name[score.second]
        pair = ids[a.name], ids[b.name]
        verdicts = [each.verdict(pair, each.two_views(a, b, native)) for each in (as_set, defaults)]
        rows.append(PairGates(score, own_gates(score, options), *verdicts))
    return rows


def own_gates(score: PairScore, options: PairOptions) -> tuple[Gate, ...]:
    """Returns our gates, or the first one alone if the pair has too few labels, as nothing else was measured then."""
    labels = Gate("labels", score.shared, MIN_LABELS, score.shared >= MIN_LABELS)
    if not labels.passed:
        return (labels,)
    angle, limit = score.median_angle_rad, options.limit_rad()
    return (
        labels,
        Gate("min_angle", angle, float(MIN_ANGLE_RAD), bool(angle >= MIN_ANGLE_RAD)),
        Gate("in_front", score.in_front, MIN_IN_FRONT, score.in_front >= MIN_IN_FRONT),
        Gate("max_angle", angle, float(limit), bool(angle <= limit)),
    )


def _defaults(names: list[str], pair: tuple[int, int]) -> pycolmap.IncrementalPipelineOptions:
    """Returns COLMAP's defaults with a fixed seed."""
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = names
    options.init_image_id1, options.init_image_id2 = pair
    options.random_seed = SEED
    return options


def attempts(options: pycolmap.IncrementalPipelineOptions) -> list[pycolmap.IncrementalMapperOptions]:
    """Returns the mapper's options as set, followed by the relaxed ones in the order of COLMAP's pipeline."""
    mappers = [options.get_mapper()]
    for count in range(1, 2 * RELAXATIONS + 1):
        mapper = options.get_mapper()
        mapper.init_min_num_inliers //= 2 ** ((count + 1) // 2)
        mapper.init_min_tri_angle /= 2 ** (count // 2)
        mappers.append(mapper)
    return mappers


def _limits(
    options: pycolmap.IncrementalPipelineOptions, mapper: pycolmap.IncrementalMapperOptions
) -> dict[str, float]:
    """Returns the limit of every gate that has one; the angle in rad."""
    return {
        "matches": options.min_num_matches,
        "inliers": max(mapper.init_min_num_inliers, MIN_INLIERS),
        "forward": mapper.init_max_forward_motion,
        "angle": float(np.radians(mapper.init_min_tri_angle)),
        "points": mapper.abs_pose_min_num_inliers,
    }


class _Mapping:
    """COLMAP with one set of options and the images of one group."""

    def __init__(self, database: Path, names: list[str], options_of):
        self.options = options_of(names, (1, 2))
        with pycolmap.Database.open(str(database)) as opened:
            wanted = pycolmap.DatabaseCacheOptions(min_num_matches=self.options.min_num_matches, image_names=set(names))
            self.cache = pycolmap.DatabaseCache.create(opened, wanted)

    def two_views(self, a: ImageObservations, b: ImageObservations, native: pycolmap.Camera) -> _TwoViews:
        """Returns COLMAP's estimate, even if it has fewer inliers than COLMAP accepts."""
        mapper = self.options.get_mapper()
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = 1
        options.ransac.min_num_trials = MIN_TRIALS
        options.ransac.max_error = mapper.init_max_error
        options.ransac.random_seed = mapper.random_seed
        matches = match_labels(a, b)
        views = native, to_colmap_px(a.centre_px), native, to_colmap_px(b.centre_px)
        geometry = pycolmap.estimate_calibrated_two_view_geometry(*views, matches, options)
        has_pose = pycolmap.estimate_two_view_geometry_pose(*views, geometry)
        name = pycolmap.TwoViewGeometryConfiguration(geometry.config).name
        inliers = len(geometry.inlier_matches)
        pose = geometry.cam2_from_cam1 if has_pose else None
        if pose is None:
            return _TwoViews(len(matches), inliers, name, None, 0.0, 0.0)
        return _TwoViews(len(matches), inliers, name, pose, float(abs(pose.translation[2])), float(geometry.tri_angle))

    def verdict(self, pair: tuple[int, int], views: _TwoViews) -> GateVerdict:
        """Returns the gates at the limits as set, and the number of relaxations with which the pair passes."""
        first, *relaxed = attempts(self.options)
        gates = self.gates(pair, views, first)
        if all(gate.passed for gate in gates):
            return GateVerdict(gates, 0)
        for count, mapper in enumerate(relaxed, start=1):
            if all(gate.passed for gate in self.gates(pair, views, mapper)):
                return GateVerdict(gates, count)
        return GateVerdict(gates, None)

    def gates(
        self, pair: tuple[int, int], views: _TwoViews, mapper: pycolmap.IncrementalMapperOptions
    ) -> tuple[Gate, ...]:
        """Returns the gates in COLMAP's order, without the last three if there is no pose."""
        limit = _limits(self.options, mapper)
        loaded = views.matches >= limit["matches"]
        gates = (
            Gate("matches", views.matches, limit["matches"], loaded),
            Gate("inliers", views.inliers, limit["inliers"], views.inliers >= limit["inliers"]),
            Gate("pose", views.configuration, None, views.pose is not None),
        )
        if views.pose is None:
            return gates
        points = self.points_left(pair, views.pose, mapper) if loaded else 0
        return (
            *gates,
            Gate("forward", views.forward, limit["forward"], views.forward < limit["forward"]),
            Gate("angle", views.angle_rad, limit["angle"], views.angle_rad > limit["angle"]),
            Gate("points", points, limit["points"], points >= limit["points"]),
        )

    def points_left(
        self, pair: tuple[int, int], second_from_first: pycolmap.Rigid3d, mapper: pycolmap.IncrementalMapperOptions
    ) -> int:
        """Returns the number of points that COLMAP triangulates in the pair, adjusts, and keeps after filtering."""
        reconstruction = pycolmap.Reconstruction()
        mapping = pycolmap.IncrementalMapper(self.cache)
        mapping.begin_reconstruction(reconstruction)
        mapping.register_initial_image_pair(mapper, *pair, second_from_first)
        triangulation = self.options.get_triangulation()
        triangulation.min_angle = mapper.init_min_tri_angle
        for image_id in pair:
            mapping.triangulate_image(triangulation, image_id)
        if reconstruction.num_points3D():
            mapping.adjust_global_bundle(mapper, self.options.get_global_bundle_adjustment())
            mapping.filter_points(mapper)
        count = reconstruction.num_points3D()
        mapping.end_reconstruction(True)
        return count


NAMES, FIGURES = ("", "first", "second"), ("labels", "angle °", "in front", "forward", "points")
HEAD = (*NAMES, *FIGURES, "as set", "COLMAP's defaults", "ranking")
KEPT = {"matches": "≥", "inliers": "≥", "forward": "<", "angle": ">", "points": "≥"}
BROKEN = {"≥": "<", "<": "≥", ">": "≤"}


def pairs_table(group: str, images: int, rows: Sequence[PairGates], shown: int) -> str:
    """Returns the first ``shown`` pairs of a group as text, with the chosen one marked. ``images`` : their number."""
    heading = f"group {group}: {len(rows)} pairs of {images} images"
    if shown < len(rows):
        heading += f", the first {shown} (--all for the other {len(rows) - shown})"
    cells = [list(HEAD)]
    for row in rows[:shown]:
        score, points = row.score, [gate.value for gate in row.as_set.gates if gate.name == "points"]
        cells.append(
            [
                "*" if score.verdict.startswith("chosen") else "",
                score.first.removeprefix(f"{group}/"),
                score.second.removeprefix(f"{group}/"),
                str(score.shared),
                f"{np.degrees(score.median_angle_rad):.2f}",
                f"{100 * score.in_front:.0f} %",
                f"{score.forward:.2f}",
                str(*points or "–"),
                _in_words(row.as_set),
                _in_words(row.defaults),
                score.verdict,
            ]
        )
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  ".join(
            c.rjust(w) if HEAD[i] in FIGURES else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    ]
    return "\n".join([heading, *(line.rstrip() for line in lines)])


def limits_text(options: PairOptions) -> str:
    """Returns the limits on which the table's verdicts rest, as text."""
    lines = []
    for title, options_of in (("as set", pipeline_options), ("COLMAP's defaults", _defaults)):
        pipeline = options_of([], (1, 2))
        mappers = attempts(pipeline)
        limits, relaxed = (_limits(pipeline, mapper) for mapper in (mappers[0], mappers[-1]))
        limits_as_text = ", ".join(f"{name} {KEPT[name]} {_number(name, value)}" for name, value in limits.items())
        relaxed_as_text = ", ".join(
            f"{name} {KEPT[name]} {_number(name, relaxed[name])}" for name in ("inliers", "angle")
        )
        lines.append(f"{title}: {limits_as_text}; relaxed {len(mappers) - 1}×: {relaxed_as_text}")
    mapper = pipeline_options([], (1, 2)).get_mapper()
    return "\n".join(
        [
            *lines,
            "relaxed n×: while images stay out COLMAP halves inliers and angle in turn, and tries the pair again",
            f"points: those that COLMAP, as set, keeps of the pair: adjusted, in front of both cameras, within "
            f"{mapper.filter_max_reproj_error:g} px, rays at {mapper.init_min_tri_angle:g}° or more",
            f"ranking: labels ≥ {MIN_LABELS}, {_number('angle', MIN_ANGLE_RAD)} ≤ angle ≤ "
            f"{_number('angle', options.limit_rad())}, in front ≥ {100 * MIN_IN_FRONT:.0f} %",
        ]
    )


def _in_words(verdict: GateVerdict) -> str:
    failed = ", ".join(
        f"no pose ({gate.value})"
        if gate.limit is None or isinstance(gate.value, str)
        else f"{gate.name} {_number(gate.name, gate.value)} {BROKEN[KEPT[gate.name]]} {_number(gate.name, gate.limit)}"
        for gate in verdict.gates
        if not gate.passed
    )
    if verdict.relaxations is None:
        return f"refused: {failed}"
    return "passes" if verdict.relaxations == 0 else f"relaxed {verdict.relaxations}×: {failed}"


def _number(name: str, value: float) -> str:
    return f"{np.degrees(value):.4g}°" if name.endswith("angle") else f"{value:.4g}"


class GateRow(Part):
    gate: str
    value: Number | str
    limit: Number | None
    passed: bool


class GatesRow(Part):
    relaxations: int | None
    gates: list[GateRow]


class RankedPair(PairRow):
    ranking: list[GateRow] = Field(
        description="our own gates: `labels`, `min_angle_deg`, `in_front`, `max_angle_deg`; only the first where it "
        "fails: `gate`, `value`, `limit`, `passed`"
    )
    as_set: GatesRow = Field(
        description="COLMAP with the options of `run`. `relaxations`: 0: the pair passes; n: after COLMAP has halved "
        "limits n times, in turn that of the inliers and that of the angle, which it does up to twice each while "
        "images stay out; null: never. `gates`: `gate`, `value`, `limit`, `passed`, at the limits not yet relaxed"
    )
    defaults: GatesRow = Field(
        description="COLMAP with its own options: `relaxations` and `gates` with `gate`, `value`, `limit`, `passed`"
    )


class GroupOfPairs(Part):
    name: str
    pairs: list[RankedPair] = Field(
        description="as in `report.json`: `first`, `second`, `shared`, `median_angle_deg`, `in_front`, `forward`, "
        "`verdict`; with"
    )


class PairsFile(ResultFile):
    """The JSON file of ``pairs``."""

    format: Literal["stcal pairs 1"] = Field(description="the file's form and its version")
    groups: list[GroupOfPairs] = Field(description="`name` of the group, and its pairs")

    @classmethod
    def of(cls, groups: Mapping[str, Sequence[PairGates]]) -> "PairsFile":
        """Returns the file of the ranked pairs, by group."""
        rows = [GroupOfPairs(name=name, pairs=[_pair(pair) for pair in ranked]) for name, ranked in groups.items()]
        return cls(format="stcal pairs 1", groups=rows)


def _pair(row: PairGates) -> RankedPair:
    score = row.score
    return RankedPair(
        first=score.first,
        second=score.second,
        shared=score.shared,
        median_angle_deg=_degrees(score.median_angle_rad),
        in_front=score.in_front,
        forward=score.forward,
        verdict=score.verdict,
        ranking=[_gate(gate) for gate in row.own],
        as_set=_gates(row.as_set),
        defaults=_gates(row.defaults),
    )


def _gates(verdict: GateVerdict) -> GatesRow:
    return GatesRow(relaxations=verdict.relaxations, gates=[_gate(gate) for gate in verdict.gates])


def _gate(gate: Gate) -> GateRow:
    if not gate.name.endswith("angle") or isinstance(gate.value, str) or gate.limit is None:
        return GateRow(gate=gate.name, value=gate.value, limit=gate.limit, passed=gate.passed)
    value, limit = _degrees(gate.value), _degrees(gate.limit)
    return GateRow(gate=f"{gate.name}_deg", value=value, limit=limit, passed=gate.passed)


def _degrees(angle_rad: float) -> float:
    """Returns the angle in degrees, rounded to 9 digits, so that a limit reads as it was given."""
    return round(float(np.degrees(angle_rad)), 9)
