"""Export of a finished run to files of other programs: robots' software, viewers, tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import require_same, save
from stcal.io.static_transforms import Static, fixed_joint, messages, ros1_launch, ros2_launch
from stcal.io.table import csv_text
from stcal.io.toml import opencv_matrix
from stcal.sfm.interop import gltf
from stcal.sfm.interop.export_content import Content, content_of, require_new
from stcal.sfm.runs.run_result import AnyRun
from stcal.sfm.runs.saved import saved_run

COLUMNS = (
    *("kind", "face", "circle", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "nx", "ny", "nz", "radius_mm"),
    *("sigma_x_um", "sigma_y_um", "sigma_z_um", "sigma_rx_mdeg", "sigma_ry_mdeg", "sigma_rz_mdeg"),
)


def table(content: Content) -> str:
    """Returns CSV with a row per face and circle, target frame. Circles have the axes and normals of their faces."""
    rows: list[Sequence] = [COLUMNS]
    for face, pose in content.faces.items():
        x, y, z, w = Rotation.from_matrix(np.array(pose.rotation)).as_quat(canonical=True).tolist()
        turned = [w, x, y, z, *pose.rotation[:, 2].tolist()]
        turn, shift = content.face_sigma(face) or (np.zeros(0), np.zeros(0))
        cells = [f"{v:.4g}" for v in (*(1e3 * shift), *(1e3 * np.degrees(turn)))]
        rows.append(["face", face, "", *pose.translation.tolist(), *turned, "", *(cells or [""] * 6)])
        for circle in content.of_face(face):
            cells = [""] * 3 if circle.sigma_mm is None else [f"{1e3 * v:.4g}" for v in circle.sigma_mm]
            place = [*circle.xyz_mm.tolist(), *turned, circle.radius_mm]
            rows.append(["circle", face, circle.label.circle, *place, *cells, "", "", ""])
    return csv_text(rows)


def opencv(content: Content) -> str:
    """Returns YAML for ``cv2.FileStorage``, mm and rad: by face the 4×4 pose, covariance, and names, centres, radii and
    covariances of circles."""
    lines = ["%YAML:1.0", "---", 'unit: "mm"', f"target: {_quoted(content.run.target_design.name)}"]
    lines += [
        f"reference_face: {_quoted(content.run.faces.reference_face)}",
        f"said: {_list(content.said())}",
        "faces:",
    ]
    for face, pose in content.faces.items():
        circles = content.of_face(face)
        centres = np.array([circle.xyz_mm for circle in circles]).reshape(-1, 3)
        covariances = [circle.covariance_mm2 for circle in circles if circle.covariance_mm2 is not None]
        matrices = {"target_from_face": pose.matrix()}
        if face in content.covariances:
            matrices["target_from_face_covariance"] = content.covariances[face]
        if circles:
            matrices |= {"centres": centres, "radii": np.array([[circle.radius_mm] for circle in circles])}
        if covariances:
            matrices["centres_covariance"] = np.array(covariances).reshape(-1, 9)
        lines += ["   -", f"      id: {_quoted(face)}", f"      circles: {_list([c.label.circle for c in circles])}"]
        matrix_lines = [line for name, values in matrices.items() for line in opencv_matrix(name, values)]
        lines.append(indent("\n".join(matrix_lines), "      "))
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _list(texts) -> str:
    return "[ " + ", ".join(map(_quoted, texts)) + " ]"


PLATE_M = 1e-4  # height of the cylinders that show circles. Their outer ends lie in the faces' planes.
MM_M = 1e-3


def urdf(content: Content) -> str:
    """Returns a ``robot`` of massless links: the target, the faces with visible circles, and the circles."""
    root = quoteattr(content.root)
    comments = [f"<!-- {line} -->" for line in _in_comments(content)]
    head = ['<?xml version="1.0"?>', *comments, f"<robot name={root}>", f"<link name={root}/>"]
    return "\n".join([*head, *_body(content, str), "</robot>\n"])


def xacro(content: Content) -> str:
    """Macro with ``prefix``, ``parent`` and ``origin``, which places the target anywhere, and more than once."""

    def prefixed(name: str) -> str:
        return "${prefix}" + _escaped(name)

    macro = "".join(c if c.isalnum() else "_" for c in content.root)
    root = prefixed(content.root)
    lines = ['<?xml version="1.0"?>', *(_escaped(f"<!-- {line} -->") for line in _in_comments(content))]
    lines += ['<robot xmlns:xacro="http://www.ros.org/wiki/xacro">']
    lines += [f"<xacro:macro name={quoteattr(macro)} params=\"prefix:='' parent *origin\">"]
    lines += [f"<link name={quoteattr(root)}/>"]
    lines += [f'<joint name={quoteattr(root + "_mount")} type="fixed">', '  <parent link="${parent}"/>']
    lines += [f"  <child link={quoteattr(root)}/>", '  <xacro:insert_block name="origin"/>', "</joint>"]
    return "\n".join([*lines, *_body(content, prefixed), "</xacro:macro>", "</robot>\n"])


def tf2(content: Content) -> str:
    """Returns a YAML document of ``geometry_msgs/TransformStamped`` for each frame; metres."""
    return "".join(f"# {line}\n" for line in content.said()) + messages(content.statics())


def _body(content: Content, named: Callable[[str], str]) -> list[str]:
    links = []
    for face, pose in content.faces.items():
        links.append(f"<link name={quoteattr(named(content.face_frame(face)))}>")
        red, green, blue = (f"{v / 255:.4g}" for v in content.rgb[face])
        for circle in content.of_face(face):
            x, y, z = (float(v) * MM_M for v in pose.inverse() @ circle.xyz_mm)
            links += [
                "  <visual>",
                f'    <origin xyz="{x!r} {y!r} {z - PLATE_M / 2!r}" rpy="0 0 0"/>',
                f'    <geometry><cylinder radius="{circle.radius_mm * MM_M!r}" length="{PLATE_M!r}"/></geometry>',
                f"    <material name={quoteattr(named(f'{content.face_frame(face)}_colour'))}>"
                f'<color rgba="{red} {green} {blue} 1"/></material>',
                "  </visual>",
            ]
        links.append("</link>")
        links += [f"<link name={quoteattr(named(content.circle_frame(c.label)))}/>" for c in content.of_face(face)]
    joints = [
        fixed_joint(Static(named(static.parent), named(static.child), static.pose)) for static in content.statics()
    ]
    return [*links, *(joint.rstrip("\n") for joint in joints)]


def _in_comments(content: Content) -> list[str]:
    """Returns lines for XML comments, in which ``--`` is not allowed; it is written with a space."""
    return [line.replace("--", "- -") for line in content.said()]


def _escaped(text: str) -> str:
    """Escapes expressions that xacro would evaluate."""
    return text.replace("$(", "$$(").replace("${", "$${")


ROOT = "target"  # default name of the target frame


@dataclass(frozen=True, slots=True)
class Form:
    """A form of export."""

    suffix: str
    write: Callable[[Content], str | bytes]
    lost: str  # results among faces, circles, σ and cameras that the files do not hold


FRAMES_ONLY = "cameras, radii, σ of circles; σ of faces is in comments"
FORMS = {
    "urdf": Form(".urdf", urdf, "cameras, σ of circles; σ of faces is in comments"),
    "xacro": Form(".xacro", xacro, "cameras, σ of circles; σ of faces is in comments"),
    "tf2": Form(".yaml", tf2, FRAMES_ONLY),
    "ros2": Form(".py", lambda content: ros2_launch(content.statics(), content.said()), FRAMES_ONLY),
    "ros1": Form(".launch", lambda content: ros1_launch(content.statics(), _in_comments(content)), FRAMES_ONLY),
    "opencv": Form(".yml", opencv, "cameras"),
    "csv": Form(".csv", table, "cameras, correlations"),
    "gltf": Form(".gltf", gltf.gltf, "the lens's distortion but as numbers in extras"),
    "glb": Form(".glb", gltf.glb, "the lens's distortion but as numbers in extras"),
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
    """Writes faces and circles to a new file, with σ and cameras if the form holds them, and returns the content.

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

    Raises
    ------
    InputError
        Not a finished run, the file exists, the form is unknown, or the name is bad.
    """
    path = Path(out)
    suffixes = {known.suffix: each for each, known in FORMS.items()}
    if not form and path.suffix.lower() not in suffixes:
        raise InputError(
            "E-OUTPUT-SUFFIX",
            f"{path}: suffix {path.suffix or 'missing'}; one of {', '.join(suffixes)} needed, or --form",
        )
    form = form or suffixes[path.suffix.lower()]
    if form not in FORMS:
        raise InputError("E-OPTION-FORM", f"--form {form}: unknown; one of {', '.join(FORMS)} needed")
    require_new(path)
    content = content_of(saved_run(run), name)
    written = FORMS[form].write(content)
    save(path, written)
    require_same(path, path.read_bytes, written.encode() if isinstance(written, str) else written)
    return ExportedRun(path, form, content)
