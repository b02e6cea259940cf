"""Scale of a model: λ in mm per unit of the model's world, from the board."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stcal.design import BoardDesign, FaceDesign, ScaleReference, faces_of_known_shape, known_distances
from stcal.errors import DegenerateError, ScaleError
from stcal.geometry.arrays import freeze
from stcal.geometry.rigid import Rigid, Similarity, align_rigid, align_similarity
from stcal.labels import CircleLabel, Label, dot_cells
from stcal.sfm.data.group_model import ImageObservations, WorldModel

MIN_DOTS = 4
EDGE_SIGMA_PX = 0.1  # σ of the shift that all edges of all tags share
MIN_CORNERS = 3  # smallest number of corners that determine the scale of a face of known shape
ScaleSource = Literal["board", "faces", "distances", "drawing"]


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """The scale of one group."""

    board_from_world: Similarity  # over all dots by least squares, unless by rows; its scale is λ, mm per unit
    rows_mm_per_unit: float  # λ as in Zhang & Wei (2017): first and last row, all pairs
    rows: tuple[int, int]
    labels: tuple[Label, ...]  # (n,) the dots, or the corners of faces of known shape
    residuals_mm: np.ndarray  # (n, 3) minus design, board frame, of corners face frames
    sigma_mm_per_unit: float  # from the stated σ of the dots' positions
    source: ScaleSource = "board"  # what determines λ; ``drawing`` if no size is known

    def __post_init__(self):
        freeze(self, "residuals_mm", (len(self.labels), 3), "residuals")

    @property
    def mm_per_unit(self) -> float:
        """λ, by least squares or by rows, as requested."""
        return self.board_from_world.scale

    def group_from_world(self) -> Similarity:
        """Returns the similarity to the group's metric frame, which is the world in mm."""
        return Similarity(self.mm_per_unit, Rigid())

    def rms_mm(self) -> float:
        """Returns the RMS of the residuals' lengths."""
        return float(np.sqrt((self.residuals_mm**2).sum(1).mean()))

    def mean_mm(self) -> float:
        """Returns the mean of the residuals' lengths: the first measure of Zhang & Wei's Table 1."""
        return float(np.linalg.norm(self.residuals_mm, axis=1).mean())

    def spread_mm(self) -> float:
        """Spread of the residuals' lengths, the second measure of Zhang & Wei's Table 1, there a mean square error."""
        return float(np.linalg.norm(self.residuals_mm, axis=1).std())


def find_scale(model: WorldModel, board: BoardDesign, by_rows: bool = False) -> Scale:
    """Returns the scale of a model from the dots of the board; ``by_rows``: λ as in Zhang & Wei (2017)."""
    members = model.points_by_face().get("board", np.zeros(0, int))
    where = f"group {model.group}: scale"
    if len(members) < MIN_DOTS and (own := _of_faces(model, board) or _of_distances(model, board)) is not None:
        return own
    if len(members) < MIN_DOTS:
        raise ScaleError(
            "E-SCALE-FEW-DOTS",
            f"{where}: {len(members)} board dots mapped, {MIN_DOTS} needed; photograph the board with the faces; "
            "check that the camera file belongs to the images and the board file to the board",
        )
    labels = [model.labels[i] for i in members]
    cells = dot_cells(labels)
    xyz_board = board.places_mm(labels)
    xyz_world = model.xyz_model[members]
    try:
        board_from_world = align_similarity(xyz_board, xyz_world)
    except DegenerateError as error:
        raise ScaleError(
            "E-SCALE-COLLINEAR", f"{where}: the mapped board dots lie in one line; show more rows of the board"
        ) from error
    spread = np.sqrt(((xyz_board - xyz_board.mean(0)) ** 2).sum())
    # λ by Zhang & Wei (2017), eq. 7, with the correct mean over pairs: 2/(n(n−1)), not 1/(n−1)!
    rows = int(cells[:, 0].min()), int(cells[:, 0].max())
    chosen = np.isin(cells[:, 0], rows)
    i, j = np.triu_indices(int(chosen.sum()), 1)
    apart = [np.linalg.norm(xyz[chosen][i] - xyz[chosen][j], axis=1) for xyz in (xyz_board, xyz_world)]
    mean_ratio = float((apart[0] / apart[1]).mean())
    if by_rows:
        board_from_world = Similarity(mean_ratio, align_rigid(xyz_board, mean_ratio * xyz_world))
    return Scale(
        board_from_world,
        mean_ratio,
        rows,
        tuple(labels),
        board_from_world @ xyz_world - xyz_board,
        float(board_from_world.scale * board.sigma_mm / spread),
    )


