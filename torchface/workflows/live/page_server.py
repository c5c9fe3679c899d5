"""Server of the live page on this machine: its files, its socket, and the stream view at an address of its own.

The page, the camera's pictures and the controls lie under a token that each start draws anew. The character, the stream
view and its socket, which shows frames and takes nothing, lie beside it at addresses that stay.
"""

import json
import logging
import mimetypes
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import unquote

import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from torchface.errors import TorchfaceError
from torchface.files.whole_files import read_file
from torchface.progress import Progress
from torchface.viz.browser.browser_page import HOST, free_port
from torchface.viz.browser.origin_check import is_allowed, without_token
from torchface.workflows.live.live_view import LiveView, TakeUpload

_LARGEST_MESSAGE = 2**16
_STATE_INTERVAL, _PICTURE_INTERVAL = 0.25, 1 / 15  # seconds
_WAIT, _PATIENCE = 0.25, 2.0  # seconds; a browser opens connections that it may never use
_HEADERS = {
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "Cache-Control": "no-store",
    "Connection": "close",
}
_ENGINE = b'data-engine="browser"', b'data-engine="server"'

Reply = Callable[[str], bytes]
"""The bytes of a file by its path behind a folder's address."""


class LiveDesk(Protocol):
    """What a page sees of a live session, and may ask of it; called from other threads than the session's."""

    def next_view(self, before: LiveView | None, seconds: float) -> LiveView | None:
        """The newest moment once there is another than ``before``; None where none came in time."""

    def state(self) -> dict[str, Any]:
        """What the page shows beside the frames."""

    def asked(self, message: Mapping[str, Any]) -> None:
        """Does what a page asks for."""

    def keep(self, name: str, rows: np.ndarray) -> None:
        """Keeps a take that a page has made or was given, rows (T,66) as of :func:`kept_takes.take_rows`."""

    def left(self) -> None:
        """The page was closed that has asked for a pose."""


class Preparing:
    """A session's desk before there is a session: the page says what is being made, with the steps of the program's
    progress."""

    def __init__(self, progress: Progress) -> None:
        self.wishes: dict[str, Any] = {}
        self.takes: list[tuple[str, np.ndarray]] = []
        self._progress, self._words = progress, ""
        self._step, self._began = "", 0.0

    def __call__(self, step: str, done: int = 0, total: int = 0) -> None:
        """Says a step, as ``Progress`` does."""
        if step != self._step:
            self._step, self._began = step, time.monotonic()
        waited = int(time.monotonic() - self._began)
        ready = f": {done} of {total} parts are ready" + (f" after {waited} s." if waited else ".") if total else "…"
        self._words = f"{step[:1].upper()}{step[1:]}{ready}"
        self._progress(step, done, total)

    def next_view(self, before: LiveView | None, seconds: float) -> None:
        """There is none yet."""
        time.sleep(seconds)

    def state(self) -> dict[str, Any]:
        """What the page shows."""
        waiting = "".join(f" {name}: kept as soon as torchface is ready." for name, _ in self.takes)
        return {"words": self._words + waiting}

    def asked(self, message: Mapping[str, Any]) -> None:
        """Keeps what the user set for the session, and nothing else."""
        self.wishes |= {key: message[key] for key in ("controls", "names") if key in message}

    def keep(self, name: str, rows: np.ndarray) -> None:
        """Holds a take for the session."""
        self.takes.append((name, rows))

    def hand_over(self, keep: Callable[[str, np.ndarray], None]) -> None:
        """Gives away the takes that it holds."""
        while self.takes:
            with suppress(TorchfaceError):  # which stands in the notes
                keep(*self.takes.pop(0))

    def left(self) -> None:
        """A page was closed."""


