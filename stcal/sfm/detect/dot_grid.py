"""Detection of the dot board: a grid is grown from neighbour to neighbour, fitted by a homography, and numbered. A
plain board looks the same after half a turn: a reading carries every numbering that fits the image."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from stcal.design import BoardDesign
from stcal.errors import DegenerateError, DetectionError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography, homography_jacobian, singular_values
from stcal.sfm.detect.candidates import MAX_AXIS_RATIO, BoardSighting, Candidates, match_pattern

NEIGHBOURS = 20
STEP_TOLERANCE = 0.3  # largest distance of a dot from its place predicted by its neighbours, in steps
DIAGONAL = 1.22  # limit between the lengths of a step along a row, 1, and along a diagonal, √2
MIN_SHARE = 0.35  # smallest share of the board's dots that makes a board
MAX_BOARDS = 3
MAX_COSINE = 0.35  # largest cosine of the angle between the two first steps in the board plane; 45° has 0.7
MIN_LINKS = 3  # smallest number of neighbours of a dot that starts a grid
NEARLY_ALL = 0.9  # share of the board that ends the search for a larger grid
MIN_SIDE = 3  # smallest number of rows and columns
CORNER_MARGIN = 0.4
"""A dot is the larger one when its radius is past this fraction of the way from the normal to the larger one."""
PITCHES = 2.2, 3.1, 4.3, 6.0, 8.4
"""Pitches in radii that are tried where a board is not found; each stands for those within the tolerance of a step."""
HALF, MOST_OF_IT = 0.55, 0.8
"""Shares of a board's dots: above that of its diagonals alone, and the smallest by which another pitch is believed."""
MAX_UNEXPLAINED = 2
"""Largest number of missing dots inside the image of a numbering, beyond those of the best numbering."""


def find_boards(candidates: Candidates, board: BoardDesign, image_corners: np.ndarray) -> list[BoardSighting]:
    """Finds the boards and returns the one with the most dots first; ``image_corners``: (4, 2) normalised, ideal."""
    if len(candidates) < MIN_SIDE**2:
        return []
    links, steps = _links(candidates, board)
    count = (links >= 0).sum(1)
    seeds = [int(i) for i in np.argsort(-count, kind="stable") if count[i] >= MIN_LINKS]
    free = np.ones(len(candidates), bool)
    readings: list[BoardSighting] = []
    for _ in range(MAX_BOARDS):
        cells: dict[int, tuple[int, int]] = {}  # of the largest grid
        inside = np.zeros(len(candidates), int)
        for seed in seeds:
            # A dot that has been in two grids is not likely to start a better third one.
            if free[seed] and inside[seed] < 2 and len(cells) < NEARLY_ALL * len(board.cells()):
                grown = _grow(candidates, links, steps, seed, free, board)
                inside[list(grown)] += 1
                cells = max(cells, grown, key=len)
        if len(cells) < MIN_SHARE * len(board.cells()):
            break
        free[list(cells)] = False
        reading = _number(candidates, cells, board, image_corners)
        if reading is not None:
            free[reading.rows] = False
            readings.append(reading)
    return sorted(readings, key=lambda r: -len(r.rows))


def contradiction(
    candidates: Candidates, board: BoardDesign, image_corners: np.ndarray, found: Sequence[BoardSighting]
) -> str:
    """Returns a note if most of the board's dots are a grid of another ratio of pitch and radius than stated; none if
    most of them were ``found`` as stated. Half of a grid passes for one of a wider pitch, along its diagonals."""
    if any(len(each.rows) >= HALF * len(board.cells()) for each in found):
        return ""
    stated = board.pitch_mm / board.radius_mm
    for ratio in PITCHES:
        other = replace(board, radius_mm=board.pitch_mm / ratio, corner=None, rings=(), unusual_size=True)
        for grid in find_boards(candidates, other, image_corners)[:1]:
            cells = board.flat(grid.numberings[0][:, ::-1].astype(float))
            slope = homography_jacobian(fit_homography(cells, candidates.xy[grid.rows]), cells)
            radii = singular_values(np.linalg.solve(slope, candidates.shape[grid.rows]))
            measured = 1 / float(np.median(radii))
            most = len(grid.rows) >= MOST_OF_IT * len(board.cells())
            if most and max(measured / stated, stated / measured) > 1 + STEP_TOLERANCE:
                there = f"a grid of the board's dots is there, its pitch {measured:.2f} times their radius"
                return f"{there}, in the board file {stated:.2f} times: correct pitch_mm or radius_mm"
    return ""


