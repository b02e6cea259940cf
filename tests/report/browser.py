"""A page in headless Chromium; tests that need one are skipped where there is none."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service

BROWSERS = "chromium", "chromium-browser", "google-chrome", "chrome"


@contextmanager
def opened(width: int = 1280, height: int = 900) -> Iterator[Chrome]:
    """A browser whose pages are so large, CSS px, without network."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("no Chromium with its driver on the PATH")
    options = ChromeOptions()
    options.binary_location = browser
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"):
        options.add_argument(word)
    chrome = Chrome(options=options, service=Service(driver))
    try:
        chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics(width, height))
        yield chrome
    finally:
        chrome.quit()


def metrics(width: int, height: int) -> dict:
    """Of a screen, for Chromium's protocol."""
    return {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}


def show(chrome: Chrome, page: Path, width: int = 1280, height: int = 900) -> None:
    chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics(width, height))
    chrome.get(page.resolve().as_uri())


def faults(chrome: Chrome) -> list[str]:
    """What the console says since it was asked last."""
    return [entry["message"] for entry in chrome.get_log("browser")]


def sideways_px(chrome: Chrome) -> int:
    """By how much the page is wider than its window."""
    return chrome.execute_script("const e = document.documentElement; return e.scrollWidth - e.clientWidth")
