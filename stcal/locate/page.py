"""Reports of located tags and of a layout's calibration: page, table, text, and the files that ``--json`` writes."""

import base64
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StringConstraints

from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.print_modes import stretch_in_words
from stcal.io.cameras.model import CameraModel
from stcal.io.images import ImageFile, decode, grey_8bit, thumbnail
from stcal.io.json import Finite, Matrix, Matrix6, Pair, Part, Pose, ResultFile
from stcal.io.table import COVARIANCE, POSE, csv_text, pose_cells
from stcal.locate.calibration import CalibratedLayout
from stcal.locate.chain import GoalChain, accepted, camera_from_obj, uncertain
from stcal.locate.estimate import ObjPose, Shift
from stcal.locate.exposures import Exposure, SceneFiles, Unreadable
from stcal.locate.layout import TargetLayout
from stcal.locate.patent import ASSUMED, PatentPose
from stcal.locate.pipeline import Located
from stcal.report.document import Block, Document, Html, Notes, Section, Table, Verdict, columns, macro, page_only
from stcal.report.svg import AXIS_COLOURS, COLOURS
from stcal.report.text import NONE, number

BASE = "base_from_goal_"


def _patent_blocks(located: Located) -> list[Block]:
    """Returns a table with a row per exposure: its result by the rules of the patent."""
    rows: list[list[str]] = []
    if located.patent is None:
        return []
    for name, result in zip((e.name for e in located.tags.readable()), located.patent.exposures, strict=True):
        state = (
            "kept" if result.exposure == located.patent.exposure else "candidate" if result.candidate else "left out"
        )
        errors = result.errors_px or (None, None)
        det_j = NONE if result.det_j is None else f"{result.det_j:.3g}"
        rows.append([name, state, str(result.tags), number(result.area_px2, 0), *(number(e, 3) for e in errors), det_j])
    return [
        "both poses are one, no ratio" if located.patent.same else "",
        page_only(
            "By the published rules: exposures with most tags; among these, the ones with more than S_dis of the "
            "largest area; among these, the pose with the smallest error"
        ),
        Table(["<exposure", "<", "tags", "area px²", "error px", "of the other", "det J 1/mm²"], rows),
        f"patent: {ASSUMED}",
    ]


@require_arguments
def poses_csv(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Returns a table of the accepted poses only, so that no robot moves to a rejected one; the others are comments.

    Parameters
    ----------
    results : sequence of Located
        Results of :func:`~stcal.locate.run`.
    chain : GoalChain, optional
        Transforms to the robot's base, of :func:`~stcal.locate.goal_chain`, for further columns ``base_from_goal_…``.

    Returns
    -------
    str
        CSV with camera_from_obj, mm, and its covariance (form: ``data_layout.md``).
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
        pose = uncertain(scene)
        cells = pose_cells(pose.rigid, pose.covariance if full else None)
        fit = (
            ["", ""]
            if scene.pose is None
            else [f"{scene.pose.rms_px():.4f}", f"{scene.pose.chi2_per_redundancy():.4f}"]
        )
        row = [scene.name, len(scene.merged.seen) if scene.merged else 0, len(scene.tags.readable()), *cells, *fit]
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
    chain: GoalChain | None = None,
) -> Document:
    """Returns the report of ``locate run``: all scenes in a table, goals in the robot's base, then scene by scene."""
    heads = ["<scene", "<verdict", "tags", "exposures", "x mm", "y mm", "z mm", "σ mm", "σ °", "RMS px", "<why"]
    goal_heads = ["<base_from_goal", "x mm", "y mm", "z mm", "rotation vector x °", "y °", "z °"]
    blocks: list[Block] = [Table(heads, _overview(results), css="text")]
    if chain and accepted(results):
        blocks += [page_only("Where the robot has to go"), Table(goal_heads, _in_base(results, chain))]
    count = f"{len(results)} scene{'s' * (len(results) != 1)}, {len(accepted(results))} accepted"
    return Document(
        f"Tags located: {layout.name}",
        f"target {layout.name}, {len(layout.tags)} tags: {count}",
        [
            Section("Scenes", blocks, terminal=True),
            *(
                Section(each.name, _scene(each, files, layout, model), terminal=each.patent is not None)
                for each, files in zip(results, scenes, strict=True)
            ),
        ],
    )


