"""Culprits: one is named only if leaving it out cures the result, and leaving out another one does not."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.labels import CircleLabel
from stcal.sfm.adjust.network import Network, ScoreTest, free_network, solve_score
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.sfm.adjust.scale import find_scale
from stcal.sfm.checks.verdict import MOST_SIGMAS, SUSPICIOUS
from stcal.sfm.data.model import WorldModel

MOST = 0.5
"""Share of the suspects from which they are no culprits: either part may be the wrong one."""
MIN_REDUNDANCY = 30.0
"""Smallest redundancy of the circles of the faces, and of the dots, whose residuals tell whether they agree."""
MOVED = "the target moved relative to the board"
MOVED_REMEDY = "sort the images into groups in which nothing moved, or take them again"


@dataclass(frozen=True, slots=True)
class Guilt:
    """Result of a search among suspects, which are the images of a group, or groups."""

    where: str  # what the suspects are in, for sentences
    # smallest set without which the result is sound; empty if another set cures it too, or half are needed
    culprits: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()  # suspects of which leaving out any one cures the result

    def words(self) -> str:
        """Returns why no culprit is named, empty if one is."""
        if self.culprits:
            return ""
        if self.rivals:
            return f"{self.where}: leaving out {' or '.join(self.rivals)} cures it as well"
        return f"{self.where}: leaving out less than half of them does not cure it"


def culprits(names: Sequence[str], worst: Callable[[Collection[int]], int | None], where: str) -> Guilt:
    """Culprits; ``worst`` gives whom the others contradict most if some are left out, None if all is sound."""
    out: list[int] = []
    while (next_one := worst(out)) is not None:
        out.append(next_one)
        if len(out) >= MOST * len(names):
            return Guilt(where)
    for i in list(out):  # one that was taken first may be innocent
        if len(out) > 1 and worst([k for k in out if k != i]) is None:
            out.remove(i)
    rivals = {
        k
        for i in out
        for j in range(len(names))
        if j not in out and worst([j if k == i else k for k in out]) is None
        for k in (i, j)
    }
    if rivals:
        return Guilt(where, rivals=tuple(names[k] for k in sorted(rivals)))
    return Guilt(where, tuple(names[i] for i in out))


def culprits_by_score(network: Network, columns: np.ndarray, suspects: Sequence[int], count: int, where: str) -> Guilt:
    """Returns the images that further parameters, ``columns`` (n, 2, q) over σ, cure, of ``count`` values tested."""
    n, _, q = columns.shape
    images, place = len(network.model.images), network.model.image_index
    apart = np.zeros((n, 2, images, q))
    apart[np.arange(n), :, place] = columns
    normal, right = network.score(apart.reshape(n, 2, images * q))
    redundancy, square = float(network.redundancy.sum()), float((network.residual**2).sum())

    def of(out: Collection[int]) -> np.ndarray:
        return (q * np.array(sorted(out), int)[:, None] + np.arange(q)).ravel()

    def test(image: int, out: Collection[int]) -> ScoreTest:
        own, held = of([image]), of(out)
        if not len(held):
            return solve_score(normal[np.ix_(own, own)], right[own])
        away = normal[np.ix_(own, held)] @ np.linalg.pinv(normal[np.ix_(held, held)], hermitian=True)
        return solve_score(normal[np.ix_(own, own)] - away @ normal[np.ix_(held, own)], right[own] - away @ right[held])

    def worst(out: Collection[int]) -> int | None:
        tests = {i: test(i, out) for i in suspects if i not in out}
        taken = solve_score(normal[np.ix_(of(out), of(out))], right[of(out)]) if out else None
        total, freedom = square, redundancy
        if taken is not None:
            total, freedom = square - taken.statistic, redundancy - taken.freedom
        chance = {}
        for i, t in tests.items():
            if t.freedom:
                rest = max(freedom - t.freedom, 1.0)
                noise = max((total - t.statistic) / rest, 1.0)
                chance[i] = fdtrc(t.freedom, rest, t.statistic / noise / t.freedom)
        guilty = [i for i, probability in chance.items() if probability * count < SUSPICIOUS]
        return max(guilty, key=lambda i: tests[i].statistic, default=None)

    return culprits(network.model.images, worst, where)


def moved_apart(model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign) -> bool:
    """Whether contradicting observations of a group agree if faces and board are taken by themselves: then the camera
    is right, and target and board moved relative to each other."""
    on_face = np.array([isinstance(label, CircleLabel) for label in model.labels])[model.point_index]
    try:
        radius = {**target.radius_of(), **board.radius_of()}
        shift = eccentricity_px(model, camera, radius, find_scale(model, board).mm_per_unit)
        corrected = replace(model, shift_px=shift)
        parts = [free_network(adjust(corrected.without(drop), camera), camera) for drop in (on_face, ~on_face)]
    except (StcalError, ValueError, np.linalg.LinAlgError):
        return False
    return all(n.redundancy.sum() > MIN_REDUNDANCY and n.noise() < MOST_SIGMAS**2 for n in parts)
