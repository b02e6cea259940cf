"""``report.json``: everything that tells how far to trust a run; its keys, and how they are filled."""

from dataclasses import fields
from itertools import combinations
from typing import Any, Literal

import numpy as np
from pydantic import Field

import stcal
from stcal.design import faces_of_known_shape
from stcal.geometry.arrays import rms
from stcal.geometry.plane import fit_plane
from stcal.io.images import Skipped
from stcal.io.json import ByFace, Part, ResultFile
from stcal.labels import DotLabel
from stcal.sfm.adjust.chain import FaceChain
from stcal.sfm.data.group_model import MIN_POINTS, GroupModel, ImageObservations, Note, lost_groups
from stcal.sfm.detect.defocus import Focus
from stcal.sfm.mapping.incremental import MIN_RAY_ANGLE_RAD, widest_angle_rad
from stcal.sfm.report.check import Check
from stcal.sfm.report.judgement import Judgement
from stcal.sfm.runs.comparisons import Comparison, Crosscheck
from stcal.sfm.runs.conditions import conditions
from stcal.sfm.runs.saved import ImageRow, RunResult
from stcal.sfm.runs.stages import GroupSolution

MICRO = 1e3
Row = dict[str, Any]


class Remark(Part):
    note: str
    code: str = ""
    place: str = ""
    words: str = ""
    remedy: str = ""


class LeftOut(Part):
    files: list[Skipped]
    images: list[Row]
    circles: list[Row]
    notes: list[Row]