def _overview(results: Sequence[Located]) -> list[list]:
    rows = []
    for located in results:
        pose, fit = camera_from_obj(located), located.pose
        place = [None] * 3 if pose is None else pose.translation
        sigma = [None] * 3 if fit is None else [fit.sigma_mm(), np.degrees(fit.sigma_rad()), fit.rms_px()]
        rows.append(
            [
                located.name,
                Verdict(located.verdict.decision),
                len(located.merged.seen) if located.merged else 0,
                len(located.tags.readable()),
                *(number(v, 2) for v in place),
                *(number(v, 3) for v in sigma),
                "; ".join((*located.verdict.reasons, *located.notes)),
            ]
        )
    return rows


def _in_base(results: Sequence[Located], chain: GoalChain) -> list[list[str]]:
    """Returns rows of base_from_goal of the accepted scenes."""
    rows = []
    for located in accepted(results):
        goal = chain.base_from_goal(located.name, uncertain(located)).rigid
        place, turn = goal.translation, np.degrees(goal.log()[:3])
        rows.append([located.name, *(number(v, 2) for v in place), *(number(v, 3) for v in turn)])
    return rows


def _scene(located: Located, files: SceneFiles, layout: TargetLayout, model: CameraModel) -> list[Block]:
    """Returns verdict, checks and pictures of a scene."""
    by_name = {file.name: file for file in files.files}
    shown = located.tags.readable()
    best = best_exposure(shown, layout)
    checks = [
        [
            check.name,
            f"{check.value:.4g}{check.unit}" if np.isfinite(check.value) else "no other pose",
            f"≥ {check.at_least:.4g}" if check.at_least is not None else f"≤ {check.at_most:.4g}",
            "yes" if check.passed else Verdict("no"),
        ]
        for check in located.verdict.checks
    ]
    several = shown if len(shown) > 1 else []

    def photo(exposure: Exposure, of: Located | None, width_px: int) -> Html:
        return macro("tag_photo", lambda: _picture(exposure, by_name[exposure.name], of, layout, model, width_px))

    return [
        " – ".join((located.verdict.decision, *located.verdict.reasons)),
        Notes(located.notes),
        Table(["<check", "value", "limit", "<kept"], checks),
        *_patent_blocks(located),
        photo(best, located, WIDE_PX) if best else None,
        columns(*([photo(exposure, None, SMALL_PX)] for exposure in several), css="columns thumbs"),
    ]


def best_exposure(exposures: Sequence[Exposure], layout: TargetLayout) -> Exposure | None:
    """Returns the exposure with most of the layout's tags, of these the one with least σ of corners and edges, or
    None."""
    rows = layout.rows()

    def rank(exposure: Exposure) -> tuple[int, float]:
        in_layout = [tag in rows for tag in exposure.tags.tags]
        corners = np.trace(exposure.tags.covariance_px2, axis1=2, axis2=3)
        variance = (corners + exposure.tags.edge_sigma_px()[:, None] ** 2)[in_layout]
        return sum(in_layout), -float(np.median(variance)) if any(in_layout) else 0.0

    return max(exposures, key=rank, default=None)


def _picture(
    exposure: Exposure,
    file: ImageFile,
    located: Located | None,
    layout: TargetLayout,
    model: CameraModel,
    width_px: int,
) -> dict:
    """Returns the image with the outlines of its tags; with axes of {obj} and names of tags if ``located`` is given."""
    grey = grey_8bit(decode(file.read(), file.name))
    width, height = exposure.size
    rows = layout.rows()
    tags = []
    for tag, corners in zip(exposure.tags.tags, exposure.tags.corners_px, strict=True):
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners)
        name = "" if located is None else str(tag[1])
        tags.append((points, COLOURS[2] if tag in rows else COLOURS[1], name, *corners.mean(0)))
    pose = None if located is None else camera_from_obj(located)
    count = sum(tag in rows for tag in exposure.tags.tags)
    return {
        "shown_px": width_px,
        "width": width,
        "height": height,
        "line": 2.0 * width / width_px,
        "caption": f"{exposure.name}: {count} of {len(layout.tags)} tags",
        "jpeg": "data:image/jpeg;base64," + base64.b64encode(thumbnail(grey, width_px)[0].tobytes()).decode(),
        "tags": tags,
        "axes": [] if pose is None else _axes(pose, layout, model.sized(width, height)),
    }


