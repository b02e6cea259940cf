"""Scenes of exposures: schedules of times, capture, and the pipeline from exposures to poses with verdicts."""

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

import stcal
from stcal.boards.board_designs import TagLayout
from stcal.boards.finders import shift_by_curves
from stcal.boards.tags import Tags, find_tags, seen_otherwise
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import Brief, require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel, CameraPrior
from stcal.io.cameras.read import camera_model
from stcal.io.device import DARK, SATURATED, Source, png
from stcal.io.files import json_text, real_place, save
from stcal.io.images import (
    SUFFIXES,
    TOP_GROUP,
    USUAL,
    ImageFile,
    decode,
    find_images,
    grey_8bit,
    grey_of,
    image_file,
    size_fault,
)
from stcal.io.json import Part, ResultFile, require_result_written
from stcal.locate.estimate import Merged, ObjPose, SeenTags, locate, merge
from stcal.locate.layout import TargetLayout
from stcal.locate.verdict import (
    PatentOptions,
    PatentPose,
    Verdict,
    VerdictOptions,
    judge,
    likely_mistake,
    locate_as_patent,
)


@dataclass(frozen=True, slots=True, repr=False)
class SceneFiles(Brief):
    """The exposures of one scene, not yet read.

    ``name`` : of the scene; ``files`` : of the exposures; ``skipped`` : files beside them that are none, with reasons.
    """

    name: str
    files: tuple[ImageFile, ...]
    skipped: tuple[str, ...] = ()

    def __post_init__(self):
        require_fields(self, "scene")


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One readable image: the ``tags`` that it shows, and its ``size`` (width and height, px)."""

    name: str
    tags: Tags
    size: tuple[int, int]


CAPTURED = "capture.json"
"""Name of the file that ``capture`` writes beside the images of a scene."""


@require_arguments
def exposure_times(shortest: float, longest: float, count: int) -> np.ndarray:
    """Returns ``count`` exposure times in a geometric series from ``shortest`` to ``longest``, in their unit.

    Raises InputError: times that are not positive or not in order, or a count that does not fit them.
    """
    if not (0 < shortest <= longest < np.inf) or count < 1 or (count == 1 and shortest < longest):
        fault = f"exposures: {count} from {shortest:g} to {longest:g}"
        remedy = "two or more, from a positive shortest time to a longest that is not shorter, needed"
        raise InputError("E-EXPOSURES-VALUE", f"{fault}; {remedy}")
    return np.geomspace(shortest, longest, count)


@require_arguments
def find_scenes(path: str | Path) -> list[SceneFiles]:
    """Finds the scenes of ``path``: one image, a folder of exposures, or a folder of such folders, each a scene.

    Raises InputError: the path does not exist, or holds no image.
    """
    path = Path(path)
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            fault = f"exposures {path}: not an image"
            raise InputError("E-IMAGE-UNREADABLE", f"{fault}; a folder or one of {', '.join(USUAL)} needed")
        return [SceneFiles(path.stem, (image_file(path),))]
    files, skipped = find_images(path)
    scenes = []
    for group in dict.fromkeys(file.group for file in files):
        skipped_in_group = [s for s in skipped if (Path(s.name).parent.name or TOP_GROUP) == group]
        left_out = tuple(f"{s.name}: {s.reason}" for s in skipped_in_group if Path(s.name).name != CAPTURED)
        name = real_place(path).name if group == TOP_GROUP else group
        scenes.append(SceneFiles(name, tuple(f for f in files if f.group == group), left_out))
    return scenes


def detect(image: np.ndarray, name: str, dictionaries: Sequence[str]) -> Exposure:
    """Finds the tags of a decoded image."""
    return Exposure(name, find_tags(image, dictionaries), (image.shape[1], image.shape[0]))


class CapturedRow(Part):
    image: str
    exposure: float
    exposure_set: float
    saturated_share: float
    dark_share: float


class CaptureFile(ResultFile):
    """Content of ``capture.json`` of a scene: the settings asked for, and those really set."""

    format: Literal["stcal capture 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    camera: str = Field(description="what took the images")
    gain: float | None = Field(description="asked for; null: as it was")
    settle_s: float = Field(description="waited after each change of exposure, s")
    exposures: list[CapturedRow] = Field(
        description="`image`, `exposure` asked for and `exposure_set` by the driver, in its unit; `saturated_share` "
        "and `dark_share` of the pixels"
    )


def scene_folder(out: Path, scene: str) -> Path:
    """Returns a scene's new folder; raises InputError: the name is invalid, or the scene exists."""
    if not re.fullmatch(r"[\w][\w .-]{0,99}", scene):
        raise InputError(
            "E-DEVICE-NAME", f"scene {scene!r}: letters, digits, spaces, '.', '-' and '_' needed, up to 100"
        )
    folder = out / scene
    if folder.exists():
        raise InputError("E-OUTPUT-EXISTS", f"{folder}: exists; give another --scene")
    return folder


