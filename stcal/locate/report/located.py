"""The file that ``locate run`` writes with ``--json``."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from stcal.io.json import Finite, Matrix6, Pair, Part, Pose, ResultFile
from stcal.locate.data.exposures import Exposure, Unreadable
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pipeline import Located
from stcal.locate.pose.estimate import ObjPose
from stcal.locate.pose.merge import Shift
from stcal.locate.pose.patent import ASSUMED, PatentPose
from stcal.locate.report.chain import GoalChain
from stcal.locate.report.page import camera_from_obj, uncertain


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
        scenes = [_scene(each, layout, chain) for each in results]
        return cls(format="stcal located 1", unit="mm", layout=layout.name, scenes=scenes)


def _scene(located: Located, layout: TargetLayout, chain: GoalChain | None) -> SceneRow:
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