def _of_faces(model: WorldModel, board: BoardDesign) -> Scale | None:
    """Returns the scale from the corners of faces of known shape, None if there are none."""
    labels: list[Label] = []
    scales, weights, parts = [], [], []
    for face, members in known_points(model.labels, board):
        design, xyz = face.places_mm(model.labels[i].circle for i in members), model.xyz_model[members]
        try:
            scales.append(align_similarity(design, xyz).scale)
        except DegenerateError:
            continue
        weights.append(((design - design.mean(0)) ** 2).sum() / (face.sigma_mm or 1.0) ** 2)
        parts.append((design, xyz))
        labels += [model.labels[i] for i in members]
    if not scales:
        return None
    scale = float(np.exp(np.average(np.log(scales), weights=weights)))
    residuals = [align_rigid(design, scale * xyz) @ (scale * xyz) - design for design, xyz in parts]
    sigma = scale / float(np.sqrt(np.sum(weights)))
    whole = Similarity(scale, Rigid())
    return Scale(whole, scale, (0, 0), tuple(labels), np.concatenate(residuals), sigma, "faces")


def _of_distances(model: WorldModel, board: BoardDesign) -> Scale | None:
    """Returns the scale from known distances, None if there are none."""
    place = {label: i for i, label in enumerate(model.labels)}
    known = [d for d in known_distances(board) if d.first in place and d.second in place]
    if not known:
        return None
    units = [np.linalg.norm(model.xyz_model[place[d.first]] - model.xyz_model[place[d.second]]) for d in known]
    weights = np.array([(d.mm / d.sigma_mm) ** 2 for d in known])
    ratios = np.array([d.mm for d in known]) / units
    scale = float(np.average(ratios, weights=weights))
    away = np.array([[scale * unit - d.mm, 0.0, 0.0] for d, unit in zip(known, units, strict=True)])
    labels = tuple(d.first for d in known)
    sigma = scale / float(np.sqrt(weights.sum()))
    source: ScaleSource = "drawing" if known[0].drawn else "distances"
    return Scale(Similarity(scale, Rigid()), scale, (0, 0), labels, away, sigma, source)


def with_edge_sigma(board: BoardDesign, observations: Sequence[ImageObservations]) -> BoardDesign:
    """Returns the board with the σ of printed sizes enlarged by that of a common shift of the edges of tags: light, ink
    and camera make all tags look larger or smaller alike, which no residual shows."""
    if not isinstance(board, ScaleReference) or not any(face.of_tags for face in board.faces):
        return board
    sides: dict[CircleLabel, CircleLabel] = {}
    for face in board.faces:
        labels = face.labels()
        if face.of_tags:
            sides |= {labels[k]: labels[k + 1] for k in range(0, len(labels), 4)}
    lengths: dict[str, list[float]] = {}
    for image in observations:
        place = dict(zip(image.labels, image.centre_px, strict=True))
        for first, second in sides.items():
            if first in place and second in place:
                length = float(np.linalg.norm(place[first] - place[second]))
                lengths.setdefault(first.face, []).append(length)
    faces = []
    for face in board.faces:
        moved = 2 * EDGE_SIGMA_PX / float(np.median(lengths[face.id])) if face.id in lengths else 0.0
        variance = face.size_sigma**2 + moved**2
        share = moved**2 / variance if variance else 0.0
        faces.append(replace(face, size_sigma=float(np.sqrt(variance)), edge_share=share))
    return replace(board, faces=tuple(faces))


def known_points(labels: Sequence[Label], board: BoardDesign) -> list[tuple[FaceDesign, np.ndarray]]:
    """Returns the faces of known shape with three points or more among ``labels``, and the indices of these."""
    faces = {face.id: face for face in faces_of_known_shape(board)}
    members: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        if isinstance(label, CircleLabel) and label.face in faces:
            members.setdefault(label.face, []).append(i)
    return [(faces[face], np.array(rows)) for face, rows in members.items() if len(rows) >= MIN_CORNERS]
