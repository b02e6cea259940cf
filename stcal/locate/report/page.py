"""Text and page of located tags, with their tables."""

import base64
import csv
import io
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from stcal.errors import InputError
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
from stcal.report.figure import AXIS_COLOURS, COLOURS
from stcal.report.page import render, verdict
from stcal.report.text import NONE, number, text_table

BASE = "base_from_goal_"


def run_text(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Returns the results as text: a line for each scene, with reasons below scenes that are not accepted.

    With ``chain``, the poses of the target in the robot's base follow.
    """
    width = max([5, *(len(scene.name) for scene in results)])
    head = f"{'scene':<{width}}  verdict    tags  exposures      x_mm      y_mm      z_mm  sigma_mm  sigma_deg   rms_px"
    lines = [head]
    for scene in results:
        exposures = len(scene.tags.readable())
        tags = len(scene.merged.seen) if scene.merged else 0
        start = f"{scene.name:<{width}}  {scene.verdict.decision:<9}  {tags:4d}  {exposures:9d}"
        pose = camera_from_obj(scene)
        if pose is not None:
            start += "".join(f"{v:10.2f}" for v in pose.translation)
        if scene.pose is not None:
            sigma = scene.pose.sigma_mm(), np.degrees(scene.pose.sigma_rad()), scene.pose.rms_px()
            start += "{:10.3f}{:11.4f}{:9.3f}".format(*sigma)
        lines += [start, *(f"{'':<{width}}    {reason}" for reason in (*scene.verdict.reasons, *scene.notes))]
        if scene.patent is not None:
            lines += [f"    {line}" for line in text_table(patent_cells(scene))]
            lines += [f"    gates: {gates_text(scene)}"]
    if chain and accepted(results):
        lines += ["", f"{'base_from_goal':<{width + 22}}      x_mm      y_mm      z_mm  rotation vector, deg"]
        for scene in accepted(results):
            goal = chain.base_from_goal(scene.name, uncertain(scene)).rigid
            turn = np.degrees(goal.log()[:3])
            place = "".join(f"{v:10.2f}" for v in goal.translation)
            lines.append(f"{scene.name:<{width + 22}}{place}" + "".join(f"{v:10.3f}" for v in turn))
    if any(scene.patent is not None for scene in results):
        lines += ["", f"patent: {ASSUMED}"]
    return "\n".join(lines)


def patent_cells(each: Located) -> list[list[str]]:
    """Returns heads, and one row per exposure: its result by the rules of the patent."""
    rows = [["<exposure", "<", "tags", "area px²", "error px", "of the other", "det J 1/mm²"]]
    if each.patent is None:
        return rows
    for name, result in zip((e.name for e in each.tags.readable()), each.patent.exposures, strict=True):
        state = "kept" if result.exposure == each.patent.exposure else "candidate" if result.candidate else "left out"
        errors = result.errors_px or (None, None)
        det_j = NONE if result.det_j is None else f"{result.det_j:.3g}"
        rows.append([name, state, str(result.tags), number(result.area_px2, 0), *(number(e, 3) for e in errors), det_j])
    return rows


def gates_text(each: Located) -> str:
    """Returns every gate with its value and limit, in words."""
    gates = [
        f"{check.name} {check.value:.4g}{check.unit} {'≥' if check.at_least is not None else '≤'} "
        f"{check.at_least if check.at_least is not None else check.at_most:.4g}{'' if check.passed else ' failed'}"
        for check in each.verdict.checks
    ]
    if each.patent is not None and each.patent.same:
        gates.append("both poses are one, no ratio")
    return "; ".join(gates)


def camera_from_obj(each: Located) -> Rigid | None:
    """Returns camera_from_obj by the method that was asked for, or None."""
    if each.patent is not None:
        return each.patent.camera_from_obj
    return None if each.pose is None else each.pose.camera_from_obj


def uncertain(each: Located) -> UncertainRigid:
    """Returns camera_from_obj with its covariance, which is zero for the patent's method."""
    if each.pose is None:
        pose = camera_from_obj(each)
        if pose is None:
            raise InputError("E-LOCATED-NO-POSE", f"{each.name}: no pose; {each.verdict.decision}")
        return UncertainRigid.exact(pose)
    return UncertainRigid(each.pose.camera_from_obj, each.pose.covariance)


def accepted(results: Sequence[Located]) -> list[Located]:
    """Returns the results whose pose may be used."""
    return [each for each in results if each.verdict.decision == "accept"]


def poses_csv(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Returns a table of the accepted poses only, so that no robot moves to a rejected one; the others are comments."""
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
COLOUR = {"accept": "#1b7f3b", "ambiguous": "#a15c00", "reject": "#b3261e"}


def run_page(
    results: Sequence[Located],
    scenes: Sequence[SceneFiles],
    layout: TargetLayout,
    model: CameraModel,
    chain: GoalChain | None = None,
) -> str:
    """Returns the whole page, which opens offline."""
    return render(
        "locate/report/page.html.jinja",
        layout=layout,
        accepted=len(accepted(results)),
        overview=_overview(results),
        goals=_in_base(results, chain),
        scenes=[
            {"head": (f"scene-{i}", each.name), **_scene(each, files, layout, model)}
            for i, (each, files) in enumerate(zip(results, scenes, strict=True), 1)
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
                _decision(located),
                len(located.merged.seen) if located.merged else 0,
                len(located.tags.readable()),
                *(number(v, 2) for v in place),
                *(number(v, 3) for v in sigma),
                "; ".join(located.verdict.reasons),
            ]
        )
    return rows


def _in_base(results: Sequence[Located], chain: GoalChain | None) -> list[list[str]]:
    """Returns rows of base_from_goal of the accepted scenes."""
    if chain is None:
        return []
    rows = []
    for located in accepted(results):
        goal = chain.base_from_goal(located.name, uncertain(located)).rigid
        place, turn = goal.translation, np.degrees(goal.log()[:3])
        rows.append([located.name, *(number(v, 2) for v in place), *(number(v, 3) for v in turn)])
    return rows


def _decision(each: Located) -> Markup:
    decision = each.verdict.decision
    return verdict(decision, COLOUR[decision])


def _scene(each: Located, files: SceneFiles, layout: TargetLayout, model: CameraModel) -> dict:
    """Returns the values of a scene for the template."""
    by_name = {file.name: file for file in files.files}
    shown = each.tags.readable()
    best = best_exposure(shown, layout)
    all_if_several = shown if len(shown) > 1 else []
    return {
        "decision": _decision(each),
        "reasons": each.verdict.reasons,
        "notes": each.notes,
        "checks": [
            [
                check.name,
                f"{check.value:.4g}{check.unit}" if np.isfinite(check.value) else "no other pose",
                f"≥ {check.at_least:.4g}" if check.at_least is not None else f"≤ {check.at_most:.4g}",
                "yes" if check.passed else verdict("no", COLOUR["reject"]),
            ]
            for check in each.verdict.checks
        ],
        "patent": [] if each.patent is None else patent_cells(each),
        "assumed": "" if each.patent is None else ASSUMED,
        "best": best and _picture(best, by_name[best.name], each, layout, model, WIDE_PX),
        "small": [_picture(own, by_name[own.name], None, layout, model, SMALL_PX) for own in all_if_several],
    }


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
    exposure: Exposure, file: ImageFile, each: Located | None, layout: TargetLayout, model: CameraModel, width_px: int
) -> dict:
    """Returns the image with the outlines of its tags; with axes of {obj} and names of tags if ``each`` is given."""
    grey = grey_8bit(decode(file.read(), file.name))
    width, height = exposure.size
    rows = layout.rows()
    tags = []
    for tag, corners in zip(exposure.tags.tags, exposure.tags.corners_px, strict=True):
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners)
        name = "" if each is None else str(tag[1])
        tags.append((points, COLOURS[2] if tag in rows else COLOURS[1], name, *corners.mean(0)))
    pose = None if each is None else camera_from_obj(each)
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
