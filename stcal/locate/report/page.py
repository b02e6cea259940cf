"""The page of ``locate run``: verdicts, values beside their limits, and what was found drawn on the images."""

import base64
from collections.abc import Sequence
from html import escape

import numpy as np

from stcal.geometry.camera import Camera
from stcal.io.camera import CameraModel
from stcal.io.images import ImageFile, decode, grey_8bit, thumbnail
from stcal.locate.data.exposures import Exposure, SceneFiles
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pipeline import Located
from stcal.locate.report.chain import Chain
from stcal.locate.report.tables import accepted, camera_from_obj, uncertain
from stcal.report.figure import AXIS_COLOURS, COLOURS
from stcal.report.page import Html, page, table
from stcal.report.text import number

WIDE_PX, SMALL_PX = 900, 215
COLOUR = {"accept": "#1b7f3b", "ambiguous": "#a15c00", "reject": "#b3261e"}


def run_page(
    results: Sequence[Located],
    scenes: Sequence[SceneFiles],
    layout: TargetLayout,
    model: CameraModel,
    chain: Chain | None = None,
) -> str:
    """The whole page, which opens off line."""
    count = len(accepted(results))
    banner = (
        f"<h1>Target {escape(layout.name)}</h1>\n"
        f'<p class="counts">{len(results)} scenes, {count} accepted; {len(layout.tags)} tags in the layout</p>\n'
    )
    sections = [("scenes", "Scenes", _overview(results) + _in_base(results, chain))]
    for number_, (each, files) in enumerate(zip(results, scenes, strict=True), 1):
        sections.append((f"scene-{number_}", escape(each.name), _scene(each, files, layout, model)))
    return page(f"stcal locate: {layout.name}", banner, sections)


def _overview(results: Sequence[Located]) -> str:
    heads = ["<scene", "<verdict", "tags", "exposures", "x mm", "y mm", "z mm", "σ mm", "σ °", "rms px", "<why"]
    rows = []
    for each in results:
        pose, fit = camera_from_obj(each), each.pose
        place = [None] * 3 if pose is None else pose.translation
        sigma = [None] * 3 if fit is None else [fit.sigma_mm(), np.degrees(fit.sigma_rad()), fit.rms_px()]
        rows.append(
            [
                each.name,
                _decision(each),
                len(each.merged.seen) if each.merged else 0,
                len(each.tags.readable()),
                *(number(v, 2) for v in place),
                *(number(v, 3) for v in sigma),
                "; ".join(each.verdict.reasons),
            ]
        )
    return table(heads, rows, css="text")


def _in_base(results: Sequence[Located], chain: Chain | None) -> str:
    """base_from_goal of the accepted scenes."""
    if chain is None or not accepted(results):
        return ""
    rows = []
    for each in accepted(results):
        goal = chain.base_from_goal(each.name, uncertain(each)).rigid
        place, turn = goal.translation, np.degrees(goal.log()[:3])
        rows.append([each.name, *(number(v, 2) for v in place), *(number(v, 3) for v in turn)])
    heads = ["<scene", "x mm", "y mm", "z mm", "rotation vector x °", "y °", "z °"]
    return "<h3>base_from_goal: where the robot has to go</h3>\n" + table(heads, rows)


def _decision(each: Located) -> Html:
    decision = each.verdict.decision
    return Html(f'<b style="color:{COLOUR[decision]}">{decision}</b>')