def _axes(pose, layout: TargetLayout, camera: Camera) -> list[tuple]:
    """Returns (start, tip, colour, name) of X, Y, Z of {obj}, a third of the target long; none if behind the camera."""
    length = float(np.ptp(layout.corners_mm.reshape(-1, 2), axis=0).max()) / 3
    ends = pose @ (length * np.vstack([np.zeros(3), np.eye(3)]))
    if (ends[:, 2] <= 0).any():
        return []
    start, *tips = camera.project(ends)
    return [(start, tip, colour, name) for tip, colour, name in zip(tips, AXIS_COLOURS, "XYZ", strict=True)]


class LimitRow(Part):
    name: str
    value: Finite
    at_least: float | None
    at_most: float | None
    unit: Annotated[str, StringConstraints(strip_whitespace=True)]
    passed: bool


class ExposureRow(Part):
    image: str
    tags: int | None
    trouble: str | None


class ShiftRow(Part):
    between: tuple[str, str]
    tags: int
    shift_px: float


class CornerRow(Part):
    corner: str
    residual_px: Pair
    weight: float


class PatentExposureRow(Part):
    image: str
    tags: int
    area_px2: float | None
    candidate: bool
    kept: bool
    errors_px: list[Finite] | None
    det_j: float | None
    camera_from_obj: Pose | None
    twin: Pose | None


class PatentRow(Part):
    exposures: list[PatentExposureRow]
    same_pose: bool
    assumed: str


class SceneRow(Part):
    scene: str
    verdict: str
    reasons: list[str]
    notes: list[str]
    checks: list[LimitRow] = Field(
        description="`name`, `value`, `at_least`, `at_most`, `unit`, `passed`; value null: no other pose"
    )
    exposures: list[ExposureRow] = Field(description="`image`, `tags`, `trouble`")
    tags: list[int] = Field(description="seen")
    differing_share: float | None = Field(
        description="of the corners' stated variance, how much differs between exposures"
    )
    shifts: list[ShiftRow] = Field(
        description="`between` two exposures, `tags` in common, `shift_px` the median shift of their middles"
    )
    camera_from_obj: Pose | None = Field(description="pose, also of rejected and ambiguous scenes")
    covariance: Matrix6 | None = Field(None, description="its covariance; not with `--method patent`")
    twin: Pose | None = Field(None, description="the other pose that fits, null where there is none")
    errors_px: list[Finite] | None = Field(None, description="only with `--method patent`: of the two poses")
    patent: PatentRow | None = Field(
        None,
        description="only with `--method patent`: `exposures`: `image`, `tags` used, `area_px2` of their triangles "
        "(null where others show more tags), `candidate`, `kept`, and of candidates `errors_px` of both poses, `det_j` "
        "(1/mm²), `camera_from_obj` and `twin`; `same_pose`: both poses are one; what was `assumed`",
    )
    delta_chi2: Finite = Field(
        None, description="this and all below as in [measure](measure.md#out-what-measure-writes)"
    )
    rms_px: float | None = Field(None, description="of the residuals, per coordinate")
    chi2: float | None = Field(None, description="of the residuals")
    dof: int | None = Field(None, description="their degrees of freedom")
    p_value: float | None = Field(None, description="of as much by chance")
    outliers: list[int] = Field([], description="ids of tags that contradict the others")
    corners: list[CornerRow] = Field([], description="`corner` as `id:0` … `id:3`, `residual_px`, `weight`")
    base_from_goal: Pose | None = Field(None, description="with `--hand-eye` or `--registration`")
    base_covariance: Matrix6 | None = Field(None, description="its covariance")


class LocatedFile(ResultFile):
    """Result file of ``locate run``, with rejected and ambiguous poses too."""

    format: Literal["stcal located 1"] = Field(description="the file's form and its version")
    unit: Literal["mm"] = Field(description="of all lengths")
    layout: str = Field(description="the layout's name")
    scenes: list[SceneRow] = Field(description="`scene`, `verdict`, `reasons`, `notes`, and")

    @classmethod
    def of(cls, results: Sequence[Located], layout: TargetLayout, chain: GoalChain | None = None) -> "LocatedFile":
        """Returns the file of all scenes; ``chain`` : chain to the robot's base."""
        scenes = [_scene_row(each, layout, chain) for each in results]
        return cls(format="stcal located 1", unit="mm", layout=layout.name, scenes=scenes)


