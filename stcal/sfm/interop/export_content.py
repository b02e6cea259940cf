"""Content of the exports of a finished run: faces, circles, cameras and their σ; target frame, mm."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import stcal
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.json import Part
from stcal.io.static_transforms import Static
from stcal.labels import CircleLabel, parse_label
from stcal.report.text import number
from stcal.sfm.runs.report_file import ReportCamera, Space
from stcal.sfm.runs.run_result import SavedRun

FACES_RGB = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
)
"""Okabe and Ito's palette, which colour-blind people can tell apart, used in a cycle in the order of the faces."""
BOARD_RGB = (150, 150, 150)


class _Report(Part):
    camera: ReportCamera
    scene: Space


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """A mapped photograph with its group and the pose of its camera."""

    name: str
    group: str
    target_from_camera: Rigid


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle of the target, target frame."""

    label: CircleLabel
    xyz_mm: np.ndarray  # (3,)
    radius_mm: float
    covariance_mm2: np.ndarray | None  # (3, 3)

    @property
    def sigma_mm(self) -> np.ndarray | None:
        """σ of x, y, z, mm, or None without a covariance."""
        return None if self.covariance_mm2 is None else np.sqrt(np.diag(self.covariance_mm2))


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """Content of an export."""

    root: str  # name of the target frame
    run: SavedRun
    camera: Camera  # as the run refined it
    faces: dict[str, Rigid]  # target_from_face
    covariances: dict[str, np.ndarray]  # of the faces, 6×6, empty if the run states none
    circles: tuple[Circle, ...]
    photographs: tuple[Photograph, ...]
    rgb: dict[str, tuple[int, int, int]]  # by face

    def of_face(self, face: str) -> list[Circle]:
        """Returns the circles of a face, in the order of the design."""
        return [circle for circle in self.circles if circle.label.face == face]

    def face_frame(self, face: str) -> str:
        """Returns the name of the frame of a face."""
        return f"{self.root}_{face}"

    def circle_frame(self, label: CircleLabel) -> str:
        """Returns the name of the frame at the centre of a circle, with the face's axes."""
        return f"{self.root}_{label.face}_{label.circle}"

    def statics(self) -> list[Static]:
        """Returns the frames of faces relative to the target, and of circles relative to their faces."""
        frames = []
        for face, pose in self.faces.items():
            frames.append(Static(self.root, self.face_frame(face), pose))
            for circle in self.of_face(face):
                face_from_circle = Rigid(np.eye(3), pose.inverse() @ circle.xyz_mm)
                frames.append(Static(self.face_frame(face), self.circle_frame(circle.label), face_from_circle))
        return frames

    def face_sigma(self, face: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns σ of a face's rotation, rad, and position, mm, about and along the target's axes, or None."""
        if face not in self.covariances:
            return None
        sigma = np.sqrt(np.maximum(np.diag(self.covariances[face]), 0))  # the reference face has 0 up to rounding
        return sigma[:3], sigma[3:]

    def said(self) -> list[str]:
        """Returns lines for comments: the origin of the content, and σ of every face."""
        faces = self.run.faces
        lines = [
            f"stcal {stcal.__version__}: target {self.run.target_design.name}, {len(self.faces)} faces, "
            f"{len(self.circles)} circles, {len(self.photographs)} photographs",
            f"frame {self.root}: that of face {faces.reference_face} ({faces.frame}); "
            f"{self.root}_FACE: of a face; {self.root}_FACE_CIRCLE: at a circle's centre, axes of its face",
        ]
        if not self.covariances:
            return [*lines, f"no sigma: solved by {faces.solve}, which states none"]
        for face in self.faces:
            turn, shift = self.face_sigma(face) or (np.zeros(3), np.zeros(3))
            um = " ".join(number(1e3 * v, 2) for v in shift)
            mdeg = " ".join(number(1e3 * v, 3) for v in np.degrees(turn))
            text = "reference" if face == faces.reference_face else f"sigma x y z {um} um, about x y z {mdeg} mdeg"
            lines.append(f"face {face}: {text}")
        return lines


def require_new(out: Path) -> None:
    """Refuses a file that exists, or whose folder does not."""
    if os.path.lexists(out):
        raise InputError("E-OUTPUT-EXISTS", f"{out}: exists, and nothing is overwritten; give a new file")
    if not out.parent.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: no folder {out.parent}; make it, or give another place")


def content_of(run: SavedRun, root: str) -> Content:
    """Returns the content of a run; ``root``: name of the target frame."""
    if not root.isprintable() or root.split() != [root]:
        raise InputError("E-FRAME-NAME", f"--name {root!r}: a word of visible characters without spaces needed")
    report = run.report_as(_Report)
    faces, scene = run.faces, report.scene
    circles = tuple(
        Circle(
            parse_label(label),  # type: ignore[arg-type]
            np.array(xyz, float),
            faces.radius_mm[label],
            np.array(faces.circle_covariance_mm2[label]) if label in faces.circle_covariance_mm2 else None,
        )
        for label, xyz in faces.circles.items()
    )
    content = Content(
        root=root,
        run=run,
        camera=run.adjusted_camera(report.camera),
        faces=faces.poses(),
        covariances={face: np.array(c) for face, c in faces.target_from_face_covariance.items()},
        circles=circles,
        photographs=tuple(
            Photograph(each.image, each.group, Rigid(np.array(each.axes).T, each.position_mm)) for each in scene.cameras
        ),
        rgb=colours(run),
    )
    names = [root, *(each.child for each in content.statics())]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            "E-FRAME-NAME",
            f"frames: {twice[0]} would be the name of two frames; rename a face or a circle of the target",
        )
    return content


def colours(run: SavedRun) -> dict[str, tuple[int, int, int]]:
    """Returns the colour of each face, by id."""
    return {face.id: FACES_RGB[i % len(FACES_RGB)] for i, face in enumerate(run.target_design.faces)}
