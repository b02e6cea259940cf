"""Cross-check against the native COLMAP: same database, same initial pairs, same thresholds; and scale and faces from
models that were made or edited in it or in the GUI."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stcal.errors import InputError, MappingError
from stcal.geometry.arrays import require_arguments, rms
from stcal.geometry.rigid import Rigid, align_similarity
from stcal.io.files import json_text, save
from stcal.io.json import read_json, require_result_written
from stcal.parallel import Progress, one_thread, scratch_folder
from stcal.report.text import number, text_table
from stcal.sfm.adjust.calibration import AdjustOptions, Calibration, calibrate, on_luminous_surface, with_sigma
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.adjust.refine import free_network, refine
from stcal.sfm.data.group_model import WorldModel
from stcal.sfm.interop.export_colmap import FORM, require_version, write_copy
from stcal.sfm.mapping.database import image_ids, pycolmap
from stcal.sfm.mapping.incremental import labelled_model, pipeline_options, seeded_mapping
from stcal.sfm.mapping.models import ReadModel, find_models, open_model, read_model, write_reconstruction
from stcal.sfm.report.judgement import judgement_of
from stcal.sfm.runs.comparisons import (
    CameraRow,
    Crosscheck,
    FaceDifference,
    FaceOff,
    MappingCompared,
    Tolerances,
    allowed_text,
)
from stcal.sfm.runs.folder import require_report, write_report
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run
from stcal.sfm.runs.transaction import AGAIN, added_results

INSTALL = "install it with `sudo apt-get install colmap` (Debian, Ubuntu) or `brew install colmap` (macOS)"
ASK_SECONDS = 60.0
"""Time limit for an answer of the program about itself, s. Loading its libraries takes a second or two."""
LAST_WORDS = 200
MAX_OUTPUT = 1 << 20
"""Number of bytes kept of a program's output. The last ones are kept, as a program may print without end."""


@dataclass(frozen=True, slots=True)
class NativeColmap:
    program: Path
    version: str  # as the program states it, like ``3.8``
    mapper_options: frozenset[str]  # names


def find_colmap(path: str | Path | None = None) -> NativeColmap:
    """Returns the program at ``path``, or the one on the PATH."""
    if (executable := shutil.which("colmap" if path is None else str(path))) is None:
        where = "on the PATH" if path is None else f"at {path} that can be executed"
        raise _unfit(f"no program {where}; {INSTALL}, or give its path with --colmap")
    program = Path(executable)
    if (version := re.search(r"COLMAP\s+v?(\d+\.\d+(?:\.\d+)?)", _answer(program, "help"))) is None:
        raise _unfit(f"{program} does not say a COLMAP version; {INSTALL}, or give another --colmap")
    options = re.findall(r"--([\w.]+)", _answer(program, "mapper", "-h"))
    return NativeColmap(program, version[1], frozenset(options))


def _unfit(fault: str) -> InputError:
    return InputError("E-COLMAP-PROGRAM", f"native COLMAP: {fault}")


def map_natively(
    native: NativeColmap, database: Path, folder: Path, names: list[str], options: dict[str, str], timeout_s: float
) -> None:
    """Runs the mapper on the named images of a database and writes to ``models`` in a new folder.
    ``options``: values by name without dashes, all of which this version must have."""
    models, images = folder / "models", folder / "images"
    for subfolder in (models, images):
        subfolder.mkdir(parents=True)
    listing = folder / "images.txt"
    listing.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    fixed = {"database_path": database, "image_path": images, "image_list_path": listing, "output_path": models}
    command = [str(native.program), "mapper"]
    for name, value in (fixed | options).items():
        command += [f"--{name}", str(value)]
    code, output = _run(command, timeout_s, TMPDIR=str(folder))  # COLMAP writes its logs there
    program = f"native COLMAP: `{native.program} mapper`"
    if code is None:
        fault = f"{program} is still running after {timeout_s:g} s"
        raise MappingError("E-COLMAP-TIMEOUT", f"{fault}; raise --timeout, or check the program")
    if code != 0:
        raise MappingError("E-COLMAP-FAILED", f"{program} {_end(code, output)}; check the program")


def _answer(program: Path, *words: str) -> str:
    """Returns the output of the program for a question about itself."""
    code, output = _run([str(program), *words], ASK_SECONDS)
    if code != 0:
        ending = f"does not end in {ASK_SECONDS:g} s" if code is None else _end(code, output)
        raise _unfit(f"`{program} {' '.join(words)}` {ending}; {INSTALL}, or give another --colmap")
    return output


