"""Report of ``locate run`` as a page: verdicts, values and limits, and the images with tags and axes drawn."""

import base64
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from stcal.geometry.camera import Camera
from stcal.io.cameras.model import CameraModel
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import ImageFile, decode, grey_8bit, thumbnail
from stcal.locate.data.exposures import Exposure, SceneFiles
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pipeline import Located
from stcal.locate.pose.patent import ASSUMED
from stcal.locate.report.chain import GoalChain
from stcal.locate.report.tables import accepted, camera_from_obj, patent_cells, uncertain
from stcal.report.figure import AXIS_COLOURS, COLOURS
from stcal.report.page import render, verdict
from stcal.report.text import number

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
    grey = grey_8bit(decode(read_bytes(file.path, IMAGE_BYTES), file.name))
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