class PageServer:
    """Serves the page until it is stopped; ``takes`` gives the rows of a take by its name."""

    def __init__(self, folder: Path, character: Mapping[str, bytes], takes: Reply, desk: LiveDesk, port: int) -> None:
        self._folder, self._character, self._takes, self._desk = folder, character, takes, desk
        self._files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        self._token = secrets.token_urlsafe(12)
        self._keeping = threading.Lock()  # no take comes to a desk that has just been left
        self._stopped = threading.Event()
        self._senders = set[threading.Thread]()
        self._posing: ServerConnection | None = None
        logger = logging.getLogger(__name__)
        logger.setLevel(logging.CRITICAL + 1)  # browsers that hang up are no news
        self._server = serve(
            self._talk,
            HOST,
            free_port(HOST, port),
            process_request=self._answer,
            max_size=_LARGEST_MESSAGE,
            open_timeout=_PATIENCE,
            close_timeout=_PATIENCE,
            logger=logger,
            compression=None,
        )
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="torchface-page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.port}/{self._token}/"

    @property
    def stream_url(self) -> str:
        """The address of the stream view."""
        return f"http://{HOST}:{self.port}/stream"

    def attend(self, desk: LiveDesk) -> None:
        """Shows another desk from now on, which gets what was wished and dropped while it was prepared."""
        with self._keeping:
            before, self._desk = self._desk, desk
            if isinstance(before, Preparing):
                with suppress(TorchfaceError):  # which stands in the notes
                    desk.asked(before.wishes)
                before.hand_over(desk.keep)

    def stop(self) -> None:
        """Says to open pages that it has ended, and ends, once."""
        if self._stopped.is_set():
            return
        self._stopped.set()
        self._server.shutdown()
        self._thread.join(_PATIENCE)
        for sender in tuple(self._senders):  # the program may end right after, and its threads with it
            sender.join(_PATIENCE)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1 or not is_allowed(hosts[0], origins[0] if origins else None, self.port):
            return _response(HTTPStatus.FORBIDDEN, b"This page is for this machine's own browser alone.\n")
        path = request.path
        inside = without_token(path, self._token)
        private = inside is not None
        name = unquote((inside if inside is not None else path).partition("?")[0]).removeprefix("/")
        if name == "socket":
            return None
        if name in ("", "index.html") and not private:
            return _response(HTTPStatus.FORBIDDEN, b"Open the whole address that torchface has printed.\n")
        try:
            return self._file(name, private)
        except TorchfaceError as error:
            return _response(HTTPStatus.NOT_FOUND, str(error).encode())

    def _file(self, name: str, private: bool) -> Response:
        if name in ("", "index.html", "stream"):
            return _response(HTTPStatus.OK, read_file(self._folder / "index.html").replace(*_ENGINE), ".html")
        if name in self._character:
            return _response(HTTPStatus.OK, self._character[name], Path(name).suffix)
        if private and name.startswith("takes/"):
            return _response(HTTPStatus.OK, self._takes(name.removeprefix("takes/")), ".bin")
        if name in self._files:
            return _response(HTTPStatus.OK, read_file(self._folder / name), Path(name).suffix)
        return _response(HTTPStatus.NOT_FOUND, b"There is no such file.\n")

    def _talk(self, connection: ServerConnection) -> None:
        private = connection.request is not None and without_token(connection.request.path, self._token) is not None
        sender = threading.Thread(target=self._send, args=(connection, private), name="torchface-sender", daemon=True)
        self._senders.add(sender)
        sender.start()
        upload: TakeUpload | None = None
        try:
            for message in connection:
                if private:
                    upload = self._take(message, upload, connection)
        except ConnectionClosed:
            pass
        if self._posing is connection:
            self._posing = None
            self._desk.left()
        sender.join(2 * _WAIT)
        self._senders.discard(sender)

    def _take(self, message: str | bytes, upload: TakeUpload | None, page: ServerConnection) -> TakeUpload | None:
        """Does what a message of a page asks for; the take that it is still handing over."""
        try:
            if isinstance(message, bytes):
                if upload is not None and upload.is_whole_with(message):
                    with self._keeping:
                        self._desk.keep(upload.name, upload.rows())
                    return None
                return upload
            asked = json.loads(message)
            if isinstance(asked, dict) and "keep" in asked:
                return TakeUpload(str(asked["keep"]), asked.get("bytes"))
            if isinstance(asked, dict) and self._counts(asked, page):
                self._desk.asked(asked)
        except (TorchfaceError, ValueError, OSError, RecursionError):
            pass  # a message that is none; what went wrong with one that is stands in the notes
        return None

    def _counts(self, asked: dict[str, Any], page: ServerConnection) -> bool:
        """Whether what a page asks for counts: not its controls while another page has the person hold a pose."""
        controls = asked.get("controls")
        if isinstance(controls, dict) and isinstance(solver := controls.get("solver"), dict):
            if self._posing not in (None, page):
                return False
            self._posing = page if solver.get("pose") else None
        return True

    def _send(self, connection: ServerConnection, private: bool) -> None:
        shown: LiveView | None = None
        state_at = picture_at = float("-inf")
        said = ""
        try:
            while not self._stopped.is_set():
                view = self._desk.next_view(shown, _WAIT)
                if view is not None:
                    shown = view
                    connection.send(view.message())
                now = time.monotonic()
                if private and view is not None and view.picture.size and now - picture_at >= _PICTURE_INTERVAL:
                    picture_at = now
                    connection.send(view.picture_message())
                if private and now - state_at >= _STATE_INTERVAL:
                    state_at = now
                    state = json.dumps(self._desk.state())
                    if state != said:
                        connection.send(state)
                        said = state
            last = self._desk.state() if private else {}
            connection.send(json.dumps({**last, "ended": last.get("ended") or "torchface has ended."}))
            connection.close()
        except ConnectionClosed:
            pass


def _response(status: HTTPStatus, body: bytes, suffix: str = ".txt") -> Response:
    kinds = {
        ".js": "text/javascript",
        ".glb": "model/gltf-binary",
        ".bin": "application/octet-stream",
        ".wasm": "application/wasm",
    }
    kind = kinds.get(suffix) or mimetypes.types_map.get(suffix, "application/octet-stream")
    text = kind.startswith("text/") or kind.endswith("json")
    headers = Headers(
        {**_HEADERS, "Content-Type": f"{kind}; charset=utf-8" if text else kind, "Content-Length": str(len(body))}
    )
    return Response(status.value, status.phrase, headers, body)