def _end(code: int, output: str) -> str:
    ending = f"ended with code {code}" if code >= 0 else f"was ended by signal {-code}"
    return f"{ending}: {' '.join(output.split())[-LAST_WORDS:] or 'no message'}"


def _run(command: list[str], timeout_s: float, **environment: str) -> tuple[int | None, str]:
    """Exit code of a command, None after the time limit, and its last output; no child process outlives it."""
    with tempfile.TemporaryFile() as output:  # no pipe, which a child of its own session may hold open
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT}
        variables = os.environ | {"QT_QPA_PLATFORM": "offscreen"} | environment
        try:
            process = subprocess.Popen(command, **streams, env=variables, start_new_session=True)
        except OSError as error:
            raise _unfit(f"{command[0]} cannot be started ({error.strerror}); {INSTALL}") from error
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout_s)
            code = process.returncode
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: not permitted for an ended process
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(max(0, output.seek(0, os.SEEK_END) - MAX_OUTPUT))
        return code, output.read().decode(errors="replace")


Chained = Literal["chain", "paper"]


def _options(run: SavedRun, solve: Chained) -> AdjustOptions:
    published: dict[str, Any] = {"frame": "three-point", "eccentricity": False} if solve == "paper" else {}
    return replace(run.options, solve=solve, refine_camera=False, **published).adjustment(run.target_design)


def faces_from_models(read: Sequence[ReadModel], run: SavedRun, solve: Chained = "chain") -> Calibration:
    """Returns scale and faces of unchanged models of the run's groups, group by group and chained."""
    models: dict[str, WorldModel] = {}
    notes = []
    for source in read:
        if not source.camera.same_as(read[0].camera):
            fault = f"models {read[0].path}, {source.path}: different cameras"
            remedy = "keep the intrinsics fixed in the mapper, or give one model at a time"
            raise InputError("E-MODEL-CAMERAS", f"{fault}; {remedy}")
        if not source.camera.same_as(run.camera):
            ideal = np.concatenate([image.centre for image in run.observations])
            off_px = np.abs(source.camera.pixel_from_normalised(ideal) - run.camera.pixel_from_normalised(ideal)).max()
            off = f"its camera is up to {off_px:.2g} px off the run's at the keypoints"
            notes.append(f"model {source.path}: {off}; the model's is used")
        counts = {
            "points left out, since their keypoints name no one circle": source.unlabelled,
            "circles that are several points each, longest tracks taken": source.split,
            "points that keypoints name, but the model does not have": source.absent,
        }
        notes += [f"model {source.path}: {what}: {count}" for what, count in counts.items() if count]
        for model in source.groups:
            if model.group in models:
                notes.append(f"group {model.group}: in several models; the one with the most images was taken")
            if model.group not in models or len(model.images) > len(models[model.group].images):
                models[model.group] = model
    notes += [f"group {name}: in none of the models" for name in run.groups() if name not in models]
    options = _options(run, solve)
    models_in_order = [models[name] for name in run.groups() if name in models]
    try:
        calibration = calibrate(models_in_order, read[0].camera, run.target_design, run.board_design, options)
    except MappingError as error:
        raise MappingError(error.code, "; ".join([str(error), *notes])) from error
    return replace(calibration, notes=(*notes, *calibration.notes))


@require_arguments
@one_thread()
def calibrate_models(
    model: str | Path, run: AnyRun, solve: Chained = "chain", out: str | Path | None = None
) -> Calibration:
    """Returns scale and faces from COLMAP models of a run's database that were made or edited elsewhere.

    Parameters
    ----------
    model : A COLMAP model, or the folder of several.
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    solve : Every way to a face weighed; or as in Zhang & Wei (2017): λ by rows, three-point frames, single transforms.
    out : File for the faces, as ``faces.json``; nothing is written if None.

    Raises
    ------
    InputError
        The models are not of the run's database, state different cameras, or ``out`` cannot be written.
    ScaleError
        The board of a group is not in its model.
    MappingError
        The reference face is in none of the models, or a face is not linked to it.
    """
    run, model = saved_run(run), Path(model)
    ids = image_ids(run.observations)
    read = [read_model(path, run.observations, ids, run.corrected_px) for path in find_models(model)]
    calibration = faces_from_models(read, run, solve)
    if out is not None:
        factor = calibration.sigma_factors.of_target
        faces = FacesFile.of(calibration.target, run.target_design, _options(run, solve), factor)
        save(Path(out), json_text(faces.content()))
        require_result_written(out, faces)
    return calibration


