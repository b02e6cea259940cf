"""Reports of located tags and of a layout's calibration: page, tables, and the files that ``--json`` writes."""

import base64
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stcal.boards.board_designs import mean_sides
from stcal.geometry.arrays import require_arguments
from stcal.geometry.print_modes import stretch_in_words
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.images import ImageFile, decode, grey_8bit, thumbnail
from stcal.io.json import Finite, Named, Part, Pose, ResultFile, Rows, Shape
from stcal.io.table import COVARIANCE, POSE, csv_text, pose_cells
from stcal.locate.base_chain import GoalChain, Goals, accepted, uncertain
from stcal.locate.estimate import Merged, ObjPose
from stcal.locate.layout import TargetLayout
from stcal.locate.layout_calibration import AdjustedLayout, CalibratedLayout
from stcal.locate.scenes import Exposure, Located, SceneFiles
from stcal.locate.verdict import ASSUMED, PatentPose, Verdict
from stcal.report.document import Answer, Block, Document, Html, Notes, Section, Table, columns, macro, verdict_word
from stcal.report.svg import AXIS_COLOURS, COLOURS
from stcal.report.text import NONE, number

BASE = "base_from_goal_"


@require_arguments
def poses_csv(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Returns the CSV of the accepted poses only, so that no robot moves to a rejected one; the others are comments.

    ``results`` : of :func:`~stcal.locate.run`; ``chain`` : of :func:`~stcal.locate.goal_chain`, for further columns
    ``base_from_goal_…``. The poses are camera_from_obj, mm, with covariance (form: ``data_layout.md``).
    """
    refused = ""
    for scene in results:
        if scene.verdict.decision != "accept":
            refused += f"# {scene.name}: {scene.verdict.decision}: {'; '.join(scene.verdict.reasons)}\n"
    full = all(scene.pose is not None for scene in accepted(results))
    columns = [*POSE, *(COVARIANCE if full else ())]
    base = [BASE + column for column in columns] if chain else []
    rows: list[Sequence] = [["scene", "tags", "exposures", *columns, "rms_px", "chi2_per_dof", *base]]
    for scene in accepted(results):
        pose, fit = uncertain(scene), ["", ""]
        if scene.pose is not None:
            fit = [f"{scene.pose.rms_px():.4f}", f"{scene.pose.chi2_per_redundancy():.4f}"]
        tags = len(scene.merged.seen) if scene.merged else 0
        cells = pose_cells(pose.rigid, pose.covariance if full else None)
        row = [scene.name, tags, len(scene.exposures), *cells, *fit]
        if chain:
            goal = chain.base_from_goal(scene.name, pose)
            row += pose_cells(goal.rigid, goal.covariance if full else None)
        rows.append(row)
    return refused + csv_text(rows)


WIDE_PX, SMALL_PX = 900, 215


def run_report(
    results: Sequence[Located],
    scenes: Sequence[SceneFiles],
    layout: TargetLayout,
    model: CameraModel,
    goals: Goals | None = None,
) -> Document:
    """Returns the report of ``locate run``: all scenes in a table, goals in the robot's base, then scene by scene."""
    heads = ["<scene", "<verdict", "tags", "exposures", "x mm", "y mm", "z mm", "σ mm", "σ °", "RMS px", "<why"]
    goal_heads = ["<base_from_goal", "x mm", "y mm", "z mm", "rotation vector x °", "y °", "z °"]
    goal_rows = [
        [name, *(number(v, 2) for v in pose.translation), *(number(v, 3) for v in np.degrees(pose.log()[:3]))]
        for name, pose in (goals.base_from_goal if goals else {}).items()
    ]
    rows = []
    for each in results:
        pose, fit = each.camera_from_obj, each.pose
        place = [None] * 3 if pose is None else pose.translation
        sigma = [None] * 3 if fit is None else [fit.sigma_mm(), np.degrees(fit.sigma_rad()), fit.rms_px()]
        tags = len(each.merged.seen) if each.merged else 0
        figures = [*(number(v, 2) for v in place), *(number(v, 3) for v in sigma)]
        why = "; ".join((*each.verdict.reasons, *each.notes))
        rows.append([each.name, verdict_word(each.verdict.decision), tags, len(each.exposures), *figures, why])
    scenes_and_goals = [Table(heads, rows, css="text"), Table(goal_heads, goal_rows)]
    good = len(accepted(results))
    count = f"{len(results)} scene{'s' * (len(results) != 1)}, {good} accepted"
    return Document(
        f"Tags located: {layout.name}",
        f"target {layout.name}, {len(layout.tags)} tags: {count}",
        [
            Section("Scenes", scenes_and_goals, terminal=True),
            *(
                Section(each.name, _scene(each, files, layout, model), terminal=each.patent is not None)
                for each, files in zip(results, scenes, strict=True)
            ),
        ],
        [Answer("yes" if good == len(results) else "part" if good else "no", count)],
    )


def _scene(located: Located, files: SceneFiles, layout: TargetLayout, model: CameraModel) -> list[Block]:
    """Returns verdict, checks and pictures of a scene."""
    by_name = {file.name: file for file in files.files}
    checks = [
        [
            check.name,
            f"{check.value:.4g}{check.unit}" if np.isfinite(check.value) else "no other pose",
            f"≥ {check.at_least:.4g}" if check.at_least is not None else f"≤ {check.at_most:.4g}",
            "yes" if check.passed else verdict_word("no"),
        ]
        for check in located.verdict.checks
    ]

    def photo(exposure: Exposure, width_px: int) -> Html:
        return macro("tag_photo", lambda: _picture(exposure, by_name[exposure.name], located, layout, model, width_px))

    rows, shown = layout.rows(), located.exposures
    best = max(shown, key=lambda each: sum(tag in rows for tag in each.tags.tags), default=None)
    return [
        " – ".join((located.verdict.decision, *located.verdict.reasons)),
        Notes(located.notes),
        Table(["<check", "value", "limit", "<kept"], checks),
        *(_patent_blocks(located, located.patent) if located.patent else ()),
        photo(best, WIDE_PX) if best else None,
        columns(*([photo(exposure, SMALL_PX)] for exposure in shown if exposure is not best), css="columns thumbs"),
    ]


def _patent_blocks(located: Located, patent: PatentPose) -> list[Block]:
    """Returns a table with a row per exposure: its result by the rules of the patent."""
    rows = []
    for exposure, result in zip(located.exposures, patent.exposures, strict=True):
        kept = "kept" if result.exposure == patent.exposure else "candidate" if result.candidate else "left out"
        errors = [number(error, 3) for error in result.errors_px or (None, None)]
        det_j = NONE if result.det_j is None else f"{result.det_j:.3g}"
        rows.append([exposure.name, kept, result.tags, number(result.area_px2, 0), *errors, det_j])
    return [
        "both poses are one, no ratio" if patent.same else "",
        Table(["<exposure", "<", "tags", "area px²", "error px", "of the other", "det J 1/mm²"], rows),
        f"patent: {ASSUMED}",
    ]


def _picture(
    exposure: Exposure, file: ImageFile, located: Located, layout: TargetLayout, model: CameraModel, width_px: int
) -> dict:
    """Returns the image with the outlines and names of its tags, and the axes of {obj}."""
    grey = grey_8bit(decode(file.read(), file.name))
    width, height = exposure.size
    rows, pose, tags = layout.rows(), located.camera_from_obj, []
    for tag, corners in zip(exposure.tags.tags, exposure.tags.corners_px, strict=True):
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners)
        tags.append((points, COLOURS[2] if tag in rows else COLOURS[1], str(tag[1]), *corners.mean(0)))
    count, axes = sum(tag in rows for tag in exposure.tags.tags), []
    if pose is not None:  # a third of the target long; none if behind the camera
        length = float(np.ptp(layout.corners_mm.reshape(-1, 2), axis=0).max()) / 3
        ends = pose @ (length * np.vstack([np.zeros(3), np.eye(3)]))
        if (ends[:, 2] > 0).all():
            start, *tips = model.sized(width, height).project(ends)
            axes = [(start, tip, colour, name) for tip, colour, name in zip(tips, AXIS_COLOURS, "XYZ", strict=True)]
    return {
        "shown_px": width_px,
        "width": width,
        "height": height,
        "line": 2.0 * width / width_px,
        "caption": f"{exposure.name}: {count} of {len(layout.tags)} tags",
        "jpeg": "data:image/jpeg;base64," + base64.b64encode(thumbnail(grey, width_px)[0].tobytes()).decode(),
        "tags": tags,
        "axes": axes,
    }


