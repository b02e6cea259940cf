"""Forms of the JSON files of ``plan`` and ``advise``."""

from typing import Literal

import numpy as np
from pydantic import Field

from stcal.io.json import ByFace, Pair, Part, Pose, ResultFile, Vector3
from stcal.sfm.planning.advise import Advice, Choice
from stcal.sfm.planning.forecast import Forecast
from stcal.sfm.planning.session import Plan

MICRO = 1e3
PPM = 1e6


class FaceForecast(Part):
    translation_sigma_um: Vector3
    rotation_sigma_mdeg: Vector3
    position_sigma_um: float
    worst_circle: str
    worst_circle_sigma_um: float
    variance_shares: dict[str, float]

    @classmethod
    def of(cls, forecast: Forecast, face: str, shares: dict[str, float]) -> "FaceForecast":
        sigma = np.sqrt(np.diag(forecast.face_covariance[face]))
        own = {label: sigma for label, sigma in forecast.circle_sigma_mm.items() if label.face == face}
        worst = max(own, key=lambda label: own[label])
        return cls(
            translation_sigma_um=MICRO * sigma[3:],
            rotation_sigma_mdeg=MICRO * np.degrees(sigma[:3]),
            position_sigma_um=MICRO * forecast.position_sigma_mm()[face],
            worst_circle=worst,
            worst_circle_sigma_um=MICRO * own[worst],
            variance_shares=shares,
        )


class ForecastPart(Part):
    """The part that both files share: σ against the reference face, in the target frame."""

    worst_face: str = Field(description="the face whose position is known worst")
    worst_sigma_um: float = Field(description="its `position_sigma_um`")
    scale_sigma_ppm: float = Field(description="of the target's size")
    faces: dict[ByFace, FaceForecast] = Field(
        description="all faces but the reference: `translation_sigma_um` and `rotation_sigma_mdeg` (x, y, z), "
        "`position_sigma_um` (root of the summed variances of x, y, z), `worst_circle` and its "
        "`worst_circle_sigma_um` (likewise), `variance_shares`: by source (`image noise`, `board`, `intrinsics` where "
        "refined) the share of the position's variance that goes when the source is switched off; they need not add up "
        "to 1"
    )

    @classmethod
    def of(cls, forecast: Forecast, shares: dict[str, dict[str, float]]) -> "ForecastPart":
        """Returns the faces, the worst face and the scale of a forecast."""
        worst, sigma = forecast.worst()
        faces = {face: FaceForecast.of(forecast, face, shares[face]) for face in forecast.face_covariance}
        return ForecastPart(
            worst_face=worst, worst_sigma_um=MICRO * sigma, scale_sigma_ppm=PPM * forecast.scale_sigma, faces=faces
        )


class RemedyRow(Part):
    what: str
    worst_sigma_um: float | None
    reason: str


class PlannedPart(Part):
    """The planned photographs."""

    format: Literal["stcal plan 1"] = Field(description="the file's form and its version")
    images_per_group: int = Field(description="photographs")
    groups: list[str] = Field(description="names")
    spread_deg: float = Field(description="± about the view that shows both faces equally")
    distance_mm: float = Field(description="of the camera")
    size_px: tuple[int, int] = Field(description="of the images")
    focal_px: Pair = Field(description="of the camera")
    refine_camera: bool = Field(description="whether the intrinsics are adjusted too")
    one_board: bool = Field(description="one plate in all groups")
    board_sigma_um: float = Field(description="of the board's dots")
    reference_face: str = Field(description="face id")
    observations: int = Field(description="centres in all images")
    centre_sigma_rms_px: float = Field(description="their σ per axis")