def _links(candidates: Candidates, board: BoardDesign) -> tuple[np.ndarray, np.ndarray]:
    """Returns (n, 4 or 6) neighbours one pitch away, −1 for none, by direction, and the steps (n, 2, 2) to them."""
    n, sides = len(candidates), directions(board)
    k = min(NEIGHBOURS + 1, n)
    neighbours = candidates.tree.query(candidates.xy, k=k)[1][:, 1:]
    inverse = np.linalg.inv(candidates.shape)
    largest, smallest = singular_values(inverse[:, None] @ candidates.shape[neighbours])
    step = np.einsum("nij,nkj->nki", inverse, candidates.xy[neighbours] - candidates.xy[:, None])
    length = np.linalg.norm(step, axis=2) * board.radius_mm / board.pitch_mm
    ok = (np.abs(length - 1) < STEP_TOLERANCE) & (largest < MAX_AXIS_RATIO) & (smallest > 1 / MAX_AXIS_RATIO)
    # Blur makes small dots look larger, and diagonal neighbours then pass for direct ones: the nearest tell.
    ok &= length < DIAGONAL * np.where(ok, length, np.inf).min(1, initial=np.inf)[:, None]
    angle = np.arctan2(step[..., 1], step[..., 0])
    together = np.where(ok, np.exp(sides * 1j * angle), 0).sum(1)
    agreed = np.angle(together) / sides
    turns = (angle - agreed[:, None]) / (2 * np.pi / sides)
    direction = np.round(turns).astype(int) % sides
    error = np.abs(turns - np.round(turns)) + np.abs(length - 1)
    ok &= np.abs(turns - np.round(turns)) < STEP_TOLERANCE
    links = np.full((n, sides), -1)
    for side in range(sides):
        cost = np.where(ok & (direction == side), error, np.inf)
        best = cost.argmin(1)
        links[:, side] = np.where(np.isfinite(cost.min(1)), neighbours[np.arange(n), best], -1)
    pitch = board.pitch_mm / board.radius_mm
    axes = np.stack([np.cos(agreed), -np.sin(agreed), np.sin(agreed), np.cos(agreed)], 1).reshape(n, 2, 2) * pitch
    return links, candidates.shape @ axes @ board.steps()


def directions(board: BoardDesign) -> int:
    """Returns the number of directions in which a dot has neighbours: 4, or 6 if rows are shifted by half a pitch."""
    return 6 if board.steps()[0, 1] else 4


def _turn(board: BoardDesign, turn: int) -> np.ndarray:
    """Returns the whole numbers (2, 2) that turn columns and rows by ``turn`` of the board's directions."""
    angle, steps = 2 * np.pi * turn / directions(board), board.steps()
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.rint(np.linalg.solve(steps, rotation @ steps)).astype(int)


def _grow(candidates: Candidates, links, steps, seed: int, free, board: BoardDesign) -> dict[int, tuple[int, int]]:
    """Returns cells (u, v) by candidate, grown from neighbour to neighbour; the steps are updated on the way."""
    start, half = np.array(steps[seed]), directions(board) // 2
    for axis in (0, 1):
        linked = [(links[seed][axis], 1), (links[seed][axis + half], -1)]
        known = [sign * (candidates.xy[other] - candidates.xy[seed]) for other, sign in linked if other >= 0]
        if known:
            start[:, axis] = np.mean(known, axis=0)
    across = np.linalg.solve(candidates.shape[seed], start)
    lengths = np.linalg.norm(across, axis=0)
    cosine = across[:, 0] @ across[:, 1] / lengths.prod() - board.steps()[:, 0] @ board.steps()[:, 1]
    if abs(cosine) > MAX_COSINE or lengths.max() > DIAGONAL * lengths.min():
        return {}
    cells, taken_cells, queue = {int(seed): (0, 0)}, {(0, 0)}, [(int(seed), start)]
    for node, step in queue:
        u, v = cells[node]
        ahead = np.array([step[:, 0], step[:, 1], -step[:, 0], -step[:, 1]])
        _, index = candidates.tree.query(candidates.xy[node] + ahead)
        largest, smallest = singular_values(np.linalg.solve(candidates.shape[node], candidates.shape[index]))
        for side, (du, dv) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
            neighbour = int(index[side])
            cell = (u + du, v + dv)
            if cell in taken_cells or neighbour in cells or not free[neighbour]:
                continue
            # Distances are judged along the step itself: the other step may be foreshortened.
            error = np.linalg.solve(step, candidates.xy[neighbour] - candidates.xy[node] - ahead[side])
            if np.abs(error).max() > STEP_TOLERANCE or largest[side] > 2 or smallest[side] < 0.5:
                continue
            moved = step.copy()
            moved[:, side % 2] = (candidates.xy[neighbour] - candidates.xy[node]) * (1 if side < 2 else -1)
            cells[neighbour] = cell
            taken_cells.add(cell)
            queue.append((neighbour, 0.5 * (moved + step)))
    return cells