def _scene_row(located: Located, layout: TargetLayout, chain: GoalChain | None) -> SceneRow:
    verdict, merged, pose = located.verdict, located.merged, camera_from_obj(located)
    content: dict[str, Any] = {
        "scene": located.name,
        "verdict": verdict.decision,
        "reasons": verdict.reasons,
        "notes": located.notes,
        "checks": verdict.checks,
        "exposures": [_exposure(own) for own in located.tags.exposures],
        "tags": [layout.tags[row][1] for row in merged.seen.rows] if merged else [],
        "differing_share": None if merged is None else merged.share,
        "shifts": [_shift(own) for own in merged.shifts] if merged else [],
        "camera_from_obj": pose,
    }
    if located.patent is not None:
        content |= {
            "twin": located.patent.second,
            "errors_px": located.patent.errors_px,
            "patent": _patent(located, located.patent),
        }
    if located.pose is not None:
        content |= _fit(located.pose, layout)
    if chain and pose is not None and not chain.without_pose([located.name]):
        goal = chain.base_from_goal(located.name, uncertain(located))
        content |= {"base_from_goal": goal.rigid, "base_covariance": goal.covariance}
    return SceneRow.model_validate(content)


def _exposure(own: Exposure | Unreadable) -> ExposureRow:
    read = isinstance(own, Exposure)
    return ExposureRow(image=own.name, tags=len(own.tags) if read else None, trouble=None if read else own.trouble)


def _patent(located: Located, patent: PatentPose) -> PatentRow:
    names = [exposure.name for exposure in located.tags.readable()]
    rows = []
    for exposure_result in patent.exposures:
        first, second = exposure_result.poses or (None, None)
        rows.append(
            {
                "image": names[exposure_result.exposure],
                "tags": exposure_result.tags,
                "area_px2": exposure_result.area_px2,
                "candidate": exposure_result.candidate,
                "kept": exposure_result.exposure == patent.exposure,
                "errors_px": exposure_result.errors_px,
                "det_j": exposure_result.det_j,
                "camera_from_obj": first,
                "twin": second,
            }
        )
    return PatentRow.model_validate({"exposures": rows, "same_pose": patent.same, "assumed": ASSUMED})


def _shift(own: Shift) -> ShiftRow:
    return ShiftRow(between=own.exposures, tags=own.tags, shift_px=own.shift_px)


def _fit(pose: ObjPose, layout: TargetLayout) -> dict[str, Any]:
    names = [f"{layout.tags[row][1]}:{corner}" for row in pose.rows for corner in range(4)]
    return {
        "covariance": pose.covariance,
        "twin": pose.second,
        "delta_chi2": pose.delta_chi2,
        "rms_px": pose.rms_px(),
        "chi2": pose.chi2,
        "dof": pose.redundancy,
        "p_value": pose.p_value(),
        "outliers": [layout.tags[row][1] for row in pose.outliers],
        "corners": [
            CornerRow(corner=name, residual_px=residual, weight=weight)
            for name, residual, weight in zip(names, pose.residuals_px, pose.weights, strict=True)
        ],
    }


class BoardImageRow(Part):
    image: str
    camera_from_board: Pose
    tags_rms_px: float


class TagRow(Part):
    dictionary: str
    id: int
    images: int
    corners_mm: Matrix
    sigma_mm: Matrix
    published_mm: Matrix
    from_nominal_mm: float | None


class CalibratedLayoutFile(ResultFile):
    """Result file of ``locate calibrate``."""

    format: Literal["stcal layout calibration 1"] = Field(description="the file's form and its version")
    unit: Literal["mm"] = Field(description="of all lengths")
    images: list[BoardImageRow] = Field(description="`image`, `camera_from_board` 4×4, `tags_rms_px`")
    left_out: list[str] = Field(description="images without board or tags, and why")
    board_from_obj: Pose = Field(description="where {obj} lies on the board")
    board_rms_px: float = Field(description="residuals of the board's points per coordinate")
    tag_rms_px: float = Field(description="residuals of the tags' corners per coordinate")
    board_stretch: float = Field(description="how much longer the board is along its rows than across, relative")
    board_shear: float = Field(description="its shear, relative")
    sigma_px: float = Field(description="as in the layout file")
    tag_sigma_px: float = Field(description="as in the layout file")
    tags: list[TagRow] = Field(
        description="`dictionary`, `id`, `images` that show it, `corners_mm`, `sigma_mm`; `published_mm`: the corners "
        "before the adjustment; `from_nominal_mm`: the largest distance of a corner from its nominal place, the "
        "nominal target laid over the calibrated one (null without one)"
    )


