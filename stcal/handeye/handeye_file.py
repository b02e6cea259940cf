"""Files of a hand-eye calibration: its result, and its transform for other programs."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml
from pydantic import Field

import stcal
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.handeye.choose import ChosenWay
from stcal.handeye.data.pose_pairs import FRAMES, Setup
from stcal.handeye.handeye_pipeline import Outcome, judged
from stcal.handeye.handeye_problem import HandEye
from stcal.handeye.remarks import Observability, Verdict
from stcal.handeye.time_offset import TimeOffset
from stcal.handeye.validate import Compared, HeldOutMotions, HeldOutPoses
from stcal.io.json import Finite, Matrix6, Named, NamedReason, Part, Pose, ResultFile, Vector3
from stcal.io.rotations import fixed
from stcal.io.static_transforms import (
    Static,
    fixed_joint,
    metres,
    ros2_launch,
    xyzw,
)
from stcal.io.toml import opencv_matrix


class PoseRow(Part):
    name: str
    used: bool
    rotation_rad: Vector3
    translation_mm: Vector3
    corner_rms_px: Finite = None


SPLITS = Named("rows rotation_rad translation_mm board_mm pose_mm")


class MethodRow(Part):
    method: str
    reason: str
    held_out: dict[str, Any] | None
    flange_from_camera: Pose | None = None
    base_from_camera: Pose | None = None
    base_from_board: Pose | None = None
    flange_from_board: Pose | None = None
    splits: Annotated[HeldOutPoses, SPLITS] | None


class HandEyeFile(ResultFile):
    """Result file of ``handeye``: mm, rad, px; null where there is no value."""

    format: Literal["stcal handeye 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    where: str = Field(alias="from", description="names of the files")
    verdict: Annotated[Verdict, Named("word sentence findings")] = Field(
        description="`word`: `good`, `use with care` or `do not use`; a `sentence` with the reasons; `findings`, each "
        "with `title`, `word`, what was `said`, `value` and `limit`, `remedy`"
    )
    setup: Setup = Field(description="what carries the camera")
    method: str = Field(description="that found the result")
    flange_from_camera: Pose | None = Field(None, description="`X` of eye-in-hand")
    base_from_camera: Pose | None = Field(None, description="`X` of eye-to-hand")
    covariance: Matrix6 | None = Field(
        description="of `X`: rotation about the camera, rad, and its translation, mm, in the axes of flange or base; "
        "null for methods that give none"
    )
    base_from_board: Pose | None = Field(None, description="`Z` of eye-in-hand")
    base_from_board_covariance: Matrix6 | None = Field(None, description="its covariance, likewise")
    flange_from_board: Pose | None = Field(None, description="`Z` of eye-to-hand")
    flange_from_board_covariance: Matrix6 | None = Field(None, description="its covariance, likewise")
    board: dict[str, Any] = Field(
        description="`scale`: true size over stated size, 1 where it was not solved for; `scale_sigma`; `pitch_mm` of "
        "dots or squares, times `scale`; null for tags and poses"
    )
    camera: dict[str, Any] | None = Field(
        description="with `--refine-camera`: COLMAP `model`; `parameters` fx, fy, cx, cy, k1, k2, p1, p2, k3 … k6, "
        "s1 … s4, OpenCV pixel origin; `sigma` of those of the model"
    )
    sigma: dict[str, float] = Field(
        description="`robot_rad`, `robot_mm`, `camera_rad`, `camera_mm`, `corner_px`, `board_mm` as far as the method "
        "weights by them; "
        "`camera_factor`: by which the σ of given covariances of `camera_from_board` were multiplied; "
        "`camera_focal`, `camera_centre`, `camera_radial`, `camera_tangential` (`camera_all` where their covariance is "
        "stated): factors, 1 or more, by which the σ of the camera file were widened"
    )
    estimated: list[str] = Field(description="which of them were estimated")
    corner_px_is_factor: bool = Field(description="whether `corner_px` is the factor of the corners' own σ")
    rms: dict[str, Any] = Field(description="`rotation_rad`, `translation_mm` of the residuals of the poses used")
    poses: list[PoseRow] = Field(
        description="`name` (`line 7`, or the image), `used`, residual `rotation_rad` (rotation vector) and "
        "`translation_mm` at the board's origin, by which the chain through this pose misses `Z`; with method "
        "`reprojection` `corner_rms_px`"
    )
    outliers: list[str] = Field(description="names of poses that contradict the others and were left out")
    left_out: list[NamedReason] = Field(description="`name`, `reason` of images and rows that did not take part")
    held_out: dict[str, Any] | None = Field(
        description="`splits`, `poses` in each, and means: `rotation_rad`, `translation_mm` of the board's origin; "
        "with images `board_mm`: the distance from each corner to the point where the camera's ray to it meets the "
        "board as placed by the robot, mean over the corners, and `pose_mm`: distance of the corners by the robot "
        "from those by the pose that the image gives alone; `agreeing`: means without `outliers`, null without any"
    )
    motions: Annotated[HeldOutMotions, Named()] | None = Field(
        None,
        description="with `--motions-held-out`: number of `fitted` motions; `names` of the poses from which and to "
        "which each other motion leads, and errors `rotation_rad`, `translation_mm` of X B X⁻¹ against A",
    )
    choice: Annotated[ChosenWay, Named("chosen sentence tried")] | None = Field(
        None,
        description="where no method was named: the way of solving that was `chosen` by errors on poses held out "
        "(`method`, and whether `camera` and `scale` were solved for), a `sentence` on it, and all that were `tried`: "
        "`candidate`, `mean_mm` (3-D at the board; of poses, of the board's origin), `reason` why it fails",
    )
    time_offset: Annotated[TimeOffset, Named("seconds sigma_s speed_mm_s speed_rad_s")] | None = Field(
        None,
        description="with `--time-offset`: `seconds` by which the robot's clock is ahead of the camera's, so that an "
        "image stamped t was taken at t + `seconds` of the robot's; `sigma_s`, which σ of `X` and `Z` hold; RMS "
        "`speed_mm_s`, `speed_rad_s` of the flange at the images",
    )
    observability: Annotated[Observability, Named("turns_rad axes sigma_rad sigma_mm")] | None = Field(
        description="`turns_rad` RMS between poses about the principal `axes`, rows, of the flange; `sigma_rad`, "
        "`sigma_mm` of the worst direction from poses of a common camera (1 mrad, 0.5 mm)"
    )
    notes: list[str] = Field(description="what should be known about the result")
    understood: list[str] = Field([], description="only of files of other programs: what each was taken for")
    splits: Annotated[HeldOutPoses, SPLITS] | None = Field(
        None,
        description="only in `--json`: `rows` of `poses` that each split held out, and the errors of each: "
        "`rotation_rad`, `translation_mm`, `board_mm`, `pose_mm`",
    )
    methods: list[MethodRow] = Field(
        [],
        description="only in `--json`, with `--method all`: `method`, `X` and `Z` (`flange_from_camera`, "
        "`base_from_board`, or `base_from_camera`, `flange_from_board`); `held_out`, with `splits`, `poses`, "
        "`rotation_rad`, `translation_mm`, `board_mm`, `pose_mm`, `agreeing`, and `splits`, with `rows`, as above; "
        "`reason` where it fails",
    )

    @classmethod
    def of(cls, outcome: Outcome, whole: bool = False) -> "HandEyeFile":
        """Returns the content of ``--out``, or, if ``whole``, of ``--json``: with every split and every method too."""
        given, result, held_out = outcome.given, outcome.result, outcome.held_out
        pitch_mm = given.pitch_mm and given.pitch_mm * result.scale
        same = ("setup", "method", "covariance", "sigma", "estimated", "observability")
        optional = {name: getattr(outcome, name) for name in ("motions", "choice", "time_offset")}
        optional["understood"] = given.understood
        if whole:
            optional |= {"splits": held_out, "methods": [_method(each) for each in outcome.compared]}
        adjusted, poses = result.reprojection, []
        for i, (name, out, off) in enumerate(zip(result.names, result.outliers, result.residuals, strict=True)):
            row = {"name": name, "used": not out, "rotation_rad": off[:3], "translation_mm": off[3:]}
            poses.append(row if adjusted is None else row | {"corner_rms_px": adjusted.rms_px(i)})
        content = {
            "format": "stcal handeye 1",
            "version": stcal.__version__,
            "where": given.where,
            "verdict": judged(outcome),
            **{name: getattr(result, name) for name in same},
            **result.transforms,
            f"{FRAMES[result.setup].board}_covariance": result.stand_covariance,
            "board": {"scale": result.scale, "scale_sigma": result.sigma_scale, "pitch_mm": pitch_mm},
            "camera": outcome.camera,
            "corner_px_is_factor": outcome.own_sigmas,
            "rms": dict(zip(("rotation_rad", "translation_mm"), result.rms(), strict=True)),
            "poses": poses,
            "outliers": outcome.outliers(),
            "left_out": [{"name": name, "reason": reason} for name, reason in given.left_out],
            "held_out": held_out and held_out.summary(result.outliers),
            "notes": outcome.all_notes(),
        }
        return cls.model_validate(content | {name: value for name, value in optional.items() if value})


def _method(each: Compared) -> dict:
    result, held_out = each.result, each.held_out
    row = {"method": each.method, "reason": each.reason, "held_out": None, "splits": held_out}
    if result is None:
        return row
    return row | {"held_out": held_out and held_out.summary(result.outliers), **result.transforms}


OPTICAL = "_optical_frame"
CAMERA_FRAME = f"camera{OPTICAL}"
"""Name in ROS of a camera frame with Z along the line of sight and X to the right, as in stcal."""
CAMERA_LINK = "camera_link"  # name in ROS of a camera frame with X along the line of sight, Y to the left and Z up
LINK_FROM_OPTICAL = Rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""Rotation between both frames, which share their origin: REP 103, suffix frames."""
CameraFrame = Literal["optical", "link"]
MOVE_GROUP = {"freehand_robot_movement": True, "move_group": "manipulator", "move_group_namespace": "/"}
"""What easy_handeye's files hold beside frames and transform, as its own dialogue writes it."""


