"""Merge of the corners from several exposures of one scene, and a test whether the scene stood still."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pose.estimate import SeenTags

PRIOR_SHARE, PRIOR_WEIGHT = 0.5, 20.0
"""Prior of the share of a corner's variance that differs between exposures, and its weight in differences."""


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Shift of the tags' middles between two exposures.

    ``tags`` : number of tags in common; ``shift_px`` : median of their shifts; ``sigma_px`` : σ of one tag's shift.
    """

    exposures: tuple[str, str]
    tags: int
    shift_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """Result of :func:`merge`: the merged corners of all exposures.

    ``seen`` : the layout's tags with merged corners; ``counts`` : (e,) number of the layout's tags in each exposure;
    ``share`` : share of the corners' variance that differs between exposures; ``shifts`` : shift of each exposure
    against the one with the most tags in common; ``repeated`` : tags of the layout that an exposure shows more than
    once; ``unknown`` : tags that are not in the layout.
    """

    seen: SeenTags
    counts: tuple[int, ...]
    share: float
    shifts: tuple[Shift, ...]
    repeated: tuple[tuple[str, int], ...]
    unknown: tuple[tuple[str, int], ...]


def merge(exposures: Sequence[Tags], layout: TargetLayout, names: Sequence[str] = ()) -> Merged:
    """Returns weighted means of the corners over the exposures, with their covariance.

    Exposures of one scene share much of a corner's error: print, lens, sampling of its edges by the pixels. The shared
    part does not average out. It is estimated by comparing the differences between exposures with their stated σ. If
    the differences exceed these, the σ are increased. The σ due to print, lens and flatness (the layout's ``sigma_px``)
    is common to all exposures.
    """
    rows = layout.rows()
    places = [{rows[tag]: k for k, tag in enumerate(tags.tags) if tag in rows} for tags in exposures]
    used = np.array(sorted({row for place in places for row in place}), int)
    corners, covariance, joint, edge = _stacked(exposures, places, used)
    visible = np.isfinite(corners[..., 0, 0])
    # At a right angle, a corner shifts by √2 times the shift of its edges.
    variance = np.trace(covariance, axis1=-2, axis2=-1) + 2 * edge[..., None] ** 2
    weight = np.where(visible[..., None], 1 / variance, 0.0)
    weight_share = weight / weight.sum(0)
    mean = (weight_share[..., None] * np.where(visible[..., None, None], corners, 0)).sum(0)
    share = _differing_share(corners, covariance, mean, visible)
    growth, differing = max(share, 1.0), min(share, 1.0)
    root = np.repeat(weight_share, 2, axis=2)[..., None] * np.linalg.cholesky(joint)
    independent = np.einsum("enij,enlj->nil", root, root)
    common = np.einsum("enij,fnlj->nil", root, root)
    merged = growth * (differing * independent + (1 - differing) * common) + layout.sigma_px**2 * np.eye(8)
    names = names or [str(k + 1) for k in range(len(exposures))]
    repeated = {tag for tags in exposures for tag in tags.repeated if tag in rows}
    unknown = {tag for tags in exposures for tag in tags.tags if tag not in rows}
    return Merged(
        SeenTags(used, mean, merged, (weight_share.mean(2) * edge).sum(0)),
        tuple(int(n) for n in visible.sum(1)),
        share,
        _shifts(corners, covariance, visible, names),
        tuple(sorted(repeated)),
        tuple(sorted(unknown)),
    )


def _stacked(exposures, places, used: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns corners (e, n, 4, 2), covariances of each and of a tag's four, and σ of the edges' common shift, (e, n).

    For tags that are not seen these are NaN, 1 px² and 0.
    """
    corners = np.full((len(exposures), len(used), 4, 2), np.nan)
    edge = np.zeros(corners.shape[:2])
    covariance = np.tile(np.eye(2), (len(exposures), len(used), 4, 1, 1))
    joint = np.tile(np.eye(8), (len(exposures), len(used), 1, 1))
    for e, (tags, place) in enumerate(zip(exposures, places, strict=True)):
        visible = [k for k, row in enumerate(used) if row in place]
        columns = [place[used[k]] for k in visible]
        corners[e, visible] = tags.corners_px[columns]
        covariance[e, visible] = tags.covariance_px2[columns]
        joint[e, visible] = tags.joint_px2[columns]
        edge[e, visible] = tags.edge_sigma_px()[columns]
    return corners, covariance, joint, edge


def _differing_share(corners, covariance, mean, there) -> float:
    """Returns the share of the corners' stated variance that appears as differences between exposures.

    A common shift of a tag's edges is removed before.
    """
    difference = np.where(there[..., None, None], corners - mean, 0)
    direction = corners_by_edges(mean)
    difference -= (
        (difference * direction).sum((2, 3), keepdims=True)
        / (direction * direction).sum((1, 2))[:, None, None]
        * direction
    )
    square = np.einsum("enki,enkij,enkj->enk", difference, np.linalg.inv(covariance), difference)
    repeated = there.sum(0) > 1
    # Bounds the influence of a tag that one exposure gets wrong.
    square = np.minimum(square[:, repeated], 25.0)
    dof = 7 * float((there.sum(0)[repeated] - 1).sum())
    return float((square.sum() + PRIOR_SHARE * PRIOR_WEIGHT) / (dof + PRIOR_WEIGHT))


def _shifts(corners, covariance, there, names) -> tuple[Shift, ...]:
    """Returns the shift of each exposure against the one with most tags in common, among exposures with more tags."""
    order = sorted(range(len(there)), key=lambda e: -int(there[e].sum()))
    middle = corners.mean(2)
    variance = np.trace(covariance, axis1=-2, axis2=-1).mean(2) / 4
    shifts = []
    for place, e in enumerate(order):
        others = [(int((there[e] & there[f]).sum()), f) for f in order[:place]]
        common, f = max(others, default=(0, -1))
        if common:
            both = there[e] & there[f]
            length = np.linalg.norm(middle[e, both] - middle[f, both], axis=1)
            sigma = np.sqrt((variance[e, both] + variance[f, both]).mean())
            shifts.append(Shift((names[f], names[e]), common, float(np.median(length)), float(sigma)))
    return tuple(shifts)
