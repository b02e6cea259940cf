"""Text and figures that show cameras and compare them."""

import numpy as np

from stcal.geometry.camera import Camera, parameter_names
from stcal.io.cameras.difference import CameraDifference, FittedLens, image_grid, rays
from stcal.report.svg import INK, SMALL, VIRIDIS, Axes, Drawing, round_below
from stcal.report.text import join, number, text_table

POOR_PX = 0.05
"""Largest residual, px, of an adequately fitted lens; beyond it the fit limits the accuracy of centres, which is a few
hundredths of a pixel."""
LENGTHS = ("f", "fx", "fy", "cx", "cy")


def shown(camera: Camera) -> list[str]:
    """Return lines with model, parameters with σ (OpenCV's pixel origin), field of view, and largest distortion."""
    rows = [["<parameter", "value", "±"]]
    sigmas = [None] * 16 if camera.covariance is None else np.sqrt(np.diag(camera.covariance))
    for name, value, sigma in zip(parameter_names(camera.colmap_model), camera.colmap_params(), sigmas, strict=False):
        digits = 4 if name in LENGTHS else 7
        rows.append([name, number(value - 0.5 * (name in ("cx", "cy")), digits), number(sigma, digits)])
    (right, low), (x, y) = (camera.width - 0.5, camera.height - 0.5), camera.centre
    opposite = (((-0.5, y), (right, y)), ((x, -0.5), (x, low)), ((-0.5, -0.5), (right, low)))
    fields = ["–" if np.isnan(angle) else f"{angle:.2f}°" for angle in (field_deg(camera, *ends) for ends in opposite)]
    lines = [
        f"{camera.colmap_model}, {camera.width}×{camera.height} px; first pixel's centre at (0, 0)",
        *text_table(rows, (10, 14, 12)),
        f"field of view: {fields[0]} across, {fields[1]} up, {fields[2]} over the diagonal",
    ]
    moved = moved_px(camera)[1]
    if share := np.isnan(moved).any(axis=2).mean():
        folds = "the distortion folds over there, or leads beyond 89°"
        lines.append(f"warning: {share:.1%} of the image has no ray: {folds}")
    if share < 1:
        lines.append(f"the lens moves points by up to {np.nanmax(np.linalg.norm(moved, axis=2)):.2f} px")
    return lines


def fitted_text(found: FittedLens) -> list[str]:
    """Return lines on the quality of a fitted lens."""
    where = "the image" if found.lens.region is None else "its valid_intrinsics_region"
    fitted = f"{found.camera.colmap_model} fitted to it is {found.rms_px:.2g} px RMS off"
    lines = [f"{found.lens.called} has no place here: {fitted} over {where}, {found.most_px:.2g} px at most"]
    turn = np.degrees(found.camera_from_lens.log()[:3])
    if turn.any():
        turned = (
            f"turned by {np.linalg.norm(turn):.4f}° ({', '.join(f'{v:.4f}' for v in turn)}) about the axes of the lens"
        )
        lines.append(f"the fitted camera is {turned}: poses that the other program gave do not apply to it")
    if found.most_px > POOR_PX:
        remedy = "refine it (`--refine-camera`), or calibrate anew"
        lines.append(f"a fit more than {POOR_PX:g} px off is a start only: {remedy}")
    if found.share < 1:
        lines.append(f"in {1 - found.share:.0%} of the directions {where} reaches beyond 89° from the axis: unused")
    return lines


def field_deg(camera: Camera, one: tuple[float, float], two: tuple[float, float]) -> float:
    """Return the angle between the rays of two pixels; nan if a pixel has no ray."""
    unit = [ray / np.linalg.norm(ray) for ray in rays(camera, np.array([one, two]))]
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(*unit)), unit[0] @ unit[1])))