Corners = Annotated[np.ndarray, Shape((None, 4, 2))]
OF_FIT = Named("covariance second delta_chi2 rms_px chi2 redundancy p_value rows outliers residuals_px weights")
OF_PATENT = Named("exposure second errors_px det_j same exposures")
OF_ADJUSTED = Named("poses image_rms_px board_rms_px tag_rms_px stretch shear sigma_px tag_sigma_px")


class ExposureRow(Part):
    name: str
    tags: Annotated[int, BeforeValidator(lambda tags: tags if isinstance(tags, int) else len(tags))]


class SceneRow(Part):
    name: str = Field(description="of the scene")
    verdict: Annotated[Verdict, Named("decision reasons checks")] = Field(
        description="`decision`, `reasons`, and `checks`: `name`, `value` (null: no other pose), `at_least`, "
        "`at_most`, `unit`, `passed`"
    )
    notes: list[str] = Field(description="what was left out, and other notes")
    exposures: list[ExposureRow] = Field(description="`name` of each readable image, number of `tags` in it")
    merged: Annotated[Merged, Named("rows share shifts")] | None = Field(
        description="of all exposures: `rows` of the tags seen, `share` of the "
        "corners' stated variance that differs between exposures, `shifts`: between two `exposures`, `tags` in common, "
        "median `shift_px` of their middles, and `sigma_px`"
    )
    camera_from_obj: Pose | None = Field(description="pose, also of rejected and ambiguous scenes")
    pose: Annotated[ObjPose, OF_FIT] | None = Field(
        description="not with `--method patent`: `covariance`; `second`, the other pose that fits, or null; "
        "`delta_chi2`, `rms_px`, `chi2`, `redundancy`, `p_value` as in [measure](measure.md#out-what-measure-writes); "
        "`rows` of the tags used, `outliers` among the others, `residuals_px` and `weights` of four corners of each"
    )
    patent: Annotated[PatentPose, OF_PATENT] | None = Field(
        description="only with `--method patent`: `exposure` that is kept, `second` pose, `errors_px` of both, `det_j` "
        "(1/mm²), `same`: both poses are one; `exposures`: `tags` used, `area_px2` of their triangles (null where "
        "others show more tags), `candidate`, and of candidates `poses`, `errors_px`, `det_j`"
    )


