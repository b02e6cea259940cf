"""From exposures to poses with verdicts: the stages in order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from stcal.boards.tags import other_dictionaries
from stcal.errors import InputError, StcalError
from stcal.io.cameras.model import CameraModel, CameraPrior
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode
from stcal.locate.data.exposures import SceneFiles, SceneTags, read_scenes
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pose.estimate import ObjPose, locate
from stcal.locate.pose.merge import Merged, Shift, merge
from stcal.locate.pose.patent import PatentOptions, PatentPose, locate_as_patent
from stcal.locate.pose.verdict import Verdict, VerdictOptions, judge

Method = Literal["joint", "patent"]
MOVED_SIGMAS = 5.0
"""Of a shift between exposures: by chance once in 10⁵ (Rayleigh)."""


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """How to locate a target.

    Parameters
    ----------
    method : {"joint", "patent"}
        By all exposures together, or as the patent has it.
    verdict : VerdictOptions
        Limits of the joint method.
    patent : PatentOptions
        Limits of the patent's.
    moved_px : float
        A scene whose tags shift by more between exposures, and by more than :data:`MOVED_SIGMAS`, has moved.
    workers : int or None
        Threads that search for tags, as many as there are cores where None.
    """

    method: Method = "joint"
    verdict: VerdictOptions = field(default_factory=VerdictOptions)
    patent: PatentOptions = field(default_factory=PatentOptions)
    moved_px: float = 0.5
    workers: int | None = None

    def __post_init__(self):
        if self.method not in ("joint", "patent"):
            raise InputError("E-OPTION-METHOD", f"method {self.method!r}: joint or patent needed")
        if not self.moved_px > 0:
            raise InputError("E-OPTION-RANGE", f"moved_px {self.moved_px:g}: a positive number needed")


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """One scene.

    Parameters
    ----------
    tags : SceneTags
        What its exposures show.
    merged : Merged or None
        Corners of all exposures together; None where these do not belong together.
    pose : ObjPose or None
        None where none was found, or another method was asked for.
    verdict : Verdict
        Whether the pose may be used.
    notes : tuple of str
        What was left out, and what else there is to know.
    patent : PatentPose or None
        What the patent's method says of it, where it was asked for.
    """

    tags: SceneTags
    merged: Merged | None
    pose: ObjPose | None
    verdict: Verdict
    notes: tuple[str, ...] = ()
    patent: PatentPose | None = None

    @property
    def name(self) -> str:
        """Of the scene."""
        return self.tags.name


def run(
    scenes: Sequence[SceneFiles], layout: TargetLayout, camera: CameraModel, options: LocateOptions | None = None
) -> Iterator[Located]:
    """The target's pose in each scene, with its verdict.

    Parameters
    ----------
    scenes : sequence of SceneFiles
        From :func:`~stcal.locate.find_scenes`.
    layout : TargetLayout
        The target.
    camera : CameraModel
        That took the exposures.
    options : LocateOptions, optional
        The defaults where None.

    Yields
    ------
    Located
        One for each scene, in their order. Trouble with one scene rejects that scene, with the reason, and never ends
        the run.
    """
    options = options or LocateOptions()
    for files, tags in zip(scenes, read_scenes(scenes, layout, options.workers), strict=True):
        located = locate_scene(tags, layout, camera, options)
        if located.merged is not None and not sum(located.merged.counts):
            located = replace(located, verdict=_rejected([_why_no_tag(located.tags, located.merged, files, layout)]))
        yield located


def locate_scene(
    scene: SceneTags, layout: TargetLayout, camera: CameraModel, options: LocateOptions | None = None
) -> Located:
    """The verdict on one scene."""
    options = options or LocateOptions()
    notes = [f"left out: {exposure.trouble}" for exposure in scene.unreadable()]
    used = scene.readable()
    troubles = _size_troubles(scene, camera)
    if troubles:
        return Located(scene, None, None, _rejected(troubles), tuple(notes))
    merged = merge([exposure.tags for exposure in used], layout, [exposure.name for exposure in used])
    notes += _notes(merged)
    troubles = _scene_troubles(merged, options)
    if troubles:
        return Located(scene, merged, None, _rejected(troubles), tuple(notes))
    size = used[0].size
    prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
    try:
        if options.method == "patent":
            found = locate_as_patent([e.tags for e in used], layout, camera.sized(*size), options.patent, scene.name)
            return Located(scene, merged, None, found.verdict, tuple(notes), found)
        pose = locate(merged.seen, layout, camera.sized(*size), prior, scene.name)
    except StcalError as error:
        return Located(scene, merged, None, _rejected([str(error).removeprefix(f"{scene.name}: ")]), tuple(notes))
    if pose.outliers:
        names = ", ".join(str(layout.tags[row][1]) for row in pose.outliers)
        notes.append(f"tags that contradict the others, left out: {names}")
    pose, verdict = judge(pose, options.verdict)
    return Located(scene, merged, pose, verdict, tuple(notes))


def _size_troubles(scene: SceneTags, camera: CameraModel) -> list[str]:
    used = scene.readable()
    if not used:
        return ["no readable image; 1 needed"]
    sizes = {exposure.size: exposure.name for exposure in reversed(used)}
    if len(sizes) > 1:
        shown = ", ".join(f"{name} {size[0]}×{size[1]}" for size, name in sorted(sizes.items()))
        return [f"exposures of different sizes ({shown} px); one size needed, as the camera file's"]
    width, height = used[0].size
    if (camera.width or width, camera.height or height) != (width, height):
        return [
            f"images of {width}×{height} px, the camera file is of {camera.width}×{camera.height} px; "
            "give the camera that took them"
        ]
    return []


def _scene_troubles(merged: Merged, options: LocateOptions) -> list[str]:
    if merged.repeated:
        names = ", ".join(str(tag) for _, tag in merged.repeated)
        return [f"tags seen twice: {names}; every id once in view needed; cover the copy"]
    if not len(merged.seen):
        return ["no tag of the layout; 1 needed"]
    away = [shift for shift in merged.shifts if moved(shift, options)]
    return [_moved_text(max(away, key=lambda shift: shift.shift_px), len(away) - 1)] if away else []


def moved(shift: Shift, options: LocateOptions) -> bool:
    """Whether two exposures show different scenes."""
    return shift.shift_px > max(options.moved_px, MOVED_SIGMAS * shift.sigma_px)


def _moved_text(shift: Shift, others: int) -> str:
    first, second = shift.exposures
    more = f" (and between {others} more pairs)" if others else ""
    return (
        f"the scene moved between {first} and {second}: {shift.tags} tags by {shift.shift_px:.2f} px{more}; "
        "take the exposures with camera and target at rest"
    )


def _notes(merged: Merged) -> list[str]:
    if not merged.unknown:
        return []
    names = ", ".join(str(tag) for _, tag in merged.unknown[:5]) + (", …" if len(merged.unknown) > 5 else "")
    return [f"tags in view that the layout does not have: {names}"]


def _rejected(reasons: Sequence[str]) -> Verdict:
    return Verdict("reject", (), tuple(reasons))


def _why_no_tag(tags: SceneTags, merged: Merged, files: SceneFiles, layout: TargetLayout) -> str:
    """Why no tag is seen: perhaps those in view are of another dictionary."""
    known = layout.dictionaries()
    used = {exposure.name for exposure in tags.readable()}
    file = next(file for file in files.files if file.name in used)
    others = other_dictionaries(decode(read_bytes(file.path, IMAGE_BYTES), file.name), known)
    if merged.unknown:
        names = ", ".join(str(tag) for _, tag in merged.unknown[:5])
        return f"no tag of the layout, but others of its dictionaries ({names}); is it the layout of this target?"
    reason = f"no tag of {', '.join(known)}; 1 of the layout needed"
    if others:
        reason += f", and {file.name} shows {others[0][1]} of {others[0][0]}; correct dictionary in the layout file"
    return reason