class ReportFile(ResultFile):
    """Content of the report of a run."""

    format: Literal["stcal report 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    target: str = Field(description="name of the design")
    reference_face: str = Field(description="face id")
    options: Row = Field(
        description="`solve`, `frame`, `eccentricity`, `refine_camera`, `expect_faces`, `max_pair_angle_deg`"
    )
    camera: Row = Field(
        description="COLMAP `model`, `size_px`, `focal_px`, `centre_px` (OpenCV pixel origin), `distortion` k1, k2, "
        "p1, p2, k3 … k6, and s1 … s4 of a lens with thin prisms"
    )
    summary: Row = Field(
        description="counts: `files` (skipped ones included), `images`, `images_mapped`, `groups`, `faces`, "
        "`faces_not_seen`, `faces_expected` (by `--expect-faces`, or by the names of groups, where all are made of "
        "ids of faces), `observations`; `residual_rms_px` per coordinate; `centre_sigma_rms_px` of the σ used; "
        "`sigma_factor` by which the residuals of the single groups exceed the centres' own σ, `circle_sigma_factor` "
        "of the circles of the faces (not below 1), `dot_sigma_factor` of the dots and `printed_sigma_factor` of "
        "printed corners (not below 1; null without printed faces), which multiply these σ; `scale_sigma_ppm`: σ of "
        "the size; `sigma0` and `redundancy` of the joint adjustment, `last_move_px` by which its last step "
        "moved a projection at most (settled: less than 1e-6), `photographs_differ` by how much photographs differ "
        "more than their pixels explain, as a ratio of σ, and `sigma_enlarged` by which all σ are larger so that they "
        "cover how groups, ways and halves differ (both in the σ); these six are null with `chain` and `paper`; "
        "`rim_mm` mean height of the rims behind which the faces lie, `rim_sigma_mm` its σ (0 where stated), null "
        "where they are as seen; `dot_rim_mm` stated height of the rims before the board's dots, null without them; "
        "`scale_from` what the size rests on; `print_factor`, `bend_factor` by which corners "
        "of printed faces are off their design over their σ, in the plane and off it (null without such faces); "
        "`camera_given` false where the camera was found from the photographs; `circle_sigma_px` of the target's "
        "circles and corners, RMS per axis (null without joint adjustment); `size_sigma_ppm` the largest σ of a "
        "printed face's size, `edge_share` the share of its variance that is due to the edges of tags (null "
        "without such faces); `printed_faces` the ids of faces with boards or tags"
    )
    faces: dict[ByFace, Row] = Field(
        description="`target_from_face`, `translation_mm`, `angle_to_reference_deg`, `translation_sigma_um` and "
        "`rotation_sigma_mdeg` (x, y, z of the target frame; null with `chain`), `translation_sources_um`: what each "
        "kind of observation (`circles`, `dots` in the images, the `board`, `flatness`, adjusted `intrinsics`, "
        "`print`, `sizes`, `distances`) contributes to the first (empty with `chain`), `circles` of "
        "`circles_of_design`, `plane_rms_um`, `groups`, `images`"
    )
    between_faces: list[Row] = Field(
        description="faces `a`, `b`, `distance_mm` of their origins and its σ `distance_sigma_um` (null with `chain`), "
        "`angle_deg` of their normals"
    )
    chains: dict[ByFace, list[FaceChain]] = Field(
        description="each way from the reference face through `faces` and `groups`; its distance from the result, "
        "`translation_mm`, `rotation_rad`"
    )
    checks: list[Check] = Field(
        description="what residuals cannot show: `key`, `title`; `verdict`: `passed`; `suspicious`: by chance in one "
        "honest run of 1000, and `agreement` where the joint adjustment has not settled; `failed`: of 100 000; `not "
        "possible` in this run (without a `remedy`: not applicable to what was photographed); its `reason` in words; "
        "`measured`: at most 8 values, the worst first: `name` of what was tested (image, label, face, group, row …), "
        "`value`, `limit` beyond which it is suspicious (null where there is none), `unit`, `probability` of as much "
        "by chance before the number of things tested is allowed for (null where it is no test); `tested`: how many "
        "things were; `names` of all that are beyond the limit, the worst first; `remedy`; `enlarges`: factor on the σ "
        "of the result by which they cover what was found"
    )
    groups: list[Row] = Field(
        description="`name`, mapped `images`, `faces`, `points`; `seeded` how the initial pair was registered; "
        "`rounds` of refinement; `pairs`, the chosen one first: `first`, `second`, `shared` labels, `median_angle_rad` "
        "of the rays, `in_front` share, `forward` share of the baseline, `verdict`; `scale`: `mm_per_unit` by least "
        "squares over all dots, `mm_per_unit_rows` from all pairs of the two `rows`, `difference_ppm`, `sigma_ppm`, "
        "`dots`; residuals after the similarity, reconstructed minus design, board frame: `board_mean_um`, "
        "`board_spread_um` (standard deviation), `board_rms_um` of their lengths, `board_residuals_um` label → "
        "`[x, y, z]`; `source` of λ: `board`, `faces` of known shape, whose corners then stand for the dots, known "
        "`distances`, or the `drawing`"
    )
    residuals_by_image: list[Row] = Field(
        description="`image`, `group`, `observations`, `rms_px` per coordinate, `max_px` length, `worst` label"
    )
    residuals_by_label: list[Row] = Field(
        description="`label`, `group` (null for circles of the target: all groups together), `observations`, `rms_px`, "
        "`max_px`"
    )
    left_out: LeftOut = Field(
        description="`files` and `images`: `name`, `reason`; `circles`: `image`, `label`, `reason`, `unit`; all with "
        "`gate` that stopped it, `value` measured and `limit`, null without a number; `notes`: `image`, `note`, its "
        "`code`, and the face or group, `place`, that it is about"
    )
    notes: list[Remark] = Field(
        description="`note`, its `code`, `place`, `words` and `remedy`: faces of a group that got no frame, and why; "
        "rows and columns of the board that no image shows; a joint adjustment that has not settled"
    )
    images: list[ImageRow] = Field(
        description="all images of the database in its order: `image_id`, `name`, `group`, `circles` labelled"
    )
    focus: list[Focus] = Field(
        [],
        description="blur of each `image` with enough circles: `focused_mm` distance of the plane of focus (null "
        "where the image does not tell it), depths of the nearest and the farthest circle, `depth_mm`, and the blur "
        "there, `blur_px` (σ); `shift_px`: largest correction of a centre for blur that varies across its circle, 0 "
        "where none is needed; `note`",
    )
    conditions: dict[str, tuple[float, float]] = Field(
        {},
        description="what of the photographs limits σ: `number` of images of a group; `distance` as the share of a "
        "picture's diagonal that faces and board cover, in %; `angles` between the outermost cameras of a group, in °; "
        "`blur` of the rims, σ in px; `light` as a pixel's noise in % of the contrast; each with the factor by which "
        "the σ of faces are larger, at most, than in good photographs (docs/howto/photograph.md)",
    )
    scene: Row = Field(
        description="target frame, mm: `cameras`: `image`, `group`, `position_mm`, `axes` (rows X, Y, Z of the "
        "camera); `boards` group → mapped dots; `circles` label → `[x, y, z]`"
    )
    judgement: Judgement | None = Field(
        None, description="the summary in words, by the rules [below](#judgement); absent of an earlier version"
    )
    comparison: Comparison | None = Field(None, description="only of a run with `--compare paper`")
    crosscheck: Crosscheck | None = Field(None, description="only after `crosscheck`, with")


def report_of(result: RunResult) -> ReportFile:
    models, options, camera = result.final_models(), result.options, result.calibration.camera
    residual = {name: model.residuals_px(camera) for name, model in models.items()}
    shown = ("solve", "frame", "eccentricity", "refine_camera")
    content = {
        "format": "stcal report 1",
        "version": stcal.__version__,
        "target": result.target_design.name,
        "reference_face": result.target.reference_face,
        "options": {
            **{key: getattr(options, key) for key in shown},
            "expect_faces": list(options.expect_faces),
            "max_pair_angle_deg": round(float(np.degrees(options.pairs.limit_rad())), 9),
        },
        "camera": {
            "model": result.camera.colmap_model,
            "size_px": [result.camera.width, result.camera.height],
            "focal_px": camera.focal.tolist(),
            "centre_px": camera.centre.tolist(),
            "distortion": camera.coefficients().tolist(),
        },
        "summary": _summary(result, models, np.concatenate(list(residual.values()))),
        "faces": {face: face_row(result, face) for face in result.target.target_from_face},
        "between_faces": _between(result),
        "chains": {face: list(chains) for face, chains in result.chains.items()},
        "checks": result.checks,
        "groups": [_group(result, solution) for solution in result.solutions],
        "residuals_by_image": _by_image(models, residual),
        "residuals_by_label": _by_label(models, residual),
        "left_out": _left_out(result),
        "notes": [note if isinstance(note, Note) else Note(note) for note in result.notes],
        "images": [
            {"image_id": i, "name": image.name, "group": image.group, "circles": len(image)}
            for i, image in enumerate(result.observations, start=1)
        ],
        "focus": [image.focus for image in result.labelled if image.focus is not None],
        "conditions": conditions(result),
        "scene": _scene(result),
    }
    return ReportFile.model_validate(content | ({} if result.comparison is None else {"comparison": result.comparison}))


def _summary(result: RunResult, models: dict[str, GroupModel], residuals: np.ndarray) -> Row:
    """Returns the counts and the factors; ``residuals`` : (n, 2) of all models, px."""
    calibration, target, design = result.calibration, result.target, result.target_design
    joint, factors, sources = calibration.joint, calibration.sigma_factors, result.scale_from()
    printed = max(faces_of_known_shape(result.board_design), key=lambda face: face.size_sigma, default=None)
    of_print = joint if "faces" in sources else None
    rims = list(calibration.rim_mm.values())
    groups = {image.file.group for image in result.detection.images} | set(lost_groups(result.notes))
    return {
        "files": len(result.detection.images) + len(result.detection.skipped),
        "images": len(result.labelled),
        "images_mapped": sum(len(model.images) for model in models.values()),
        "groups": len(models),
        "faces": len(target.target_from_face),
        "faces_not_seen": [face.id for face in design.faces if face.id not in target.target_from_face],
        "faces_expected": result.options.faces_expected(groups, design),
        "observations": len(residuals),
        "residual_rms_px": rms(residuals),
        "centre_sigma_rms_px": rms(np.concatenate([model.sigma_px() for model in models.values()])),
        "sigma_factor": factors.all,
        "circle_sigma_factor": factors.circles,
        "dot_sigma_factor": factors.dots,
        "printed_sigma_factor": factors.printed if design.has_printed else None,
        "scale_sigma_ppm": None if target.scale_sigma is None or design.up_to_scale else 1e6 * target.scale_sigma,
        **{key: getattr(joint, key, None) for key in ("sigma0", "redundancy", "last_move_px")},
        "photographs_differ": getattr(joint, "differ", None),
        "sigma_enlarged": getattr(joint, "enlarged", None),
        "rim_mm": float(np.mean(rims)) if rims else None,
        "rim_sigma_mm": calibration.rim_sigma_mm if rims else None,
        "dot_rim_mm": result.board_design.rim_mm or None,
        "scale_from": sources,
        **{key: getattr(of_print, key, None) for key in ("print_factor", "bend_factor")},
        "camera_given": result.camera_given,
        "circle_sigma_px": calibration.circle_sigma_px,
        "size_sigma_ppm": 1e6 * printed.size_sigma if printed else None,
        "edge_share": printed.edge_share if printed else None,
        "printed_faces": sorted(design.printed_ids()),
    }


def face_row(result: RunResult, face_id: str) -> Row:
    pose = result.target.target_from_face[face_id]
    labels = [label for label in result.target.circles if label.face == face_id]
    members = [member for member in result.calibration.faces if member.face == face_id]
    covariance = result.target.face_covariance.get(face_id)
    sigma = None if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0))
    sources = result.target.position_sources_mm.get(face_id, {})
    return {
        "target_from_face": pose.matrix().tolist(),
        "translation_mm": pose.translation.tolist(),
        "angle_to_reference_deg": float(np.degrees(np.arccos(np.clip(pose.rotation[2, 2], -1, 1)))),
        "translation_sigma_um": None if sigma is None else (MICRO * sigma[3:]).tolist(),
        "rotation_sigma_mdeg": None if sigma is None else (MICRO * np.degrees(sigma[:3])).tolist(),
        "translation_sources_um": {kind: (MICRO * sigma_mm).tolist() for kind, sigma_mm in sources.items()},
        "circles": len(labels),
        "circles_of_design": len(result.target_design.face(face_id).ids),
        "plane_rms_um": MICRO * fit_plane(np.array([result.target.circles[label] for label in labels])).rms,
        "groups": [member.group for member in members],
        "images": sum(member.images for member in members),
    }


