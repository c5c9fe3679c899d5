"""Debian's Chromium without a window or a graphics card, and how a test waits for its page."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_SWITCHES = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader-webgl",  # for WebGL alone: so are pages drawn where there is no graphics card
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-features=OptimizationHints,MediaRouter,Translate",
    "--autoplay-policy=no-user-gesture-required",
)
_LIMIT = 300.0
"""Seconds after which a page hangs: a slow machine beside other tests needs many times what a quiet one does."""
_SCRIPT_LIMIT = 100.0  # seconds; the driver's own connection ends after 120


@contextmanager
def headless_chromium(profile: Path, *switches: str, size: tuple[int, int]) -> Iterator[Any]:
    """A driver of Chromium with a window of so many pixels; skips visibly where it is not installed."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("chromium or chromedriver not found; on Debian: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    own = (f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}")
    for switch in (*_SWITCHES, *own, *switches):
        options.add_argument(switch)
    service = webdriver.ChromeService(executable_path=driver, env={**os.environ, "SE_OFFLINE": "true"})
    running = webdriver.Chrome(options=options, service=service)
    running.set_script_timeout(_SCRIPT_LIMIT)
    try:
        yield running
    finally:
        running.quit()


def until(found: Callable[[], Any], seconds: float = _LIMIT) -> Any:
    """Waits for something true, and returns it."""
    end = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < end, "the page did not get there in time"
        time.sleep(0.05)
    return value
