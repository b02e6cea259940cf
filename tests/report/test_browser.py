"""The page of a run in a browser: nothing in the console, turned, sorted, and narrow."""

import io

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By

from stcal.sfm.report.run_page import report_html
from tests.report.browser import faults, opened, show
from tests.sfm.report.test_report import by_image, make

NAMES = ["a/9.jpg", "a/10.jpg", "a/1.jpg"]
RMS = [0.02, 0.004, 0.1]


def jpeg() -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (648, 432), "navy").save(stream, "JPEG")
    return stream.getvalue()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Of a run of three images with residuals."""
    report = make()
    report["images"] = [{"image_id": i, "name": n, "group": "a", "circles": 12} for i, n in enumerate(NAMES, 1)]
    report["residuals_by_image"] = [by_image(n) | {"rms_px": r} for n, r in zip(NAMES, RMS, strict=True)]
    centres = np.random.default_rng(1).uniform((0, 0), (2592, 1728), (12, 2))
    residuals = {name: np.column_stack([centres, np.full((12, 2), 0.01), np.ones((12, 2))]) for name in NAMES}
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(report_html(report, dict.fromkeys(NAMES, jpeg()), residuals), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def chrome():
    with opened() as browser:
        yield browser


@pytest.fixture
def opened_page(chrome, page):
    show(chrome, page)
    yield chrome
    assert faults(chrome) == []


def picture(chrome) -> str:
    return chrome.execute_script("return document.querySelector('.turn canvas').toDataURL()")


@pytest.mark.slow
def test_the_scene_turns(opened_page):
    canvas = opened_page.find_element(By.CSS_SELECTOR, ".turn canvas")
    opened_page.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    before = picture(opened_page)
    ActionChains(opened_page).move_to_element(canvas).click_and_hold().move_by_offset(80, 30).release().perform()
    turned = picture(opened_page)
    assert turned != before
    opened_page.find_element(By.CSS_SELECTOR, ".turn button[value=all]").click()
    assert picture(opened_page) not in (before, turned)
    opened_page.find_element(By.CSS_SELECTOR, ".turn button[value=target]").click()
    assert picture(opened_page) == before


def test_something_is_drawn(opened_page):
    """Beside the empty canvas: of the scene's colours each."""
    opened_page.find_element(By.CSS_SELECTOR, ".turn button[value=all]").click()
    drawn = opened_page.execute_script(
        "const c = document.querySelector('.turn canvas');"
        "const p = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, found = new Set();"
        "for (let i = 0; i < p.length; i += 4) if (p[i + 3] == 255) found.add(p[i] + ' ' + p[i + 1] + ' ' + p[i + 2]);"
        "return [...found];"
    )
    colours = np.array([pixel.split() for pixel in drawn], int)
    axes_and_group = [(193, 39, 45), (46, 139, 61), (36, 87, 168), (0, 114, 178), (0, 0, 0)]
    off = [np.abs(colours - colour).max(1).min() for colour in axes_and_group]
    assert max(off) < 51  # a pixel of a line thinner than two of them is its colour by four fifths


def press(chrome, table: str, index: int) -> str:
    """Click on a heading; what it says of the order."""
    head = chrome.find_elements(By.CSS_SELECTOR, f"{table} thead tr:last-child th")[index]
    chrome.execute_script("arguments[0].scrollIntoView({block: 'center'})", head)
    head.find_element(By.TAG_NAME, "button").click()
    return head.get_attribute("aria-sort")


def images(chrome) -> list[str]:
    rows = chrome.find_elements(By.CSS_SELECTOR, "#residuals > .scroll tbody tr")
    return [row.find_element(By.CSS_SELECTOR, "td").text for row in rows]


@pytest.mark.slow
def test_tables_sort_at_a_click(opened_page):
    table = "#residuals > .scroll"
    assert images(opened_page) == NAMES
    assert press(opened_page, table, 4) == "ascending"  # RMS
    assert images(opened_page) == ["a/10.jpg", "a/9.jpg", "a/1.jpg"]
    assert press(opened_page, table, 4) == "descending"
    assert images(opened_page) == ["a/1.jpg", "a/9.jpg", "a/10.jpg"]
    assert press(opened_page, table, 1) == "ascending"  # names, numbers in them by value
    assert images(opened_page) == ["a/1.jpg", "a/9.jpg", "a/10.jpg"]
    sorted_by = opened_page.find_elements(By.CSS_SELECTOR, f"{table} [aria-sort]:not([aria-sort=none])")
    assert [head.text.split()[0] for head in sorted_by] == ["Image"]
    press(opened_page, table, 1)
    assert press(opened_page, table, 1) == "none"
    assert images(opened_page) == NAMES


def test_vectors_stand_where_the_circles_are(opened_page):
    """The first centre of the image, through the browser's own transform of the drawing."""
    opened_page.find_element(By.CSS_SELECTOR, "#photo-0 .open").click()
    x, y = opened_page.execute_script(
        "const path = document.querySelector('#photo-0 .vectors path'), p = path.getPointAtLength(0);"
        "const s = p.matrixTransform(path.getScreenCTM()); return [s.x, s.y];"
    )
    photo = opened_page.find_element(By.CSS_SELECTOR, "#photo-0 img").rect
    top = opened_page.execute_script("return window.scrollY")
    centre = np.random.default_rng(1).uniform((0, 0), (2592, 1728), (12, 2))[0]
    scale = photo["width"] / 2592
    assert x == pytest.approx(photo["x"] + scale * (centre[0] + 0.5), abs=0.1)
    assert y == pytest.approx(photo["y"] - top + scale * (centre[1] + 0.5), abs=0.5)
