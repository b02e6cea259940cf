"""Content of ``report.json``: everything that tells how far to trust the result."""

from itertools import combinations

import numpy as np

import stcal
from stcal.design import faces_of_known_shape
from stcal.geometry.arrays import rms
from stcal.geometry.plane import fit_plane
from stcal.labels import DotLabel, Label
from stcal.sfm.data.model import MIN_POINTS, GroupModel, ImageObservations
from stcal.sfm.detect.defocus import Focus
from stcal.sfm.mapping.incremental import MIN_RAY_ANGLE_RAD
from stcal.sfm.report.judgement import lost_groups
from stcal.sfm.runs.report import ReportFile
from stcal.sfm.runs.result import RunResult

MICRO = 1e3


def report_of(result: RunResult) -> ReportFile:
    """Returns the report of a run."""
    models, calibration = _final_models(result), result.calibration
    residual = {name: model.residuals_px(calibration.camera) for name, model in models.items()}
    options, camera = result.options, calibration.camera
    content = {
        "format": "stcal report 1",
        "version": stcal.__version__,
        "target": result.target_design.name,
        "reference_face": result.target.reference_face,
        "options": {
            "solve": options.solve,
            "frame": options.frame,
            "eccentricity": options.eccentricity,
            "refine_camera": options.refine_camera,
            "expect_faces": list(options.expect_faces),
            "max_pair_angle_deg": round(float(np.degrees(options.pairs.limit_rad())), 9),
        },
        "camera": {
            "model": result.camera.colmap_model,
            "size_px": [result.camera.width, result.camera.height],
            "focal_px": camera.focal,
            "centre_px": camera.centre,
            "distortion": camera.coefficients(),
        },
        "summary": _summary(result, models, np.concatenate(list(residual.values()))),
        "faces": {face: _face(result, face) for face in result.target.target_from_face},
        "between_faces": _between(result),
        "chains": {
            face: [
                {
                    "faces": list(chain.faces),
                    "groups": list(chain.groups),
                    "translation_um": MICRO * chain.translation_mm,
                    "rotation_mdeg": MICRO * float(np.degrees(chain.rotation_rad)),
                }
                for chain in chains
            ]
            for face, chains in result.chains.items()
        },
        "checks": result.checks,
        "groups": [_group(result, solution) for solution in result.solutions],
        "residuals_by_image": _by_image(models, residual),
        "residuals_by_label": _by_label(models, residual),
        "left_out": _left_out(result),
        "notes": list(result.notes),
        "images": [
            {"image_id": i, "name": image.name, "group": image.group, "circles": len(image)}
            for i, image in enumerate(result.observations(), start=1)
        ],
        "focus": [_focus(image.focus) for image in result.labelled if image.focus is not None],
        "scene": _scene(result),
    }
    return ReportFile.model_validate(content | ({} if result.comparison is None else {"comparison": result.comparison}))


def _summary(result: RunResult, models: dict[str, GroupModel], residuals: np.ndarray) -> dict:
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
        "sigma0": joint.sigma0 if joint else None,
        "redundancy": joint.redundancy if joint else None,
        "last_move_px": joint.last_move_px if joint else None,
        "photographs_differ": joint.differ if joint else None,
        "sigma_enlarged": joint.enlarged if joint else None,
        "rim_mm": float(np.mean(rims)) if rims else None,
        "rim_sigma_mm": calibration.rim_sigma_mm if rims else None,
        "dot_rim_mm": result.board_design.rim_mm or None,
        "scale_from": sources,
        "print_factor": of_print.print_factor if of_print else None,
        "bend_factor": of_print.bend_factor if of_print else None,
        "camera_given": result.camera_given,
        "circle_sigma_px": calibration.circle_sigma_px,
        "size_sigma_ppm": 1e6 * printed.size_sigma if printed else None,
        "edge_share": printed.edge_share if printed else None,
        "printed_faces": sorted(design.printed_ids()),
    }


def residuals_px(result: RunResult) -> list[np.ndarray]:
    """Returns corrected minus projected keypoints of every image, (k, 2); NaN for keypoints not in the result."""
    models = _final_models(result)
    by_image = {image.name: np.full((len(image), 2), np.nan) for image in result.observations()}
    for model in models.values():
        residual = model.residuals_px(result.calibration.camera)
        for name, rows in zip(model.images, model.rows_by_image(), strict=True):
            by_image[name][model.keypoint[rows]] = residual[rows]
    return list(by_image.values())