FEW_IMAGES = 3


def calibrated_text(result: CalibratedLayout) -> str:
    """Returns the report as text: totals, and a line for each tag."""
    layout, adjusted = result.layout, result.adjusted
    lines = [
        f"{len(result.images)} images, {len(layout.tags)} tags; residuals {adjusted.board_rms_px:.3f} px of the board, "
        f"{adjusted.tag_rms_px:.3f} px of the tags",
        f"beside the corners' own σ: {adjusted.sigma_px:.3f} px each, {adjusted.tag_sigma_px:.3f} px a tag as a whole",
        *stretch_in_words("the board", adjusted.stretch, adjusted.shear),
        f"{'id':>5}  {'dictionary':<24} images   side_mm  sigma_um  adjusted by_um  from nominal_mm",
    ]
    moved = np.linalg.norm(layout.corners_mm - result.published, axis=2).max(1)
    for row, ((dictionary, tag), count) in enumerate(zip(layout.tags, result.counts, strict=True)):
        sigma = 1000 * np.sqrt((layout.sigma_mm()[row] ** 2).sum(1).mean())
        nominal = result.deviation_mm[row]
        cell = f"{nominal:15.3f}" if np.isfinite(nominal) else f"{'–':>15}"
        side = sides_mm(layout.corners_mm[row]).mean()
        mark = "  origin" if row == layout.origin else ""
        lines.append(
            f"{tag:>5}  {dictionary:<24} {count:>6}  {side:8.3f}  {sigma:8.1f}  {1000 * moved[row]:14.1f}  {cell}{mark}"
        )
    return "\n".join(lines)


def sides_mm(corners: np.ndarray) -> np.ndarray:
    """Returns the side lengths of a tag, (4,)."""
    return np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)


def warnings(result: CalibratedLayout, names: tuple[tuple[str, int], ...]) -> list[str]:
    """Returns warnings that the result may be worse than its σ; ``names`` : tags of the plan."""
    messages = []
    if result.unseen:
        tags = ", ".join(str(names[row][1]) for row in result.unseen)
        messages.append(f"tags that no image shows, left out of the layout: {tags}")
    few = [tag[1] for tag, count in zip(result.layout.tags, result.counts, strict=True) if count < FEW_IMAGES]
    if few:
        messages.append(f"tags in fewer than {FEW_IMAGES} images, so that a misread one would not be noticed: {few}")
    if result.adjusted.downweighted > 0.1:
        messages.append(
            f"{result.adjusted.downweighted:.0%} of the tags seen are outliers; are target and board in one plane?"
        )
    if not result.adjusted.settled:
        messages.append("the σ of board and tags still change at the end of the adjustment; add images")
    return messages


def calibrated_file(result: CalibratedLayout) -> CalibratedLayoutFile:
    """Returns the result file, without the covariance, which the layout file holds."""
    layout, adjusted = result.layout, result.adjusted
    return CalibratedLayoutFile.model_validate(
        {
            "format": "stcal layout calibration 1",
            "unit": "mm",
            "images": [
                {"image": name, "camera_from_board": pose, "tags_rms_px": float(rms)}
                for name, pose, rms in zip(result.images, adjusted.poses, adjusted.image_rms_px, strict=True)
            ],
            "left_out": list(result.left_out),
            "board_from_obj": result.board_from_obj,
            "board_rms_px": adjusted.board_rms_px,
            "tag_rms_px": adjusted.tag_rms_px,
            "board_stretch": adjusted.stretch,
            "board_shear": adjusted.shear,
            "sigma_px": adjusted.sigma_px,
            "tag_sigma_px": adjusted.tag_sigma_px,
            "tags": [
                {
                    "dictionary": dictionary,
                    "id": tag,
                    "images": int(count),
                    "corners_mm": corners,
                    "sigma_mm": sigma,
                    "published_mm": published,
                    "from_nominal_mm": float(nominal) if np.isfinite(nominal) else None,
                }
                for (dictionary, tag), count, corners, sigma, published, nominal in zip(
                    layout.tags,
                    result.counts,
                    layout.corners_mm,
                    layout.sigma_mm(),
                    result.published,
                    result.deviation_mm,
                    strict=True,
                )
            ],
        }
    )
