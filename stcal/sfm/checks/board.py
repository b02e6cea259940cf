"""Checks of the board and of the scale that it gives."""

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
"""σ of the target's size as a whole against its design: what 4 K do to aluminium, or a printer to a film."""
MIN_DOTS = 4
PITCH = "Scale of the board against the target's design"


def board_checks(networks: Sequence[Network], board: BoardDesign) -> list[Check]:
    """The dots of every group against the grid and its stated σ, as a whole; and the scale of each row and column
    against the rest, where a board that is as a whole worse than stated is judged by its own measure."""
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
    """Dots less grid after a similarity, (3d,) mm, board frame; its inverse covariance (pseudo); cells (d, 2)."""
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
    # With the similarity as unknowns: what is left of the inverse covariance annihilates it.
    inverse = np.linalg.inv(covariance)
    along = inverse @ free
    weight = inverse - along @ np.linalg.solve(free.T @ along, along.T)
    return (board_from_model @ xyz - design).ravel(), weight, cells


def _lines(name, gap, weight, cells, board: BoardDesign, inflation: float, redundancy: float) -> list[Trial]:
    """A stretch of each row along X and each column along Y, in ppm."""
    trials = []
    for what, own, along, axis in (("row", 0, 1, 0), ("column", 1, 0, 1)):
        for line in np.unique(cells[:, own]):
            members = np.flatnonzero(cells[:, own] == line)
            if len(members) < 3:
                continue
            pattern = np.zeros((len(cells), 3))
            place = board.pitch_mm * cells[members, along]
            pattern[members, axis] = place - place.mean()
            information = float(pattern.ravel() @ weight @ pattern.ravel())
            stretch = float(pattern.ravel() @ weight @ gap) / information
            statistic = stretch**2 * information / inflation
            trials.append(Trial(f"{name} {what} {line}", 1e6 * stretch, "ppm", statistic, 1, redundancy))
    return trials


def pitch_check(calibrated: CalibratedTarget, target: TargetDesign, radii: Radii) -> Check:
    """Size of the target as measured against its design: a board whose pitch is wrong as a whole makes everything else
    too large or too small, and no residual shows it.

    Positions: a similarity of the circles of each face to the design; their placement σ is what the fits leave. Radii:
    the slope of measured over designed radii, which a constant bias of the edges does not touch. Their weighted mean is
    tested, with the σ of the target's own size, 100 ppm.
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
        own = [i for i, label in enumerate(face.labels()) if label in calibrated.circles]
        if len(own) < MIN_DOTS:
            continue
        design = np.column_stack([face.xy_mm[own], np.zeros(len(own))])
        xyz = np.array([calibrated.circles[face.labels()[i]] for i in own])
        fit = align_similarity(xyz, design)
        spread = float(((design - design.mean(0)) ** 2).sum())
        weighted, weight = weighted + spread * (fit.scale - 1), weight + spread
        left = fit.inverse() @ xyz - design
        square, freedom = square + float((left[:, :2] ** 2).sum()), freedom + 2 * len(own) - 4
    if not freedom:
        return None
    return Size("by positions of circles", weighted / weight, float(np.sqrt(square / freedom / weight)), freedom)
