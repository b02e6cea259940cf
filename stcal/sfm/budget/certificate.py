"""The certificate of calibration, for a customer and an auditor (ISO/IEC 17025:2017, 7.8.2 and 7.8.4; GUM)."""

from functools import partial

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.report.document import Block, Document, Section, Table, bullets, columns, plot
from stcal.report.svg import AXIS, AXIS_COLOURS, FAINT, INK, Axes, Drawing
from stcal.report.text import NONE
from stcal.sfm.budget.budget_file import BudgetFile
from stcal.sfm.budget.budget_tables import contributions, facts, hashes, inputs, length_test, method, results, what_u_is
from stcal.sfm.budget.combine import FIELDS

REQUIRED = [name for name in FIELDS if name not in ("place", "item", "maker", "type", "instrument", "operator")]
"""Fields without which a page is no certificate (ISO/IEC 17025:2017, 7.8.2.1 and 7.8.4.1)."""
RELATES = (
    "The results relate only to the item named above, in the state in which it was calibrated. The certificate may be "
    "reproduced only as a whole."
)
STATED = {
    "rows": "rows of dots",
    "columns": "columns of dots",
    "pitch_mm": "pitch of the dots, mm",
    "pitch_sigma_ppm": "its standard uncertainty, ppm",
    "temperature_c": "temperature, °C",
    "temperature_sigma_k": "its standard uncertainty, K",
    "expansion_ppm_per_k": "coefficient of expansion, ppm/K",
    "expansion_sigma_ppm_per_k": "its standard uncertainty, ppm/K",
    "reference_temperature_c": "reference temperature, °C",
}
"""Words for what is stated of board and target."""
DIRECTIONS = 200  # number of directions among which that of the drawing is chosen
MOST_NAMES = 40  # number of points of a face up to which all are named in its drawing; of more, the outermost are
SAME_PLANE_MM = 0.1  # distance of a face from the middle of all within which the item is one plane


def certificate(file: BudgetFile) -> Document:
    """Returns the certificate of a budget for which all is stated that it needs."""
    images, groups = sum(each.images for each in file.views), len(file.views)
    given = {"item": file.run.target} | {name: value.strip() for name, value in file.fields.items() if value.strip()}
    head = [[FIELDS.get(name, name), given[name]] for name in dict.fromkeys((*FIELDS, *given)) if name in given]
    bodies = dict.fromkeys(row.body for row in file.stated)
    values = {(row.body, row.key): f"{row.value:g}" for row in file.stated}
    by_words = {words: [values.get((body, key), NONE) for body in bodies] for key, words in STATED.items()}
    rows = [[words, *row] for words, row in by_words.items() if set(row) - {NONE}]
    stated = Table(["<stated", *({"target": "item"}.get(body, body) for body in bodies)], rows)
    found = file.run.photographs_sha256
    kept = f"{len(found)} of {images} photographs, as they were in their folder when this certificate was made"
    photographs = Table(["<photograph", "<SHA-256"], list(found.items()), css="text")
    programs = f"bundle adjustment by stcal {file.run.version}, uncertainties by stcal {file.version}"
    adjusted = f"the points of all faces and the poses of the camera were adjusted together ({programs})"
    how = f"{images} photographs of the item in {groups} group{'s' * (groups != 1)}; {adjusted}"
    tests = [block for test in file.length_tests for block in length_test(test)]
    return Document(
        f"Certificate of calibration no. {file.fields['number'].strip()}",
        file.fields["laboratory"].strip(),
        [
            Section("Method and conditions", [file.fields["method"], how, stated, file.holds]),
            Section("What is measured", [drawings(file), bullets(file.definitions), what_u_is(file)]),
            Section("Results", [*results(file), "End of the results; the annex follows"], terminal=True),
            Section("Annex: test of lengths", tests, terminal=True),
            Section("Annex: uncertainty budget", [method(file), inputs(file), *contributions(file)], terminal=True),
            Section("Annex: data", [hashes(file), kept, photographs, "End of the certificate"]),
        ],
        banner=[facts(head), RELATES],
    )