class LocatedFile(ResultFile):
    """Result file of ``locate run``, with rejected and ambiguous poses too; rows are those of ``tags``, from 0."""

    format: Literal["stcal located 1"] = Field(description="the file's form and its version")
    unit: Literal["mm"] = Field(description="of all lengths")
    layout: str = Field(description="the layout's name")
    tags: list[tuple[str, int]] = Field(description="dictionary and id of the layout's tags")
    scenes: list[SceneRow] = Field(description="one object each")
    goals: Annotated[Goals, Named("base_from_goal covariance")] | None = Field(
        description="with `--hand-eye` or `--registration`: `base_from_goal` and its `covariance` of accepted scenes"
    )

    @classmethod
    def of(cls, results: Sequence[Located], layout: TargetLayout, goals: Goals | None = None) -> "LocatedFile":
        """Returns the file of all scenes."""
        own = {"format": "stcal located 1", "unit": "mm", "layout": layout.name, "tags": layout.tags}
        return cls.model_validate({**own, "scenes": list(results), "goals": goals})


class CalibratedLayoutFile(ResultFile):
    """Result file of ``locate calibrate``, without the covariance, which the layout file holds."""

    format: Literal["stcal layout calibration 1"] = Field(description="the file's form and its version")
    unit: Literal["mm"] = Field(description="of all lengths")
    images: list[str] = Field(description="that were used")
    left_out: list[str] = Field(description="images without board or tags, and why")
    board_from_obj: Pose = Field(description="where {obj} lies on the board")
    adjusted: Annotated[AdjustedLayout, OF_ADJUSTED] = Field(
        description="`poses` camera_from_board of the images; RMS residuals per coordinate of the tags in each, "
        "`image_rms_px`, of the board's points, `board_rms_px`, and of all tags, `tag_rms_px`; how much longer the "
        "board is along its rows than across, `stretch`, and its `shear`, relative; `sigma_px` and `tag_sigma_px` as "
        "in the layout file"
    )
    layout: Annotated[TargetLayout, Named("tags")] = Field(
        description="`tags`: dictionary and id; `--out` has the corners"
    )
    counts: Rows = Field(description="number of images that show each tag")
    published: Corners = Field(description="corners before the adjustment")
    deviation_mm: Annotated[list[Finite], BeforeValidator(list)] = Field(
        description="largest distance of a tag's corner from its nominal place, the nominal target laid over the "
        "calibrated one; null without one"
    )


