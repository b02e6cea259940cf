"""Report of a layout's calibration: text, and the file of ``locate calibrate --json``."""

from typing import Literal

import numpy as np
from pydantic import Field

from stcal.io.json import Matrix, Part, Pose, ResultFile
from stcal.locate.calibration import CalibratedLayout


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
