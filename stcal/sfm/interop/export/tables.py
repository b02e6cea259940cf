"""Faces and circles as tables and matrices: CSV, and YAML of OpenCV's FileStorage."""

import csv
import io
from textwrap import indent

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.io.plain_yaml import opencv_matrix
from stcal.sfm.interop.export.content import Content

COLUMNS = (
    *("kind", "face", "circle", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "nx", "ny", "nz", "radius_mm"),
    *("sigma_x_um", "sigma_y_um", "sigma_z_um", "sigma_rx_mdeg", "sigma_ry_mdeg", "sigma_rz_mdeg"),
)


def table(content: Content) -> str:
    """A row for each face and each circle, target frame; the circles have their faces' axes and normals."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for face, pose in content.faces.items():
        turned = [*_wxyz(pose.rotation), *pose.rotation[:, 2].tolist()]
        sigma = content.face_sigma(face)
        own = [""] * 6 if sigma is None else [_digits(v) for v in (*(1e3 * sigma[1]), *(1e3 * np.degrees(sigma[0])))]
        writer.writerow(["face", face, "", *pose.translation.tolist(), *turned, "", *own])
        for circle in content.of_face(face):
            own = [""] * 3 if circle.sigma_mm is None else [_digits(1e3 * v) for v in circle.sigma_mm]
            place = circle.xyz_mm.tolist()
            writer.writerow(["circle", face, circle.label.circle, *place, *turned, circle.radius_mm, *own, "", "", ""])
    return stream.getvalue()


def opencv(content: Content) -> str:
    """For ``cv2.FileStorage``: a list of faces, each with 4×4, covariance, names of circles, centres (n, 3), radii and
    the centres' covariances (n, 9); mm, rad."""
    lines = ["%YAML:1.0", "---", 'unit: "mm"', f"target: {_quoted(content.run.target.name)}"]
    lines += [
        f"reference_face: {_quoted(content.run.faces.reference_face)}",
        f"said: {_list(content.said())}",
        "faces:",
    ]
    for face, pose in content.faces.items():
        own = content.of_face(face)
        centres = np.array([circle.xyz_mm for circle in own]).reshape(-1, 3)
        covariances = [circle.covariance_mm2 for circle in own if circle.covariance_mm2 is not None]
        matrices = {"target_from_face": pose.matrix()}
        if face in content.covariances:
            matrices["target_from_face_covariance"] = content.covariances[face]
        if own:
            matrices |= {"centres": centres, "radii": np.array([[circle.radius_mm] for circle in own])}
        if covariances:
            matrices["centres_covariance"] = np.array(covariances).reshape(-1, 9)
        lines += ["   -", f"      id: {_quoted(face)}", f"      circles: {_list([c.label.circle for c in own])}"]
        matrix_lines = [line for name, values in matrices.items() for line in opencv_matrix(name, values)]
        lines.append(indent("\n".join(matrix_lines), "      "))
    return "\n".join(lines) + "\n"


def _wxyz(rotation: np.ndarray) -> list[float]:
    x, y, z, w = Rotation.from_matrix(np.array(rotation)).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def _digits(value: float) -> str:
    return f"{value:.4g}"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _list(texts) -> str:
    return "[ " + ", ".join(map(_quoted, texts)) + " ]"
