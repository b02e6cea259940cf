"""Pipeline from exposures to poses with verdicts: the stages in order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stcal.boards.board_designs import TagLayout
from stcal.boards.finders import shift_by_curves
from stcal.boards.tags import seen_otherwise
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import Brief, require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel, CameraPrior
from stcal.io.cameras.read import camera_model
from stcal.io.images import decode, grey_8bit, grey_of, size_fault
from stcal.locate.estimate import Merged, ObjPose, locate, merge
from stcal.locate.exposures import Exposure, SceneFiles, SceneTags, detect, read_scenes
from stcal.locate.layout import TargetLayout
from stcal.locate.patent import PatentOptions, PatentPose, locate_as_patent
from stcal.locate.verdict import Verdict, VerdictOptions, judge, likely_mistake

Method = Literal["joint", "patent"]
MOVED_SIGMAS = 5.0
"""Shift between exposures, in σ, beyond which a scene has moved. Chance exceeds it once in 10⁵ (Rayleigh)."""


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """Options of how to locate a target.

    Parameters
    ----------
    method : {"joint", "patent"}
        One pose from all exposures together, or the method of the patent.
    verdict : VerdictOptions
        Limits of the joint method.
    patent : PatentOptions
        Limits of the patent's method.
    moved_px : float
        A scene has moved if its tags shift by more than this between exposures, and by more than :data:`MOVED_SIGMAS`.
    workers : int or None
        Number of threads that search for tags; as many as cores if None.
    """

    method: Method = "joint"
    verdict: VerdictOptions = field(default_factory=VerdictOptions)
    patent: PatentOptions = field(default_factory=PatentOptions)
    moved_px: float = 0.5
    workers: int | None = None

    def __post_init__(self):
        require_fields(self, "locate", workers=1)
        if self.method not in ("joint", "patent"):
            raise InputError("E-OPTION-METHOD", f"method {self.method!r}: joint or patent needed")
        if not self.moved_px > 0:
            raise InputError("E-OPTION-RANGE", f"moved_px {self.moved_px:g}: a positive number needed")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Located(Brief):
    """Result of one scene.

    Parameters
    ----------
    tags : SceneTags
        Tags that its exposures show.
    merged : Merged or None
        Merged corners of all exposures; None if the exposures do not belong together.
    pose : ObjPose or None
        Pose by the joint method; None if it failed, or another method was asked for.
    verdict : Verdict
        Whether the pose may be used.
    notes : tuple of str
        What was left out, and other notes.
    patent : PatentPose or None
        Result of the patent's method, if it was asked for.
    """

    tags: SceneTags
    merged: Merged | None
    pose: ObjPose | None
    verdict: Verdict
    notes: tuple[str, ...] = ()
    patent: PatentPose | None = None

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.tags.name

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """Readable exposures of the scene."""
        return self.tags.exposures

    @property
    def camera_from_obj(self) -> Rigid | None:
        """Pose of the target by the method that was asked for, mm; None if there is none."""
        found = self.patent or self.pose
        return found and found.camera_from_obj


@require_arguments
def run(
    scenes: Sequence[SceneFiles],
    layout: TargetLayout | TagLayout,
    camera: Camera | CameraModel,
    options: LocateOptions | None = None,
) -> Iterator[Located]:
    """Yields the target's pose in each scene, with its verdict.

    Parameters
    ----------
    scenes : sequence of SceneFiles
        Scenes from :func:`~stcal.locate.find_scenes`.
    layout : TargetLayout or TagLayout
        The target.
    camera : Camera
        The camera that took the exposures.
    options : LocateOptions, optional
        Options of the method; the defaults if None.

    Yields
    ------
    Located
        One result per scene, in their order. Trouble with one scene rejects that scene, with the reason, and never
        ends the run.
    """
    options, model = options or LocateOptions(), camera_model(camera)
    layout = TargetLayout.of(layout) if isinstance(layout, TagLayout) else layout
    for files, tags in zip(scenes, read_scenes(scenes, layout, options.workers), strict=True):
        located = locate_scene(tags, layout, model, options)
        if _without_tag(located):
            first = next(file for file in files.files if file.name == tags.exposures[0].name)
            located = _explained(located, layout, decode(first.read(), first.name))
        yield located


@require_arguments
def locate_image(
    image: np.ndarray,
    layout: TargetLayout | TagLayout,
    camera: CameraModel | Camera,
    options: LocateOptions | None = None,
    name: str = "image",
) -> Located:
    """Locates the target in one image and judges the pose.

    Parameters
    ----------
    image : (height, width) or (height, width, 3) array
        Grey or RGB, 8 or 16 bit.
    layout : TargetLayout or TagLayout
        The target.
    camera : Camera
        The camera that took the image.
    options : LocateOptions, optional
        Options of the method; the defaults if None.
    name : str
        Name of the image, for messages.

    Returns
    -------
    Located
        Its ``pose`` is None if there is none; the verdict says why.

    Raises
    ------
    InputError
        The image is no grey or RGB array, or its size is not the camera's.
    """
    grey = grey_of(image, name)
    target = TargetLayout.of(layout) if isinstance(layout, TagLayout) else layout
    model = camera_model(camera)
    size = grey.shape[1], grey.shape[0]
    wanted = model.width or size[0], model.height or size[1]
    if size != wanted:
        raise InputError("E-IMAGE-SIZE", f"{name}: {size_fault(name, size, wanted, 'the camera').reason}")
    exposure = detect(grey_8bit(grey), name, target.dictionaries())
    located = locate_scene(SceneTags(name, (exposure,)), target, model, options)
    return _explained(located, target, grey) if _without_tag(located) else located


def locate_scene(
    scene: SceneTags, layout: TargetLayout, camera: CameraModel, options: LocateOptions | None = None
) -> Located:
    """Locates the target in one scene and judges the pose."""
    options = options or LocateOptions()
    used, notes = scene.exposures, [f"left out: {trouble}" for trouble in scene.unreadable]

    def rejected(merged: Merged | None, *reasons: str) -> Located:
        return Located(scene, merged, None, Verdict("reject", (), reasons), tuple(notes))

    if trouble := _size_trouble(scene, camera):
        return rejected(None, trouble)
    merged = merge([exposure.tags for exposure in used], layout, [exposure.name for exposure in used])
    if merged.unknown:
        notes.append(f"tags in view that the layout does not have: {_first_ids(merged.unknown)}")
    notes += [
        f"{each.name}: motion during the exposure blurs edges by {each.tags.smear_px:.1f} px, which σ contain; "
        "camera and target at rest, or a shorter exposure"
        for each in used
        if each.tags.smear_px
    ]
    if trouble := _scene_trouble(merged, options):
        return rejected(merged, trouble)
    prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)

    def mistakes(pose: ObjPose | None) -> list[str]:
        try:
            mistake = likely_mistake(merged.seen, layout, camera.sized(*used[0].size), prior, pose)
        except StcalError:  # it is the camera's fault
            return []
        return [f"all tags would fit if {mistake}; correct the layout file"] if mistake else []

    try:
        sized = camera.sized(*used[0].size)
        corners = merged.seen.corners_px
        straight = corners - shift_by_curves(corners, sized)
        merged = replace(merged, seen=replace(merged.seen, corners_px=straight))
        if options.method == "patent":
            found = locate_as_patent([e.tags for e in used], layout, sized, options.patent, scene.name)
            return Located(scene, merged, None, found.verdict, tuple(notes), found)
        pose = locate(merged.seen, layout, sized, prior, scene.name)
    except StcalError as error:
        return rejected(merged, str(error).removeprefix(f"{scene.name}: "), *mistakes(None))
    if pose.outliers:
        notes.append(
            f"tags that contradict the others, left out: {', '.join(str(layout.tags[r][1]) for r in pose.outliers)}"
        )
    explained = mistakes(pose) if pose.outliers else []
    pose, verdict = judge(pose, options.verdict)
    if verdict.decision == "reject":
        explained = explained or mistakes(pose)
    if explained:
        verdict = replace(verdict, decision="reject", reasons=(*verdict.reasons, *explained))
    return Located(scene, merged, pose, verdict, tuple(notes))


def _first_ids(tags: Sequence[tuple[str, int]]) -> str:
    return ", ".join(str(tag) for _, tag in tags[:5]) + (", …" if len(tags) > 5 else "")


def _size_trouble(scene: SceneTags, camera: CameraModel) -> str | None:
    used = scene.exposures
    if not used:
        return "no readable image; 1 needed"
    sizes = {exposure.size: exposure.name for exposure in reversed(used)}
    if len(sizes) > 1:
        shown = ", ".join(f"{name} {size[0]}×{size[1]}" for size, name in sorted(sizes.items()))
        return f"exposures of different sizes ({shown} px); one size needed, as the camera file's"
    width, height = used[0].size
    if (camera.width or width, camera.height or height) != (width, height):
        return (
            f"images of {width}×{height} px, the camera file is of {camera.width}×{camera.height} px; "
            "give the camera that took them"
        )
    return None


def _scene_trouble(merged: Merged, options: LocateOptions) -> str | None:
    if merged.repeated:
        names = ", ".join(str(tag) for _, tag in merged.repeated)
        return f"tags seen twice: {names}; every id once in view needed; cover the copy"
    if not len(merged.seen):
        return "no tag of the layout; 1 needed"
    moved = [each for each in merged.shifts if each.shift_px > max(options.moved_px, MOVED_SIGMAS * each.sigma_px)]
    if not moved:
        return None
    shift = max(moved, key=lambda shift: shift.shift_px)
    further_pairs = f" (and between {len(moved) - 1} more pairs)" if len(moved) > 1 else ""
    return (
        f"the scene moved between {shift.exposures[0]} and {shift.exposures[1]}: {shift.tags} tags by "
        f"{shift.shift_px:.2f} px{further_pairs}; take the exposures with camera and target at rest"
    )


def _without_tag(located: Located) -> bool:
    return located.merged is not None and not sum(located.merged.counts)


def _explained(located: Located, layout: TargetLayout, image: np.ndarray) -> Located:
    """Returns the result of a scene without a tag with the reason: tags in its image may be of another dictionary."""
    if located.merged and located.merged.unknown:
        names = _first_ids(located.merged.unknown)
        reason = f"no tag of the layout, but others of its dictionaries ({names}); is it the layout of this target?"
    else:
        reason = f"no tag of {', '.join(layout.dictionaries())}; 1 of the layout needed"
        if shown := seen_otherwise(image, layout.rows(), "the layout file"):
            reason = f"{reason}, and {located.exposures[0].name} shows {shown}"
    return replace(located, verdict=Verdict("reject", (), (reason,)))