MICRO = 1e3
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
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    colmap : The native program; ``colmap`` on the PATH if None.
    tolerances : Largest differences that are accepted.
    timeout_s : Time for one group after which the native mapper is stopped, s.
    progress : Called with (stage, done, total).
    into_report : Whether the comparison is added to ``report.json`` and ``report.html`` in the run's folder; else
        nothing is written.

    Returns
    -------
    Crosscheck : ``differences`` beyond the tolerances, in words; those of ``mapping``, between the two programs, and of
        ``result``, from the native models against the run; µm, millidegrees and σ.

    Raises
    ------
    InputError
        There is no native program, or its version is not known to open the database; it cannot list a name; the
        database is not the run's; or other results took the run's place meanwhile.
    MappingError
        The native program fails or hangs, or makes no model of a group, or one of another database.
    """
    saved = saved_run(run)
    compared = partial(_compared, saved, colmap, tolerances, timeout_s, progress or (lambda *_: None))
    if not into_report:
        return compared()
    require_report(saved)  # before minutes of mapping
    with added_results(saved.folder) as stage:
        if read_json(saved.folder / "report.json", "", AGAIN) != saved.report:
            fault = f"run {saved.folder}: its results were replaced meanwhile"
            raise InputError("E-RUN-REPLACED", f"{fault}; cross-check it again")
        check = compared()
        report = saved.report | {"crosscheck": check.model_dump(exclude_unset=True)}
        write_report(stage, report | {"judgement": judgement_of(report).model_dump()}, saved.folder)
    return check


def _compared(
    run: SavedRun, colmap: str | Path | None, tolerances: Tolerances, timeout_s: float, progress: Progress
) -> Crosscheck:
    native = find_colmap(colmap)
    require_version(native.version)
    ids, groups, options = image_ids(run.observations), run.groups(), run.options.adjustment(run.target_design)
    native_models, own_models, adjusted = [], [], []
    with scratch_folder("crosscheck") as folder:
        write_copy(run, folder / "native.db")
        shutil.copy(folder / "native.db", folder / "ours.db")
        for index, (name, group) in enumerate(groups.items()):
            progress("crosscheck", index, len(groups))
            names, work = [image.name for image in group], folder / f"group{index}"
            chosen = next(row for row in run.report["groups"] if row["name"] == name)["pairs"][0]
            pair = ids[chosen["first"]], ids[chosen["second"]]
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
    only = {"only_native": sorted(native_images - own_images), "only_pycolmap": sorted(own_images - native_images)}
    of_native_px, of_pycolmap_px = (
        rms(np.concatenate([model.residuals_px(run.camera) for model in of.models])) for of in (of_native, of_pycolmap)
    )
    between = _targets(of_native.target, of_pycolmap.target.target_from_face, of_pycolmap.target.circles, run)
    sections: dict[str, Any] = {
        "images": {"native": len(native_images), "pycolmap": len(own_images), "run": len(run.observations)} | only,
        "residual_rms_px": {"native": of_native_px, "pycolmap": of_pycolmap_px}
        | {"run": run.report["summary"]["residual_rms_px"]},
        "mapping": between.model_copy(update={"cameras": _cameras(of_native, of_pycolmap, run)}),
        "result": _targets(again.target, run.faces.poses(), run.faces.circles, run),
        "plain": {"faces": face_differences(of_native.target, run)},
    }
    check = Crosscheck(
        native=native.version,
        pycolmap=pycolmap.__version__,
        schema=FORM,
        tolerances=tolerances if run.faces.target_from_face_covariance else tolerances.without_sigma(),
        notes=list(of_native.notes),
        differences=[],
        **sections,
    )
    return check.model_copy(update={"differences": _differences(check)})


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
        fault = f"group {group}: native COLMAP {native.version} makes no model from the run's initial pair"
        why = "the pair may share too few labels, or be too near to each other"
        raise MappingError("E-COLMAP-NO-MODEL", f"{fault}; {why}; add images from further apart") from error
    try:
        path = max(models, key=lambda model: open_model(model).num_reg_images())
        return path, read_model(path, run.observations, ids, run.corrected_px)
    except InputError as error:
        made = f"what native COLMAP {native.version} made from the run's database cannot be used"
        raise MappingError("E-COLMAP-NO-MODEL", f"group {group}: {made}: {error}") from error


def _own_model(folder: Path, place: Path, names, pair, group: str, run: SavedRun, ids) -> ReadModel:
    reconstruction = seeded_mapping(folder / "ours.db", place / "own", names, pair)
    if reconstruction is None:
        fault = f"group {group}: pycolmap makes no model from the run's initial pair alone"
        own = "the run used its own relative pose"
        raise MappingError("E-COLMAP-NO-MODEL", f"{fault} ({own}); a cross-check is not possible")
    written = place / "own-model"
    written.mkdir()
    write_reconstruction(reconstruction, written)
    return read_model(written, run.observations, ids, run.corrected_px)


def _targets(target: CalibratedTarget, faces: dict[str, Rigid], circles: dict, run: SavedRun) -> MappingCompared:
    """Returns the differences of a target from other faces and circles, also in the run's σ."""
    covariances = run.faces.circle_covariance_mm2
    off = {label: np.subtract(xyz, circles[label]) for label, xyz in target.circles.items() if label in circles}
    um: dict[str, float] = {label: MICRO * float(np.linalg.norm(v)) for label, v in off.items()}
    known = {label: covariances[label] for label in off if label in covariances}
    sigmas: dict[str, float] = {label: _sigmas(off[label], c, FACE_FLOOR[3:]) for label, c in known.items()}
    return MappingCompared(faces=face_differences(target, run, faces), circles_um=um, circles_sigmas=sigmas)


