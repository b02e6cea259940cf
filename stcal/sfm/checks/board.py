"""Checks of the board, and of the scale that it gives."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.align import align_similarity
from stcal.geometry.rigid import skew
from stcal.labels import DotLabel, dot_cells
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.network import Network
from stcal.sfm.checks.radii import Radii, Size, size_by_radii
from stcal.sfm.checks.verdict import Check, Measured, Trial, impossible, judge

DESIGN_SCALE = 1e-4
"""Relative σ of the target's size against its design: the effect of 4 K on aluminium, or of a printer on a film."""
MIN_DOTS = 4
PITCH = "Scale of the board against the target's design"


def board_checks(networks: Sequence[Network], board: BoardDesign) -> list[Check]:
    """Tests the dots of every group against the grid, and the scale of each row and column against the rest.

    The grid is tested as a whole with its stated σ. If the whole board is worse than stated, its rows and columns are
    judged by its actual deviations.
    """
    whole, lines = [], []
    for network in networks:
        dots = np.array([i for i, label in enumerate(network.model.labels) if isinstance(label, DotLabel)])
        if len(dots) < MIN_DOTS:
            continue
        gap, weight, cells = _board_gap(network, dots, board)
        redundancy = network.redundancy.sum()
        freedom = 3 * len(dots) - 7
        square = float(gap @ weight @ gap)
        rms = 1e3 * float(np.sqrt((gap**2).mean()))
        name = f"group {network.model.group}"
        whole.append(Trial(name, rms, "µm RMS", square, freedom, redundancy))
        lines += _lines(name, gap, weight, cells, board, max(1.0, square / freedom), redundancy)
    remedy = "a bent, swollen or badly printed board, or a stated σ too small: measure it, state its σ in board.toml"
    of_line = "check this line of the board for damage, and rows, columns and pitch in board.toml"
    scale = "Scale of each row and column of the board against the rest"
    return [
        judge("board", "Board against its stated σ", whole, "groups", remedy),
        judge("board-lines", scale, lines, "rows and columns", of_line),
    ]


def _board_gap(network: Network, dots: np.ndarray, board: BoardDesign):
    """Returns dots minus grid after a similarity, their weight matrix, and their cells (d, 2).

    The differences are (3d,) mm, board frame. The weight matrix is the inverse of their covariance (pseudo).
    """
    labels = [network.model.labels[i] for i in dots]
    cells = dot_cells(labels)
    design = board.places_mm(labels)
    xyz = network.model.xyz_model[dots]
    board_from_model = align_similarity(design, xyz)
    turn = np.kron(np.eye(len(dots)), board_from_model.scale * board_from_model.rigid.rotation)
    covariance = turn @ network.covariance_of(dots) @ turn.T + board.sigma_mm**2 * np.eye(3 * len(dots))
    middle = design - design.mean(0)
    free = np.concatenate(
        [-skew(middle), np.broadcast_to(np.eye(3), (len(dots), 3, 3)), middle[:, :, None]], axis=2
    ).reshape(-1, 7)
    # The similarity is eliminated as an unknown, so that the weights annihilate it.
    inverse = np.linalg.inv(covariance)
    along = inverse @ free
    weight = inverse - along @ np.linalg.solve(free.T @ along, along.T)
    return (board_from_model @ xyz - design).ravel(), weight, cells


def _lines(name, gap, weight, cells, board: BoardDesign, inflation: float, redundancy: float) -> list[Trial]:
    """Tests the stretch of each row along X and of each column along Y, in ppm."""
    trials = []
    for kind, across, along, axis in (("row", 0, 1, 0), ("column", 1, 0, 1)):
        for line in np.unique(cells[:, across]):
            members = np.flatnonzero(cells[:, across] == line)
            if len(members) < 3:
                continue
            pattern = np.zeros((len(cells), 3))
            place = board.pitch_mm * cells[members, along]
            pattern[members, axis] = place - place.mean()
            information = float(pattern.ravel() @ weight @ pattern.ravel())
            stretch = float(pattern.ravel() @ weight @ gap) / information
            statistic = stretch**2 * information / inflation
            trials.append(Trial(f"{name} {kind} {line}", 1e6 * stretch, "ppm", statistic, 1, redundancy))
    return trials


def pitch_check(calibrated: CalibratedTarget, target: TargetDesign, radii: Radii) -> Check:
    """Tests the measured size of the target against its design.

    If the pitch of the board is wrong as a whole, everything else is too large or too small, and no residual shows it.

    Positions: a similarity maps the design to the circles of each face, and its residuals give the σ of their
    placement. Radii: the slope of measured over designed radii, which a constant bias of the edges does not change. The
    weighted mean of both is tested, with 100 ppm as σ of the target's own size.
    """
    measures = [m for m in (_size_by_positions(calibrated, target), size_by_radii(radii)) if m is not None]
    if not measures:
        return impossible(
            "pitch", PITCH, f"no face with {MIN_DOTS} circles, and no circles of two sizes", "add views of the faces"
        )
    weight = np.array([1 / m.sigma**2 for m in measures])
    size = float(weight @ [m.size for m in measures] / weight.sum())
    variance = 1 / weight.sum() + DESIGN_SCALE**2
    freedom = sum(m.freedom for m in measures)
    remedy = (
        "the pitch in board.toml, or the size of the target in target.toml, is wrong as a whole, and all distances of "
        "the result with it: measure the board over its full length with a calliper"
    )
    trial = Trial("board pitch", 1e6 * size, "ppm", size**2 / variance, 1, freedom)
    check = judge("pitch", PITCH, [trial], "boards", remedy)
    single = tuple(Measured(m.name, 1e6 * m.size, None, "ppm", None) for m in measures)
    return replace(check, measured=check.measured + single)


def _size_by_positions(calibrated: CalibratedTarget, target: TargetDesign) -> Size | None:
    weighted, weight, square, freedom = 0.0, 0.0, 0.0, 0
    for face in target.faces:
        indices = [i for i, label in enumerate(face.labels()) if label in calibrated.circles]
        if len(indices) < MIN_DOTS:
            continue
        design = np.column_stack([face.xy_mm[indices], np.zeros(len(indices))])
        xyz = np.array([calibrated.circles[face.labels()[i]] for i in indices])
        fit = align_similarity(xyz, design)
        spread = float(((design - design.mean(0)) ** 2).sum())
        weighted, weight = weighted + spread * (fit.scale - 1), weight + spread
        residuals = fit.inverse() @ xyz - design
        square, freedom = square + float((residuals[:, :2] ** 2).sum()), freedom + 2 * len(indices) - 4
    if not freedom:
        return None
    return Size("by positions of circles", weighted / weight, float(np.sqrt(square / freedom / weight)), freedom)
