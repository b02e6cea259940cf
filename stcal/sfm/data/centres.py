"""Centres of circles as measured in one image."""

from dataclasses import dataclass, fields

import numpy as np

from stcal.geometry.arrays import frozen


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
