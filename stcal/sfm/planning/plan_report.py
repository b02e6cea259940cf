"""Plans and advice as result files and as text."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from stcal.design import faces_of_known_shape
from stcal.io.json import ByFace, Part, Pose, ResultFile
from stcal.report.text import join, number, text_table
from stcal.sfm.planning.advise import Advice, NewGroup
from stcal.sfm.planning.forecast import Forecast, worst_of
from stcal.sfm.planning.session import Plan, Remedy

MICRO = 1e3
PPM = 1e6
LEAST_SHARE = 0.005  # least share of a variance that is printed
USUAL_FOCAL_MM = 24.0  # focal length of the lens that is planned with if no camera is given, on a sensor 22.3 mm wide


@dataclass(frozen=True, slots=True)
class FaceForecast:
    translation_sigma_um: list[float]
    rotation_sigma_mdeg: list[float]
    position_sigma_um: float
    worst_circle: str
    worst_circle_sigma_um: float
    variance_shares: dict[str, float]


class ForecastPart(Part):
    """σ against the reference face, in the target frame."""

    worst_face: str
    worst_sigma_um: float
    scale_sigma_ppm: float
    faces: dict[ByFace, FaceForecast] = Field(
        description="all faces but the reference: `translation_sigma_um` and `rotation_sigma_mdeg` (x, y, z), "
        "`position_sigma_um` (root of the summed variances of x, y, z), `worst_circle` and its "
        "`worst_circle_sigma_um` (likewise), `variance_shares`: by source (`image noise`, `board` or `print`, "
        "`flatness` where stated, `intrinsics` where adjusted, `rims` where estimated) the share of the position's "
        "variance that is due to the source; they add up to 1"
    )

    @classmethod
    def of(cls, forecast: Forecast, shares: dict[str, dict[str, float]]) -> "ForecastPart":
        faces, position_mm = {}, forecast.position_sigma_mm()
        for face, covariance in forecast.face_covariance.items():
            sigma = MICRO * np.sqrt(np.diag(covariance))
            worst, circle_mm = worst_of({c: own for c, own in forecast.circle_sigma_mm.items() if c.face == face})
            rows = sigma[3:].tolist(), np.degrees(sigma[:3]).tolist(), MICRO * position_mm[face]
            faces[face] = FaceForecast(*rows, worst, MICRO * circle_mm, shares[face])
        name, sigma_mm = worst_of(position_mm)
        scale_ppm = PPM * forecast.scale_sigma
        return cls(worst_face=name, worst_sigma_um=MICRO * sigma_mm, scale_sigma_ppm=scale_ppm, faces=faces)

    def table(self) -> list[str]:
        rows = [["<face", "σ x, µm", "y", "z", "all", "σ about x, mdeg", "y", "z", "<worst point", "µm", "<variance"]]
        for face, row in self.faces.items():
            shares = sorted(row.variance_shares.items(), key=lambda item: -item[1])
            said = [f"{name.removeprefix('image ')} {100 * own:.0f} %" for name, own in shares if own > LEAST_SHARE]
            sigma = [*row.translation_sigma_um, row.position_sigma_um, *row.rotation_sigma_mdeg]
            worst = [row.worst_circle, number(row.worst_circle_sigma_um, 2)]
            rows.append([face, *(number(s, 2) for s in sigma), *worst, join(said)])
        return text_table(rows)


FORECAST = (
    "`worst_face`, whose position is known worst, and its `worst_sigma_um`; `scale_sigma_ppm` of the target's size; and"
)


class PlanFile(ResultFile):
    """The JSON file of ``plan``: the planned photographs, the forecast, and what would help."""

    format: Literal["stcal plan 1"] = Field(description="the file's form and its version")
    images_per_group: int = Field(description="photographs")
    groups: tuple[str, ...] = Field(description="names")
    spread_deg: float = Field(description="± about the view that shows both faces equally")
    distance_mm: float = Field(description="of the camera")
    reference_face: str = Field(description="face id")
    observations: int = Field(description="centres in all images")
    centre_sigma_px: float = Field(description="their RMS σ per axis")
    aperture_mm: float = Field(
        description="widest aperture, focal length / f-number, up to which depth of field moves no centre by more than "
        "its σ"
    )
    forecast: ForecastPart = Field(description=FORECAST)
    remedies: tuple[Remedy, ...] = Field(
        description="`what` could be changed, `sigma_mm` of the worst face after that, null where it is not possible "
        "for `reason`"
    )

    @classmethod
    def of_plan(cls, plan: Plan) -> "PlanFile":
        return cls(
            format="stcal plan 1",
            images_per_group=plan.options.images,
            groups=plan.groups,
            spread_deg=plan.options.spread_deg,
            distance_mm=plan.options.distance_mm,
            reference_face=plan.setup.start.reference_face,
            observations=plan.observations,
            centre_sigma_px=plan.centre_sigma_px,
            aperture_mm=plan.aperture_mm,
            forecast=ForecastPart.of(plan.forecast, plan.shares),
            remedies=plan.remedies,
        )


class ViewRow(Part):
    group: str
    middle: str
    azimuth_deg: float
    elevation_deg: float
    roll_deg: float
    distance_mm: float
    tilts_deg: dict[str, float]
    nearest: str
    nearest_deg: float
    camera_from_target: Pose
    labels: list[str]


class ChoiceRow(Part):
    view: ViewRow = Field(
        description="`group`; `middle`, the photograph in the middle of the group's views; `azimuth_deg` to the right "
        "and `elevation_deg` up from there as that photograph shows them (longitude and latitude about the middle of "
        "board and faces), `roll_deg` of the camera about its axis, `distance_mm` to that middle; `tilts_deg` by face "
        "and `board`, between normal and line of sight; `nearest` photograph and `nearest_deg` to it; "
        "`camera_from_target` 4×4; `labels` in view"
    )
    face: str
    sigma_mm: float


class AdviceFile(ResultFile):
    """The JSON file of ``advise``: the present forecast, and further photographs."""

    format: Literal["stcal advice 1"] = Field(description="the file's form and its version")
    now: ForecastPart = Field(description=FORECAST)
    choices: list[ChoiceRow] = Field(
        description="further photographs, one after the other: `view`, and the worst `face` with its `sigma_mm` with "
        "this view and those before"
    )
    new_groups: tuple[NewGroup, ...] = Field(
        description="pairs of `faces` that no group shows together, the best first: the worst `face` and its "
        "`sigma_mm` with `images` of them and the board"
    )
    board_dominates: bool = Field(
        description="more than half of the worst face's variance is the board's: more views help little"
    )
    half_board_sigma_um: float = Field(description="of the worst face with half the board's σ and no further view")
    tried: int = Field(description="views that were compared")

    @classmethod
    def of_advice(cls, advice: Advice) -> "AdviceFile":
        return cls(
            format="stcal advice 1",
            now=ForecastPart.of(advice.now, advice.shares),
            choices=[ChoiceRow.model_validate(choice) for choice in advice.choices],
            new_groups=advice.new_groups,
            board_dominates=advice.board_dominates,
            half_board_sigma_um=MICRO * advice.better_board.worst()[1],
            tried=advice.tried,
        )


def plan_text(plan: Plan, noise: str) -> str:
    """Returns the forecast as a table. ``noise`` : where the σ of the centres comes from."""
    options, board, now = plan.options, plan.setup.board, ForecastPart.of(plan.forecast, plan.shares)
    remedies: list[list[str]] = [["<what would help", "worst face, µm", "<"]]
    for remedy in sorted(plan.remedies, key=lambda each: each.sigma_mm or np.inf):
        told = f"not possible, {remedy.reason.partition('; ')[0]}"
        if remedy.sigma_mm is not None:
            told = f"{100 * (MICRO * remedy.sigma_mm / now.worst_sigma_um - 1):+.0f} %"
        remedies.append([remedy.what, number(remedy.sigma_mm and MICRO * remedy.sigma_mm, 2), told])
    lens = f"f/{USUAL_FOCAL_MM / plan.aperture_mm:.1f} of a {USUAL_FOCAL_MM:g} mm lens"
    lines = [
        _photographs_said(plan),
        f"{plan.observations} {'centres' if board.rows else 'corners'}, σ {plan.centre_sigma_px:.4f} px RMS: {noise}",
        *now.table(),
        f"scale: σ {now.scale_sigma_ppm:.1f} ppm; worst is face {now.worst_face}, {now.worst_sigma_um:.2f} µm, against "
        f"face {plan.setup.start.reference_face}",
        "",
        *text_table(remedies),
        "in focus at the middle of each image, depth of field moves no centre by more than its σ up to an aperture "
        f"{plan.aperture_mm:.2g} mm across ({'focal length / f-number' if options.camera else lens}), and up to one "
        "2.8 times as wide from twice as far; what it moves is corrected to about 15 %",
    ]
    if assumed := [face.id for face in plan.setup.target.faces if face.outline_mm is None]:
        lines.append(
            f"plates of {', '.join(assumed)} are assumed to end {options.margin_mm:g} mm beyond their circles "
            "(--margin-mm, or outline_mm in target.toml)"
        )
    if board.rows:
        lines.append("the random places of board and cameras (--seed) change it by about ±3 %")
    else:
        lines += filter(None, [plan.hardly_seen])
        lines.append("which faces the photographs happen to show together (--seed) changes it: compare two seeds")
    return "\n".join(lines)


def _photographs_said(plan: Plan) -> str:
    options, camera, board = plan.options, plan.setup.camera, plan.setup.board
    size = f"{camera.width}×{camera.height} px, {options.distance_mm:g} mm away"
    if not board.rows:
        faces = faces_of_known_shape(board)
        prints = sorted({MICRO * (face.sigma_mm or 0.0) for face in faces})
        ends = " to ".join(dict.fromkeys(f"{each:g}" for each in (prints[0], prints[-1])))
        found = "found from them" if options.camera is None else "of the file"
        return (
            f"{options.images} images, {size}, of a body in random poses that show two or more of {len(faces)} faces; "
            f"camera {found}, σ of print {ends} µm"
        )
    boards = "the same board in all groups" if options.one_board else "a board of its own in each group"
    return (
        f"groups {', '.join(plan.groups)}, {options.images} images each, {size}, spread ±{options.spread_deg:g}°; "
        f"{boards}, σ {MICRO * board.sigma_mm:g} µm"
    )


HOW_TO_GO = (
    "go right and up as seen in the photograph named, about the middle of board and faces, which is to be in the "
    "middle of the image, mm away; degrees of board and faces are from their normal. If board or target have been "
    "moved since, photograph a new group"
)
HOW_TO_TURN = (
    "go right and up as seen in the photograph named, about the middle of the body, or turn the body the other way; it "
    "must be in the middle of the image, mm away; degrees of faces are from their normal"
)


def advice_text(advice: Advice) -> str:
    """Returns what to photograph next, as a table that a photographer can follow."""
    now, better_um = ForecastPart.of(advice.now, advice.shares), MICRO * advice.better_board.worst()[1]
    lines = [*now.table(), f"worst is face {now.worst_face}, {now.worst_sigma_um:.2f} µm"]
    if advice.board_dominates:
        lines.append(
            f"{100 * advice.shares[now.worst_face]['board']:.0f} % of its variance comes from the board: further views "
            f"will help little; with a board of half the σ: {better_um:.2f} µm"
        )
    lines += ["", f"further views, one after the other, the best of {advice.tried}:"]
    lines += text_table([["<group", "<from", "<go", "mm", "<sees", "<nearest", "<worst face, µm"], *_views(advice)])
    if not advice.choices:
        lines.append("none: no other view within ±50° shows the whole board and a face")
    lines.append(HOW_TO_GO if advice.has_board else HOW_TO_TURN)
    ways = [(better_um, "a board of half the σ" if advice.has_board else "print and size of half the σ")]
    if count := len(advice.choices):
        ways.append(
            (MICRO * advice.choices[-1].sigma_mm, f"the {count} views together" if count > 1 else "the one view")
        )
    for pair in advice.new_groups:
        words = f"{pair.images} images of faces {join(pair.faces)} with the board next to them, a new group"
        ways.append((MICRO * pair.sigma_mm, words))
    rows = [["<worst face afterwards, the best first", "µm"], *([words, number(um, 2)] for um, words in sorted(ways))]
    return "\n".join([*lines, "", *text_table(rows)])


def _views(advice: Advice) -> Iterator[list[str]]:
    face, sigma = advice.now.worst()
    for choice in advice.choices:
        view = choice.view
        turns = ((view.azimuth_deg, ("right", "left")), (view.elevation_deg, ("up", "down")))
        parts = [f"{abs(angle):g}° {names[angle < 0]}" for angle, names in turns if angle]
        go = ", ".join([*parts, *(["camera on end"] if view.roll_deg else [])]) or "the same place"
        sees = join(f"{'' if key == 'board' else 'face '}{key} {tilt:.0f}°" for key, tilt in view.tilts_deg.items())
        change = f"{face}: {MICRO * sigma:.2f} → {choice.face}: {MICRO * choice.sigma_mm:.2f}"
        nearest = f"{view.nearest} {view.nearest_deg:.0f}°"
        yield [view.group, view.middle, go, f"{view.distance_mm:.0f}", sees, nearest, change]
        face, sigma = choice.face, choice.sigma_mm
