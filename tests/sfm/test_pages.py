"""The page of every command that writes one, in a browser: no wider than its window, a quiet console, the answer."""

import pytest

from tests.commands import CALLS, Call
from tests.fuzzing.judged import OUT, in_process, lay_out
from tests.report.browser import faults, opened, show, sideways_px

PAGES = {call.command: call for call in reversed(CALLS) if ">page.html" in call.words}
WITHOUT_ANSWER = {"robot axes", "robot evaluate", "robot verify", "robot design"}
"""What they print is not used as a whole: each row has a verdict of its own, or none."""


@pytest.fixture(scope="module")
def chrome():
    with opened() as browser:
        yield browser


@pytest.mark.slow
@pytest.mark.parametrize("call", PAGES.values(), ids=PAGES)
def test_a_page_fits_a_phone_and_a_screen(chrome, stock, tmp_path, call: Call):
    lay_out(stock, tmp_path / "case", call, earlier=False)
    outcome = in_process(call, "stcal", tmp_path / "case")
    assert outcome.code == call.code, outcome
    for theme in ("light", "dark"):
        chrome.execute_cdp_cmd(
            "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": theme}]}
        )
        for width in (420, 1280):
            show(chrome, tmp_path / "case" / OUT / "page.html", width)
            assert (sideways_px(chrome), faults(chrome)) == (0, [])
    head = chrome.execute_script("return document.body.innerText.split('\\n\\n').slice(0, 4).join(' ')")
    assert ("use it?" in head or "used?" in head) != (call.command in WITHOUT_ANSWER), head
