"""Sharp frames of a video that differ in their view, as images in a folder."""

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stcal.errors import InputError, InputNote
from stcal.io.device import frames_of, png
from stcal.io.files import save
from stcal.io.images import SUFFIXES
from stcal.parallel import scratch_folder

AUTO = "auto"
SMALL_PX = 240
"""Longer side of the frames that are compared, px."""
MOVED = 0.04
"""Move of the parts that move most, as a share of the longer side, from which on a view is another: two degrees for
a lens of medium focal length."""
MOVING = 90
"""Percentile of the moves of pixels: a body before a resting background has few pixels."""
SHARP_BLUR_PX = 2.0
"""σ, px, of the blur that measures the sharpness of a frame: a frame that is already blurred as much hardly loses
detail by it."""
EDGE_SHARE = 0.05
"""Share of the pixels that are taken for edges."""
ALL, NEXT, BEFORE = slice(None), slice(1, None), slice(None, -1)
DIRECTIONS = (
    ((ALL, NEXT), (ALL, BEFORE)),
    ((NEXT, ALL), (BEFORE, ALL)),
    ((NEXT, NEXT), (BEFORE, BEFORE)),
    ((NEXT, BEFORE), (BEFORE, NEXT)),
)
"""Neighbours along the rows, the columns and both diagonals."""
LEAST_SHARPNESS = 0.6
"""Smallest sharpness of a chosen frame, as a share of the median: by motion or a focus that hunts, others have less."""
LEAST_FRAMES = 3
MOST_FRAMES = 120
"""Most frames that are chosen: more of one video cost time, and hardly add views."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame: its ``number``, ``grey`` as the video has it, ``small`` (h, w) for comparison, ``sharpness``."""

    number: int
    grey: np.ndarray
    small: np.ndarray
    sharpness: float


def checked_every(every: str | int) -> str | int:
    """Return ``auto`` or the number of frames."""
    if every == AUTO:
        return AUTO
    with contextlib.suppress(ValueError):
        if (count := int(every)) >= 1:
            return count
    raise InputError("E-OPTION-VALUE", f"--every {str(every)[:20]}: auto or a number of frames, 1 and more, needed")


def sharpness(grey: np.ndarray) -> float:
    """Return how much steeper the edges of a grey image are than after a blur, in the direction where they are least.

    It is a ratio of squared differences of neighbours, less 1, at the blurred image's steepest edges, so that
    brightness, contrast and empty parts do not count.
    """
    picture = grey.astype(np.float32)
    blurred = cv2.GaussianBlur(picture, (0, 0), SHARP_BLUR_PX)
    ratios = []
    for first, second in DIRECTIONS:
        own, smooth = ((image[first] - image[second]) ** 2 for image in (picture, blurred))
        edges = smooth >= max(float(np.quantile(smooth, 1 - EDGE_SHARE)), 1e-6)
        ratios.append(float(own[edges].sum() / smooth[edges].sum()) - 1 if edges.any() else 0.0)
    return max(min(ratios), 0.0)


def chosen_frames(frames: Iterator[np.ndarray], every: str | int = AUTO) -> Iterator[_Frame]:
    """Yield the sharpest frame of each part of a video in which the view hardly changes, or of ``every`` frames."""
    start = last = best = None
    for number, grey in enumerate(frames):
        scale = SMALL_PX / max(grey.shape)
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        frame = _Frame(number, grey, small, sharpness(grey))
        new_part = start is None or (
            number // every != start.number // every if isinstance(every, int) else _move(start, frame) >= MOVED
        )
        if new_part:
            if best is not None:
                yield best
                last = best
            start, best = frame, None
        apart = last is None or isinstance(every, int) or _move(last, frame) >= MOVED / 2
        if apart and (best is None or frame.sharpness > best.sharpness):
            best = frame
    if best is not None:
        yield best


def _move(first: _Frame, second: _Frame) -> float:
    """Return the motion of the fastest parts between two frames, as a share of the frames' longer side."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(first.small, second.small, None)  # type: ignore[call-overload]
    return float(np.percentile(np.linalg.norm(flow, axis=2), MOVING)) / SMALL_PX


def write_frames(video: str | Path, folder: str | Path, every: str | int = AUTO) -> list[Path]:
    """Write the chosen frames of a video into a folder, as ``frame_<number>.png``; those of an earlier call go.

    A warning lists them. Frames that are blurred more than others are left out. Raises InputError: the video cannot be
    read, fewer than ``LEAST_FRAMES`` views of it differ, or the folder cannot be written.
    """
    video, folder, every = Path(video), Path(folder), checked_every(every)
    written: list[tuple[Path, int, float]] = []
    with frames_of(video) as frames:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.glob("frame_*.png"):
                old.unlink()
        except OSError as error:
            raise InputError(
                "E-OUTPUT-UNWRITABLE", f"folder {folder}: {error.strerror or error}; give a writable folder"
            ) from error
        for frame in chosen_frames(frames, every):
            path = folder / f"frame_{frame.number:06d}.png"
            save(path, png(frame.grey))
            written.append((path, frame.number, frame.sharpness))
    usual = float(np.median([sharp for _, _, sharp in written]))
    sharp_ones = [each for each in written if each[2] >= LEAST_SHARPNESS * usual]
    spare = np.linspace(0, len(sharp_ones) - 1, min(len(sharp_ones), MOST_FRAMES)).round().astype(int).tolist()
    chosen = [sharp_ones[k] for k in spare]
    for path in {path for path, _, _ in written} - {path for path, _, _ in chosen}:
        path.unlink()
    if len(chosen) < LEAST_FRAMES:
        raise InputError(
            "E-VIDEO-VIEWS",
            f"video {video}: {len(chosen)} sharp frames with different views, {LEAST_FRAMES} needed; move the target "
            "or the camera more, and slowly, or name a number of frames with --every",
        )
    blurred = len(written) - len(sharp_ones)
    warnings.warn(
        f"{video.name}: {len(chosen)} frames chosen{f', {blurred} left out as blurred' if blurred else ''}: "
        f"{', '.join(str(number) for _, number, _ in chosen)}; photographs are better: rolling shutter and compression "
        "move edges, which σ do not know",
        InputNote,
        stacklevel=2,
    )
    return [path for path, _, _ in chosen]


@contextlib.contextmanager
def images_or_frames(images: Path) -> Iterator[Path]:
    """Yield a folder of images, or of one image, as it is; of a video, a folder with its chosen frames."""
    if not images.is_file() or images.suffix.lower() in SUFFIXES:
        yield images
        return
    with scratch_folder("frames") as folder:
        write_frames(images, folder)
        yield folder
