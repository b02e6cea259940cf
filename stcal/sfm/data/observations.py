"""Centres of circles as measured in an image, and the labelled observations of a group."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from stcal.geometry.arrays import frozen
from stcal.labels import CircleLabel, Label, parse_labels


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservations:
    """n labelled circles of one image.

    ``centre_px`` : (n, 2) ellipse centres in the original image, OpenCV pixel origin; ``centre`` : (n, 2) and
    ``shape`` : (n, 2, 2) the ideal ellipse in normalised coordinates; ``covariance_px2`` : (n, 2, 2) covariances
    of ``centre_px``; ``uneven_px`` : (n, 2) shift of the centres that uneven brightness would have caused, zero by
    default and if no uneven brightness was detected.
    """

    name: str
    group: str
    labels: tuple[Label, ...]
    centre_px: np.ndarray
    centre: np.ndarray
    shape: np.ndarray
    covariance_px2: np.ndarray
    uneven_px: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self):
        object.__setattr__(self, "labels", parse_labels(self.labels))
        n = len(self.labels)
        for field, shape in (("centre_px", (n, 2)), ("centre", (n, 2)), ("shape", (n, 2, 2))):
            object.__setattr__(self, field, frozen(getattr(self, field), shape, field))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (n, 2, 2), "covariance_px2"))
        uneven = np.zeros((n, 2)) if self.uneven_px is None else self.uneven_px
        object.__setattr__(self, "uneven_px", frozen(uneven, (n, 2), "uneven_px"))

    def __len__(self) -> int:
        return len(self.labels)

    def sigma_px(self) -> np.ndarray:
        """Returns the standard deviation of each centre per axis (RMS over both axes), (n,)."""
        return np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2)

    def face_ids(self) -> list[str]:
        """Returns the ids of the target's faces that the labels name, in order of appearance."""
        return list(dict.fromkeys(label.face for label in self.labels if isinstance(label, CircleLabel)))

    def plus(self, other: "ImageObservations") -> "ImageObservations":
        """Returns these circles followed by the circles of ``other``, observations of the same image."""
        arrays = [np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)[3:]]
        return ImageObservations(self.name, self.group, self.labels + other.labels, *arrays)

    def select(self, keep) -> "ImageObservations":
        """Returns the circles of the indices ``keep``."""
        arrays = [getattr(self, f.name)[keep] for f in fields(self)[3:]]
        return ImageObservations(self.name, self.group, tuple(self.labels[i] for i in keep), *arrays)


def by_group(observations: Sequence[ImageObservations]) -> dict[str, list[ImageObservations]]:
    """Returns the observations by group, in order."""
    groups: dict[str, list[ImageObservations]] = {}
    for image in observations:
        groups.setdefault(image.group, []).append(image)
    return groups


def detections_csv(observations: list[ImageObservations]) -> str:
    """Returns the text of ``detections.csv``."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["image", "label", "x_px", "y_px", "sigma_px"])
    for image in observations:
        for label, (x, y), sigma in zip(image.labels, image.centre_px, image.sigma_px(), strict=True):
            writer.writerow([image.name, label, f"{x:.5f}", f"{y:.5f}", f"{sigma:.5f}"])
    return stream.getvalue()


@dataclass(frozen=True, slots=True, eq=False)
class Centres:
    """n measured ellipses.

    ``centre_px`` : (n, 2) centre of the ideal ellipse, distorted into the original image (OpenCV pixel origin);
    ``centre`` : (n, 2) the same in normalised ideal coordinates; ``shape`` : (n, 2, 2) shape of the ellipse in these
    coordinates, rim = centre + shape @ unit circle; ``covariance_px2`` : (n, 2, 2) covariance of ``centre_px``;
    ``blur_px`` : (n,); ``contrast`` : (n,) grey values, inside minus outside; ``noise`` : (n,) robust σ of a pixel
    about the model, grey values; ``rim`` : (n,) share of the rim that follows the model; ``uneven_px`` : (n, 2) shift
    of the centre that uneven brightness would have caused, zero if no uneven brightness was detected; ``ok`` : (n,)
    True if the ellipse is usable.
    """

    centre_px: np.ndarray
    centre: np.ndarray
    shape: np.ndarray
    covariance_px2: np.ndarray
    blur_px: np.ndarray
    contrast: np.ndarray
    noise: np.ndarray
    rim: np.ndarray
    uneven_px: np.ndarray
    ok: np.ndarray

    def __post_init__(self):
        n = len(self.centre_px)
        for name, shape in (
            ("centre_px", (n, 2)),
            ("centre", (n, 2)),
            ("shape", (n, 2, 2)),
            ("blur_px", (n,)),
            ("covariance_px2", (n, 2, 2)),
            ("contrast", (n,)),
            ("noise", (n,)),
            ("rim", (n,)),
            ("uneven_px", (n, 2)),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name))
        object.__setattr__(self, "ok", frozen(self.ok, (n,), "ok", dtype=bool))

    def __len__(self) -> int:
        return len(self.centre_px)

    def select(self, keep: np.ndarray) -> "Centres":
        """Returns the ellipses of the indices or mask ``keep``."""
        return Centres(*(getattr(self, f.name)[keep] for f in fields(self)))

    @classmethod
    def concatenate(cls, parts: list["Centres"]) -> "Centres":
        """Returns the ellipses of all parts, one part after the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def sigma_px(self) -> np.ndarray:
        """Returns the standard deviation of each centre per axis (RMS over both axes), (n,)."""
        return np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2)