@require_arguments
def capture(
    source: Source,
    exposures: Sequence[float],
    folder: str | Path,
    gain: float | None = None,
    settle_s: float = 0.3,
    taken: Callable[[CapturedRow], None] | None = None,
) -> CaptureFile:
    """Takes an exposure series and writes ``<folder>/<exposure>.png`` and ``capture.json`` with the settings used.

    Parameters
    ----------
    source : the camera; or anything else with a ``name`` and their methods.
    exposures : exposures in the unit of the camera's driver, as of :func:`stcal.locate.exposure_times`.
    folder : new folder of the scene. It is written only after all images are taken.
    gain : gain that ``source`` was told, for ``capture.json``.
    settle_s : time that the camera is given after each change of exposure, s.
    taken : called with the row of each image.

    Returns
    -------
    CaptureFile : the exposures asked for and those set, and shares of saturated and dark pixels.

    Raises InputError: the camera refuses an exposure or gives no image, an exposure comes twice, or the folder exists.
    """
    folder = Path(folder)
    if not 0 <= settle_s <= 60:
        raise InputError("E-OPTION-RANGE", f"--settle-s {settle_s:g}: 0 to 60 s needed")
    if folder.exists():
        raise InputError("E-OUTPUT-EXISTS", f"{folder}: exists; give another --scene")
    rows, images = [], []
    for exposure in exposures:
        image, exposure_set = source.expose(float(exposure), settle_s)
        row = CapturedRow(
            image=f"{exposure:.6g}.png",
            exposure=float(exposure),
            exposure_set=exposure_set,
            saturated_share=float((image >= SATURATED).mean()),
            dark_share=float((image <= DARK).mean()),
        )
        if any(each.image == row.image for each in rows):
            fault = f"exposure {exposure:.6g} comes twice"
            raise InputError("E-EXPOSURES-VALUE", f"{fault}; take fewer --count, or a wider range")
        rows.append(row)
        images.append(image)
        if taken:
            taken(row)
    own = {"format": "stcal capture 1", "version": stcal.__version__, "camera": source.name}
    content = CaptureFile.model_validate({**own, "gain": gain, "settle_s": settle_s, "exposures": rows})
    folder.mkdir(parents=True)
    for row, image in zip(rows, images, strict=True):
        save(folder / row.image, png(image))
    save(folder / CAPTURED, json_text(content.content()))
    require_result_written(folder / CAPTURED, content)
    return content


