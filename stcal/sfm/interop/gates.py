"""How the ranked pairs fare at the gates for the initial pair: ours, and COLMAP's as we set them and at its defaults.

COLMAP's gates are taken from its source (4.2: ``EstimateInitialTwoViewGeometry`` in sfm/incremental_mapper_impl.cc,
``InitializeReconstruction`` and ``Run`` in controllers/incremental_pipeline.cc). What they measure COLMAP measures
itself here, pair by pair, from the centres that the mapping had.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.io.cameras.model import CalibratedCamera
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.mapping.colmap import pycolmap
from stcal.sfm.mapping.database import colmap_camera, image_ids, match_labels, to_colmap_px, write_database
from stcal.sfm.mapping.incremental import LOG_ERRORS_ONLY, SEED, pipeline_options
from stcal.sfm.mapping.pairs import MIN_ANGLE_RAD, MIN_IN_FRONT, MIN_LABELS, PairOptions, PairScore
from stcal.sfm.runs.saved import SavedRun

MIN_TRIALS = 30
"""Of RANSAC, for the initial pair: a constant of COLMAP, not an option."""
MIN_INLIERS = pycolmap.TwoViewGeometryOptions().min_num_inliers
"""Whatever ``init_min_num_inliers`` is: COLMAP estimates the initial pair with this option at its default."""
RELAXATIONS = 2
"""How often COLMAP's pipeline halves the inliers, and then the angle, where not every image was registered."""


@dataclass(frozen=True, slots=True)
class Gate:
    """``name``; measured ``value`` and ``limit`` (angles in rad; ``pose`` : COLMAP's name of the configuration, and no
    limit); ``passed``."""

    name: str
    value: float | str
    limit: float | None
    passed: bool


@dataclass(frozen=True, slots=True)
class GateVerdict:
    """COLMAP's ``gates`` in its order, at the limits as given; ``relaxations`` : how many times it halves a limit
    until the pair passes, 0 where it passes at once, None where it never does."""

    gates: tuple[Gate, ...]
    relaxations: int | None


@dataclass(frozen=True, slots=True)
class PairGates:
    """A ranked pair: ``own`` gates, and COLMAP's verdict with our options and with its defaults."""

    score: PairScore
    own: tuple[Gate, ...]
    as_set: GateVerdict
    defaults: GateVerdict


@dataclass(frozen=True, slots=True, eq=False)
class _TwoViews:
    """COLMAP's estimate of one pair: ``matches``, ``inliers`` counts; ``configuration``; ``pose``, None without;
    ``forward`` |t_z| and ``angle_rad``, the median ray angle."""

    matches: int
    inliers: int
    configuration: str
    pose: pycolmap.Rigid3d | None
    forward: float
    angle_rad: float


def run_gates(run: SavedRun, group: str | None = None) -> dict[str, list[PairGates]]:
    """The gates of every ranked pair of a run by group, or of one group; the pairs in the run's order.

    Raises
    ------
    InputError
        There is no such group, or the report lacks its pairs.
    """
    ranked = ranked_pairs(run)
    if group is not None and group not in ranked:
        raise InputError("E-RUN-NO-GROUP", f"group {group}: not in run {run.folder}; give one of {', '.join(ranked)}")
    found = {}
    for name in ranked if group is None else [group]:
        names = {image for score in ranked[name] for image in (score.first, score.second)}
        images = [image for image in run.observations if image.name in names]
        if len(images) < len(names):
            missing = names - {image.name for image in images}
            raise InputError(
                "E-RUN-DAMAGED", f"{run.folder / 'report.json'}: no image {min(missing)} in labels.csv; run it again"
            )
        found[name] = group_gates(images, ranked[name], run.camera, run.options.pairs)
    return found


def ranked_pairs(run: SavedRun) -> dict[str, list[PairScore]]:
    """The pairs of a run by group, as it ranked them, the chosen one first; without their poses.

    Raises
    ------
    InputError
        A report without them.
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
    camera: CalibratedCamera,
    options: PairOptions,
) -> list[PairGates]:
    """The gates of some pairs of a group's images.

    Parameters
    ----------
    group : the images that are mapped together; more than two matter for tracks of two views, which the defaults skip
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
    """Our gates; of a pair with too few labels nothing else was measured."""
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
    """COLMAP's defaults, but for the seed, which would be another one each time."""
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = names
    options.init_image_id1, options.init_image_id2 = pair
    options.random_seed = SEED
    return options


def attempts(options: pycolmap.IncrementalPipelineOptions) -> list[pycolmap.IncrementalMapperOptions]:
    """The mapper's options as set, and as COLMAP's pipeline relaxes them one after the other."""
    found = [options.get_mapper()]
    for count in range(1, 2 * RELAXATIONS + 1):
        mapper = options.get_mapper()
        mapper.init_min_num_inliers //= 2 ** ((count + 1) // 2)
        mapper.init_min_tri_angle /= 2 ** (count // 2)
        found.append(mapper)
    return found


def _limits(
    options: pycolmap.IncrementalPipelineOptions, mapper: pycolmap.IncrementalMapperOptions
) -> dict[str, float]:
    """Limit of every gate that has one; the angle in rad."""
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
        """COLMAP's estimate, also where it has fewer inliers than COLMAP accepts."""
        mapper = self.options.get_mapper()
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = 1
        options.ransac.min_num_trials = MIN_TRIALS
        options.ransac.max_error = mapper.init_max_error
        options.ransac.random_seed = mapper.random_seed
        matches = match_labels(a, b)
        views = native, to_colmap_px(a.centre_px), native, to_colmap_px(b.centre_px)
        geometry = pycolmap.estimate_calibrated_two_view_geometry(*views, matches, options)
        found = pycolmap.estimate_two_view_geometry_pose(*views, geometry)
        name = pycolmap.TwoViewGeometryConfiguration(geometry.config).name
        inliers = len(geometry.inlier_matches)
        pose = geometry.cam2_from_cam1 if found else None
        if pose is None:
            return _TwoViews(len(matches), inliers, name, None, 0.0, 0.0)
        return _TwoViews(len(matches), inliers, name, pose, float(abs(pose.translation[2])), float(geometry.tri_angle))

    def verdict(self, pair: tuple[int, int], views: _TwoViews) -> GateVerdict:
        """At the limits as set, and if they refuse the pair, at the first relaxed ones that let it pass."""
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
        """The gates in COLMAP's order; without a pose there is nothing to measure for the last three."""
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
        """Points that COLMAP triangulates in the pair and keeps after adjusting and filtering it."""
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
    """The first ``shown`` pairs of a group's ``images`` as text, the chosen one marked."""
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
    """What the table's verdicts rest on."""
    lines = []
    for title, options_of in (("as set", pipeline_options), ("COLMAP's defaults", _defaults)):
        pipeline = options_of([], (1, 2))
        tries = attempts(pipeline)
        limits, relaxed = (_limits(pipeline, mapper) for mapper in (tries[0], tries[-1]))
        words = ", ".join(f"{name} {KEPT[name]} {_number(name, value)}" for name, value in limits.items())
        end = ", ".join(f"{name} {KEPT[name]} {_number(name, relaxed[name])}" for name in ("inliers", "angle"))
        lines.append(f"{title}: {words}; relaxed {len(tries) - 1}×: {end}")
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
