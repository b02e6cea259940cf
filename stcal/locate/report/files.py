"""The file that ``locate calibrate`` writes with ``--json``."""

from typing import Literal

from pydantic import Field

from stcal.io.json import Matrix, Part, Pose, ResultFile


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