def unadjusted(result: RunResult) -> dict[str, frozenset[Label]]:
    """Returns the labels of the keypoints that are not in the result, by image."""
    return {
        image.name: frozenset(image.labels[k] for k in np.flatnonzero(np.isnan(residual).any(axis=1)))
        for image, residual in zip(result.observations(), residuals_px(result), strict=True)
    }


def _focus(focus: Focus) -> dict:
    return {
        "image": focus.image,
        "focused_mm": focus.focused_mm,
        "nearest_mm": focus.depth_mm[0],
        "farthest_mm": focus.depth_mm[1],
        "nearest_blur_px": focus.blur_px[0],
        "farthest_blur_px": focus.blur_px[1],
        "shift_px": focus.shift_px,
    }


def _final_models(result: RunResult) -> dict[str, GroupModel]:
    """Returns the models that the result rests on, by group."""
    if result.calibration.joint:
        return {model.group: model for model in result.calibration.joint.models}
    return {solution.model.group: solution.model for solution in result.solutions}


def _face(result: RunResult, face_id: str) -> dict:
    pose = result.target.target_from_face[face_id]
    labels = [label for label in result.target.circles if label.face == face_id]
    members = [member for member in result.calibration.faces if member.face == face_id]
    covariance = result.target.face_covariance.get(face_id)
    sigma = None if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0))
    return {
        "target_from_face": pose,
        "translation_mm": pose.translation,
        "angle_to_reference_deg": float(np.degrees(np.arccos(np.clip(pose.rotation[2, 2], -1, 1)))),
        "translation_sigma_um": None if sigma is None else MICRO * sigma[3:],
        "rotation_sigma_mdeg": None if sigma is None else MICRO * np.degrees(sigma[:3]),
        "translation_sources_um": {
            kind: MICRO * sigma_mm for kind, sigma_mm in result.target.position_sources_mm.get(face_id, {}).items()
        },
        "circles": len(labels),
        "circles_of_design": len(result.target_design.face(face_id).ids),
        "plane_rms_um": MICRO * fit_plane(np.array([result.target.circles[label] for label in labels])).rms,
        "groups": [member.group for member in members],
        "images": sum(member.images for member in members),
    }


def _between(result: RunResult) -> list[dict]:
    rows = []
    poses, sigma = result.target.target_from_face, result.target.distance_sigma_mm
    for a, b in combinations(poses, 2):
        cosine = poses[a].rotation[:, 2] @ poses[b].rotation[:, 2]
        rows.append(
            {
                "a": a,
                "b": b,
                "distance_mm": float(np.linalg.norm(poses[a].translation - poses[b].translation)),
                "distance_sigma_um": MICRO * sigma[a, b] if (a, b) in sigma else None,
                "angle_deg": float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
            }
        )
    return rows


def _group(result: RunResult, solution) -> dict:
    name = solution.model.group
    scale = result.calibration.scales[name]
    return {
        "name": name,
        "images": list(solution.model.images),
        "faces": [face.face for face in result.calibration.faces if face.group == name],
        "points": len(solution.model.labels),
        "seeded": solution.seeded,
        "rounds": solution.rounds,
        "pairs": [
            {
                "first": p.first,
                "second": p.second,
                "shared": p.shared,
                "median_angle_deg": float(np.degrees(p.median_angle_rad)),
                "in_front": p.in_front,
                "forward": p.forward,
                "verdict": p.verdict,
            }
            for p in solution.pairs
        ],
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
            "board_residuals_um": {
                label: MICRO * residual for label, residual in zip(scale.labels, scale.residuals_mm, strict=True)
            },
            "source": scale.source,
        },
    }


def _by_image(models: dict[str, GroupModel], residual: dict[str, np.ndarray]) -> list[dict]:
    rows = []
    for name, model in models.items():
        length = np.linalg.norm(residual[name], axis=1)
        for i, image in enumerate(model.images):
            indices = np.flatnonzero(model.image_index == i)
            worst = indices[np.argmax(length[indices])]
            rows.append(
                {
                    "image": image,
                    "group": name,
                    "observations": len(indices),
                    "rms_px": rms(residual[name][indices]),
                    "max_px": float(length[worst]),
                    "worst": model.labels[model.point_index[worst]],
                }
            )
    return rows


