"""Results of ``plan`` and ``advise`` as text for people."""

from stcal.sfm.planning.advise import Advice
from stcal.sfm.planning.file import MICRO, PPM, ForecastPart
from stcal.sfm.planning.forecast import Forecast
from stcal.sfm.planning.session import Plan
from stcal.sfm.planning.views import PlannedView


def forecast_table(forecast: Forecast, shares: dict[str, dict[str, float]]) -> list[str]:
    """Returns one line for each face, in 80 columns if names are short."""
    rows = ForecastPart.of(forecast, shares).faces
    circles = {face: f"{row.worst_circle} {row.worst_circle_sigma_um:.2f}" for face, row in rows.items()}
    wide, worst = max([4, *map(len, rows)]), max([8, *map(len, circles.values())])
    axes = " ".join(f"{name:>5}" for name in ("x", "y", "z", "all", "x", "y", "z"))
    lines = [
        f"{'face':>{wide}} {'σ position µm':^23} {'σ rotation mdeg':^17}  {'circle':<{worst}}  share of",
        f"{'':>{wide}} {axes}  {'worst µm':<{worst}}  variance",
    ]
    for face, row in rows.items():
        position = " ".join(f"{s:5.2f}" for s in [*row.translation_sigma_um, row.position_sigma_um])
        rotation = " ".join(f"{s:5.2f}" for s in row.rotation_sigma_mdeg)
        shares_text = _shares_text(row.variance_shares)
        lines.append(f"{face:>{wide}} {position} {rotation}  {circles[face]:<{worst}}  {shares_text}")
    return lines


def _shares_text(shares: dict[str, float]) -> str:
    """Returns the shares as a text, the largest first."""
    ordered = sorted(shares.items(), key=lambda each: -each[1])
    return ", ".join(f"{source.removeprefix('image ')} {100 * max(share, 0.0):.0f} %" for source, share in ordered)


def plan_text(plan: Plan, noise: str) -> str:
    """Returns the forecast as a table. ``noise`` : where the σ of the centres comes from."""
    camera, options = plan.setup.camera, plan.options
    boards = "the same board in all groups" if options.one_board else "a board of its own in each group"
    worst, sigma = plan.forecast.worst()
    lines = [
        f"groups {', '.join(plan.groups)}, {options.images} images each, {camera.width}×{camera.height} px, "
        f"{options.distance_mm:g} mm away, spread ±{options.spread_deg:g}°; {boards}, σ "
        f"{MICRO * plan.setup.board.sigma_mm:g} µm",
        f"{plan.observations} centres, σ {plan.centre_sigma_px:.4f} px RMS: {noise}",
        *forecast_table(plan.forecast, plan.shares),
        f"scale: σ {PPM * plan.forecast.scale_sigma:.1f} ppm; worst is face {worst}, {MICRO * sigma:.2f} µm, against "
        f"face {plan.setup.start.reference_face}",
        "",
        f"{'what would help':<28} worst face µm",
    ]
    reachable = [(r.sigma_mm, r.what) for r in plan.remedies if r.sigma_mm is not None]
    for worst_mm, change in sorted(reachable, key=lambda each: each[0]):
        lines.append(f"{change:<28} {MICRO * worst_mm:6.2f}   {100 * (worst_mm / sigma - 1):+.0f} %")
    lines += [f"{r.what:<28}      –   {r.reason}" for r in plan.remedies if r.sigma_mm is None]
    lines.append("where board and cameras happen to stand (--seed) makes about ±3 %")
    return "\n".join(lines)


def advice_text(advice: Advice) -> str:
    """Returns what to photograph next, as a table that a photographer can follow."""
    worst, sigma = advice.now.worst()
    lines = [*forecast_table(advice.now, advice.shares), f"worst is face {worst}, {MICRO * sigma:.2f} µm"]
    if advice.board_dominates:
        lines.append(
            f"{100 * advice.shares[worst]['board']:.0f} % of its variance is the board's: further views will help "
            f"little; with a board of half the σ: {MICRO * advice.better_board.worst()[1]:.2f} µm"
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
    lines += [
        "go right and up as seen in the photograph named, about the middle of board and faces, which is to be in the",
        "middle of the image, mm away; degrees of board and faces are from their normal. If board or target have",
        "been moved since, photograph a new group.",
    ]
    if advice.new_groups:
        lines += ["", "faces not photographed together yet, with the board beside them, as a new group:"]
        for pair in advice.new_groups:
            lines.append(
                f"  faces {pair.faces[0]} and {pair.faces[1]}, {pair.images} images: worst is face {pair.face}, "
                f"{MICRO * sigma:.2f} → {MICRO * pair.sigma_mm:.2f} µm"
            )
    return "\n".join([*lines, "", _verdict(advice)])


def next_text(advice: Advice) -> str:
    """Returns the first view of :func:`advice_text` in one line."""
    if not advice.choices:
        return "no other view within ±50° shows the whole board and a face"
    choice = advice.choices[0]
    return (
        f"group {choice.view.group}, from {choice.view.middle} {where(choice.view)}, {choice.view.distance_mm:.0f} mm: "
        f"worst face {MICRO * advice.now.worst()[1]:.2f} → {MICRO * choice.sigma_mm:.2f} µm"
    )


def where(view: PlannedView) -> str:
    """Returns the direction from the named photograph to the view, as seen in that photograph: ``25° right, 12°
    up``."""
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
    ways = [(board, "a board of half the σ")]
    if advice.choices:
        count = len(advice.choices)
        ways.append((advice.choices[-1].sigma_mm, f"the {count} views together" if count > 1 else "the one view"))
    if advice.new_groups:
        best = advice.new_groups[0]
        ways.append((best.sigma_mm, f"{best.images} images of faces {best.faces[0]} and {best.faces[1]}"))
    ways.sort()
    told = "; ".join(f"{MICRO * sigma:.2f} µm with {what}" for sigma, what in ways)
    return f"worst face afterwards, the best first: {told}"
