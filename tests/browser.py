"""Headless Chromium for the tests of pages: what a page shows, says in its console, and asks the
network for."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

FLAGS = (
    *(
        "--headless=new",
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
    ),
    *(
        "--disable-component-update",
        "--disable-sync",
        "--force-device-scale-factor=1",
        "--window-size=1400,1000",
    ),
)


@contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """A driver of a new browser; the test is skipped where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    browser = shutil.which("chromium")
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("needs Debian's packages chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with tempfile.TemporaryDirectory(
        prefix="jaxba-chromium-", ignore_cleanup_errors=True
    ) as profile:
        for flag in (*FLAGS, *flags, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        try:
            yield page
        finally:
            page.quit()


def complaints(page: Any) -> list[str]:
    """What the console said since the last call."""
    return [entry["message"] for entry in page.get_log("browser")]


def requests(page: Any) -> list[str]:
    """Addresses that were asked for since the last call, but those of this page's own files and of
    its own text."""
    messages = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    asked = [
        m["params"]["request"]["url"]
        for m in messages
        if m["method"] == "Network.requestWillBeSent"
    ]
    return [
        url for url in asked if not url.startswith(("file:", "data:", "blob:", "about:", "chrome:"))
    ]
