"""Cross-check against the native COLMAP: same database, same initial pairs, same thresholds; result file and text."""

from pathlib import Path

import numpy as np

from stcal.errors import InputError, MappingError
from stcal.geometry.arrays import require_arguments, rms
from stcal.geometry.rigid import Rigid, align_similarity
from stcal.io.json import read_json
from stcal.parallel import Progress, scratch_folder
from stcal.report.text import number, text_table
from stcal.sfm.adjust.calibration import Calibration, calibrate, on_luminous_surface, with_sigma
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.network import free_network
from stcal.sfm.adjust.refine import refine
from stcal.sfm.interop.export import FORMS, ExportedRun
from stcal.sfm.interop.export_database import Exported, write_copy
from stcal.sfm.interop.export_model import ExportedModel
from stcal.sfm.interop.native import NativeColmap, faces_from_models, find_colmap, map_natively, require_listable
from stcal.sfm.interop.schema import find_schema, schema_of_version
from stcal.sfm.mapping.database import image_ids, pycolmap
from stcal.sfm.mapping.incremental import labelled_model, pipeline_options, seeded_mapping
from stcal.sfm.mapping.models import ReadModel, find_models, open_model, read_model, write_reconstruction
from stcal.sfm.report.judgement import judged
from stcal.sfm.runs.folder import require_report, write_report
from stcal.sfm.runs.saved import AGAIN, AnyRun, SavedRun, saved_run
from stcal.sfm.runs.tolerances import (
    CameraDifference,
    Crosscheck,
    FaceDifference,
    FacesCompared,
    ImagesRegistered,
    MappingCompared,
    ResidualRms,
    ResultCompared,
    Tolerances,
    allowed_text,
)
from stcal.sfm.runs.transaction import added_results

MICRO = 1e3
MIN_INLIERS = pycolmap.TwoViewGeometryOptions().min_num_inliers
"""Least number of inliers of an initial pair, whatever `init_min_num_inliers` says: COLMAP estimates the pair with this
default."""
TOLERANCES = Tolerances()
FACE_FLOOR = np.array([1e-7] * 3 + [1e-4] * 3)
"""Negligible differences in rad and mm: 6 µdeg and 0.1 µm. Circles that carry the frame have no σ."""
RENAMED = {
    "ba_global_images_freq": "ba_global_frames_freq",
    "ba_global_images_ratio": "ba_global_frames_ratio",
    "local_ba_min_tri_angle": "ba_local_min_tri_angle",
}
"""Names of thresholds in older versions, and in pycolmap."""


@require_arguments
def crosscheck(
    run: AnyRun,
    colmap: str | Path | None = None,
    tolerances: Tolerances = TOLERANCES,
    timeout_s: float = 600.0,
    progress: Progress | None = None,
    into_report: bool = False,
) -> Crosscheck:
    """Maps the database of a run with the native COLMAP, and compares faces, circles and cameras.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    colmap : str or Path, optional
        The native program; ``colmap`` on the PATH if None.
    tolerances : Tolerances
        Largest differences that are accepted.
    timeout_s : float
        Time for one group after which the native mapper is stopped, s.
    progress : callable, optional
        Called with (stage, done, total).
    into_report : bool
        Whether the comparison is added to ``report.json`` and ``report.html`` in the run's folder; else nothing is
        written.

    Returns
    -------
    Crosscheck
        ``differences`` beyond the tolerances, in words; those of ``mapping``, between the two programs, and of
        ``result``, from the native models against the run; µm, millidegrees and σ.

    Raises
    ------
    InputError
        There is no native program, or no schema of its version is known; it cannot list a name; the database is not the
        run's; or other results took the run's place meanwhile.
    MappingError
        The native program fails or hangs, or makes no model of a group, or one of another database.
    """
    saved = saved_run(run)
    if not into_report:
        return _compared(saved, colmap, tolerances, timeout_s, progress)
    require_report(saved)  # before minutes of mapping
    with added_results(saved.folder) as stage:
        if read_json(saved.folder / "report.json", "", AGAIN) != saved.report:
            raise InputError(
                "E-RUN-REPLACED", f"run {saved.folder}: its results were replaced meanwhile; cross-check it again"
            )
        check = _compared(saved, colmap, tolerances, timeout_s, progress)
        write_report(stage, judged(saved.report | {"crosscheck": check.model_dump()}), saved.folder)
    return check