def tree(result: HandEye, parent: str = "", child: str = "", camera_frame: CameraFrame = "optical") -> list[Static]:
    """Returns the transforms that add the camera to a tree of frames, of the names of :func:`frame_names`. Raises
    InputError: a name is invalid, or the names are not all different."""
    mount, first, *below = frame_names(result.setup, parent, child, camera_frame)
    if not below:
        return [Static(mount, first, result.mount_from_camera)]
    mount_from_link = result.mount_from_camera @ LINK_FROM_OPTICAL.inverse()
    return [Static(mount, first, mount_from_link), Static(first, below[0], LINK_FROM_OPTICAL)]


def frame_names(setup: Setup, parent: str, child: str, camera_frame: CameraFrame) -> tuple[str, ...]:
    """Returns the names of the frames from the root; NAME_link has the child NAME_optical_frame. Empty names: flange or
    base, and :data:`CAMERA_FRAME` or :data:`CAMERA_LINK`. Raises InputError: a control character, or a name twice."""
    link = child or CAMERA_LINK
    below = [child or CAMERA_FRAME] if camera_frame == "optical" else [link, f"{link.removesuffix('_link')}{OPTICAL}"]
    names = [parent or FRAMES[setup].mount, *below]
    for name in names:
        if not name.isprintable():
            raise InputError("E-FRAME-NAME", f"frames: {name!r} has control characters; give a name in letters")
        if names.count(name) > 1:
            raise InputError("E-FRAME-NAME", f"frames: parent and child are both {name!r}; two names needed")
    return tuple(names)