def _between(result: RunResult) -> list[Row]:
    sigma, rows = result.target.distance_sigma_mm, []
    for (a, pose), (b, other) in combinations(result.target.target_from_face.items(), 2):
        distance_mm = float(np.linalg.norm(pose.translation - other.translation))
        sigma_um = MICRO * sigma[a, b] if (a, b) in sigma else None
        angle_deg = float(np.degrees(np.arccos(np.clip(pose.rotation[:, 2] @ other.rotation[:, 2], -1, 1))))
        length = {"distance_mm": distance_mm, "distance_sigma_um": sigma_um}
        rows.append({"a": a, "b": b} | length | {"angle_deg": angle_deg})
    return rows


def _group(result: RunResult, solution: GroupSolution) -> Row:
    name, ranked = solution.model.group, solution.pairs
    scale = result.calibration.scales[name]
    return {
        "name": name,
        "images": list(solution.model.images),
        "faces": [face.face for face in result.calibration.faces if face.group == name],
        "points": len(solution.model.labels),
        "seeded": solution.seeded,
        "rounds": solution.rounds,
        "pairs": [{f.name: getattr(p, f.name) for f in fields(p) if f.name != "second_from_first"} for p in ranked],
        "scale": {
            "mm_per_unit": scale.mm_per_unit,
            "mm_per_unit_rows": scale.rows_mm_per_unit,
            "rows": list(scale.rows),
            "difference_ppm": 1e6 * (scale.rows_mm_per_unit / scale.mm_per_unit - 1),
            "sigma_ppm": 1e6 * scale.sigma_mm_per_unit / scale.mm_per_unit,
            "dots": len(scale.labels),
            "board_mean_um": MICRO * scale.mean_mm(),
            "board_spread_um": MICRO * scale.spread_mm(),
            "board_rms_um": MICRO * scale.rms_mm(),
            "board_residuals_um": dict(zip(map(str, scale.labels), (MICRO * scale.residuals_mm).tolist(), strict=True)),
            "source": scale.source,
        },
    }