def _compared(
    run: SavedRun, colmap: str | Path | None, tolerances: Tolerances, timeout_s: float, progress: Progress | None
) -> Crosscheck:
    progress = progress or (lambda *_: None)
    native = find_colmap(colmap)
    schema = schema_of_version(native.version)
    require_listable([image.name for image in run.observations])
    ids, groups, options = image_ids(run.observations), run.groups(), run.options.adjustment(run.target_design)
    native_models, own_models, adjusted = [], [], []
    with scratch_folder("crosscheck") as folder:
        write_copy(run, folder / "native.db", find_schema(schema))
        write_copy(run, folder / "ours.db", find_schema("4.2"))
        for index, (name, group) in enumerate(groups.items()):
            progress("crosscheck", index, len(groups))
            names, work = [image.name for image in group], folder / f"group{index}"
            chosen = next(row for row in run.report["groups"] if row["name"] == name)["pairs"][0]
            first, second = (next(i for i in group if i.name == chosen[which]) for which in ("first", "second"))
            pair, shared = (ids[first.name], ids[second.name]), len(set(first.labels) & set(second.labels))
            if shared < MIN_INLIERS:  # few tags have few corners
                raise MappingError(
                    "E-CROSSCHECK-FEW",
                    f"group {name}: {first.name} and {second.name} share {shared} labels, {MIN_INLIERS} needed to "
                    "begin with; COLMAP cannot map it, check the run with the checks of its report",
                )
            map_natively(native, folder / "native.db", work, names, mapper_options(native, names, pair), timeout_s)
            path, model = _native_model(work / "models", name, native, run, ids)
            native_models.append(model)
            labelled, _ = labelled_model(open_model(path), group, ids, run.camera)
            refined = refine(labelled, run.camera, run.target_design, run.board_design, options.eccentricity)
            adjusted.append(refined.model)
            own_models.append(_own_model(folder, work, names, pair, name, run, ids))
        progress("crosscheck", len(groups), len(groups))
        of_native, of_pycolmap = faces_from_models(native_models, run), faces_from_models(own_models, run)
    again = calibrate(adjusted, run.camera, run.target_design, run.board_design, options)
    heights, rim_sigma_mm = run.rims_mm()
    if heights:
        again = on_luminous_surface(again, heights, rim_sigma_mm, run.target_design, options.frame)
    native_images, own_images = ({name for m in of.models for name in m.images} for of in (of_native, of_pycolmap))
    images = ImagesRegistered(
        native=len(native_images),
        pycolmap=len(own_images),
        run=len(run.observations),
        only_native=sorted(native_images - own_images),
        only_pycolmap=sorted(own_images - native_images),
    )
    ours = of_pycolmap.target
    between = _targets(of_native.target, ours.target_from_face, ours.circles, run)
    mapping = MappingCompared(**dict(between), cameras=_cameras(of_native, of_pycolmap, run))
    result = _targets(again.target, run.faces.poses(), run.faces.circles, run)
    if not run.faces.target_from_face_covariance:
        tolerances = tolerances.without_sigma()
    of_native_px, of_pycolmap_px = (
        rms(np.concatenate([model.residuals_px(run.camera) for model in of.models])) for of in (of_native, of_pycolmap)
    )
    of_run_px = run.report["summary"]["residual_rms_px"]
    return Crosscheck(
        native=native.version,
        pycolmap=pycolmap.__version__,
        schema=schema,
        tolerances=tolerances,
        images=images,
        residual_rms_px=ResidualRms(native=of_native_px, pycolmap=of_pycolmap_px, run=of_run_px),
        mapping=mapping,
        result=result,
        plain=FacesCompared(faces=face_differences(of_native.target, run)),
        notes=list(of_native.notes),
        differences=_differences(images, mapping, result, tolerances),
    )