def drawings(file: BudgetFile) -> Block:
    """Returns the item with its faces, and each face with its numbered circles, axes and origin."""
    circles: dict[str, dict[str, np.ndarray]] = {}
    for label, each in file.circles.items():
        face, _, circle = label.partition(":")
        circles.setdefault(face, {})[circle] = np.array(each.position_mm)
    poses = {file.reference_face: Rigid()} | {
        name: Rigid(Rotation.from_rotvec(each.rotation_vector_deg, degrees=True), each.position_mm)
        for name, each in file.faces.items()
        if each.position_mm is not None
    }
    middle = np.mean([np.mean(list(own.values()), axis=0) for own in circles.values()], axis=0)
    # Z of a face leads out of the body or, of a printed one, into it; of one face alone, towards who looks at it.
    out = {
        face: -1.0 if (pose.translation - middle) @ pose.rotation[:, 2] < -SAME_PLANE_MM else 1.0
        for face, pose in poses.items()
    }
    figures = [plot(partial(_item, circles, poses, out), "The item: its faces with the axes of their frames", css="")]
    for face, own in circles.items():
        xyz = dict(zip(own, poses[face].inverse() @ np.array(list(own.values())), strict=True))
        figures.append(plot(partial(_face, xyz, out[face]), f"Face {face}, seen from outside", css=""))
    return columns(*([figure] for figure in figures), css="columns thumbs")


def _outermost(xy: np.ndarray) -> np.ndarray:
    try:
        return ConvexHull(xy).vertices
    except QhullError:  # a line
        return np.arange(len(xy))


def _face(xyz: dict[str, np.ndarray], out: float) -> Drawing:
    """Draws the circles of a face in its frame; ``out`` : -1 where Z leads into the body, and Y is drawn downwards."""
    drawing = Drawing(3.3, 2.6)
    xy = np.array(list(xyz.values()))[:, :2] * [1.0, out]
    reach = 0.25 * float(np.ptp(np.vstack([xy, [[0, 0]]]), axis=0).max())
    tips = reach * np.array([[1.0, 0.0], [0.0, out]])
    axes = Axes.equal(drawing, drawing.panels(left=16, right=16, top=14, bottom=14)[0], np.vstack([xy, tips, 0 * tips]))
    for tip, colour, name, aside in zip(tips, AXIS_COLOURS, "XY", ((0, -8), (-9, 0)), strict=False):
        axes.arrows(np.zeros((1, 2)), tip[None], 1.2, colour)
        axes.words(tip[0], tip[1], name, aside, colour=colour, size=11, weight="bold")
    axes.marks(xy[:, 0], xy[:, 1], "ring", 7, INK)
    names = list(xyz)
    for i in range(len(xy)) if len(xy) <= MOST_NAMES else _outermost(xy):
        axes.words(xy[i, 0], xy[i, 1], names[i], (0, 11), size=10)
    return drawing


def _item(circles: dict[str, dict[str, np.ndarray]], poses: dict[str, Rigid], out: dict[str, float]) -> Drawing:
    """Draws faces and frames, Y of the reference up, from where most are seen; those that look away are pale."""
    drawing = Drawing(3.3, 2.6)
    normals = {face: out[face] * poses[face].rotation[:, 2] for face in circles}
    # Evenly on a sphere, but not along Y, which is up.
    turn, height = np.pi * (1 + 5**0.5) * np.arange(DIRECTIONS), np.linspace(-0.95, 0.95, DIRECTIONS)
    across = np.sqrt(1 - height**2)
    towards = np.column_stack([across * np.cos(turn), height, across * np.sin(turn)])
    facing = np.clip(towards @ np.array(list(normals.values())).T, 0, None)
    viewer = towards[np.argmax(np.sqrt(facing).sum(1) + 0.1 * height)]
    right = np.cross([0.0, 1.0, 0.0], viewer)
    right /= np.linalg.norm(right)
    onto = np.array([right, np.cross(viewer, right)])
    places = {face: np.array(list(own.values())) @ onto.T for face, own in circles.items()}
    together = np.vstack(list(places.values()))
    reach = 0.16 * float(np.ptp(together, axis=0).max())
    axes = Axes.equal(drawing, drawing.panels(left=14, right=14, top=14, bottom=14)[0], together)
    for face in sorted(circles, key=lambda face: normals[face] @ viewer):
        seen, xy = normals[face] @ viewer > 0, places[face]
        outline = xy[_outermost(xy)]
        ink = INK if seen else FAINT
        axes.lines([outline.T], AXIS if seen else FAINT, 1.0, fill="#eef2f6" if seen else "#ffffff")
        axes.marks(xy[:, 0], xy[:, 1], "ring", 4, ink)
        if seen:
            start = onto @ poses[face].translation
            for direction, colour in zip(poses[face].rotation.T, AXIS_COLOURS, strict=True):
                axes.arrows(start[None], reach * (onto @ direction)[None], 1.2, colour)
    for face, xy in places.items():  # of a face that looks away, outside of the item
        seen = normals[face] @ viewer > 0
        at = xy.mean(0) + (0.0 if seen else 1.2 * reach) * (onto @ normals[face])
        axes.words(at[0], at[1], face, size=11, weight="bold", colour=INK if seen else AXIS)
    return drawing