def _by_label(models: dict[str, GroupModel], residual: dict[str, np.ndarray]) -> list[dict]:
    """Returns residuals by label: of the target's circles over all groups, of the board's dots group by group."""
    gathered: dict[tuple[str, str], list[np.ndarray]] = {}
    for name, model in models.items():
        for k, r in zip(model.point_index, residual[name], strict=True):
            label = model.labels[k]
            gathered.setdefault((name if isinstance(label, DotLabel) else "", label), []).append(r)
    return [
        {
            "label": label,
            "group": group or None,
            "observations": len(rows),
            "rms_px": rms(np.array(rows)),
            "max_px": float(np.linalg.norm(rows, axis=1).max()),
        }
        for (group, label), rows in sorted(gathered.items())
    ]


def _left_out(result: RunResult) -> dict:
    observed = {image.observations.name: image for image in result.labelled}
    images, circles = [], []
    for solution in result.solutions:
        mapped = set(solution.model.labels)
        for name, reason in solution.left_out.items():
            known = len(mapped & set(observed[name].observations.labels))
            few = known < MIN_POINTS
            images.append(
                {
                    "name": name,
                    "reason": reason,
                    "gate": "known_circles" if few else "fitting_circles",
                    "value": known if few else None,
                    "limit": MIN_POINTS,
                }
            )
        circles += [
            {
                "image": o.image,
                "label": o.label,
                "reason": f"residual {o.residual_px:.3f} px, {o.limit_px:.3f} px allowed: contradicts the others; "
                "look for glare, dirt, a part hidden, or something that moved",
                "gate": "residual",
                "value": o.residual_px,
                "limit": o.limit_px,
                "unit": "px",
            }
            for o in solution.outliers
        ]
        mapped_images = [observed[name].observations for name in solution.model.images]
        circles += _without_point(solution.model, mapped_images, {(o.image, o.label) for o in solution.outliers})
    return {
        "files": result.detection.skipped,
        "images": images,
        "circles": circles,
        "notes": [{"image": name, "note": note} for name, image in observed.items() for note in image.notes],
    }


def _without_point(model: GroupModel, images: list[ImageObservations], outliers: set[tuple[str, str]]) -> list[dict]:
    """Returns labelled circles of mapped images that are no points of the model: seen once, or from one direction."""
    rays: dict[str, list[tuple[str, np.ndarray]]] = {}
    for image, pose in zip(images, model.camera_from_model, strict=True):
        for k in range(len(image)):
            if image.labels[k] not in model.labels and (image.name, image.labels[k]) not in outliers:
                ray = pose.rotation.T @ np.append(image.centre[k], 1.0)
                rays.setdefault(image.labels[k], []).append((image.name, ray / np.linalg.norm(ray)))
    circles = []
    for label, sightings in rays.items():
        direction = np.array([ray for _, ray in sightings])
        angle = float(np.degrees(np.arccos(np.clip(direction @ direction.T, -1, 1)).max()))
        needed = float(np.degrees(MIN_RAY_ANGLE_RAD))
        if len(sightings) == 1:
            gate = {"gate": "views", "value": 1, "limit": 2, "unit": "images"}
            reason = "seen in one mapped image of its group only, 2 needed; photograph it from another place too"
        else:
            gate = {"gate": "ray_angle", "value": angle, "limit": needed, "unit": "deg"}
            reason = (
                f"{len(sightings)} images see it within {angle:.2f}°, {needed:g}° needed; add views from further apart"
            )
        circles += [{"image": name, "label": label, "reason": reason} | gate for name, _ in sightings]
    return circles


def _scene(result: RunResult) -> dict:
    """Returns cameras, board dots and circles in the target frame, for the picture in space."""
    cameras, boards = [], {}
    for model in result.calibration.models:
        for image, pose in zip(model.images, model.camera_from_model, strict=True):
            position_mm = pose.inverse().translation
            cameras.append({"image": image, "group": model.group, "position_mm": position_mm, "axes": pose.rotation})
        dots = [i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)]
        if dots:
            boards[model.group] = model.xyz_model[dots]
    return {"cameras": cameras, "boards": boards, "circles": result.target.circles}
