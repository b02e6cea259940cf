"""Export of a finished run to files of other programs: robots' software, OpenCV, tables."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent
from xml.sax.saxutils import quoteattr

import numpy as np

import stcal
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Rigid
from stcal.io.files import require_same, save
from stcal.io.static_transforms import METRE_MM, Static, fixed_joint, messages, ros2_launch, xyzw
from stcal.io.table import csv_text
from stcal.io.toml import opencv_matrix
from stcal.labels import CircleLabel
from stcal.report.text import number
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run, target_in

FACES_RGB = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167))
"""Okabe and Ito's palette, which colour-blind people can tell apart, used in a cycle in the order of the faces."""
BOARD_RGB = (150, 150, 150)


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """Content of an export."""

    root: str  # name of the target frame
    run: SavedRun
    target: CalibratedTarget  # of faces.json

    def circles_of(self, face: str) -> list[CircleLabel]:
        """Returns the circles of a face, in the order of the design."""
        return [label for label in self.target.circles if label.face == face]

    def xyz_face(self, label: CircleLabel) -> np.ndarray:
        """Returns the centre (3,) of a circle in the frame of its face, mm."""
        return self.target.target_from_face[label.face].inverse() @ self.target.circles[label]

    def face_frame(self, face: str) -> str:
        return f"{self.root}_{face}"

    def circle_frame(self, label: CircleLabel) -> str:
        """Returns the name of the frame at the centre of a circle, with the face's axes."""
        return f"{self.root}_{label.face}_{label.circle}"

    def statics(self) -> list[Static]:
        """Returns the frames of faces relative to the target, and of circles relative to their faces."""
        frames = []
        for face, pose in self.target.target_from_face.items():
            frames.append(Static(self.root, self.face_frame(face), pose))
            for label in self.circles_of(face):
                face_from_circle = Rigid(np.eye(3), self.xyz_face(label))
                frames.append(Static(self.face_frame(face), self.circle_frame(label), face_from_circle))
        return frames

    def face_sigma(self, face: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns σ of a face's position, µm, and rotation, mdeg, in the target's axes; empty if not known."""
        if face not in self.target.face_covariance:
            return np.zeros(0), np.zeros(0)
        sigma = 1e3 * np.sqrt(np.maximum(np.diag(self.target.face_covariance[face]), 0))  # the reference's may be −0
        return sigma[3:], np.degrees(sigma[:3])

    def said(self) -> list[str]:
        """Returns lines for comments: the origin of the content, and σ of every face."""
        faces = self.run.faces
        counts = f"{len(faces.target_from_face)} faces, {len(faces.circles)} circles"
        frames = f"{self.root}_FACE: of a face; {self.root}_FACE_CIRCLE: at a circle's centre, axes of its face"
        lines = [
            f"stcal {stcal.__version__}: target {self.run.target_design.name}, {counts}",
            f"frame {self.root}: that of face {faces.reference_face} ({faces.frame}); {frames}",
        ]
        if not self.target.face_covariance:
            return [*lines, f"no sigma: solved by {faces.solve}, which states none"]
        for face in faces.target_from_face:
            um, mdeg = (" ".join(number(v, 2 + k) for v in own) for k, own in enumerate(self.face_sigma(face)))
            text = f"sigma x y z {um} um, about x y z {mdeg} mdeg" if um else "no sigma"
            text = "reference" if face == faces.reference_face else text
            lines.append(f"face {face}: {text}")
        return lines


def require_new(out: Path) -> None:
    """Refuses a file that exists, or whose folder does not."""
    require_free(out)
    if not out.parent.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: no folder {out.parent}; make it, or give another place")


def require_free(out: Path, folder: bool = False) -> None:
    """Refuses a place that is taken; ``folder`` : an empty folder there is as good as none."""
    if os.path.lexists(out) and not (folder and out.is_dir() and not any(out.iterdir())):
        new = "new or empty folder" if folder else "new file"
        raise InputError("E-OUTPUT-EXISTS", f"{out}: exists, and nothing is overwritten; give a {new}")


def content_of(run: SavedRun, root: str) -> Content:
    """Returns the content of a run; ``root``: name of the target frame."""
    if not root.isprintable() or root.split() != [root]:
        raise InputError("E-FRAME-NAME", f"--name {root!r}: a word of visible characters without spaces needed")
    content = Content(root, run, target_in(run.faces))
    names = [root, *(each.child for each in content.statics())]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        fault = f"frames: {twice[0]} would be the name of two frames"
        raise InputError("E-FRAME-NAME", f"{fault}; rename a face or a circle of the target")
    return content


def colours(run: SavedRun) -> dict[str, tuple[int, int, int]]:
    return {face.id: FACES_RGB[i % len(FACES_RGB)] for i, face in enumerate(run.target_design.faces)}


COLUMNS = (
    *("kind", "face", "circle", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "nx", "ny", "nz", "radius_mm"),
    *("sigma_x_um", "sigma_y_um", "sigma_z_um", "sigma_rx_mdeg", "sigma_ry_mdeg", "sigma_rz_mdeg"),
)


def table(content: Content) -> str:
    """Returns CSV with a row per face and circle, target frame. Circles have the axes and normals of their faces."""
    rows: list[Sequence] = [COLUMNS]
    for face, pose in content.target.target_from_face.items():
        x, y, z, w = xyzw(pose)
        turned = [w, x, y, z, *pose.rotation[:, 2].tolist()]
        cells = [f"{v:.4g}" for v in np.concatenate(content.face_sigma(face))]
        rows.append(["face", face, "", *pose.translation.tolist(), *turned, "", *(cells or [""] * 6)])
        for label in content.circles_of(face):
            covariance = content.target.circle_covariance.get(label)
            cells = [""] * 3 if covariance is None else [f"{1e3 * v:.4g}" for v in np.sqrt(np.diag(covariance))]
            place = [*content.target.circles[label].tolist(), *turned, content.run.faces.radius_mm[label]]
            rows.append(["circle", face, label.circle, *place, *cells, "", "", ""])
    return csv_text(rows)


def opencv(content: Content) -> str:
    """Returns YAML for ``cv2.FileStorage``, mm and rad: by face the 4×4 pose, covariance, and names, centres, radii and
    covariances of circles."""
    target, radius = content.target, content.run.faces.radius_mm
    lines = ["%YAML:1.0", "---", 'unit: "mm"', f"target: {_quoted(content.run.target_design.name)}"]
    lines += [f"reference_face: {_quoted(target.reference_face)}", f"said: {_list(content.said())}", "faces:"]
    for face, pose in target.target_from_face.items():
        labels = content.circles_of(face)
        covariances = [target.circle_covariance[label] for label in labels if label in target.circle_covariance]
        matrices = {"target_from_face": pose.matrix()}
        if face in target.face_covariance:
            matrices["target_from_face_covariance"] = target.face_covariance[face]
        if labels:
            matrices["centres"] = np.array([target.circles[label] for label in labels])
            matrices["radii"] = np.array([[radius[label]] for label in labels])
        if covariances:
            matrices["centres_covariance"] = np.array(covariances).reshape(-1, 9)
        lines += ["   -", f"      id: {_quoted(face)}", f"      circles: {_list([label.circle for label in labels])}"]
        matrix_lines = [line for name, values in matrices.items() for line in opencv_matrix(name, values)]
        lines.append(indent("\n".join(matrix_lines), "      "))
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _list(texts) -> str:
    return "[ " + ", ".join(map(_quoted, texts)) + " ]"


PLATE_M = 1e-4  # height of the cylinders that show circles. Their outer ends lie in the faces' planes.
MM_M = 1 / METRE_MM


def urdf(content: Content) -> str:
    """Returns a ``robot`` of massless links: the target, the faces with visible circles, and the circles."""
    root, comments = quoteattr(content.root), (f"<!-- {line} -->" for line in _in_comments(content))
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
    links, rgb = [], colours(content.run)
    for face in content.target.target_from_face:
        links.append(f"<link name={quoteattr(named(content.face_frame(face)))}>")
        red, green, blue = (f"{v / 255:.4g}" for v in rgb[face])
        for label in content.circles_of(face):
            x, y, z = (float(v) * MM_M for v in content.xyz_face(label))
            radius_m = content.run.faces.radius_mm[label] * MM_M
            links += [
                "  <visual>",
                f'    <origin xyz="{x!r} {y!r} {z - PLATE_M / 2!r}" rpy="0 0 0"/>',
                f'    <geometry><cylinder radius="{radius_m!r}" length="{PLATE_M!r}"/></geometry>',
                f"    <material name={quoteattr(named(f'{content.face_frame(face)}_colour'))}>"
                f'<color rgba="{red} {green} {blue} 1"/></material>',
                "  </visual>",
            ]
        links.append("</link>")
        links += [f"<link name={quoteattr(named(content.circle_frame(e)))}/>" for e in content.circles_of(face)]
    joints = (fixed_joint(Static(named(e.parent), named(e.child), e.pose)) for e in content.statics())
    return [*links, *(joint.rstrip("\n") for joint in joints)]


def _in_comments(content: Content) -> list[str]:
    """Returns lines for XML comments, in which ``--`` is not allowed; it is written with a space."""
    return [line.replace("--", "- -") for line in content.said()]


def _escaped(text: str) -> str:
    """Escapes expressions that xacro would evaluate."""
    return text.replace("$(", "$$(").replace("${", "$${")


@dataclass(frozen=True, slots=True)
class Form:
    suffix: str
    write: Callable[[Content], str]
    lost: str  # results among faces, circles, σ and cameras that the files do not hold


FRAMES_ONLY = "cameras, radii, σ of circles; σ of faces is in comments"
FORMS = {
    "urdf": Form(".urdf", urdf, "cameras, σ of circles; σ of faces is in comments"),
    "xacro": Form(".xacro", xacro, "cameras, σ of circles; σ of faces is in comments"),
    "tf2": Form(".yaml", tf2, FRAMES_ONLY),
    "ros2": Form(".py", lambda content: ros2_launch(content.statics(), content.said()), FRAMES_ONLY),
    "opencv": Form(".yml", opencv, "cameras"),
    "csv": Form(".csv", table, "cameras, correlations"),
}
"""Forms by the value of ``--form``."""


@dataclass(frozen=True, slots=True)
class Exported:
    """A file or folder that was written."""

    path: Path
    text: str  # on what is in it, and what is not


@require_arguments
def export_run(run: AnyRun, out: str | Path, form: str = "", name: str = "target") -> Exported:
    """Writes faces and circles to a new file, with σ if the form holds them.

    Parameters
    ----------
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : New file, whose suffix gives the form: ``.urdf``, ``.xacro``, ``.yaml`` (tf2), ``.py`` (a launch file of ROS
        2), ``.yml`` (OpenCV) or ``.csv``.
    form : ``urdf``, ``xacro``, ``tf2``, ``ros2``, ``opencv`` or ``csv``, in place of that of the suffix.
    name : Name of the target frame, and prefix of the other frames' names.

    Raises
    ------
    InputError
        Not a finished run, the file exists, the form is unknown, or the name is bad.
    """
    path = Path(out)
    suffixes = {known.suffix: each for each, known in FORMS.items()}
    form = form or suffixes.get(path.suffix.lower(), "")
    if not form:
        fault = f"{path}: suffix {path.suffix or 'missing'}"
        raise InputError("E-OUTPUT-SUFFIX", f"{fault}; one of {', '.join(suffixes)} needed, or --form")
    if form not in FORMS:
        raise InputError("E-OPTION-FORM", f"--form {form}: unknown; one of {', '.join(FORMS)} needed")
    require_new(path)
    content = content_of(saved_run(run), name)
    written = FORMS[form].write(content)
    save(path, written)
    require_same(path, path.read_bytes, written.encode())
    target, lost = content.target, FORMS[form].lost
    what = f"{len(target.target_from_face)} faces and {len(target.circles)} circles, frame {name}, as {form}: {path}"
    no_sigma = f"\nno σ: the run was solved by {content.run.faces.solve}, which states none; run it with joint"
    return Exported(path, f"{what}{'' if target.face_covariance else no_sigma}\nnot in it: {lost}")
