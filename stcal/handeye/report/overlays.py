"""Images with measured corners, and enlarged residuals of the corners that robot and transforms predict."""

import base64
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.handeye.report.coverage import by_robot, rms_px
from stcal.handeye.report.figures import enlargement
from stcal.handeye.report.outcome import Outcome
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode, grey_8bit, thumbnail

WIDTH_PX = 800
"""Width of an image in the page, in px. The page holds three images of some 100 kB each."""


@dataclass(frozen=True, slots=True)
class Overlay:
    """One image with its corners.

    ``corners`` : (x, y, x and y of the end of the enlarged residual, title); ``factor`` : enlargement of the residuals;
    ``dot`` : radius of the dots in px of the image.
    """

    title: str
    says: str
    width: int
    height: int
    jpeg: str
    factor: float
    dot: float
    corners: list[tuple[float, float, float, float, str]]


def overlays(outcome: Outcome) -> tuple[list[Overlay], list[str]]:
    """Returns the overlays of the worst, the median and the best image, and a message for each unreadable image.

    Both lists are empty if the poses did not come from images.
    """
    result, pairs, views = outcome.result, outcome.pairs, outcome.views
    if pairs is None or views is None or outcome.folder is None:
        return [], []
    predicted = by_robot(result, pairs, views)
    rms = np.array([rms_px(p, view.xy_px) for p, view in zip(predicted, views.views, strict=True)])
    order = np.argsort(rms, kind="stable")[::-1]
    chosen: dict[int, str] = {}
    for i, word in ((order[0], "worst"), (order[len(order) // 2], "usual"), (order[-1], "best")):
        chosen.setdefault(int(i), word)
    shown, missing = [], []
    for i, word in chosen.items():
        name = pairs.names[i]
        try:
            grey = grey_8bit(decode(read_bytes(outcome.folder / name, IMAGE_BYTES), name))
        except (OSError, InputError) as error:
            reason = error.strerror or error if isinstance(error, OSError) else error
            missing.append(f"{name} cannot be shown: {reason}")
            continue
        text = f"{rms[i]:.3g} px RMS by the robot's pose{', left out' if result.outliers[i] else ''}"
        shown.append(_overlay(f"{word}: {name}", text, grey, views.views[i].xy_px, predicted[i]))
    return shown, missing


def _overlay(title: str, says: str, grey: np.ndarray, seen: np.ndarray, predicted: np.ndarray) -> Overlay:
    height, width = grey.shape
    residuals = predicted - seen
    factor = enlargement(residuals, width)
    corners = []
    for (x, y), (right, down) in zip(seen.tolist(), residuals.tolist(), strict=True):
        if np.isfinite(right):
            text = f"x {right:+.2f} px, y {down:+.2f} px, {np.hypot(right, down):.2f} px"
            corners.append((x, y, x + factor * right, y + factor * down, text))
    jpeg = base64.b64encode(thumbnail(grey, WIDTH_PX)[0].tobytes()).decode()
    return Overlay(title, says, width, height, f"data:image/jpeg;base64,{jpeg}", factor, 0.005 * width, corners)
