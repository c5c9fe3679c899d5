"""The app's folder on a local server, and its page in a Chromium whose camera is a film."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from headless_chromium import until

WINDOW = (480, 360)
_ISOLATED = {"Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp"}


@dataclass
class Server:
    """A running server."""

    url: str  # of its root
    # method and path, or for a proxy the address, of each request
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


def film_camera(film: Path) -> tuple[str, ...]:
    """The switches by which Chromium's camera plays a film."""
    return ("--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={film}")


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
        until(lambda: self.text("status").startswith(("Your face", "No face", "Learning")) or self.problem)
        assert not self.problem, self.problem

    @property
    def recorded_frames(self) -> int:
        """How many frames the page says that it has recorded."""
        return int(self.text("recorded").split()[2])

    @contextmanager
    def held_pictures(self) -> Iterator[None]:
        """Lets no picture through to the page's worker."""
        self.driver.execute_script("watched.held = []")
        try:
            yield
        finally:
            self.let_pictures_go()

    def let_pictures_go(self) -> None:
        """Lets those through that were held, and all that come."""
        self.driver.execute_script("const held = watched.held ?? []; watched.held = null; held.forEach(go => go())")

    def stop(self) -> None:
        """Stops the camera."""
        self.click("start")
        until(lambda: self.text("start") == "Start camera")


@dataclass
class Open:
    """An open app, its host, and what it asks of the rest of the world."""

    page: Page
    host: Server
    outside: Server