Method = Literal["joint", "patent"]
MOVED_SIGMAS = 5.0
"""Shift between exposures, in σ, beyond which a scene has moved. Chance exceeds it once in 10⁵ (Rayleigh)."""


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """Options of how to locate a target.

    Parameters
    ----------
    method : {"joint", "patent"}; one pose from all exposures together, or the method of the patent.
    verdict : limits of the joint method.
    patent : limits of the patent's method.
    moved_px : A scene has moved if its tags shift by more than this between exposures, and by more than
        :data:`MOVED_SIGMAS`.
    workers : number of threads that search for tags; as many as cores if None.
    """

    method: Method = "joint"
    verdict: VerdictOptions = field(default_factory=VerdictOptions)
    patent: PatentOptions = field(default_factory=PatentOptions)
    moved_px: float = 0.5
    workers: int | None = None

    def __post_init__(self):
        require_fields(self, "locate", workers=1)
        if not self.moved_px > 0:
            raise InputError("E-OPTION-RANGE", f"moved_px {self.moved_px:g}: a positive number needed")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Located(Brief):
    """Result of one scene.

    ``name`` : of the scene; ``exposures`` : its readable ones; ``merged`` : their corners, None if the exposures do not
    belong together; ``pose`` : by the joint method, None if it failed or another was asked for; ``verdict`` : whether
    the pose may be used; ``notes`` : what was left out, and others; ``patent`` : result of the patent's method, if
    asked for.
    """

    name: str
    exposures: tuple[Exposure, ...]
    merged: Merged | None
    pose: ObjPose | None
    verdict: Verdict
    notes: tuple[str, ...] = ()
    patent: PatentPose | None = None

    @property
    def camera_from_obj(self) -> Rigid | None:
        """Pose of the target by the method that was asked for, mm; None if there is none."""
        found = self.patent or self.pose
        return None if found is None else found.camera_from_obj


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
    scenes : scenes from :func:`~stcal.locate.find_scenes`.
    layout : the target.
    camera : the camera that took the exposures.
    options : options of the method; the defaults if None.

    Yields
    ------
    Located : one result per scene, in their order. Trouble with one scene rejects that scene, with the reason, and
        never ends the run.
    """
    options, model = options or LocateOptions(), camera_model(camera)
    layout = TargetLayout.of(layout) if isinstance(layout, TagLayout) else layout
    dictionaries = layout.dictionaries()
    with ThreadPoolExecutor(options.workers) as pool:  # threads search earlier images for tags meanwhile
        for scene in scenes:
            by_name, pending, notes = {file.name: file for file in scene.files}, [], []
            for file in scene.files:
                # Decoding stays in this thread, because it captures what the decoders write to standard error.
                try:
                    image = grey_8bit(decode(file.read(), file.name))
                except (InputError, OSError) as error:
                    notes.append(f"left out: {' '.join(str(error).split())}")
                else:
                    pending.append(pool.submit(detect, image, file.name, dictionaries))

            def image_of(name: str, by_name=by_name) -> np.ndarray:
                return decode(by_name[name].read(), name)

            exposures = tuple(each.result() for each in pending)
            yield locate_scene(scene.name, exposures, layout, model, options, image_of, notes)


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
    image : (height, width) or (height, width, 3) grey or RGB, 8 or 16 bit.
    layout : the target.
    camera : the camera that took the image.
    options : options of the method; the defaults if None.
    name : name of the image, for messages.

    Returns
    -------
    Located : its ``pose`` is None if there is none; the verdict says why.

    Raises InputError: the image is no grey or RGB array, or its size is not the camera's.
    """
    grey = grey_of(image, name)
    target = TargetLayout.of(layout) if isinstance(layout, TagLayout) else layout
    model = camera_model(camera)
    size = grey.shape[1], grey.shape[0]
    wanted = model.width or size[0], model.height or size[1]
    if size != wanted:
        raise InputError("E-IMAGE-SIZE", f"{name}: {size_fault(name, size, wanted, 'the camera').reason}")
    exposure = detect(grey_8bit(grey), name, target.dictionaries())
    return locate_scene(name, (exposure,), target, model, options or LocateOptions(), lambda _: grey)


