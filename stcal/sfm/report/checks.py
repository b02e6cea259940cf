"""The report's section on the checks that residuals cannot fake."""

from html import escape

from stcal.report.page import NONE, Html, fold, number, table

COLOURS = {"passed": "#1b7837", "suspicious": "#b26a00", "failed": "#b3261e", "not possible": "#556270"}
ORDER = ("failed", "suspicious", "passed", "not possible")
FIRST_NAMES = 6
"""Names that a row has room for."""


def count_verdicts(verdicts: list[str]) -> str:
    """``2 failed, 13 passed``: the worst first."""
    return ", ".join(f"{verdicts.count(v)} {v}" for v in ORDER if v in verdicts) or "none"


def checks_section(checks: list[dict]) -> str:
    """HTML of ``report.json``'s ``checks``."""
    ranked = sorted(checks, key=lambda check: ORDER.index(check["verdict"]))
    rows = [
        [check["title"], _verdict(check["verdict"]), *_value(check), _names(check), check["reason"], check["remedy"]]
        for check in ranked
    ]
    columns = ["<Check", "<Verdict", "Value", "Limit", "<Named", "<Found", "<What to do"]
    detail = [
        [check["title"], m["name"], *_number(m), NONE if m["probability"] is None else f"{m['probability']:.1g}"]
        for check in ranked
        for m in check["measured"]
    ]
    heads = ["<Check", "<What", "Value", "Limit", "Probability by chance"]
    return (
        f"<p><strong>{escape(count_verdicts([check['verdict'] for check in checks]))}.</strong> Each check tests what "
        "small residuals do not prove. Suspicious is what happens by chance in one run of a thousand, failed in one of "
        "a hundred thousand, however many images or circles were tested.</p>\n"
        f"{table(columns, rows, css='text')}{fold('What was measured', table(heads, detail, css='text'))}"
    )


def _verdict(verdict: str) -> Html:
    return Html(f'<strong style="color:{COLOURS[verdict]}">{escape(verdict)}</strong>')


def _value(check: dict) -> list[str]:
    return _number(check["measured"][0]) if check["measured"] else [NONE, NONE]


def _number(measured: dict) -> list[str]:
    """Value and limit with their unit."""
    unit = f" {measured['unit']}" if measured["unit"] else ""
    return [_short(measured["value"]) + unit, NONE if measured["limit"] is None else _short(measured["limit"]) + unit]


def _short(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}" if 1e-4 < abs(value) < 1e3 else number(value, 0) if abs(value) >= 1e3 else f"{value:.2g}"


def _names(check: dict) -> str:
    names = check["names"]
    more = f" and {len(names) - FIRST_NAMES} more" if len(names) > FIRST_NAMES else ""
    return ", ".join(names[:FIRST_NAMES]) + more if names else NONE