def mapper_options(native: NativeColmap, names: list[str], pair: tuple[int, int]) -> dict[str, str]:
    """Returns our thresholds as options of the native mapper: all of pycolmap's except negative values, which newer
    versions take as a request for an automatic choice."""
    options = pipeline_options(names, pair)
    chosen = {}
    for name in sorted(native.mapper_options):
        prefix, _, field = name.partition(".")
        if prefix == "Mapper":
            field = RENAMED.get(field, field)
            places = ((options, field), (options.mapper, field), (options.triangulation, field.removeprefix("tri_")))
            setting = next((getattr(place, k) for place, k in places if hasattr(place, k)), None)
            if isinstance(setting, bool | int | float) and setting >= 0:
                chosen[name] = str(int(setting)) if isinstance(setting, bool) else repr(setting)
    seed = next((o for o in ("random_seed", "default_random_seed") if o in native.mapper_options), None)
    return chosen | ({seed: str(options.random_seed)} if seed else {})


def _native_model(folder: Path, group: str, native: NativeColmap, run: SavedRun, ids) -> tuple[Path, ReadModel]:
    """Returns the path of the largest native model, and this model with labels."""
    try:
        models = find_models(folder)
    except InputError as error:
        raise MappingError(
            "E-COLMAP-NO-MODEL",
            f"group {group}: native COLMAP {native.version} makes no model from the run's initial pair; "
            "the pair may share too few labels, or be too near to each other; add images from further apart",
        ) from error
    try:
        path = max(models, key=lambda model: open_model(model).num_reg_images())
        return path, read_model(path, run.observations, ids, run.corrected_px)
    except InputError as error:
        raise MappingError(
            "E-COLMAP-NO-MODEL",
            f"group {group}: what native COLMAP {native.version} made from the run's database cannot be used: {error}",
        ) from error


def _own_model(folder: Path, place: Path, names, pair, group: str, run: SavedRun, ids) -> ReadModel:
    reconstruction = seeded_mapping(folder / "ours.db", place / "own", names, pair)
    if reconstruction is None:
        raise MappingError(
            "E-COLMAP-NO-MODEL",
            f"group {group}: pycolmap makes no model from the run's initial pair alone (the run used its own relative "
            "pose); a cross-check is not possible",
        )
    written = place / "own-model"
    written.mkdir()
    write_reconstruction(reconstruction, written)
    return read_model(written, run.observations, ids, run.corrected_px)


def _targets(target: CalibratedTarget, faces: dict[str, Rigid], circles: dict, run: SavedRun) -> ResultCompared:
    """Returns the differences of a target from other faces and circles, also in the run's σ."""
    covariances = run.faces.circle_covariance_mm2
    off = {label: np.subtract(xyz, circles[label]) for label, xyz in target.circles.items() if label in circles}
    return ResultCompared(
        faces=face_differences(target, run, faces),
        circles_um={label: MICRO * float(np.linalg.norm(v)) for label, v in off.items()},
        circles_sigmas={
            label: _sigmas(v, np.asarray(covariances[label]), FACE_FLOOR[3:])
            for label, v in off.items()
            if label in covariances
        },
    )


def face_differences(
    target: CalibratedTarget, run: SavedRun, faces: dict[str, Rigid] | None = None
) -> dict[str, FaceDifference | None]:
    """Returns the differences of a target's faces from ``faces``, or the run's; None of a face that only one has."""
    a, b, covariance = target.target_from_face, faces, run.faces.target_from_face_covariance
    b = run.faces.poses() if b is None else b
    rows: dict[str, FaceDifference | None] = dict.fromkeys(sorted(a.keys() | b.keys()))
    for face in a.keys() & b.keys():
        difference = a[face].difference(b[face])
        rows[face] = FaceDifference(
            translation_um=MICRO * float(np.linalg.norm(difference[3:])),
            rotation_mdeg=MICRO * float(np.degrees(np.linalg.norm(difference[:3]))),
            sigmas=_sigmas(difference, np.asarray(covariance[face]), FACE_FLOOR) if face in covariance else None,
        )
    return rows


def _sigmas(off: np.ndarray, covariance: np.ndarray, floor: np.ndarray) -> float:
    """Returns √(dᵀC⁻¹d/k) of k differences. ``floor`` : (k,) σ of negligible differences, added to the covariance."""
    return float(np.sqrt(off @ np.linalg.solve(covariance + np.diag(floor**2), off) / len(off)))


