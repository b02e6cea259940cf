"""One set of corners from several exposures of a scene that stands still, and whether it did."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pose.estimate import SeenTags

PRIOR_SHARE, PRIOR_WEIGHT = 0.5, 20.0
"""Share of a corner's variance that other exposures do not repeat, and how many differences this guess is worth."""


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """By how much the tags' middles differ between two exposures: ``shift_px``, the median over ``tags`` of them, and
    its σ."""

    exposures: tuple[str, str]
    tags: int
    shift_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The corners of all exposures together.

    ``seen`` : the layout's tags with merged corners; ``counts`` : (e,) layout's tags in each exposure; ``share`` : of
    the corners' variance that differs between exposures; ``shifts`` : of each exposure against the one with the most
    tags in common; ``repeated`` : layout's tags that some exposure shows more than once; ``unknown`` : other tags.
    """

    seen: SeenTags
    counts: tuple[int, ...]
    share: float
    shifts: tuple[Shift, ...]
    repeated: tuple[tuple[str, int], ...]
    unknown: tuple[tuple[str, int], ...]


def merge(exposures: Sequence[Tags], layout: TargetLayout, names: Sequence[str] = ()) -> Merged:
    """Weighted means of the corners over the exposures, and their covariance.

    Exposures of one scene share much of a corner's error: print, lens, how pixels cut its edges. A part that they do
    share does not average out. It is estimated from how much they differ, against the σ they state; where they differ
    by more than these, the σ grow. What print, lens and flatness add (the layout's ``sigma_px``) is the same in all.
    """
    rows = layout.rows()
    places = [{rows[tag]: k for k, tag in enumerate(tags.tags) if tag in rows} for tags in exposures]
    used = np.array(sorted({row for place in places for row in place}), int)
    corners, covariance, edge = _stacked(exposures, places, used)
    there = np.isfinite(corners[..., 0, 0])
    # At a right angle a corner goes √2 as far as its edges.
    variance = np.trace(covariance, axis1=-2, axis2=-1) + 2 * edge[..., None] ** 2
    weight = np.where(there[..., None], 1 / variance, 0.0)
    share_of = weight / weight.sum(0)
    mean = (share_of[..., None] * np.where(there[..., None, None], corners, 0)).sum(0)
    share = _differing_share(corners, covariance, mean, there)
    growth, own = max(share, 1.0), min(share, 1.0)
    root = share_of[..., None, None] * np.linalg.cholesky(covariance)
    alone = np.einsum("enkij,enklj->nkil", root, root)
    together = np.einsum("enkij,fnklj->nkil", root, root)
    merged = growth * (own * alone + (1 - own) * together) + layout.sigma_px**2 * np.eye(2)
    names = names or [str(k + 1) for k in range(len(exposures))]
    repeated = {tag for tags in exposures for tag in tags.repeated if tag in rows}
    unknown = {tag for tags in exposures for tag in tags.tags if tag not in rows}
    return Merged(
        SeenTags(used, mean, merged, (share_of.mean(2) * edge).sum(0)),
        tuple(int(n) for n in there.sum(1)),
        share,
        _shifts(corners, covariance, there, names),
        tuple(sorted(repeated)),
        tuple(sorted(unknown)),
    )


def _stacked(exposures, places, used: np.ndarray) -> tuple[np.ndarray, ...]:
    """Corners (e, n, 4, 2), NaN where a tag is not seen, their covariances, there those of one pixel, and σ of their
    edges' common shift (e, n), there 0."""
    corners = np.full((len(exposures), len(used), 4, 2), np.nan)
    edge = np.zeros(corners.shape[:2])
    covariance = np.tile(np.eye(2), (len(exposures), len(used), 4, 1, 1))
    for e, (tags, place) in enumerate(zip(exposures, places, strict=True)):
        seen = [k for k, row in enumerate(used) if row in place]
        own = [place[used[k]] for k in seen]
        corners[e, seen] = tags.corners_px[own]
        covariance[e, seen] = tags.covariance_px2[own]
        edge[e, seen] = tags.edge_sigma_px()[own]
    return corners, covariance, edge


def _differing_share(corners, covariance, mean, there) -> float:
    """Of the corners' stated variance, how much their differences between exposures show, without what is common to a
    tag's edges."""
    off = np.where(there[..., None, None], corners - mean, 0)
    way = corners_by_edges(mean)
    off -= (off * way).sum((2, 3), keepdims=True) / (way * way).sum((1, 2))[:, None, None] * way
    square = np.einsum("enki,enkij,enkj->enk", off, np.linalg.inv(covariance), off)
    many = there.sum(0) > 1
    # A tag that one exposure gets wrong must not speak for all.
    square = np.minimum(square[:, many], 25.0)
    free = 7 * float((there.sum(0)[many] - 1).sum())
    return float((square.sum() + PRIOR_SHARE * PRIOR_WEIGHT) / (free + PRIOR_WEIGHT))


def _shifts(corners, covariance, there, names) -> tuple[Shift, ...]:
    """Each exposure against the one that has the most tags in common with it, among those with more tags."""
    order = sorted(range(len(there)), key=lambda e: -int(there[e].sum()))
    middle = corners.mean(2)
    variance = np.trace(covariance, axis1=-2, axis2=-1).mean(2) / 4
    found = []
    for place, e in enumerate(order):
        others = [(int((there[e] & there[f]).sum()), f) for f in order[:place]]
        common, f = max(others, default=(0, -1))
        if common:
            both = there[e] & there[f]
            length = np.linalg.norm(middle[e, both] - middle[f, both], axis=1)
            sigma = np.sqrt((variance[e, both] + variance[f, both]).mean())
            found.append(Shift((names[f], names[e]), common, float(np.median(length)), float(sigma)))
    return tuple(found)