class PlanFile(ForecastPart, PlannedPart, ResultFile):
    """The JSON file of ``plan``: the planned photographs, the forecast, and what would help. Fields of bases come last
    base first."""

    remedies: list[RemedyRow] = Field(
        description="`what` could be changed, `worst_sigma_um` after that, null where it is not possible for `reason`"
    )

    @classmethod
    def of_plan(cls, plan: Plan) -> "PlanFile":
        """Returns the file of a plan."""
        options, camera = plan.options, plan.setup.camera
        return cls(
            format="stcal plan 1",
            images_per_group=options.images,
            groups=list(plan.groups),
            spread_deg=options.spread_deg,
            distance_mm=options.distance_mm,
            size_px=(camera.width, camera.height),
            focal_px=camera.focal,
            refine_camera=options.run.refine_camera,
            one_board=options.one_board,
            board_sigma_um=MICRO * plan.setup.board.sigma_mm,
            reference_face=plan.setup.start.reference_face,
            observations=plan.observations,
            centre_sigma_rms_px=plan.centre_sigma_px,
            **dict(ForecastPart.of(plan.forecast, plan.shares)),
            remedies=[
                RemedyRow(what=each.what, worst_sigma_um=each.sigma_mm and MICRO * each.sigma_mm, reason=each.reason)
                for each in plan.remedies
            ],
        )


class ViewRow(Part):
    group: str
    from_image: str
    right_deg: float
    up_deg: float
    roll_deg: float
    distance_mm: float
    tilts_deg: dict[str, float]
    nearest_image: str
    nearest_deg: float
    camera_from_target: Pose
    labels: list[str]
    worst_face: str
    worst_sigma_um: float

    @classmethod
    def of(cls, choice: Choice) -> "ViewRow":
        view = choice.view
        return cls(
            group=view.group,
            from_image=view.middle,
            right_deg=view.azimuth_deg,
            up_deg=view.elevation_deg,
            roll_deg=view.roll_deg,
            distance_mm=view.distance_mm,
            tilts_deg=view.tilts_deg,
            nearest_image=view.nearest,
            nearest_deg=view.nearest_deg,
            camera_from_target=view.model.camera_from_model[0].matrix(),
            labels=[view.model.labels[i] for i in view.model.point_index],
            worst_face=choice.face,
            worst_sigma_um=MICRO * choice.sigma_mm,
        )


class GroupToAdd(Part):
    faces: tuple[str, str]
    images: int
    worst_face: str
    worst_sigma_um: float


class AdviceFormat(Part):
    format: Literal["stcal advice 1"] = Field(description="the file's form and its version")


class AdviceFile(ForecastPart, AdviceFormat, ResultFile):
    """The JSON file of ``advise``: the present forecast, and further photographs."""

    views: list[ViewRow] = Field(
        description="further photographs, one after the other: `group`; `from_image`, the photograph in the middle of "
        "the group's views; `right_deg`, `up_deg` from there as that photograph shows them (longitude and latitude "
        "about the middle of board and faces), `roll_deg` of the camera about its axis, `distance_mm` to that middle; "
        "`tilts_deg` by face and `board`, between normal and line of sight; `nearest_image` and `nearest_deg` to it; "
        "`camera_from_target` 4×4; `labels` in view; `worst_face`, `worst_sigma_um` with this view and those before"
    )
    new_groups: list[GroupToAdd] = Field(
        description="pairs of `faces` that no group shows together, the best first: `worst_face`, `worst_sigma_um` "
        "with `images` of them and the board"
    )
    board_dominates: bool = Field(
        description="more than half of the worst face's variance is the board's: more views help little"
    )
    half_board_sigma_um: float = Field(description="`worst_sigma_um` with half the board's σ and no further view")
    candidates: int = Field(description="views that were compared")

    @classmethod
    def of_advice(cls, advice: Advice) -> "AdviceFile":
        """Returns the file of an advice."""
        return cls(
            format="stcal advice 1",
            **dict(ForecastPart.of(advice.now, advice.shares)),
            views=[ViewRow.of(choice) for choice in advice.choices],
            new_groups=[
                GroupToAdd(
                    faces=each.faces, images=each.images, worst_face=each.face, worst_sigma_um=MICRO * each.sigma_mm
                )
                for each in advice.new_groups
            ],
            board_dominates=advice.board_dominates,
            half_board_sigma_um=MICRO * advice.better_board.worst()[1],
            candidates=advice.tried,
        )
