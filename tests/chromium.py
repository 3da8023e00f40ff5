"""A browser without a window, for tests and for pictures of pages."""

import contextlib
import shutil

import pytest

PROGRAMS = ("chromium", "chromedriver")


@contextlib.contextmanager
def browsing(width=1700, height=1500, options=()):
    """Yield a browser with a window of some size in pixels; a test is skipped where there is none.

    `options` are further options of the command line of chromium.
    """
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    if not all(map(shutil.which, PROGRAMS)):
        pytest.skip("Debian's chromium and chromium-driver are not installed")
    from selenium.webdriver.chrome.service import Service

    chosen = webdriver.ChromeOptions()
    chosen.binary_location = shutil.which("chromium")
    chosen.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for word in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        f"--window-size={width},{height}",
        *options,
    ):
        chosen.add_argument(word)
    browser = webdriver.Chrome(options=chosen, service=Service(shutil.which("chromedriver")))
    try:
        yield browser
    finally:
        browser.quit()
