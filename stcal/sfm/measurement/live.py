"""Live view of ``measure --live``: the pose in each picture of a camera, drawn into it, for a browser."""

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from stcal.errors import InputError, StcalError
from stcal.io.images import Skipped
from stcal.report.document import environment
from stcal.report.svg import AXIS_COLOURS, COLOURS
from stcal.sfm.measurement.images import MeasureOptions, outcome, result_of
from stcal.sfm.measurement.pose import TargetPose
from stcal.sfm.measurement.report import poses_file
from stcal.sfm.measurement.tracker import Tracker

WIDEST_PX = 1280
"""Largest width of the picture that is sent."""
JPEG_QUALITY = 80
RATE_OVER = 20
"""Number of pictures over which the rate is taken."""
LOST = "no pose"


@dataclass(frozen=True, slots=True)
class LivePicture:
    """One measured picture.

    ``number`` : counts from 1; ``jpeg`` : the picture with what was measured; ``content`` : what ``/live.json``
    answers.
    """

    number: int
    jpeg: bytes
    content: dict


class LiveView:
    """Newest measured picture, which one thread puts and others take.

    Attributes
    ----------
    newest : LivePicture or None
        None before the first picture.
    ended : bool
        Whether no further picture comes.
    """

    def __init__(self):
        self.newest: LivePicture | None = None
        self.ended = False

    @staticmethod
    def page() -> str:
        """Returns the page that shows pictures and poses as they come."""
        return environment().get_template("report/templates/live.html.jinja").render()

    def json(self) -> str:
        """Returns number, status, pose and rate of the newest picture."""
        content = self.newest.content if self.newest else {"picture": 0, "status": "waiting", "shown": []}
        return json.dumps(content | {"ended": self.ended}, ensure_ascii=False, allow_nan=False)


def follow(
    frames: Iterable[np.ndarray], tracker: Tracker, view: LiveView, tell: Callable[[LivePicture], None] | None = None
) -> int:
    """Measures the pictures of a camera until it ends, and puts each into a view.

    Parameters
    ----------
    frames : iterable of (height, width) arrays, uint8
        Grey pictures, as from :func:`stcal.io.device.pictures_of`.
    tracker : Tracker
        Target and camera.
    view : LiveView
        Receives the pictures.
    tell : callable, optional
        Called with each picture.

    Returns
    -------
    int
        Number of pictures.

    Raises
    ------
    InputError
        If a picture is of another size than the camera's.
    """
    times: list[float] = []
    number = 0
    for number, frame in enumerate(frames, 1):
        name = f"picture {number}"
        began = time.monotonic()
        labelled, pose = None, None
        try:
            labelled, pose = tracker.observe(frame, name)
            measured = outcome(name, pose, labelled.notes)
        except InputError:
            raise
        except StcalError as error:
            measured = Skipped(name, str(error).removeprefix(f"{name}: "), "pose")
        times = [*times[-RATE_OVER:], time.monotonic()]
        fit = pose if isinstance(pose, TargetPose) else None
        centres = labelled.observations.centre_px if labelled else np.zeros((0, 2))
        result = result_of([measured], tracker.target, MeasureOptions(tracker.pose_options), tracker.prior)
        content = {
            "picture": number,
            "status": fit.status if fit else LOST,
            "reason": measured.reason if isinstance(measured, Skipped) else "",
            "rate": (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0,
            "measured_in_s": times[-1] - began,
            "shown": rows_of(fit) if fit else [],
            "poses": poses_file(result).content(),
        }
        view.newest = LivePicture(number, _jpeg(drawn(frame, centres, fit, tracker)), content)
        if tell:
            tell(view.newest)
    view.ended = True
    return number


def rows_of(pose: TargetPose) -> list[list[str]]:
    """Returns the rows of the page for a pose: names and values with their σ, camera_from_target in mm and degrees."""
    turn = np.degrees(pose.camera_from_target.log()[:3])
    sigma = pose.camera_from_target.log_sigma(pose.covariance)
    sigma[:3] = np.degrees(sigma[:3])
    rows = [["faces", ", ".join(pose.faces)], ["circles", str(len(pose.labels))]]
    rows += [
        [axis, f"{value:.3f} ± {s:.3f} mm"]
        for axis, value, s in zip("xyz", pose.camera_from_target.translation, sigma[3:], strict=True)
    ]
    rows += [
        [f"turn about {axis}", f"{value:.3f} ± {s:.3f}°"] for axis, value, s in zip("xyz", turn, sigma[:3], strict=True)
    ]
    return [*rows, ["residuals", f"{pose.rms_px():.3f} px RMS"]]


def line_of(picture: LivePicture) -> str:
    """Returns one line for the terminal: number, status, pose and rate of a picture."""
    content = picture.content
    what = "  ".join(f"{name} {value}" for name, value in content["shown"] if name != "circles") or content["reason"]
    return f"picture {picture.number}: {content['status']}: {what}  ({content['rate']:.1f} a second)"


def drawn(frame: np.ndarray, centres_px: np.ndarray, pose: TargetPose | None, tracker: Tracker) -> np.ndarray:
    """Returns a picture, at most ``WIDEST_PX`` wide, in colour, with centres, faces and the target's axes.

    Parameters
    ----------
    frame : (height, width) array, uint8
        The picture as the camera took it.
    centres_px : (n, 2) array
        Measured centres.
    pose : TargetPose or None
        Pose of the target, if there is one.
    tracker : Tracker
        Target and camera.
    """
    scale = min(1.0, WIDEST_PX / frame.shape[1])
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else frame
    picture = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    unit = max(picture.shape[1] / 640, 1.0)

    def place(xy: np.ndarray) -> tuple[int, int]:
        x, y = (xy + 0.5) * scale - 0.5
        return round(float(x)), round(float(y))

    camera = tracker.camera
    if pose is not None and camera is not None:
        target = tracker.target
        for k, face in enumerate(pose.faces):
            of_face = np.array([label in target.place and label.face == face for label in target.labels])
            xy = camera.project(pose.camera_from_target @ target.xyz[of_face])
            hull = cv2.convexHull(np.array([place(p) for p in xy], np.int32))
            cv2.polylines(picture, [hull], True, _bgr(COLOURS[k % len(COLOURS)]), round(1.5 * unit), cv2.LINE_AA)
            words = ("face " + face, tuple(int(v) for v in hull[:, 0].min(0)), cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit)
            cv2.putText(picture, *words, (0, 0, 0), round(3 * unit), cv2.LINE_AA)
            cv2.putText(picture, *words, _bgr(COLOURS[k % len(COLOURS)]), round(unit), cv2.LINE_AA)
        length = 0.4 * float(np.linalg.norm(np.ptp(target.xyz, axis=0)))
        ends = pose.camera_from_target @ np.vstack([np.zeros(3), length * np.eye(3)])
        if (ends[:, 2] > 0).all():
            origin, *tips = (place(xy) for xy in camera.project(ends))
            for tip, colour in zip(tips, AXIS_COLOURS, strict=False):
                cv2.arrowedLine(picture, origin, tip, _bgr(colour), round(2 * unit), cv2.LINE_AA, tipLength=0.12)
    for xy in centres_px:
        cv2.drawMarker(picture, place(xy), (0, 255, 0), cv2.MARKER_CROSS, round(7 * unit), round(unit), cv2.LINE_AA)
    return picture


def _bgr(colour: str) -> tuple[int, int, int]:
    """Returns blue, green and red of a colour like ``#0b5394``."""
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def _jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
