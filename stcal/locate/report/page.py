"""The report of located tags, and their table."""

import base64
import csv
import io
from collections.abc import Sequence

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.geometry.uncertain import UncertainRigid
from stcal.io.cameras.model import CameraModel
from stcal.io.images import ImageFile, decode, grey_8bit, thumbnail
from stcal.io.table import COVARIANCE, POSE, pose_cells
from stcal.locate.data.exposures import Exposure, SceneFiles
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pipeline import Located
from stcal.locate.pose.patent import ASSUMED
from stcal.locate.report.chain import GoalChain
from stcal.report.document import Block, Document, Html, Notes, Section, Table, Verdict, columns, macro, page_only
from stcal.report.figure import AXIS_COLOURS, COLOURS
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


def camera_from_obj(located: Located) -> Rigid | None:
    """Returns camera_from_obj by the method that was asked for, or None."""
    if located.patent is not None:
        return located.patent.camera_from_obj
    return None if located.pose is None else located.pose.camera_from_obj


def uncertain(located: Located) -> UncertainRigid:
    """Returns camera_from_obj with its covariance, which is zero for the patent's method."""
    if located.pose is None:
        pose = camera_from_obj(located)
        if pose is None:
            raise InputError("E-LOCATED-NO-POSE", f"{located.name}: no pose; {located.verdict.decision}")
        return UncertainRigid.exact(pose)
    return UncertainRigid(located.pose.camera_from_obj, located.pose.covariance)


def accepted(results: Sequence[Located]) -> list[Located]:
    """Returns the results whose pose may be used."""
    return [each for each in results if each.verdict.decision == "accept"]


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
    out = io.StringIO()
    for scene in results:
        if scene.verdict.decision != "accept":
            out.write(f"# {scene.name}: {scene.verdict.decision}: {'; '.join(scene.verdict.reasons)}\n")
    write = csv.writer(out, lineterminator="\n")
    full = all(scene.pose is not None for scene in accepted(results))
    columns = [*POSE, *(COVARIANCE if full else ())]
    base = [BASE + column for column in columns] if chain else []
    write.writerow(["scene", "tags", "exposures", *columns, "rms_px", "chi2_per_dof", *base])
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
        write.writerow(row)
    return out.getvalue()


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
    """Returns the exposure with most tags of the layout, or None if there is no exposure.

    Among several, it is the one with the smallest σ of corners and edges; darkness and saturation increase these σ.
    """
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