def face_differences(
    target: CalibratedTarget, run: SavedRun, faces: dict[str, Rigid] | None = None
) -> dict[str, FaceDifference | None]:
    """Returns the differences of a target's faces from ``faces``, or the run's; None of a face that only one has."""
    a, b = target.target_from_face, run.faces.poses() if faces is None else faces
    covariance = run.faces.target_from_face_covariance
    rows: dict[str, FaceDifference | None] = dict.fromkeys(sorted(a.keys() | b.keys()))
    for face in a.keys() & b.keys():
        difference = a[face].difference(b[face])
        sigmas = _sigmas(difference, covariance[face], FACE_FLOOR) if face in covariance else None
        rows[face] = FaceDifference.of(difference, sigmas=sigmas)
    return rows


def _sigmas(off: np.ndarray, covariance: np.ndarray, floor: np.ndarray) -> float:
    """Returns √(dᵀC⁻¹d/k) of k differences. ``floor`` : (k,) σ of negligible differences, added to the covariance."""
    return float(np.sqrt(off @ np.linalg.solve(covariance + np.diag(floor**2), off) / len(off)))


def _cameras(a: Calibration, b: Calibration, run: SavedRun) -> list[CameraRow]:
    """Returns differences of camera poses relative to the target; in σ, to their group's circles."""
    factors = run.sigma_factors()
    model_of_group = {model.group: model for model in b.models}
    rows = []
    for theirs in a.models:
        if (model := model_of_group.get(theirs.group)) is None:
            continue
        common = sorted(set(theirs.labels) & set(model.labels), key=model.labels.index)
        own, other = (m.xyz_model[[m.labels.index(label) for label in common]] for m in (model, theirs))
        alignment = align_similarity(own, other)
        network = free_network(with_sigma(model, factors), run.camera)
        covariance = dict(zip(model.images, network.pose_covariance(), strict=True))
        poses = dict(zip(model.images, model.camera_from_model, strict=True))
        aligned = theirs.in_world(alignment).camera_from_model
        for name, pose, moved in zip(theirs.images, theirs.camera_from_model, aligned, strict=True):
            if name in poses:
                off = FaceOff.of(pose.inverse().difference(poses[name].inverse()))
                sigmas = _sigmas(moved.difference(poses[name]), covariance[name], np.zeros(6))
                place = {"position_um": off.translation_um, "rotation_mdeg": off.rotation_mdeg}
                rows.append(CameraRow(image=name, **place, sigmas=sigmas))
    return sorted(rows, key=lambda row: row.image)