def _scene(each: Located, files: SceneFiles, layout: TargetLayout, model: CameraModel) -> str:
    parts = [f"<p>{_decision(each)}{''.join(f' – {escape(reason)}' for reason in each.verdict.reasons)}</p>"]
    parts += [f"<p>{escape(note)}</p>" for note in each.notes]
    if each.verdict.checks:
        rows = [
            [
                check.name,
                f"{check.value:.4g}{check.unit}" if np.isfinite(check.value) else "no other pose",
                f"≥ {check.at_least:.4g}" if check.at_least is not None else f"≤ {check.at_most:.4g}",
                "yes" if check.passed else Html(f'<b style="color:{COLOUR["reject"]}">no</b>'),
            ]
            for check in each.verdict.checks
        ]
        parts.append(table(["<check", "value", "limit", "<kept"], rows))
    by_name = {file.name: file for file in files.files}
    shown = each.tags.readable()
    if shown:
        best = max(shown, key=lambda exposure: len(exposure.tags))
        parts.append(_picture(best, by_name[best.name], each, layout, model, WIDE_PX))
    if len(shown) > 1:
        small = [_picture(exposure, by_name[exposure.name], None, layout, model, SMALL_PX) for exposure in shown]
        parts.append(f'<div style="display:flex;flex-wrap:wrap;gap:.6rem">{"".join(small)}</div>')
    return "\n".join(parts)


def _picture(
    exposure: Exposure, file: ImageFile, each: Located | None, layout: TargetLayout, model: CameraModel, width_px: int
) -> str:
    """The image with the outlines of its tags; with the axes of {obj} and the tags' places where ``each`` is given."""
    grey = grey_8bit(decode(file.path.read_bytes(), file.name))
    width, height = exposure.size
    jpeg = base64.b64encode(thumbnail(grey, width_px)[0].tobytes()).decode()
    known = layout.rows()
    line = 2.0 * width / width_px
    drawn = []
    for tag, corners in zip(exposure.tags.tags, exposure.tags.corners_px, strict=True):
        colour = COLOURS[2] if tag in known else COLOURS[1]
        drawn.append(_outline(corners, colour, line))
        if each is not None:
            x, y = corners.mean(0)
            drawn.append(_text(x, y, str(tag[1]), 14 * width / width_px, "#ffd400"))
    pose = None if each is None else camera_from_obj(each)
    if pose is not None:
        drawn += _axes(pose, layout, model.sized(width, height), line)
    count = sum(tag in known for tag in exposure.tags.tags)
    caption = f"{escape(exposure.name)}: {count} of {len(layout.tags)} tags"
    image = f'<image href="data:image/jpeg;base64,{jpeg}" x="-.5" y="-.5" width="{width}" height="{height}"/>'
    return (
        f'<figure style="margin:.4rem 0;max-width:{width_px}px"><svg viewBox="-.5 -.5 {width} {height}" '
        f'style="width:{width_px}px;max-width:100%;height:auto;display:block" role="img" aria-label="{caption}">'
        f"{image}{''.join(drawn)}</svg><figcaption>{caption}</figcaption></figure>"
    )


def _outline(corners: np.ndarray, colour: str, width: float) -> str:
    points = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners)
    return f'<polygon points="{points}" fill="none" stroke="{colour}" stroke-width="{width:.2f}"/>'


def _text(x: float, y: float, text: str, size: float, colour: str) -> str:
    style = f'font-size="{size:.1f}" fill="{colour}" stroke="#000" stroke-width="{size / 6:.1f}" paint-order="stroke"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style} text-anchor="middle" dominant-baseline="central">{text}</text>'


def _axes(pose, layout: TargetLayout, camera: Camera, width: float) -> list[str]:
    """X, Y and Z of {obj}, a third of the target long; an axis that would pass behind the camera is left out."""
    length = float(np.ptp(layout.corners_mm.reshape(-1, 2), axis=0).max()) / 3
    ends = pose @ (length * np.vstack([np.zeros(3), np.eye(3)]))
    if (ends[:, 2] <= 0).any():
        return []
    start, *tips = camera.project(ends)
    return [
        f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{tip[0]:.1f}" y2="{tip[1]:.1f}" stroke="{colour}" '
        f'stroke-width="{2 * width:.1f}"/>{_text(tip[0], tip[1], name, 9 * width, colour)}'
        for tip, colour, name in zip(tips, AXIS_COLOURS, "XYZ", strict=True)
    ]