def _cameras(a: Calibration, b: Calibration, run: SavedRun) -> list[CameraDifference]:
    """Returns the differences of camera positions and attitudes relative to the target; those in σ are relative to the
    circles of their group, the covariances' datum."""
    factors = run.sigma_factors()
    model_of_group = {model.group: model for model in b.models}
    rows = []
    for theirs in a.models:
        model = model_of_group.get(theirs.group)
        if model is None:
            continue
        common = sorted(set(theirs.labels) & set(model.labels), key=model.labels.index)
        own, other = (m.xyz_model[[m.labels.index(label) for label in common]] for m in (model, theirs))
        alignment = align_similarity(own, other)
        network = free_network(with_sigma(model, factors), run.camera)
        covariance = dict(zip(model.images, network.pose_covariance(), strict=True))
        poses = dict(zip(model.images, model.camera_from_model, strict=True))
        aligned = theirs.in_world(alignment).camera_from_model
        for name, pose, moved in zip(theirs.images, theirs.camera_from_model, aligned, strict=True):
            if name not in poses:
                continue
            off = pose.inverse().difference(poses[name].inverse())
            rows.append(
                CameraDifference(
                    image=name,
                    position_um=MICRO * float(np.linalg.norm(off[3:])),
                    rotation_mdeg=MICRO * float(np.degrees(np.linalg.norm(off[:3]))),
                    sigmas=_sigmas(moved.difference(poses[name]), covariance[name], np.zeros(6)),
                )
            )
    return sorted(rows, key=lambda row: row.image)


def comparison_text(check: Crosscheck) -> str:
    """Returns the comparison as a text table."""
    residual, images, cameras = check.residual_rms_px, check.images, check.mapping.cameras
    rows = [["face", *("µm", "mdeg", "σ") * 3]]
    for face in check.mapping.faces:
        cells = [face]
        for compared in (check.mapping, check.result, check.plain):
            row = compared.faces.get(face)
            values = (row.translation_um, row.rotation_mdeg, row.sigmas) if row else (None, None, None)
            cells += [number(value, digits) for value, digits in zip(values, (3, 3, 2), strict=True)]
        rows.append(cells)
    width = max(6, *(len(row[0]) for row in rows))
    circles = check.mapping.circles_um
    lines = [
        f"COLMAP {check.native} (schema {check.schema_}): {images.native} of {images.run} images, residual "
        f"{residual.native:.4f} px RMS",
        f"pycolmap {check.pycolmap}: {images.pycolmap} of {images.run} images, residual "
        f"{residual.pycolmap:.4f} px RMS; the run: {residual.run:.4f} px",
        f"{'':{width}} {'native – pycolmap':>24} {'adjusted – faces.json':>28} {'as it is – faces.json':>28}",
        *text_table(rows, least=(6, 10, 8, 4, 14, 8, 4, 14, 8, 4), gap=1),
        f"largest between the two programs: circles {max(circles.values(), default=0.0):.3f} µm, "
        f"{max(check.mapping.circles_sigmas.values(), default=0.0):.2f} σ; "
        f"cameras {max((c.position_um for c in cameras), default=0.0):.2f} µm and "
        f"{max((c.rotation_mdeg for c in cameras), default=0.0):.3f} mdeg, "
        f"{max((c.sigmas for c in cameras), default=0.0):.2f} σ",
        f"allowed: {allowed_text(check.tolerances)}: {'exceeded' if check.differences else 'they agree'}",
    ]
    return "\n".join([*check.notes, *lines])


