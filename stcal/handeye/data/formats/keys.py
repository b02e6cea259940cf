"""Names under which programs keep poses, and the transform that each name means."""

import re

from stcal.handeye.data.formats.record import EVERY_FRAME, Frames, Role

_WORDS = {
    "base": "base|robot_?base|robotbase|world",
    "flange": "flange|gripper|hand|ee|eef|effector|end_?effector|endeffector|tool0?|tcp",
    "camera": "camera|cam|sensor|optical",
    "board": "board|target|marker|tag|object|pattern|checkerboard|chessboard|charuco|aruco",
}
"""Words that name each frame."""
_ANY = "|".join(f"(?P<{{0}}_{frame}>{words})" for frame, words in _WORDS.items())
_LEFT, _RIGHT = _ANY.replace("{0}", "a"), _ANY.replace("{0}", "b")
_FORMS = (
    (re.compile(rf"(?:{_LEFT})_from_(?:{_RIGHT})"), "ab", True),
    (re.compile(rf"(?:{_LEFT})2(?:{_RIGHT})"), "ba", True),
    (re.compile(rf"(?:{_LEFT})_(?:wrt|in)_(?:{_RIGHT})"), "ba", True),
    (re.compile(rf"(?:{_LEFT})_?t_?(?:{_RIGHT})"), "ab", False),
    (re.compile(rf"t_(?:{_LEFT})_(?:{_RIGHT})"), "ab", False),
)
"""Forms of names of transforms; which of the two frames is the first of ``a_from_b``; and whether no other reading is
possible."""
_PART = re.compile(r"(?:rot|trans|rotation|translation|rvecs?|tvecs?|[rth])_(?=[a-z_]+2)")
"""Prefix for rotation, translation or the whole matrix, before a name like OpenCV's gripper2base."""
ROLES_BY_NAME: dict[Role, re.Pattern] = {
    "robot": re.compile(r"(robot|arm|hand|gripper|flange|eef?|end_?effector|tcp)(_?(pose|transform|matri(x|ce))s?)?"),
    "camera": re.compile(
        r"(tracking|optical|camera|cam|board|target|marker|tag|object|pattern)(_?(pose|transform|matri(x|ce))s?)?"
    ),
}
"""Names that tell whether poses are the robot's or the camera's, but not in which direction."""


def frames_of(key: str) -> Frames | None:
    """Returns the transform that a name means; None where it means none."""
    name = re.sub(r"[\s.\-/]+", "_", str(key).strip()).lower()
    if name in EVERY_FRAME:
        return Frames(name, f"by its name {key}")
    bare = _PART.sub("", name, count=1) if _PART.match(name) else name
    for form, order, only in _FORMS:
        match = form.fullmatch(bare)
        if match:
            sides = {part[0]: part[2:] for part, text in match.groupdict().items() if text is not None}
            frames = f"{sides[order[0]]}_from_{sides[order[1]]}"
            if frames in EVERY_FRAME:
                return Frames(frames, f"by its name {key}", only)
    return None


def inverse_name(key: str) -> str:
    """Returns a name with its two frames exchanged, such as ``t_cam2target`` for ``t_target2cam``; empty if the name
    has another form."""
    for between in ("_from_", "_wrt_", "_in_", "2"):
        head, separator, tail = key.partition(between)
        if separator:
            prefix = next(iter(re.findall(r"^(?:rot|trans|rotation|translation|rvecs?|tvecs?|[rthRTH])_", head)), "")
            return f"{prefix}{tail}{separator}{head.removeprefix(prefix)}"
    return ""


def role_of(key: str) -> Role | None:
    """Returns the side, robot or camera, that a name without a direction refers to; None if it refers to neither."""
    name = re.sub(r"[\s.\-/]+", "_", str(key).strip()).lower()
    return next((role for role, form in ROLES_BY_NAME.items() if form.fullmatch(name)), None)
