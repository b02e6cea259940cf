"""Section of the report on the checks that residuals cannot fake."""

from stcal.report.page import verdict
from stcal.report.text import NONE, number
from stcal.sfm.report.judgement import CHANCE

COLOURS = {"passed": "#1b7837", "suspicious": "#b26a00", "failed": "#b3261e", "not possible": "#556270"}
ORDER = ("failed", "suspicious", "passed", "not possible")
FIRST_NAMES = 6
"""Number of names that a row has room for."""


def count_verdicts(verdicts: list[str]) -> str:
    """Returns the number of checks with each verdict as ``2 failed, 13 passed``, the worst first."""
    return ", ".join(f"{verdicts.count(v)} {v}" for v in ORDER if v in verdicts) or "none"


def checks_values(checks: list[dict]) -> dict:
    """Returns the section ``checks`` of ``report.json`` as the template shows it."""
    ranked = sorted(checks, key=lambda check: ORDER.index(check["verdict"]))
    rows = [
        [
            check["title"],
            verdict(check["verdict"], COLOURS[check["verdict"]]),
            *(_number(check["measured"][0]) if check["measured"] else [NONE, NONE]),
            _names(check),
            check["reason"],
            check["remedy"],
        ]
        for check in ranked
    ]
    measured = [
        [check["title"], m["name"], *_number(m), NONE if m["probability"] is None else f"{m['probability']:.1g}"]
        for check in ranked
        for m in check["measured"]
    ]
    verdicts = count_verdicts([check["verdict"] for check in checks])
    return {"verdicts": verdicts, "check_rows": rows, "measured": measured, "chance": CHANCE}


def _number(measured: dict) -> list[str]:
    """Returns value and limit with their unit."""
    unit = f" {measured['unit']}" if measured["unit"] else ""
    return [_short(measured["value"]) + unit, NONE if measured["limit"] is None else _short(measured["limit"]) + unit]


def _short(value: float) -> str:
    """Returns the value with about three digits."""
    return f"{value:.3g}" if 1e-4 < abs(value) < 1e3 else number(value, 0) if abs(value) >= 1e3 else f"{value:.2g}"


def _names(check: dict) -> str:
    names = check["names"]
    surplus = f" and {len(names) - FIRST_NAMES} more" if len(names) > FIRST_NAMES else ""
    return ", ".join(names[:FIRST_NAMES]) + surplus if names else NONE
