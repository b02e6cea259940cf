"""Scale of a model: λ in mm per unit of the model's world, from the board."""

from dataclasses import dataclass

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import DegenerateError, ScaleError
from stcal.geometry.align import align_rigid, align_similarity
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Rigid, Similarity
from stcal.labels import DotLabel, dot_cells
from stcal.sfm.data.model import WorldModel

MIN_DOTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """The scale of one group.

    ``board_from_world`` : similarity over all dots by least squares, unless λ by rows was requested; its scale is λ
    (mm per unit); ``rows_mm_per_unit`` : λ as in Zhang & Wei (2017) (first and last row, all pairs); ``rows`` : these
    two rows; ``labels`` : (n,) the dots; ``residuals_mm`` : (n, 3) reconstructed minus design, board frame;
    ``sigma_mm_per_unit`` : σ of λ, from the stated σ of the dots' positions.
    """

    board_from_world: Similarity
    rows_mm_per_unit: float
    rows: tuple[int, int]
    labels: tuple[DotLabel, ...]
    residuals_mm: np.ndarray
    sigma_mm_per_unit: float

    def __post_init__(self):
        object.__setattr__(self, "residuals_mm", frozen(self.residuals_mm, (len(self.labels), 3), "residuals"))

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
        """Returns the standard deviation of the residuals' lengths: the second measure of Zhang & Wei's Table 1.

        The table calls it mean square error. It is smaller than the mean there, which no root mean square can be.
        """
        return float(np.linalg.norm(self.residuals_mm, axis=1).std())


def find_scale(model: WorldModel, board: BoardDesign, by_rows: bool = False) -> Scale:
    """Returns the scale of a model from the dots of the board; ``by_rows`` : λ as in Zhang & Wei (2017).

    Raises
    ------
    ScaleError
        Fewer than four dots are mapped, or all are collinear.
    """
    members = model.points_by_face().get("board", np.zeros(0, int))
    where = f"group {model.group}: scale"
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
    mean_ratio, rows = _by_rows(xyz_board, xyz_world, cells[:, 0])
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


def _by_rows(xyz_board, xyz_world, row) -> tuple[float, tuple[int, int]]:
    """Computes λ by Zhang & Wei (2017), eq. 7, with the correct mean over pairs: 2/(n(n−1)), not 1/(n−1)!."""
    first, last = int(row.min()), int(row.max())
    chosen = (row == first) | (row == last)
    i, j = np.triu_indices(int(chosen.sum()), 1)
    designed = np.linalg.norm(xyz_board[chosen][i] - xyz_board[chosen][j], axis=1)
    reconstructed = np.linalg.norm(xyz_world[chosen][i] - xyz_world[chosen][j], axis=1)
    return float((designed / reconstructed).mean()), (first, last)
