"""Checks of single observations: exchanged labels, and centres that contradict all others."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from stcal.geometry.camera import Camera
from stcal.labels import Label
from stcal.sfm.adjust.network import Network
from stcal.sfm.checks.verdict import SHOWN, Check, Measured, Trial, judge, without_image
from stcal.sfm.data.model import Outlier
from stcal.sfm.data.observations import ImageObservations

EXCHANGED = 0.1
"""Largest deviation of exchanged labels: each centre lies at the place of the other to within this share of their
distance."""
MANY = 5
"""Number of centres left out of one image at which they are no longer single hidden or dirty circles."""


def labels_check(
    networks: Sequence[Network], outliers: Sequence[Outlier], images: Sequence[ImageObservations], camera: Camera
) -> Check:
    """Tests every observation against all others.

    Observations that were left out already do no harm and are named. Observations that were kept but are beyond chance
    (squared residual over its own redundancy: Baarda's data snooping) are named, too; their weight is reduced. Labels
    of one image that are at each other's places are a fault: other labels may be exchanged without being noticed.
    """
    remedy = "look at these circles in the overlays: hidden in part, dirty, a reflection, or a wrong label"
    check = judge("labels", "Each centre against all others", _trials(networks), "centres", remedy, "suspicious")
    swapped = _exchanged(networks, outliers, images, camera)
    lost = tuple(name for name, count in Counter(o.image for o in outliers).most_common() if count >= MANY)
    if not outliers:
        return check
    named = tuple(f"{o.image} {o.label}" for o in outliers)
    measured = tuple(
        Measured(name, o.residual_px, o.limit_px, "px", None) for name, o in zip(named, outliers, strict=True)
    )
    reason = f"{len(outliers)} left out, first {named[0]}: {outliers[0].residual_px:.3g} px"
    verdict = "suspicious"
    if lost:
        verdict = "failed"
        reason = f"{len(outliers)} left out, {MANY} or more of image {', '.join(lost)}"
        remedy = (
            "in these images the target stood elsewhere against the board, or they are of another group: take them "
            f"out, the first with {without_image(lost[0])}"
        )
    if swapped:
        verdict = "failed"
        reason = f"labels exchanged: {swapped[0]}"
        remedy = "these labels are wrong: check the circles' positions and radii in target.toml, look at the overlay"
    shown = (*measured, *check.measured)[:SHOWN]
    return replace(
        check,
        verdict=verdict,
        reason=reason,
        measured=shown,
        names=(*swapped, *lost, *named, *check.names),
        remedy=remedy,
    )


def _trials(networks: Sequence[Network]) -> list[Trial]:
    trials = []
    for network in networks:
        model, total = network.model, network.redundancy.sum()
        length = np.linalg.norm(network.residual, axis=1)
        for k in np.flatnonzero(network.redundancy > 0.2):
            statistic = 2 * length[k] ** 2 / network.redundancy[k]
            name = f"{model.images[model.image_index[k]]} {model.labels[model.point_index[k]]}"
            trials.append(Trial(name, float(length[k]), "σ", float(statistic), 2, float(total)))
    return trials


def _exchanged(
    networks: Sequence[Network], outliers: Sequence[Outlier], images: Sequence[ImageObservations], camera: Camera
) -> tuple[str, ...]:
    """Returns ``image: label and label`` of every pair of outliers that are at each other's places."""
    by_image: dict[str, list[Label]] = {}
    for outlier in outliers:
        by_image.setdefault(outlier.image, []).append(outlier.label)
    observed = {image.name: image for image in images}
    pairs = []
    for network in networks:
        model = network.model
        for name in set(model.images) & set(by_image):
            pose = model.camera_from_model[model.images.index(name)]
            labels = [label for label in by_image[name] if label in model.labels]
            place = {x: camera.project((pose @ model.xyz_model[model.labels.index(x)])[None])[0] for x in labels}
            measured = dict(zip(observed[name].labels, observed[name].centre_px, strict=True))
            for a, b in combinations(labels, 2):
                apart = np.linalg.norm(place[a] - place[b])
                off = max(np.linalg.norm(measured[a] - place[b]), np.linalg.norm(measured[b] - place[a]))
                if off < EXCHANGED * apart:
                    pairs.append(f"{name}: {a} and {b}")
    return tuple(pairs)