def locate_scene(
    name: str,
    used: tuple[Exposure, ...],
    layout: TargetLayout,
    camera: CameraModel,
    options: LocateOptions,
    image_of: Callable[[str], np.ndarray],
    trouble: Sequence[str] = (),
) -> Located:
    """Locates the target in one scene by its exposures and judges the pose; ``trouble`` : notes so far. In an image
    without its tags, others are looked for."""
    notes, merged = [*trouble], None

    def rejected(*reasons: str) -> Located:
        return Located(name, used, merged, None, Verdict("reject", (), reasons), tuple(notes))

    if not used:
        return rejected("no readable image; 1 needed")
    sizes = {exposure.size: exposure.name for exposure in reversed(used)}
    if len(sizes) > 1:
        shown = ", ".join(f"{name} {size[0]}×{size[1]}" for size, name in sorted(sizes.items()))
        return rejected(f"exposures of different sizes ({shown} px); one size needed, as the camera file's")
    width, height = used[0].size
    if (camera.width or width, camera.height or height) != (width, height):
        fault = f"images of {width}×{height} px, the camera file is of {camera.width}×{camera.height} px"
        return rejected(f"{fault}; give the camera that took them")
    merged = merge([exposure.tags for exposure in used], layout, [exposure.name for exposure in used])
    unknown = ", ".join(str(tag) for _, tag in merged.unknown[:5]) + (", …" if len(merged.unknown) > 5 else "")
    if unknown:
        notes.append(f"tags in view that the layout does not have: {unknown}")
    notes += [
        f"{each.name}: motion during the exposure blurs edges by {each.tags.smear_px:.1f} px, which σ contain; "
        "camera and target at rest, or a shorter exposure"
        for each in used
        if each.tags.smear_px
    ]
    if not len(merged.seen):
        if unknown:
            others = f"no tag of the layout, but others of its dictionaries ({unknown})"
            return rejected(f"{others}; is it the layout of this target?")
        shown = seen_otherwise(image_of(used[0].name), layout.rows(), "the layout file")
        more = f", and {used[0].name} shows {shown}" if shown else ""
        return rejected(f"no tag of {', '.join(layout.dictionaries())}; 1 of the layout needed{more}")
    if merged.repeated:
        names = ", ".join(str(tag) for _, tag in merged.repeated)
        return rejected(f"tags seen twice: {names}; every id once in view needed; cover the copy")
    moved = [each for each in merged.shifts if each.shift_px > max(options.moved_px, MOVED_SIGMAS * each.sigma_px)]
    if moved:
        shift = max(moved, key=lambda shift: shift.shift_px)
        further_pairs = f" (and between {len(moved) - 1} more pairs)" if len(moved) > 1 else ""
        by = f"{shift.tags} tags by {shift.shift_px:.2f} px{further_pairs}"
        fault = f"the scene moved between {shift.exposures[0]} and {shift.exposures[1]}: {by}"
        return rejected(f"{fault}; take the exposures with camera and target at rest")
    prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)

    def mistakes(seen: SeenTags, pose: ObjPose | None) -> list[str]:
        try:
            mistake = likely_mistake(seen, layout, camera.sized(width, height), prior, pose)
        except StcalError:  # it is the camera's fault
            return []
        return [f"all tags would fit if {mistake}; correct the layout file"] if mistake else []

    try:
        sized, corners = camera.sized(width, height), merged.seen.corners_px
        straight = corners - shift_by_curves(corners, sized)
        merged = replace(merged, seen=replace(merged.seen, corners_px=straight))
        if options.method == "patent":
            found = locate_as_patent([e.tags for e in used], layout, sized, options.patent, name)
            return Located(name, used, merged, None, found.verdict, tuple(notes), found)
        pose = locate(merged.seen, layout, sized, prior, name)
    except StcalError as error:
        return rejected(str(error).removeprefix(f"{name}: "), *mistakes(merged.seen, None))
    if pose.outliers:
        ids = ", ".join(str(layout.tags[row][1]) for row in pose.outliers)
        notes.append(f"tags that contradict the others, left out: {ids}")
    pose, verdict = judge(pose, options.verdict)
    doubtful = pose.outliers or verdict.decision == "reject"
    if doubtful and (explained := mistakes(merged.seen, pose)):
        verdict = replace(verdict, decision="reject", reasons=(*verdict.reasons, *explained))
    return Located(name, used, merged, pose, verdict, tuple(notes))