def _by_image(models: dict[str, GroupModel], residual: dict[str, np.ndarray]) -> list[Row]:
    rows = []
    for name, model in models.items():
        length = np.linalg.norm(residual[name], axis=1)
        for image, indices in zip(model.images, model.rows_by_image(), strict=True):
            worst = indices[np.argmax(length[indices])]
            largest = {"max_px": float(length[worst]), "worst": str(model.labels[model.point_index[worst]])}
            row = {"image": image, "group": name, "observations": len(indices)}
            rows.append(row | {"rms_px": rms(residual[name][indices])} | largest)
    return rows


def _by_label(models: dict[str, GroupModel], residual: dict[str, np.ndarray]) -> list[Row]:
    """Returns residuals by label: of the target's circles over all groups, of the board's dots group by group."""
    gathered: dict[tuple[str, str], list[np.ndarray]] = {}
    for name, model in models.items():
        for k, r in zip(model.point_index, residual[name], strict=True):
            label = model.labels[k]
            gathered.setdefault((name if isinstance(label, DotLabel) else "", label), []).append(r)
    rows = []
    for (group, label), own in sorted(gathered.items()):
        sizes = {"rms_px": rms(np.array(own)), "max_px": float(np.linalg.norm(own, axis=1).max())}
        rows.append({"label": str(label), "group": group or None, "observations": len(own)} | sizes)
    return rows


