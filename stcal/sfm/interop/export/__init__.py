"""Export of a finished run to files of other programs: robots' software, viewers, tables."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses
from stcal.io.files import save
from stcal.io.poses.programs import Static, read_messages, read_ros1_launch, read_ros2_launch
from stcal.io.table import require_poses_written
from stcal.sfm.interop.export import tables, viewers
from stcal.sfm.interop.export.content import Content, content_of
from stcal.sfm.runs.saved import AnyRun, saved_run

ROOT = "target"
"""Default name of the target frame."""


@dataclass(frozen=True, slots=True)
class Form:
    """A form of export."""

    suffix: str
    write: Callable[[Content], str | bytes]
    lost: str  # results among faces, circles, σ and cameras that the files do not hold
    # returns :meth:`Content.statics` from a text, None for viewers
    read: Callable[[str], Sequence[Static]] | None = None


FRAMES_ONLY = "cameras, radii, σ of circles; σ of faces is in comments"
FORMS = {
    "urdf": Form(".urdf", tables.urdf, "cameras, σ of circles; σ of faces is in comments", tables.read_urdf),
    "xacro": Form(".xacro", tables.xacro, "cameras, σ of circles; σ of faces is in comments", tables.read_urdf),
    "tf2": Form(".yaml", tables.tf2, FRAMES_ONLY, read_messages),
    "ros2": Form(".py", tables.launch_ros2, FRAMES_ONLY, read_ros2_launch),
    "ros1": Form(".launch", tables.launch_ros1, FRAMES_ONLY, read_ros1_launch),
    "opencv": Form(".yml", tables.opencv, "cameras", tables.read_opencv),
    "csv": Form(".csv", tables.table, "cameras, correlations", tables.read_table),
    "gltf": Form(".gltf", viewers.gltf, "the lens's distortion but as numbers in extras"),
    "glb": Form(".glb", viewers.glb, "the lens's distortion but as numbers in extras"),
}
"""Forms by the value of ``--form``."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportedRun:
    """An export that was written."""

    path: Path
    form: str
    content: Content


@require_arguments
def export_run(run: AnyRun, out: str | Path, form: str = "", name: str = ROOT) -> ExportedRun:
    """Writes faces and circles to a new file, with σ and cameras if the form holds them.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : str or Path
        New file, whose suffix gives the form: ``.urdf``, ``.xacro``, ``.yaml`` (tf2), ``.py`` and ``.launch`` (ROS 2
        and 1), ``.yml`` (OpenCV), ``.csv``, ``.gltf`` or ``.glb``.
    form : {"urdf", "xacro", "tf2", "ros2", "ros1", "opencv", "csv", "gltf", "glb"}, optional
        Form in place of that of the suffix.
    name : str
        Name of the target frame, and prefix of the other frames' names.

    Returns
    -------
    ExportedRun
        ``path``, ``form``, and the ``content``.

    Raises
    ------
    InputError
        Not a finished run, the file exists, the form is unknown, or the name is bad.
    """
    path = Path(out)
    form = form or form_of(path)
    if form not in FORMS:
        raise InputError("E-OPTION-FORM", f"--form {form}: unknown; one of {', '.join(FORMS)} needed")
    if os.path.lexists(path):
        raise InputError("E-OUTPUT-EXISTS", f"{path}: exists, and nothing is overwritten; give a new file")
    if not path.parent.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{path}: no folder {path.parent}; make it, or give another place")
    content = content_of(saved_run(run), name)
    save(path, FORMS[form].write(content))
    if (read := FORMS[form].read) is not None:
        require_poses_written(
            path,
            lambda: Poses.of(static.pose for static in read(path.read_text(encoding="utf-8"))),
            Poses.of(static.pose for static in content.statics()),
        )
    return ExportedRun(path, form, content)


def form_of(path: Path) -> str:
    """Returns the form for the suffix of a path."""
    suffixes = {form.suffix: name for name, form in FORMS.items()}
    if path.suffix.lower() not in suffixes:
        raise InputError(
            "E-OUTPUT-SUFFIX",
            f"{path}: suffix {path.suffix or 'missing'}; one of {', '.join(suffixes)} needed, or --form",
        )
    return suffixes[path.suffix.lower()]
