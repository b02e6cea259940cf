"""Result files, tables and text of plans and advice."""

from typing import Literal

import numpy as np
from pydantic import Field

from stcal.design import faces_of_known_shape
from stcal.io.json import ByFace, Pair, Part, Pose, ResultFile, Vector3
from stcal.sfm.planning.advise import Advice, Choice
from stcal.sfm.planning.forecast import Forecast
from stcal.sfm.planning.session import Plan
from stcal.sfm.planning.views import PlannedView

MICRO = 1e3
PPM = 1e6
LEAST_SHARE = 0.005
"""Least share of a variance that is printed."""
USUAL_FOCAL_MM = 24.0
"""Focal length of the lens that is planned with if no camera is given, on a sensor 22.3 mm wide."""


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
        sigma_of_circle = {label: sigma for label, sigma in forecast.circle_sigma_mm.items() if label.face == face}
        worst = max(sigma_of_circle, key=lambda label: sigma_of_circle[label])
        return cls(
            translation_sigma_um=MICRO * sigma[3:],
            rotation_sigma_mdeg=MICRO * np.degrees(sigma[:3]),
            position_sigma_um=MICRO * forecast.position_sigma_mm()[face],
            worst_circle=worst,
            worst_circle_sigma_um=MICRO * sigma_of_circle[worst],
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
        "`worst_circle_sigma_um` (likewise), `variance_shares`: by source (`image noise`, `board` or `print`, "
        "`flatness` where stated, `intrinsics` where adjusted, `rims` where estimated) the share of the position's "
        "variance that is due to the source; they add up to 1"
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
    widest_aperture_mm: float = Field(
        description="diameter of the aperture, focal length / f-number, up to which depth of field moves no centre by "
        "more than its σ"
    )


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
            widest_aperture_mm=plan.aperture_mm,
            **dict(ForecastPart.of(plan.forecast, plan.shares)),
            remedies=[
                RemedyRow(
                    what=remedy.what, worst_sigma_um=remedy.sigma_mm and MICRO * remedy.sigma_mm, reason=remedy.reason
                )
                for remedy in plan.remedies
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
                    faces=group.faces, images=group.images, worst_face=group.face, worst_sigma_um=MICRO * group.sigma_mm
                )
                for group in advice.new_groups
            ],
            board_dominates=advice.board_dominates,
            half_board_sigma_um=MICRO * advice.better_board.worst()[1],
            candidates=advice.tried,
        )


def forecast_table(forecast: Forecast, shares: dict[str, dict[str, float]]) -> list[str]:
    """Returns one line for each face, in 80 columns if names are short."""
    rows = ForecastPart.of(forecast, shares).faces
    circles = {face: f"{row.worst_circle} {row.worst_circle_sigma_um:.2f}" for face, row in rows.items()}
    wide, worst = max([4, *map(len, rows)]), max([8, *map(len, circles.values())])
    point = "point" if any("print" in own for own in shares.values()) else "circle"
    axes = " ".join(f"{name:>5}" for name in ("x", "y", "z", "all", "x", "y", "z"))
    lines = [
        f"{'face':>{wide}} {'σ position µm':^23} {'σ rotation mdeg':^17}  {point:<{worst}}  share of",
        f"{'':>{wide}} {axes}  {'worst µm':<{worst}}  variance",
    ]
    for face, row in rows.items():
        position = " ".join(f"{s:5.2f}" for s in [*row.translation_sigma_um, row.position_sigma_um])
        rotation = " ".join(f"{s:5.2f}" for s in row.rotation_sigma_mdeg)
        shares_text = _shares_text(row.variance_shares)
        lines.append(f"{face:>{wide}} {position} {rotation}  {circles[face]:<{worst}}  {shares_text}")
    return lines


def _shares_text(shares: dict[str, float]) -> str:
    """Returns the shares of half a percent and more as a text, the largest first."""
    ordered = sorted((item for item in shares.items() if item[1] >= LEAST_SHARE), key=lambda item: -item[1])
    return ", ".join(f"{source.removeprefix('image ')} {100 * share:.0f} %" for source, share in ordered)


def plan_text(plan: Plan, noise: str) -> str:
    """Returns the forecast as a table. ``noise`` : where the σ of the centres comes from."""
    options = plan.options
    points = "centres" if plan.setup.board.rows else "corners"
    worst, sigma = plan.forecast.worst()
    lines = [
        _photographs_said(plan),
        f"{plan.observations} {points}, σ {plan.centre_sigma_px:.4f} px RMS: {noise}",
        *forecast_table(plan.forecast, plan.shares),
        f"scale: σ {PPM * plan.forecast.scale_sigma:.1f} ppm; worst is face {worst}, {MICRO * sigma:.2f} µm, against "
        f"face {plan.setup.start.reference_face}",
        "",
        f"{'what would help':<28} worst face µm",
    ]
    reachable = sorted((r.sigma_mm, r.what) for r in plan.remedies if r.sigma_mm is not None)
    for worst_mm, change in reachable:
        if worst_mm < (1 - LEAST_SHARE) * sigma:
            lines.append(f"{change:<28} {MICRO * worst_mm:6.2f}   {100 * (worst_mm / sigma - 1):+.0f} %")
    if useless := [change for worst_mm, change in reachable if worst_mm >= (1 - LEAST_SHARE) * sigma]:
        lines.append(f"does not help: {', '.join(useless)}")
    impossible = ((r.what, r.reason.partition("; ")[0]) for r in plan.remedies if r.sigma_mm is None)
    lines += [f"{change:<28}      –   not possible, {why}" for change, why in impossible]
    lens = f"f/{USUAL_FOCAL_MM / plan.aperture_mm:.1f} of a {USUAL_FOCAL_MM:g} mm lens"
    lens = "focal length / f-number" if options.camera else lens
    lines.append(
        "in focus at the middle of each image, depth of field moves no centre by more than its σ up to an aperture "
        f"{plan.aperture_mm:.2g} mm across ({lens}), and up to "
        "one 2.8 times as wide from twice as far; what it moves is corrected to about 15 %"
    )
    if assumed := [face.id for face in plan.setup.target.faces if face.outline_mm is None]:
        lines.append(
            f"plates of {', '.join(assumed)} are assumed to end {options.margin_mm:g} mm beyond their circles "
            "(--margin-mm, or outline_mm in target.toml)"
        )
    if plan.setup.board.rows:
        lines.append("the random places of board and cameras (--seed) change it by about ±3 %")
    else:
        lines += filter(None, [plan.hardly_seen])
        lines.append("which faces the photographs happen to show together (--seed) changes it: compare two seeds")
    return "\n".join(lines)