def _differences(
    images: ImagesRegistered, mapping: MappingCompared, result: ResultCompared, tolerances: Tolerances
) -> list[str]:
    clauses = []
    for names, program in ((images.only_native, "native COLMAP"), (images.only_pycolmap, "pycolmap")):
        if names:
            others = f" and {len(names) - 1} more" if len(names) > 1 else ""
            clauses.append(f"image {names[0]}{others}: registered by {program} only")
    largest = []  # what, its largest value, unit, and limit
    for compared, source, sigma in (
        (mapping, "mapped by both", tolerances.mapped_sigma),
        (result, "from the native model against faces.json", tolerances.sigma),
    ):
        for face, row in compared.faces.items():
            if row is None:
                clauses.append(f"face {face} ({source}): only one of the two has it")
                continue
            each = (row.translation_um, tolerances.face_um, "µm"), (row.rotation_mdeg, tolerances.face_mdeg, "mdeg")
            each = (*each, (row.sigmas, sigma, "σ"))
            if limits := [f"{most:g} {unit}" for v, most, unit in each if v and most is not None and v > most]:
                sigma_text = "" if row.sigmas is None else f", {row.sigmas:.2f} σ"
                clauses.append(
                    f"face {face} ({source}) {row.translation_um:.1f} µm, {row.rotation_mdeg:.2f} mdeg{sigma_text}; "
                    f"{', '.join(limits)} allowed"
                )
        circles = (compared.circles_um, "µm", tolerances.circle_um), (compared.circles_sigmas, "σ", sigma)
        largest += [("circle {} " + f"({source})", *each) for each in circles]
    position, attitude = (
        {c.image: getattr(c, key) for c in mapping.cameras} for key in ("position_um", "rotation_mdeg")
    )
    largest.append(("camera {}: position", position, "µm", tolerances.camera_um))
    largest.append(("camera {}: attitude", attitude, "mdeg", tolerances.camera_mdeg))
    for what, values, unit, limit in largest:
        name, worst = max(values.items(), key=lambda item: item[1], default=("", 0.0))
        if limit is not None and worst > limit:
            clauses.append(f"{what.format(name)} {worst:.1f} {unit}; {limit:g} {unit} allowed")
    return clauses


def database_text(written: Exported) -> str:
    """Returns a text on the contents of the copied database, and how to open it."""
    return (
        f"schema {written.schema}, checked: {written.images} images, {written.pairs} pairs, "
        f"camera model {', '.join(written.camera_models)}\n"
        f"open it with: colmap gui --database_path {written.path} --image_path IMAGES"
    )


def model_text(written: ExportedModel, kind: str) -> str:
    """Returns a text on the contents of the model, and on the ideal camera if the format needs one."""
    lines = [
        f"{written.images} images and {written.points} points; mm, target frame: {written.path}",
        f"labels: {written.labels}",
    ]
    if written.focal_px is not None and written.centre_px is not None:
        x, y = written.centre_px
        lines.append(
            f"{kind} knows one focal length and a principal point at the centre: the keypoints are those of an ideal "
            f"camera without distortion, f = {written.focal_px:.4f} px, principal point ({x:g}, {y:g}) px; undistort "
            "the photographs to it to match"
        )
    return "\n".join(lines)


def export_text(written: ExportedRun) -> str:
    """Returns a text on the contents of the file, and on the results that it lacks."""
    content = written.content
    lines = [
        f"{len(content.faces)} faces and {len(content.circles)} circles, frame {content.root}, as {written.form}: "
        f"{written.path}"
    ]
    if not content.covariances:
        lines.append(f"no σ: the run was solved by {content.run.faces.solve}, which states none; run it with joint")
    if lost := FORMS[written.form].lost:
        lines.append(f"not in it: {lost}")
    return "\n".join(lines)


def faces_text(calibration: Calibration, run: SavedRun) -> str:
    """Returns a text with the scale of each model, and the faces with their differences from the run's."""
    lines = [*calibration.notes]
    for model in calibration.models:
        scale = calibration.scales[model.group]
        lines.append(
            f"group {model.group}: {len(model.images)} images, {len(model.labels)} circles, {scale.mm_per_unit:.6g} mm "
            f"per unit, {'board' if scale.source == 'board' else scale.source} within {1e3 * scale.rms_mm():.1f} µm RMS"
        )
    difference = face_differences(calibration.target, run)
    rows = [["face", "x", "y", "z", "mm   against the run: µm", "mdeg"]]
    for face_id, pose in calibration.target.target_from_face.items():
        row = difference.get(face_id)
        cells = [number(row.translation_um, 2), number(row.rotation_mdeg, 3)] if row else ["not in the run", ""]
        rows.append([face_id, *(number(x, 4) for x in pose.translation), *cells])
    return "\n".join([*lines, *text_table(rows, least=(6, 11, 11, 11, 24, 8), gap=1)])