def calibrated_text(result: CalibratedLayout) -> str:
    """Returns the report as text: totals, and a line for each tag."""
    layout, adjusted = result.layout, result.adjusted
    moved = np.linalg.norm(layout.corners_mm - result.published, axis=2).max(1)
    sigma = np.sqrt((layout.sigma_mm() ** 2).sum(2).mean(1))
    side = mean_sides(layout.corners_mm)
    rows = []
    for row, (dictionary, tag) in enumerate(layout.tags):
        um = number(1000 * sigma[row], 1), number(1000 * moved[row], 1)
        name = dictionary + (", origin" if row == layout.origin else "")
        rows.append(
            [str(tag), name, result.counts[row], number(side[row], 3), *um, number(result.deviation_mm[row], 3)]
        )
    heads = ["id", "<dictionary", "images", "side_mm", "sigma_um", "adjusted by_um", "from nominal_mm"]
    residuals = f"{adjusted.board_rms_px:.3f} px of the board, {adjusted.tag_rms_px:.3f} px of the tags"
    about = f"{len(result.images)} images, {len(layout.tags)} tags; residuals {residuals}"
    blocks = [
        f"beside the corners' own σ: {adjusted.sigma_px:.3f} px each, {adjusted.tag_sigma_px:.3f} px a tag as a whole",
        *stretch_in_words("the board", adjusted.stretch, adjusted.shear),
        Table(heads, rows),
    ]
    return Document("Layout calibrated", about, [], blocks).text()


def warnings(result: CalibratedLayout, names: tuple[tuple[str, int], ...]) -> list[str]:
    """Returns warnings that the result may be worse than its σ; ``names`` : tags of the plan."""
    messages = []
    if result.unseen:
        tags = ", ".join(str(names[row][1]) for row in result.unseen)
        messages.append(f"tags that no image shows, left out of the layout: {tags}")
    few = [tag[1] for tag, count in zip(result.layout.tags, result.counts, strict=True) if count < 3]
    if few:
        messages.append(f"tags in fewer than 3 images, so that a misread one would not be noticed: {few}")
    if result.adjusted.downweighted > 0.1:
        messages.append(
            f"{result.adjusted.downweighted:.0%} of the tags seen are outliers; are target and board in one plane?"
        )
    if not result.adjusted.settled:
        messages.append("the σ of board and tags still change at the end of the adjustment; add images")
    return messages