def comparison_text(check: Crosscheck) -> str:
    residual, images, mapping = check.residual_rms_px, check.images, check.mapping
    rows = [["face", *("µm", "mdeg", "σ") * 3]]
    for face in mapping.faces:
        rows.append([face])
        for compared in (mapping, check.result, check.plain):
            row = compared.faces.get(face)
            values = (row.translation_um, row.rotation_mdeg, row.sigmas) if row else (None, None, None)
            rows[-1] += [number(value, digits) for value, digits in zip(values, (3, 3, 2), strict=True)]
    width = max(6, *(len(row[0]) for row in rows))
    of_native = f"{images.native} of {images.run} images, residual {residual.native:.4f} px RMS"
    of_pycolmap = f"{images.pycolmap} of {images.run} images, residual {residual.pycolmap:.4f} px RMS"
    circles, circle_sigmas = (max(v.values(), default=0.0) for v in (mapping.circles_um, mapping.circles_sigmas))
    cameras = [(row.position_um, row.rotation_mdeg, row.sigmas) for row in mapping.cameras]
    um, mdeg, sigmas = np.max([(0.0, 0.0, 0.0), *cameras], axis=0)
    lines = [
        f"COLMAP {check.native} (schema {check.schema_}): {of_native}",
        f"pycolmap {check.pycolmap}: {of_pycolmap}; the run: {residual.run:.4f} px",
        f"{'':{width}} {'native – pycolmap':>24} {'adjusted – faces.json':>28} {'as it is – faces.json':>28}",
        *text_table(rows, least=(6, 10, 8, 4, 14, 8, 4, 14, 8, 4), gap=1),
        f"largest between the two programs: circles {circles:.3f} µm, {circle_sigmas:.2f} σ; "
        f"cameras {um:.2f} µm and {mdeg:.3f} mdeg, {sigmas:.2f} σ",
        f"allowed: {allowed_text(check.tolerances)}: {'exceeded' if check.differences else 'they agree'}",
    ]
    return "\n".join([*check.notes, *lines])


def _differences(check: Crosscheck) -> list[str]:
    images, mapping, result, limits = check.images, check.mapping, check.result, check.tolerances
    clauses = []
    for names, program in ((images.only_native, "native COLMAP"), (images.only_pycolmap, "pycolmap")):
        if names:
            others = f" and {len(names) - 1} more" if len(names) > 1 else ""
            clauses.append(f"image {names[0]}{others}: registered by {program} only")
    largest: list[tuple[str, dict[str, float], str, float | None]] = []  # what, values by name, unit, and limit
    for compared, source, sigma in (
        (mapping, "mapped by both", limits.mapped_sigma),
        (result, "from the native model against faces.json", limits.sigma),
    ):
        for face, row in compared.faces.items():
            if row is None:
                clauses.append(f"face {face} ({source}): only one of the two has it")
                continue
            um, mdeg, own = row.translation_um, row.rotation_mdeg, row.sigmas
            each = (um, limits.face_um, "µm"), (mdeg, limits.face_mdeg, "mdeg"), (own, sigma, "σ")
            if allowed := [f"{most:g} {unit}" for v, most, unit in each if v and most is not None and v > most]:
                in_sigma = "" if own is None else f", {own:.2f} σ"
                measured = f"{um:.1f} µm, {mdeg:.2f} mdeg{in_sigma}"
                clauses.append(f"face {face} ({source}) {measured}; {', '.join(allowed)} allowed")
        of_circles = (compared.circles_um, "µm", limits.circle_um), (compared.circles_sigmas, "σ", sigma)
        largest += [(f"circle {{}} ({source})", off, unit, most) for off, unit, most in of_circles]
    largest += [
        ("camera {}: position", {c.image: c.position_um for c in mapping.cameras}, "µm", limits.camera_um),
        ("camera {}: attitude", {c.image: c.rotation_mdeg for c in mapping.cameras}, "mdeg", limits.camera_mdeg),
    ]
    for what, values, unit, limit in largest:
        name, worst = max(values.items(), key=lambda item: item[1], default=("", 0.0))
        if limit is not None and worst > limit:
            clauses.append(f"{what.format(name)} {worst:.1f} {unit}; {limit:g} {unit} allowed")
    return clauses


def faces_text(calibration: Calibration, run: SavedRun) -> str:
    """Returns a text with the scale of each model, and the faces with their differences from the run's."""
    lines = [*calibration.notes]
    for model in calibration.models:
        scale = calibration.scales[model.group]
        within = f"{scale.source} within {1e3 * scale.rms_mm():.1f} µm RMS"
        counts = f"{len(model.images)} images, {len(model.labels)} circles"
        lines.append(f"group {model.group}: {counts}, {scale.mm_per_unit:.6g} mm per unit, {within}")
    difference = face_differences(calibration.target, run)
    rows = [["face", "x", "y", "z", "mm   against the run: µm", "mdeg"]]
    for face_id, pose in calibration.target.target_from_face.items():
        row = difference.get(face_id)
        cells = [number(row.translation_um, 2), number(row.rotation_mdeg, 3)] if row else ["not in the run", ""]
        rows.append([face_id, *(number(x, 4) for x in pose.translation), *cells])
    return "\n".join([*lines, *text_table(rows, least=(6, 11, 11, 11, 24, 8), gap=1)])
