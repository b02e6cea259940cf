"""The result of a rig's calibration, as text for the terminal and as a page."""

import numpy as np

from stcal.report.figure import COLOURS, INK, SMALL, calm, new_figure, plane, uri
from stcal.report.page import render
from stcal.report.poses import HEADS, transform_rows
from stcal.report.text import number, text_table
from stcal.sfm.camera.report import residual_map, sigma_map
from stcal.sfm.camera.rig import RigCalibration

CAMERA_HEADS = (
    "<camera",
    "<lens model",
    "views",
    "shared",
    "RMS px",
    "alone px",
    "σ of a projection px",
    "held out px",
)
MOST_ROWS = 500
FRUSTUM_SHARE = 0.15
"""Length of the drawn fields of view, as a share of the rig's extent."""


def rig_text(rig: RigCalibration) -> str:
    """Returns the cameras and their poses on the rig as text."""
    lines = [
        f"skipped {name}/{each.name}: {each.reason}"
        for name, camera in zip(rig.names, rig.cameras, strict=True)
        for each in camera.skipped
    ]
    lines += [f"apart {each.camera}/{each.image}: {each.reason}" for each in rig.apart]
    lines += [_headline(rig), "", *text_table([list(CAMERA_HEADS), *_camera_rows(rig)])]
    for name, rows in _poses(rig):
        lines += ["", *text_table([["<" + name, *HEADS[1:]], *rows])]
    lines += [f"warning: {each}" for each in _all_warnings(rig)]
    return "\n".join(lines)


def _headline(rig: RigCalibration) -> str:
    shared = sum(len(images) > 1 for images in rig.instants.values())
    return (
        f"{len(rig.names)} cameras, {len(rig.instants)} instants, {shared} of them seen by several; residuals are "
        f"{rig.factor:.3g} times those of the cameras alone"
    )


def _all_warnings(rig: RigCalibration) -> list[str]:
    each = zip(rig.names, rig.cameras, strict=True)
    return [*rig.warnings, *(f"{name}: {text}" for name, own in each for text in own.warnings)]


def _camera_rows(rig: RigCalibration) -> list[list[str]]:
    return [
        [
            name,
            camera.intrinsics.colmap_model,
            str(len(camera.views)),
            str(shared),
            number(rms, 4),
            number(alone, 4),
            number(float(np.median(camera.projection.sigma_px)), 4),
            number(camera.held_out.rms_px() if camera.held_out else None, 4),
        ]
        for name, camera, shared, rms, alone in zip(
            rig.names, rig.cameras, rig.shared, rig.rms_of_cameras(), rig.alone_rms_px, strict=True
        )
    ]


def _poses(rig: RigCalibration) -> list[tuple[str, list[list[str]]]]:
    each = zip(rig.names[1:], rig.camera_from_first[1:], rig.covariance[1:], strict=True)
    return [(f"{name}_from_{rig.names[0]}", transform_rows(pose, covariance)) for name, pose, covariance in each]


def rig_page(rig: RigCalibration, where: str) -> str:
    """Returns the report of ``calibrate-camera --rig``."""
    return render(
        "sfm/camera/rig.html.jinja",
        where=where,
        names=rig.names,
        headline=_headline(rig),
        warnings=rig.warnings,
        camera_heads=CAMERA_HEADS,
        cameras=_camera_rows(rig),
        heads=HEADS,
        poses=_poses(rig),
        arrangement=uri(_arrangement(rig)),
        by_instant=uri(_by_instant(rig)),
        maps=[
            (name, own.warnings, sigma_map(own), residual_map(own))
            for name, own in zip(rig.names, rig.cameras, strict=True)
        ],
        instants=[
            [name, number(rig.rms_px[name], 4), *(images.get(camera, "") for camera in rig.names)]
            for name, images in rig.instants.items()
        ],
        left_out=[[each.camera, each.image, each.reason] for each in rig.apart]
        + [
            [name, each.name, each.reason]
            for name, own in zip(rig.names, rig.cameras, strict=True)
            for each in own.skipped
        ],
        most=MOST_ROWS,
    )


def _arrangement(rig: RigCalibration):
    """Returns a figure of the cameras and their fields of view from above (x, z) and from the side (z, y).

    Coordinates are in the frame of the first camera.
    """
    inverse = [pose.inverse() for pose in rig.camera_from_first]
    places = np.array([pose.translation for pose in inverse])
    length = FRUSTUM_SHARE * max(float(np.ptp(places, axis=0).max()), 1.0) * 3
    figure = new_figure(7.2, 3.4)
    figure.set_layout_engine("constrained")
    for axes, (a, b), labels in zip(
        figure.subplots(1, 2), ((0, 2), (2, 1)), (("x, mm", "z, mm"), ("z, mm", "y, mm")), strict=True
    ):
        calm(axes)
        for k, (name, pose, calibration) in enumerate(zip(rig.names, inverse, rig.cameras, strict=True)):
            camera, colour = calibration.intrinsics.camera, COLOURS[k % len(COLOURS)]
            across = 0 if a == 0 else 1
            half = 0.5 * (camera.width, camera.height)[across] / camera.focal[across]
            edge = np.zeros((2, 3))
            edge[:, across], edge[:, 2] = [-half, half], 1.0
            ends = pose @ (length * edge / np.hypot(half, 1))
            fan = np.array([ends[0], pose.translation, ends[1]])
            axes.plot(fan[:, a], fan[:, b], color=colour, linewidth=1.2)
            axes.annotate(
                name, pose.translation[[a, b]], fontsize=SMALL, color=colour, xytext=(4, -8), textcoords="offset points"
            )
        plane(axes, *labels, 0.15)
    figure.axes[1].invert_yaxis()
    return figure


def _by_instant(rig: RigCalibration):
    """Returns a figure of the residuals by instant. Instants that several cameras saw have their own colour."""
    figure = new_figure(7.2, 2.2)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    calm(axes)
    shared = [len(images) > 1 for images in rig.instants.values()]
    axes.bar(
        range(len(shared)), list(rig.rms_px.values()), color=[COLOURS[0] if each else "#9aa0a8" for each in shared]
    )
    axes.set_ylabel("RMS, px", fontsize=SMALL + 0.5, color=INK)
    axes.set_xlabel("instant", fontsize=SMALL + 0.5, color=INK)
    return figure
