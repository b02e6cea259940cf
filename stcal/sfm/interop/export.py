"""Export of a finished run to files of other programs: robots' software, viewers, tables."""

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.files import save
from stcal.io.poses.programs import (
    Static,
    fixed_joint,
    messages,
    read_messages,
    read_ros1_launch,
    read_ros2_launch,
    ros1_launch,
    ros2_launch,
    static_of_joint,
)
from stcal.io.table import csv_rows, csv_text, require_poses_written
from stcal.io.toml import load_yaml, opencv_matrix
from stcal.sfm.interop import gltf
from stcal.sfm.interop.export_content import Content, content_of
from stcal.sfm.runs.saved import AnyRun, saved_run

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
        sigma = content.face_sigma(face)
        sigma_cells = (
            [""] * 6 if sigma is None else [_digits(v) for v in (*(1e3 * sigma[1]), *(1e3 * np.degrees(sigma[0])))]
        )
        rows.append(["face", face, "", *pose.translation.tolist(), *turned, "", *sigma_cells])
        for circle in content.of_face(face):
            sigma_cells = [""] * 3 if circle.sigma_mm is None else [_digits(1e3 * v) for v in circle.sigma_mm]
            place = circle.xyz_mm.tolist()
            rows.append(
                ["circle", face, circle.label.circle, *place, *turned, circle.radius_mm, *sigma_cells, "", "", ""]
            )
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


def _digits(value: float) -> str:
    return f"{value:.4g}"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _list(texts) -> str:
    return "[ " + ", ".join(map(_quoted, texts)) + " ]"


PLATE_M = 1e-4
"""Height of the cylinders that show circles. Their outer ends lie in the faces' planes."""
MM_M = 1e-3


def urdf(content: Content) -> str:
    """Returns a ``robot`` of massless links: the target, the faces with visible circles, and the circles."""
    head = ['<?xml version="1.0"?>', *_comments(content), f"<robot name={quoteattr(content.root)}>"]
    return "\n".join([*head, f"<link name={quoteattr(content.root)}/>", *_body(content, str), "</robot>\n"])


def xacro(content: Content) -> str:
    """Macro with ``prefix``, ``parent`` and ``origin``, which places the target anywhere, and more than once."""

    def prefixed(name: str) -> str:
        return "${prefix}" + _escaped(name)

    macro = "".join(c if c.isalnum() else "_" for c in content.root)
    root = prefixed(content.root)
    lines = ['<?xml version="1.0"?>', *map(_escaped, _comments(content))]
    lines += ['<robot xmlns:xacro="http://www.ros.org/wiki/xacro">']
    lines += [f"<xacro:macro name={quoteattr(macro)} params=\"prefix:='' parent *origin\">"]
    lines += [f"<link name={quoteattr(root)}/>"]
    lines += [f'<joint name={quoteattr(root + "_mount")} type="fixed">', '  <parent link="${parent}"/>']
    lines += [f"  <child link={quoteattr(root)}/>", '  <xacro:insert_block name="origin"/>', "</joint>"]
    return "\n".join([*lines, *_body(content, prefixed), "</xacro:macro>", "</robot>\n"])


def tf2(content: Content) -> str:
    """Returns a YAML document of ``geometry_msgs/TransformStamped`` for each frame; metres."""
    return "".join(f"# {line}\n" for line in content.said()) + messages(content.statics())


def launch_ros2(content: Content) -> str:
    """Returns a launch file of ROS 2 that publishes the frames."""
    return ros2_launch(content.statics(), content.said())


def launch_ros1(content: Content) -> str:
    """Returns a launch file of ROS 1 that publishes the frames."""
    return ros1_launch(content.statics(), [line.replace("--", "- -") for line in content.said()])


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


def _comments(content: Content) -> list[str]:
    """Returns XML comments. ``--`` is not allowed in them and is written with a space."""
    return [f"<!-- {line.replace('--', '- -')} -->" for line in content.said()]


def _escaped(text: str) -> str:
    """Escapes expressions that xacro would evaluate."""
    return text.replace("$(", "$$(").replace("${", "$${")


def read_urdf(text: str) -> list[Static]:
    """Returns the frames in a text of :func:`urdf` or :func:`xacro`."""
    joints = ElementTree.fromstring(text).iter("joint")
    return [static_of_joint(joint) for joint in joints if joint.find("origin") is not None]


def read_table(text: str) -> list[Static]:
    """Returns the frames in a text of :func:`table`."""
    frames: list[Static] = []
    for row in csv_rows(text):
        turn, place = ([float(row[name]) for name in COLUMNS[at]] for at in (slice(6, 10), slice(3, 6)))
        pose = Poses.from_quaternions([turn], [place])[0]
        if row["kind"] == "face":
            face = pose
        frames.append(Static(row["face"], row["circle"], pose if row["kind"] == "face" else face.inverse() @ pose))
    return frames


def read_opencv(text: str) -> list[Static]:
    """Returns the frames in a text of :func:`opencv`."""
    frames = []
    for face in load_yaml(text)["faces"]:
        pose = Rigid.from_matrix(np.reshape(face["target_from_face"]["data"], (4, 4)))
        frames.append(Static("", face["id"], pose))
        centres = np.reshape(face["centres"]["data"], (-1, 3)) if "centres" in face else ()
        frames += [Static(face["id"], "", Rigid(np.eye(3), pose.inverse() @ centre)) for centre in centres]
    return frames


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
    "urdf": Form(".urdf", urdf, "cameras, σ of circles; σ of faces is in comments", read_urdf),
    "xacro": Form(".xacro", xacro, "cameras, σ of circles; σ of faces is in comments", read_urdf),
    "tf2": Form(".yaml", tf2, FRAMES_ONLY, read_messages),
    "ros2": Form(".py", launch_ros2, FRAMES_ONLY, read_ros2_launch),
    "ros1": Form(".launch", launch_ros1, FRAMES_ONLY, read_ros1_launch),
    "opencv": Form(".yml", opencv, "cameras", read_opencv),
    "csv": Form(".csv", table, "cameras, correlations", read_table),
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