def _number(candidates: Candidates, cells, board: BoardDesign, image_corners) -> BoardSighting | None:
    """Fits the homography of the grown cells, matches all dots with it, and lists the numberings that fit."""
    index, uv = np.array(list(cells)), np.array(list(cells.values()))
    homography = _robust_homography(board.flat(uv), candidates, index)
    if homography is None:
        return None
    lowest, highest = uv.min(0) - 2, uv.max(0) + 2
    sides = [np.arange(a, b + 1) for a, b in zip(lowest, highest, strict=True)]
    grid = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
    centre = board.flat(uv).mean(0)
    depth = np.column_stack([board.flat(grid), np.ones(len(grid))]) @ homography[2]
    grid = grid[depth * np.sign(homography[2] @ [*centre, 1]) > 0]
    radius = np.full(len(grid), board.radius_mm / board.pitch_mm)
    matched = match_pattern(candidates, homography, board.flat(grid), radius)
    if board.corner is not None:
        larger = radius * board.corner_radius_mm / board.radius_mm
        large = match_pattern(candidates, homography, board.flat(grid), larger)
        matched = np.where(matched >= 0, matched, large)
    uv, index = grid[matched >= 0], matched[matched >= 0]
    if np.linalg.det(homography) < 0:
        steps = board.steps()
        mirror = np.eye(3)
        mirror[:2, :2] = steps @ np.linalg.solve(steps.T, [[0.0, 1.0], [1.0, 0.0]]).T
        uv, homography = uv[:, ::-1], homography @ mirror
    if len(uv) < max(MIN_SHARE * len(board.cells()), MIN_SIDE**2):
        return None
    placements = _placements(candidates, uv, index, board, homography, image_corners)
    if not placements:
        return None
    most = placements[0][0] + MAX_UNEXPLAINED
    likely = [(inside, cells) for unexplained, inside, cells in placements if unexplained <= most]
    common = np.logical_and.reduce([inside for inside, _ in likely])
    index = index[common]
    numberings = np.stack([cells[common] for _, cells in likely])
    further = [cells[common] for count, inside, cells in placements if count > most and inside[common].all()]
    return BoardSighting(index, numberings, np.array(further, int).reshape(-1, len(index), 2))


def by_rings(
    reading: BoardSighting, board: BoardDesign, grey: np.ndarray, camera: Camera, xy: np.ndarray
) -> BoardSighting:
    """Reading with the numberings that put dots with a hole where the 8-bit image shows one; ``xy``: all candidates.
    DetectionError: it shows as many holes as are stated, at other places by any numbering."""
    angle, size = np.arange(0, 2 * np.pi, np.pi / 8), np.array(grey.shape[::-1])
    around, cells = np.column_stack([np.cos(angle), np.sin(angle)]), board.cells()
    rings = np.array([tuple(cell) in board.rings for cell in cells.tolist()])
    middles = board.pitch_mm * board.flat(cells[:, ::-1].astype(float))[:, None]
    circles_mm = np.stack([middles + share * board.radius_mm * around for share in RING_SHARES])
    wrong: list[int] = []
    seen: list[np.ndarray] = []
    for numbering in reading.numberings:
        xy_mm = board.pitch_mm * board.flat(numbering[:, ::-1].astype(float))
        points = apply_homography(fit_homography(xy_mm, xy[reading.rows]), circles_mm.reshape(-1, 2))
        px = camera.project(np.pad(points, ((0, 0), (0, 1)), constant_values=1))
        sampled = cv2.remap(grey, px.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]  # type: ignore[call-overload]
        middle, body, outside = sampled.reshape(circles_mm.shape[:3]).mean(2)
        inside = ((px > 0) & (px < size - 1)).reshape(circles_mm.shape)[-1].all((1, 2))
        holes = np.abs(middle - body) > HOLE_SHARE * np.median(np.abs(body - outside)[inside])
        wrong.append(int((holes != rings)[inside].sum()))
        seen.append(holes & inside)
    kept = [i for i, count in enumerate(wrong) if count == min(wrong)]
    if min(wrong) > MOST_WRONG:
        found = seen[kept[0]]
        if found.sum() == rings.sum():
            where = ", ".join(str(cell) for cell in cells[found].tolist())
            fault = f"board: dots with a hole are at [row, column] {where}, other than in its file"
            raise DetectionError("E-RINGS-ELSEWHERE", f"{fault}; correct rings")
        return reading
    return replace(reading, numberings=reading.numberings[kept])


