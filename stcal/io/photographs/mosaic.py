"""Mosaics of coloured pixels, as sensors with a Bayer filter deliver them: how to tell one, and its grey image."""

import cv2
import numpy as np

from stcal.errors import InputError

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colours of the first two rows and columns."""
LEAST_COLOUR = 0.05
"""Smallest relative difference between neighbours of two colours that tells a mosaic."""
GREEN_ALIKE = 0.3
"""Largest difference between both greens, as a share of that between green and the other colours."""
TRIED_PX = 1024
"""Side of the middle of the image that is judged, px."""


def demosaiced(mosaic: np.ndarray, pattern: str, name: str) -> np.ndarray:
    """Return the grey image of a mosaic; ``pattern`` : one of :data:`PATTERNS`.

    Raises InputError: the pattern is unknown, or the image has colours already.
    """
    word = pattern.upper()
    if word not in PATTERNS:
        raise InputError("E-OPTION-VALUE", f"--bayer {pattern[:20]}: one of {', '.join(PATTERNS)} needed")
    if mosaic.ndim != 2:
        raise InputError("E-IMAGE-TYPE", f"{name}: a colour image, not a mosaic; leave --bayer out")
    return cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{word}2GRAY"))


def patterns_seen(image: np.ndarray) -> tuple[str, ...]:
    """Return the patterns that a grey image may be a mosaic of: two, as red and blue look alike; none if it is none.

    In a mosaic both greens, on one diagonal of each 2×2 pixels, are alike, and another colour differs from them all
    over the image. Medians hide what the scene adds, as it favours no pixel of the four.
    """
    height, width = (min(side, TRIED_PX) // 2 * 2 for side in image.shape)
    if not height or not width:
        return ()
    top, left = ((side - part) // 4 * 2 for side, part in zip(image.shape, (height, width), strict=True))
    grey = image[top : top + height, left : left + width].astype(np.float32)
    a, b, c, d = grey[::2, ::2], grey[::2, 1::2], grey[1::2, ::2], grey[1::2, 1::2]
    total = a + b + c + d
    bright = total >= max(float(np.median(total)), 1.0)
    if not bright.any():
        return ()

    def apart(one: np.ndarray, two: np.ndarray) -> float:
        return float(np.median((one - two)[bright] / total[bright])) * 4

    for greens, others, patterns in (
        ((b, c), (a, d), ("RGGB", "BGGR")),
        ((a, d), (b, c), ("GRBG", "GBRG")),
    ):
        colour = max(min(abs(apart(other, green)) for green in greens) for other in others)
        if colour > LEAST_COLOUR and abs(apart(*greens)) < GREEN_ALIKE * colour:
            return patterns
    return ()