def moved_px(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (r, c, 2) over the image, and their distortion (r, c, 2), px, relative to a camera with the same
    focal lengths and projection, but without distortion."""
    pixels = image_grid(camera)
    rays_camera = rays(camera, pixels.reshape(-1, 2))
    ideal = Camera(camera.width, camera.height, camera.focal, camera.centre, np.zeros(12), camera.fisheye)
    with np.errstate(invalid="ignore"):
        return pixels, pixels - ideal.pixel_from_normalised(rays_camera[:, :2]).reshape(pixels.shape)


def comparison_text(found: CameraDifference) -> list[str]:
    length = found.lengths()
    turn = np.degrees(found.second_from_first.log()[:3])
    rows, columns = length.shape
    middle = length[rows // 4 : -(rows // 4), columns // 4 : -(columns // 4)]
    corners = length[[0, 0, -1, -1], [0, -1, 0, -1]]
    rms_px, middle_px = (np.sqrt(np.nanmean(each**2)) for each in (length, middle))
    over = f"{rms_px:.4f} px RMS over the image, {np.nanmax(length):.4f} px at most"
    lines = [
        f"apart: {over}; {middle_px:.4f} px RMS in its middle half",
        f"corners: {join(number(v, 4) for v in corners)} px",
        f"the second camera is turned by {np.linalg.norm(turn):.5f}° ({', '.join(f'{v:.5f}' for v in turn)})",
    ]
    if share := np.isnan(length).mean():
        unused = "of the image has no ray in one of both, or is outside of where both are valid: unused"
        lines.append(f"{share:.1%} {unused}")
    return lines


def field_figure(pixels: np.ndarray, moved: np.ndarray, what: str = "moved by the lens, px") -> Drawing:
    """Return a figure of vectors (r, c, 2), px, at ``pixels``: lengths as colours, directions as arrows."""
    (x0, y0), (x1, y1) = pixels[0, 0], pixels[-1, -1]
    drawing = Drawing(7.0, 0.6 + 5.7 * (y1 - y0) / (x1 - x0))
    box = drawing.panels(top=20, right=60)[0]
    axes = Axes(drawing, box, (x0, x1), (y1, y0))
    length = np.linalg.norm(moved, axis=2)
    most = float(np.nanmax(length, initial=0)) or 1.0
    axes.shade(length, (x0, y0, x1, y1), 0, most, VIRIDIS)
    every = (slice(1, None, 3), slice(1, None, 3))
    known = np.isfinite(length[every])
    unit = moved[every][known] / np.maximum(length[every][known], 1e-12)[:, None]
    axes.arrows(pixels[every][known], 0.026 * (x1 - x0) * unit, 1.1, "#ffffff", 0.8)
    axes.frame("x, px", "y, px")
    drawing.scale((box[2] + 14, box[1] + 16, box[2] + 24, box[3] - 16), 0, most, "px", VIRIDIS)
    drawing.words(((box[0] + box[2]) / 2, 9), what, SMALL + 1)
    return drawing


LEAST = 5  # number of residuals in a cell whose mean is drawn


def means_of_cells(
    xy_px: np.ndarray, residuals_px: np.ndarray, cells: tuple[int, int], size_px: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return means (c, 2) and numbers (c,) of residuals (n, 2) at places (n, 2), for :func:`mean_residuals_figure`."""
    at = np.clip(xy_px / size_px * cells, 0, np.subtract(cells, 1)).astype(int) @ [cells[1], 1]
    count = np.bincount(at, minlength=cells[0] * cells[1])
    total = np.column_stack([np.bincount(at, each, len(count)) for each in residuals_px.T])
    return total / np.maximum(count, 1)[:, None], count


def mean_residuals_figure(
    mean_px: np.ndarray, count: np.ndarray, cells: tuple[int, int], size_px: tuple[int, int]
) -> Drawing:
    """Return a figure of the mean residuals (c, 2) in ``cells`` of an image, in x and y, with their numbers (c,); the
    cells are column by column. Model errors are alike in neighbouring cells."""
    (width, height), size = size_px, np.divide(size_px, cells)
    drawing = Drawing(4.3, 0.65 + 3.55 * height / width)
    axes = Axes(drawing, drawing.panels(top=24)[0], (-0.5, width - 0.5), (height - 0.5, -0.5))
    enough = np.flatnonzero(count >= LEAST)
    middle = (np.stack(np.divmod(enough, cells[1]), axis=1) + 0.5) * size
    lengths = np.linalg.norm(mean_px[enough], axis=1)
    longest = float(np.quantile(lengths, 0.9)) if len(lengths) else 0.0
    times = 0.6 * size.min() / longest if longest else 1.0
    for (x, y), number_of in zip(middle, count[enough], strict=True):
        axes.words(x, y + 0.36 * size[1], f"{number_of:.0f}", size=5, colour="#8b97a3")
    axes.arrows(middle, times * mean_px[enough], 1.2, INK)
    axes.frame("x, px", "y, px")
    bar_px, right = round_below(longest), axes.box[2]
    bar = times * bar_px * (right - axes.box[0]) / width
    drawing.lines([np.array([[right - bar, 12], [right, 12]])], INK, 2)
    drawing.words((right - bar - 5, 12), f"{bar_px:g} px; below, the number of residuals", SMALL, "end")
    return drawing
