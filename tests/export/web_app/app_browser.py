"""The app's folder on a local server, and a Chromium whose camera is a film; both tell what was asked for."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

_SWITCHES = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-features=OptimizationHints,MediaRouter,Translate",
    "--autoplay-policy=no-user-gesture-required",
)
_ISOLATED = {"Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp"}


@dataclass
class Server:
    """A running server.

    Args:
        url: of its root.
        requests: method and path, or for a proxy the address, of each request.
    """

    url: str
    requests: list[tuple[str, str]] = field(default_factory=list)


@contextmanager
def _running(handler: type[BaseHTTPRequestHandler] | partial[BaseHTTPRequestHandler]) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def static_host(folder: Path, isolated: bool = False) -> Iterator[Server]:
    """Serves a folder as any static host would; ``isolated`` with the headers that threads need."""
    found = Server("")

    class Handler(SimpleHTTPRequestHandler):
        def parse_request(self) -> bool:
            parsed = super().parse_request()
            if parsed:
                found.requests.append((self.command, self.path))
            return parsed

        def end_headers(self) -> None:
            for name, value in (_ISOLATED if isolated else {}).items():
                self.send_header(name, value)
            super().end_headers()

        def log_message(self, *words: object) -> None:
            pass

    with _running(partial(Handler, directory=str(folder))) as url:
        found.url = url
        yield found


@contextmanager
def elsewhere() -> Iterator[Server]:
    """A proxy to the rest of the world that notes what is asked of it and answers nothing of it."""
    found = Server("")

    class Handler(BaseHTTPRequestHandler):
        def parse_request(self) -> bool:
            if super().parse_request():
                found.requests.append((self.command, self.path))
                self.send_response(204)
                self.send_header("Access-Control-Allow-Origin", "*")
                self.end_headers()
            return False

        def log_message(self, *words: object) -> None:
            pass

    with _running(Handler) as url:
        found.url = url
        yield found


@contextmanager
def chromium(profile: Path, *switches: str, size: tuple[int, int] = (800, 700)) -> Iterator[Any]:
    """A driver of Debian's Chromium; skips visibly where it is not installed."""
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
    running.set_script_timeout(60)
    try:
        yield running
    finally:
        running.quit()


def film_camera(film: Path) -> tuple[str, ...]:
    """The switches by which Chromium's camera plays a film."""
    return ("--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={film}")


def until(found: Callable[[], Any], seconds: float = 90.0) -> Any:
    """Waits for something true, and returns it."""
    end = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < end, "the page did not get there in time"
        time.sleep(0.05)
    return value


class Page:
    """The open app, as a user sees it."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def text(self, name: str) -> str:
        """What an element shows."""
        return self.driver.execute_script("return document.getElementById(arguments[0]).innerText", name)

    @property
    def problem(self) -> str:
        """What the page complains of; empty while it does not."""
        script = "const p = document.getElementById('problem'); return p.hidden ? '' : p.firstElementChild.innerText"
        return self.driver.execute_script(script)

    def click(self, name: str) -> None:
        """Presses a button once it can be pressed."""
        button = self.driver.find_element("id", name)
        until(button.is_enabled)
        button.click()

    def start(self) -> None:
        """Starts the camera, if it does not run, and waits for the first answer."""
        if self.text("start") == "Start camera":
            self.click("start")
        until(lambda: self.text("status").startswith(("Your face", "No face")) or self.problem)
        assert not self.problem, self.problem

    def stop(self) -> None:
        """Stops the camera."""
        self.click("start")
        until(lambda: self.text("start") == "Start camera")
