"""Content of ``report.json`` about the comparison with the published method."""

from pydantic import Field

from stcal.io.json import ByFace, Part


class FaceOff(Part):
    translation_um: float
    rotation_mdeg: float


class ComparedRow(Part):
    method: str
    faces: dict[ByFace, FaceOff]
    missing: list[str]
    board_mean_um: float | None
    board_spread_um: float | None
    residual_rms_px: float | None
    reason: str | None


class SigmaRow(Part):
    translation_um: float
    rotation_mdeg: float


class Comparison(Part):
    """Content that ``--compare paper`` adds to ``report.json``."""

    method: str = Field(alias="with", description="`paper`")
    rows: list[ComparedRow] = Field(
        description="`as published`, then with one step more each, all with three-point frames: `method`; `faces` "
        "face → `translation_um`, `rotation_mdeg` off the last row (empty in that), `missing` faces; length of the "
        "board's residuals, `board_mean_um` and `board_spread_um` (mean and standard deviation over all groups' dots, "
        "Table 1); "
        "`residual_rms_px` per coordinate; `reason` where a row has no result, null otherwise"
    )
    sigma: dict[ByFace, SigmaRow] = Field(
        description="of the last row by face: `translation_um`, `rotation_mdeg`, lengths of σ over the three axes"
    )