def _left_out(result: RunResult) -> Row:
    observed = {image.observations.name: image for image in result.labelled}
    images, circles = [], []
    for solution in result.solutions:
        mapped = set(solution.model.labels)
        for name, reason in solution.left_out.items():
            known = len(mapped & set(observed[name].observations.labels))
            gate, value = ("known_circles", known) if known < MIN_POINTS else ("fitting_circles", None)
            images.append({"name": name, "reason": reason, "gate": gate, "value": value, "limit": MIN_POINTS})
        for o in solution.outliers:
            residual = f"residual {o.residual_px:.3f} px, {o.limit_px:.3f} px allowed: contradicts the others"
            reason = f"{residual}; look for glare, dirt, a part hidden, or something that moved"
            gate = {"gate": "residual", "value": o.residual_px, "limit": o.limit_px, "unit": "px"}
            circles.append({"image": o.image, "label": str(o.label), "reason": reason} | gate)
        mapped_images = [observed[name].observations for name in solution.model.images]
        circles += _without_point(solution.model, mapped_images, {(o.image, o.label) for o in solution.outliers})
    return {
        "files": result.detection.skipped,
        "images": images,
        "circles": circles,
        "notes": [
            {"image": name, "note": str(note), "code": getattr(note, "code", ""), "place": getattr(note, "place", "")}
            for name, image in observed.items()
            for note in image.notes
        ],
    }


def _without_point(model: GroupModel, images: list[ImageObservations], outliers: set[tuple[str, str]]) -> list[Row]:
    """Returns labelled circles of mapped images that are no points of the model: seen once, or from one direction."""
    rays: dict[str, list[tuple[str, np.ndarray]]] = {}
    for image, pose in zip(images, model.camera_from_model, strict=True):
        for label, centre in zip(image.labels, image.centre, strict=True):
            if label not in model.labels and (image.name, label) not in outliers:
                ray = pose.rotation.T @ np.append(centre, 1.0)
                rays.setdefault(label, []).append((image.name, ray / np.linalg.norm(ray)))
    circles, needed = [], float(np.degrees(MIN_RAY_ANGLE_RAD))
    for label, sightings in rays.items():
        angle = float(np.degrees(widest_angle_rad(np.array([ray for _, ray in sightings]))))
        if len(sightings) == 1:
            gate = {"gate": "views", "value": 1, "limit": 2, "unit": "images"}
            reason = "seen in one mapped image of its group only, 2 needed; photograph it from another place too"
        else:
            gate = {"gate": "ray_angle", "value": angle, "limit": needed, "unit": "deg"}
            within = f"{len(sightings)} images see it within {angle:.2f}°, {needed:g}° needed"
            reason = f"{within}; add views from further apart"
        circles += [{"image": name, "label": str(label), "reason": reason} | gate for name, _ in sightings]
    return circles


def _scene(result: RunResult) -> Row:
    """Returns cameras, board dots and circles in the target frame, for the picture in space."""
    cameras, boards = [], {}
    for model in result.calibration.models:
        for image, pose in zip(model.images, model.camera_from_model, strict=True):
            place = {"position_mm": pose.inverse().translation.tolist(), "axes": pose.rotation.tolist()}
            cameras.append({"image": image, "group": model.group, **place})
        if dots := [i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)]:
            boards[model.group] = model.xyz_model[dots].tolist()
    circles = {str(label): xyz.tolist() for label, xyz in result.target.circles.items()}
    return {"cameras": cameras, "boards": boards, "circles": circles}