def _photographs_said(plan: Plan) -> str:
    """Returns what is photographed, and what tells its size."""
    options, camera, board = plan.options, plan.setup.camera, plan.setup.board
    size = f"{camera.width}×{camera.height} px, {options.distance_mm:g} mm away"
    if not board.rows:
        faces = faces_of_known_shape(board)
        prints = sorted({f"{MICRO * (face.sigma_mm or 0.0):g}" for face in faces}, key=float)
        found = "found from them" if options.camera is None else "of the file"
        return (
            f"{options.images} images, {size}, of a body in random poses that show two or more of {len(faces)} faces; "
            f"camera {found}, σ of print {' to '.join(prints[:: max(1, len(prints) - 1)])} µm"
        )
    boards = "the same board in all groups" if options.one_board else "a board of its own in each group"
    return (
        f"groups {', '.join(plan.groups)}, {options.images} images each, {size}, spread ±{options.spread_deg:g}°; "
        f"{boards}, σ {MICRO * board.sigma_mm:g} µm"
    )


_HOW_TO_GO = (
    "go right and up as seen in the photograph named, about the middle of board and faces, which is to be in the",
    "middle of the image, mm away; degrees of board and faces are from their normal. If board or target have",
    "been moved since, photograph a new group.",
)
_HOW_TO_TURN = (
    "go right and up as seen in the photograph named, about the middle of the body, or turn the body the other way;",
    "it must be in the middle of the image, mm away; degrees of faces are from their normal",
)


def advice_text(advice: Advice) -> str:
    """Returns what to photograph next, as a table that a photographer can follow."""
    worst, sigma = advice.now.worst()
    lines = [*forecast_table(advice.now, advice.shares), f"worst is face {worst}, {MICRO * sigma:.2f} µm"]
    if advice.board_dominates:
        lines.append(
            f"{100 * advice.shares[worst]['board']:.0f} % of its variance comes from the board: further views will "
            f"help little; with a board of half the σ: {MICRO * advice.better_board.worst()[1]:.2f} µm"
        )
    lines += ["", f"further views, one after the other, the best of {advice.tried}:"]
    lines.append(f"{'group':>6}  {'from':<20} {'go':<22} {'mm':>5}  worst face, µm")
    before = f"{worst}: {MICRO * sigma:.2f}"
    for choice in advice.choices:
        view = choice.view
        after = f"{choice.face}: {MICRO * choice.sigma_mm:.2f}"
        change = f"{before} → {after}"
        tilts = ", ".join(f"{'' if key == 'board' else 'face '}{key} {t:.0f}°" for key, t in view.tilts_deg.items())
        lines += [
            f"{view.group:>6}  {view.middle:<20} {where(view):<22} {view.distance_mm:5.0f}  {change}",
            f"{'':>6}  sees {tilts}; {view.nearest} {view.nearest_deg:.0f}° away",
        ]
        before = after
    if not advice.choices:
        lines.append("none: no other view within ±50° shows the whole board and a face")
    lines += _HOW_TO_GO if advice.has_board else _HOW_TO_TURN
    if advice.new_groups:
        lines += ["", "faces not yet photographed together, with the board next to them, as a new group:"]
        for pair in advice.new_groups:
            lines.append(
                f"  faces {pair.faces[0]} and {pair.faces[1]}, {pair.images} images: worst is face {pair.face}, "
                f"{MICRO * sigma:.2f} → {MICRO * pair.sigma_mm:.2f} µm"
            )
    return "\n".join([*lines, "", _verdict(advice)])


def where(view: PlannedView) -> str:
    """Returns the direction from the named photograph to the view, as seen there: ``25° right, 12° up``."""
    parts = []
    for angle, names in ((view.azimuth_deg, ("right", "left")), (view.elevation_deg, ("up", "down"))):
        if angle:
            parts.append(f"{abs(angle):g}° {names[angle < 0]}")
    if view.roll_deg:
        parts.append("camera on end")
    return ", ".join(parts) or "the same place"


def _verdict(advice: Advice) -> str:
    """Returns the worst face after each kind of remedy, the best first."""
    board = advice.better_board.worst()[1]
    ways = [(board, "a board of half the σ" if advice.has_board else "print and size of half the σ")]
    if advice.choices:
        count = len(advice.choices)
        ways.append((advice.choices[-1].sigma_mm, f"the {count} views together" if count > 1 else "the one view"))
    if advice.new_groups:
        best = advice.new_groups[0]
        ways.append((best.sigma_mm, f"{best.images} images of faces {best.faces[0]} and {best.faces[1]}"))
    ways.sort()
    options = "; ".join(f"{MICRO * sigma:.2f} µm with {what}" for sigma, what in ways)
    return f"worst face afterwards, the best first: {options}"
