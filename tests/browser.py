"""A real browser without a window, for the pages that jaxro makes."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

QUIET = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
"""It opens files and asks the network for nothing."""


@contextmanager
def browser(width: int = 1000) -> Iterator:
    """A driver of Chromium. Skips the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver")
    driver = shutil.which("chromedriver")
    if driver is None or not any(map(shutil.which, ("chromium", "google-chrome"))):
        pytest.skip("no Chromium with its chromedriver")
    options = webdriver.ChromeOptions()
    for flag in (*QUIET, f"--window-size={width},900"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    from selenium.webdriver.chrome.service import Service

    started = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield started
    finally:
        started.quit()


def open_page(driver, file: Path) -> None:
    driver.get(file.absolute().as_uri())


def column(driver, table: str, number: int) -> list[str]:
    """The texts of the shown cells of a column."""
    script = (
        "const rows = document.querySelector(arguments[0]).tBodies[0].rows;"
        "return Array.from(rows).filter(row => row.offsetParent !== null)"
        ".map(row => row.cells[arguments[1]].textContent);"
    )
    return driver.execute_script(script, table, number)


def errors(driver) -> list[dict]:
    """What the console of the browser says."""
    return driver.get_log("browser")