def said_of(result: HandEye) -> list[str]:
    """Returns lines for comments: the transform's name, σ, and covariance."""
    frames = FRAMES[result.setup]
    lines = [f"stcal {stcal.__version__}: {frames.camera}, {result.setup}, {result.method}, {len(result.names)} poses"]
    if result.covariance is None:
        return [*lines, f"no covariance: method {result.method} gives none"]
    sigma = np.sqrt(np.diag(result.covariance))
    turn, shift = (" ".join(f"{v:.4g}" for v in part) for part in (np.degrees(sigma[:3]), sigma[3:]))
    lines.append(f"sigma along x y z of the {frames.mount}: {shift} mm; about them: {turn} deg")
    lines.append(f"covariance, rotation about x y z (rad), then shift along x y z (mm), axes of the {frames.mount}:")
    return lines + ["  " + " ".join(f"{v:.6e}" for v in row) for row in result.covariance]


def opencv_yaml(result: HandEye) -> str:
    """Returns a file for ``cv2.FileStorage``: both transforms, 4×4, and their covariances if there are any; mm, rad."""
    covariances = (result.covariance, result.stand_covariance)
    lines = ["%YAML:1.0", "---", f'setup: "{result.setup}"', f'method: "{result.method}"', 'unit: "mm"']
    for (name, pose), covariance in zip(result.transforms.items(), covariances, strict=True):
        lines += opencv_matrix(name, pose.matrix())
        if covariance is not None:
            lines += opencv_matrix(f"{name}_covariance", covariance)
    return "\n".join(lines) + "\n"