RING_SHARES = (0.15, 0.75, 1.25)
"""Radii of the circles on which the middle of a dot, its body and the board about it are sampled, in its radii."""
HOLE_SHARE = 0.5
"""Smallest difference between middle and body of a dot with a hole, over that between bodies and the board."""
MOST_WRONG = 1  # largest number of dots whose hole is missed, or seen where none is


def _robust_homography(uv, candidates: Candidates, index) -> np.ndarray | None:
    """Returns the homography of the consistent cells; None if they do not span the plane."""
    keep = np.ones(len(uv), bool)
    for _ in range(5):
        if keep.sum() < MIN_SIDE**2 or min(np.ptp(uv[keep], axis=0)) < MIN_SIDE - 1:
            return None
        try:
            homography = fit_homography(uv[keep], candidates.xy[index[keep]])
        except DegenerateError:
            return None
        step = homography_jacobian(homography, uv)
        error = candidates.xy[index] - apply_homography(homography, uv)
        distance = np.linalg.norm(np.linalg.solve(step, error[..., None])[..., 0], axis=1)
        again = distance < max(0.1, 3 * np.median(distance))
        if (again == keep).all():
            return homography
        keep = again
    return homography


def _placements(
    candidates: Candidates, uv, index, board: BoardDesign, homography, image_corners
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Returns placements of the board, likeliest first: dots outside or missing, mask of those on it, their cells."""
    size, all_cells = np.array([board.columns, board.rows]), board.cells()[:, ::-1]
    has_dot = np.zeros(size[::-1], bool)
    has_dot[tuple(all_cells[:, ::-1].T)] = True
    large = np.zeros(len(uv), bool)
    if board.corner is not None and board.corner_radius_mm is not None:
        ratio = candidates.radius[index] / _step(homography, board.flat(uv))
        large = ratio / np.median(ratio) > 1 + CORNER_MARGIN * (board.corner_radius_mm / board.radius_mm - 1)
    edge = np.roll(image_corners, -1, axis=0) - image_corners
    normal = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]
    normal *= np.sign((image_corners.mean(0) - image_corners[0]) @ normal[0])
    placements = []
    for turn in range(directions(board)):
        turned = uv @ _turn(board, turn).T
        for offset in _offsets(turned, size):
            column_row = turned + offset
            inside = ((column_row >= 0) & (column_row < size)).all(1)
            inside[inside] = has_dot[tuple(column_row[inside, ::-1].T)]
            outside_count = (~inside).sum()
            at_corner = np.zeros(len(uv), bool) if board.corner is None else (column_row == board.corner[::-1]).all(1)
            if outside_count > MAX_UNEXPLAINED or (large != at_corner)[inside].any():
                continue
            occupied = np.zeros_like(has_dot)
            occupied[tuple(column_row[inside, ::-1].T)] = True
            missing = ~occupied[tuple(all_cells[:, ::-1].T)]
            absent = board.flat((all_cells - offset)[missing] @ _turn(board, -turn).T)
            apart = apply_homography(homography, absent)[:, None] - image_corners
            distance = np.einsum("ned,ed->ne", apart, normal)  # with their whole rim, and some margin
            expected = (distance > 0.35 * _step(homography, absent)[:, None]).all(1)
            placements.append((int(expected.sum() + outside_count), inside, column_row[:, ::-1]))
    return sorted(placements, key=lambda each: each[0])


def _offsets(cells: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Shifts (k, 2) of cells (n, 2) that leave at most ``MAX_UNEXPLAINED`` < n outside at each end of an axis."""
    if len(cells) > size.prod() + MAX_UNEXPLAINED:
        return np.zeros((0, 2), int)
    in_order = np.sort(cells, axis=0)
    low, high = -in_order[MAX_UNEXPLAINED], size - in_order[-1 - MAX_UNEXPLAINED]
    return np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1).reshape(-1, 2)


def _step(homography: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Returns the mean length of a step at the places ``uv``, in normalised coordinates."""
    return np.sqrt(np.abs(np.linalg.det(homography_jacobian(homography, uv))))
