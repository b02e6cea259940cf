"""The native ``colmap`` program, and scale and faces from models that were made or edited in it or in the GUI."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from stcal.errors import InputError, MappingError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import json_text, save
from stcal.io.json import require_result_written
from stcal.parallel import one_thread
from stcal.sfm.adjust.calibration import AdjustOptions, Calibration, calibrate
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.data.group_model import WorldModel
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import ReadModel, find_models, read_model
from stcal.sfm.runs.run_result import AnyRun, SavedRun
from stcal.sfm.runs.saved import saved_run

INSTALL = "install it with `sudo apt-get install colmap` (Debian, Ubuntu) or `brew install colmap` (macOS)"
ASK_SECONDS = 60.0
"""Time limit for an answer of the program about itself, s. Loading its libraries takes a second or two."""
LAST_WORDS = 200
MAX_OUTPUT = 1 << 20
"""Number of bytes kept of a program's output. The last ones are kept, as a program may print without end."""


@dataclass(frozen=True, slots=True)
class NativeColmap:
    """A native COLMAP program."""

    program: Path
    version: str  # as the program states it, like ``3.8``
    mapper_options: frozenset[str]  # names


def find_colmap(path: str | Path | None = None) -> NativeColmap:
    """Returns the program at ``path``, or the one on the PATH."""
    executable = shutil.which("colmap" if path is None else str(path))
    if executable is None:
        where = "on the PATH" if path is None else f"at {path} that can be executed"
        raise InputError(
            "E-COLMAP-PROGRAM", f"native COLMAP: no program {where}; {INSTALL}, or give its path with --colmap"
        )
    program = Path(executable)
    text = _answer(program, "help")
    version = re.search(r"COLMAP\s+v?(\d+\.\d+(?:\.\d+)?)", text)
    if version is None:
        raise InputError(
            "E-COLMAP-PROGRAM",
            f"native COLMAP: {program} does not say a COLMAP version; {INSTALL}, or give another --colmap",
        )
    options = re.findall(r"--([\w.]+)", _answer(program, "mapper", "-h"))
    return NativeColmap(program, version[1], frozenset(options))


def require_listable(names: list[str]) -> None:
    """Refuses names that begin or end with a space: COLMAP strips the lines of its list of images."""
    for name in names:
        if name != name.strip(" "):
            raise InputError(
                "E-IMAGE-NAME-SPACES",
                f"image {name!r}: native COLMAP lists images without the spaces at their names' ends and would not "
                "find it; rename the image or its folder, and run again",
            )


def map_natively(
    native: NativeColmap, database: Path, folder: Path, names: list[str], options: dict[str, str], timeout_s: float
) -> None:
    """Runs the mapper on the named images of a database and writes to ``models`` and ``mapper.log`` in a new folder.
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
    (folder / "mapper.log").write_text(output, encoding="utf-8")
    program = f"native COLMAP: `{native.program} mapper`"
    if code is None:
        raise MappingError(
            "E-COLMAP-TIMEOUT",
            f"{program} is still running after {timeout_s:g} s; raise --timeout, or check the program",
        )
    if code != 0:
        raise MappingError("E-COLMAP-FAILED", f"{program} {_end(code, output)}; check the program")


def _answer(program: Path, *words: str) -> str:
    """Returns the output of the program for a question about itself."""
    code, output = _run([str(program), *words], ASK_SECONDS)
    if code != 0:
        ending = f"does not end in {ASK_SECONDS:g} s" if code is None else _end(code, output)
        raise InputError(
            "E-COLMAP-PROGRAM",
            f"native COLMAP: `{program} {' '.join(words)}` {ending}; {INSTALL}, or give another --colmap",
        )
    return output


def _end(code: int, output: str) -> str:
    ending = f"ended with code {code}" if code >= 0 else f"was ended by signal {-code}"
    return f"{ending}: {' '.join(output.split())[-LAST_WORDS:] or 'no message'}"


LISTENED_S = 2.0
"""How long the output of an ended program is waited for, s: a child of its own session may hold the pipe open."""


def _run(command: list[str], timeout_s: float, **environment: str) -> tuple[int | None, str]:
    """Exit code of a command, None after the time limit, and its last output; no child process outlives it."""
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | {"QT_QPA_PLATFORM": "offscreen"} | environment,
            start_new_session=True,
        )
    except OSError as error:
        raise InputError(
            "E-COLMAP-PROGRAM", f"native COLMAP: {command[0]} cannot be started ({error.strerror}); {INSTALL}"
        ) from error
    output = bytearray()

    def listen() -> None:
        with contextlib.suppress(OSError, ValueError):  # closed below, where another session still holds the pipe
            while chunk := os.read(pipe.fileno(), 1 << 16):
                output.extend(chunk)
                del output[:-MAX_OUTPUT]

    with process.stdout as pipe:  # type: ignore[union-attr]  # as stdout=PIPE
        listener = threading.Thread(target=listen, daemon=True)
        listener.start()
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout_s)
            code = process.returncode
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: not permitted for an ended process
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            listener.join(LISTENED_S)
    return code, output.decode(errors="replace")


Chained = Literal["chain", "paper"]


def _options(run: SavedRun, solve: Chained) -> AdjustOptions:
    options = replace(run.options, solve=solve, refine_camera=False)
    if solve == "paper":
        options = replace(options, frame="three-point", eccentricity=False)
    return options.adjustment(run.target_design)


def faces_from_models(read: Sequence[ReadModel], run: SavedRun, solve: Chained = "chain") -> Calibration:
    """Returns scale and faces of unchanged models of the run's groups, group by group and chained."""
    models: dict[str, WorldModel] = {}
    notes = []
    for source in read:
        if not source.camera.same_as(read[0].camera):
            raise InputError(
                "E-MODEL-CAMERAS",
                f"models {read[0].path}, {source.path}: different cameras; keep the intrinsics fixed in the mapper, "
                "or give one model at a time",
            )
        if not source.camera.same_as(run.camera):
            ideal = np.concatenate([image.centre for image in run.observations])
            off_px = np.abs(source.camera.pixel_from_normalised(ideal) - run.camera.pixel_from_normalised(ideal)).max()
            notes.append(
                f"model {source.path}: its camera is up to {off_px:.2g} px off the run's at the keypoints; the model's "
                "is used"
            )
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
    model : str or Path
        A COLMAP model, or the folder of several.
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    solve : {"chain", "paper"}
        Every way to a face weighed; or as in Zhang & Wei (2017): λ by rows, three-point frames, single transforms.
    out : str or Path, optional
        File for the faces, as ``faces.json``; nothing is written if None.

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