def urdf_joint(transforms: list[Static]) -> str:
    """Returns fixed joints of URDF (m; fixed-axis roll, pitch, yaw, rad); several in a ``robot`` for xacro."""
    joints = [fixed_joint(each) for each in transforms]
    if len(joints) == 1:
        return joints[0]
    links = [f"<link name={quoteattr(each.child)}/>\n" for each in transforms]
    return "<robot>\n" + "".join(link + joint for link, joint in zip(links, joints, strict=True)) + "</robot>\n"


def easy_handeye(result: HandEye, transforms: list[Static], name: str, second: bool = False) -> str:
    """Returns the file ``~/.ros/easy_handeye/NAME.yaml`` of ROS 1's easy_handeye, or, of the ``second`` version, for
    ROS 2, ``~/.ros2/easy_handeye2/calibrations/NAME.calib``. Frames of board and robot are unused."""
    first, *others = transforms
    frames, in_hand, lines = FRAMES[result.setup], result.setup == "eye-in-hand", said_of(result)
    carries = {frames.mount: first.parent, frames.stand: frames.stand}
    robot = {"robot_base_frame": carries["base"], "robot_effector_frame": carries["flange"]}
    named = {**robot, "tracking_base_frame": first.child, "tracking_marker_frame": "board"}
    turn, place = dict(zip("xyzw", xyzw(first.pose), strict=True)), dict(zip("xyz", metres(first.pose), strict=True))
    if second:
        kind = "eye_in_hand" if in_hand else "eye_on_base"
        content: dict[str, dict] = {"parameters": {"name": name, "calibration_type": kind, **named, **MOVE_GROUP}}
        content["transform"] = {"translation": place, "rotation": turn}
    else:
        content = {"parameters": {"eye_on_hand": in_hand, **MOVE_GROUP, "namespace": f"/{name}/", **named}}
        content["transformation"] = {f"q{axis}": value for axis, value in turn.items()} | place
    for each in others:
        words = " ".join(fixed(value, 3) for value in xyzw(each.pose))
        lines.append(f"{each.child} is not in this file: in {each.parent} at 0 0 0, quaternion x y z w {words}")
    return "".join(f"# {line}\n" for line in lines) + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


FORMS: dict[str, Callable[[HandEye, list[Static], str], str]] = {
    "ros2": lambda result, transforms, _: ros2_launch(transforms, said_of(result)),
    "easy-handeye": easy_handeye,
    "easy-handeye2": partial(easy_handeye, second=True),
}
"""Writers of all formats, by the word of ``--export``."""
