"""Requests that a page answers: those with its token, and none of another page in the same browser."""

import importlib
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_HOSTS = ("127.0.0.1", "localhost")
_TITLE = b"<title>Viser</title>"
_HEADERS = {
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "Cache-Control": "no-store",
}
_LARGEST_MESSAGE = 2**16
"""Bytes; what a page's inputs, clicks and camera have to say takes a hundredth of that."""
_starting = threading.Lock()

Serve = Callable[["ServerConnection", "Request"], "Response | None"]


def is_allowed(host: str | None, origin: str | None, port: int) -> bool:
    """Whether a request may be answered.

    A browser sends in ``Origin`` which page opens a connection, and in ``Host`` by which name it found this machine: a
    foreign page has another origin, and one whose name was made to point at 127.0.0.1 has another host. Programs that
    are no browsers send no origin; they could do as they like anyway.
    """
    places = {f"{name}:{port}" for name in _HOSTS} | (set(_HOSTS) if port == 80 else set())
    return host in places and (origin is None or origin in {f"http://{name}" for name in places})


def without_token(path: str, token: str) -> str | None:
    """A request's path without the token that it must begin with; None where it does not.

    Example:
        >>> without_token("/secret/index.html?a=1", "secret"), without_token("/index.html", "secret")
        ('/index.html?a=1', None)
    """
    bare, mark, query = path.partition("?")
    first, _, rest = bare.removeprefix("/").partition("/")
    same = bare.startswith("/") and secrets.compare_digest(first.encode(), token.encode())
    return f"/{rest}{mark}{query}" if same else None


@contextmanager
def only_this_page(title: str, token: str) -> Iterator[None]:
    """Servers that viser starts meanwhile answer their own page alone, under a path that begins with the token.

    The page is shown in no frame, and called by ``title``. viser hands its server's handshake to ``websockets`` and has
    no setting for any of these.
    """
    server: Any = importlib.import_module("websockets.asyncio.server")
    with _starting:
        before = server.serve

        def serve(*arguments: Any, process_request: Serve, **more: Any) -> Any:
            more["max_size"] = _LARGEST_MESSAGE
            return before(*arguments, process_request=_guarded(process_request, title, token), **more)

        server.serve = serve
        try:
            yield
        finally:
            server.serve = before


def _guarded(answer: Serve, title: str, token: str) -> Serve:
    named = b"<title>" + escape(title).encode() + b"</title>"

    def process(connection: "ServerConnection", request: "Request") -> "Response | None":
        # Twice the same header is nothing that a browser sends, and get() would raise.
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        port = connection.local_address[1]
        if len(hosts) != 1 or len(origins) > 1 or not is_allowed(hosts[0], origins[0] if origins else None, port):
            return connection.respond(HTTPStatus.FORBIDDEN, "This page is for this machine's own browser alone.\n")
        path = without_token(request.path, token)
        if path is None:
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the whole address that torchface has printed.\n")
        request.path = path
        document = request.path.partition("?")[0] in ("/", "/index.html")
        if document and "Accept-Encoding" in request.headers:
            # As it lies on disk: a packed one could not be given its title.
            del request.headers["Accept-Encoding"]
        response = answer(connection, request)
        if response is not None:
            for name, value in _HEADERS.items():
                response.headers[name] = value
            if document and response.body is not None:
                response.body = response.body.replace(_TITLE, named, 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
        return response

    return process
