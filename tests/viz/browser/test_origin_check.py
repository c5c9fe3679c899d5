"""Who does not know the page's address, or is another page, can neither drive the viewer, nor read it, nor frame it."""

import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

import pytest

from torchface.rig import BlendshapeRig
from torchface.viz.browser.origin_check import is_allowed, only_this_page, without_token
from torchface.viz.browser.rig_viewer import RigViewer


@pytest.mark.parametrize(
    ("host", "origin", "expected"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True),
        ("localhost:8080", "http://localhost:8080", True),
        ("127.0.0.1:8080", None, True),
        ("127.0.0.1:8080", "http://127.0.0.1:8081", False),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", False),
        ("127.0.0.1:8080", "null", False),
        ("127.0.0.1:8080", "http://127.0.0.1:8080.evil.example", False),
        ("evil.example:8080", "http://evil.example:8080", False),
        ("evil.example:8080", None, False),
        ("127.0.0.1:8081", None, False),
        (None, None, False),
    ],
)
def test_who_is_welcome(host: str | None, origin: str | None, expected: bool) -> None:
    assert is_allowed(host, origin, 8080) is expected


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/secret", "/"),
        ("/secret/", "/"),
        ("/secret/assets/a.js?b=/c", "/assets/a.js?b=/c"),
        ("/secret?websocket=ws://x", "/?websocket=ws://x"),
        ("/", None),
        ("", None),
        ("secret/", None),
        ("/secre/", None),
        ("/secrets/", None),
        ("/SECRET/", None),
        ("//secret/", None),
        ("/./secret/", None),
        ("/index.html?secret", None),
        ("/?token=secret", None),
        ("/s%65cret/", None),
        ("/sécret/", None),
    ],
)
def test_an_address_begins_with_the_token(path: str, expected: str | None) -> None:
    assert without_token(path, "secret") == expected


@pytest.fixture(scope="module")
def viewer(ball_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RigViewer]:
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    out = tmp_path_factory.mktemp("out") / "edited.csv"
    opened = RigViewer(ball_rig, out=out, label="<two> balls", port=0)
    yield opened
    opened.stop()


def fetched(url: str, **headers: str) -> tuple[int, http.client.HTTPMessage, str]:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", parts.port, timeout=10)
    connection.request("GET", parts.path, headers=headers)
    response = connection.getresponse()
    found = response.status, response.headers, response.read().decode()
    connection.close()
    return found


def test_the_page_is_called_by_its_rig_and_shown_in_no_frame(viewer: RigViewer) -> None:
    status, headers, text = fetched(viewer.url, **{"Accept-Encoding": "gzip"})
    assert status == 200
    assert "<title>&lt;two&gt; balls – torchface</title>" in text
    assert "<title>Viser" not in text
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["Referrer-Policy"] == "no-referrer"


def bare(viewer: RigViewer) -> str:
    """The page's address as somebody would guess it who listens at all ports."""
    return f"http://127.0.0.1:{viewer.server.get_port()}"


def test_without_the_token_there_is_no_page_and_no_socket(ball_rig: BlendshapeRig, viewer: RigViewer) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    token = urlsplit(viewer.url).path.strip("/")
    assert len(token) >= 22  # 128 bits
    speaks: Any = {"subprotocols": [f"viser-v{viser.__version__}"], "proxy": None}
    for path in ("/", "/index.html", f"/{token[:-1]}/", f"/?{token}", f"//{token}/", "/" + "A" * len(token) + "/"):
        status, _, text = fetched(bare(viewer) + path)
        assert (status, "Open the whole address" in text, token in text) == (403, True, False)
        with pytest.raises(InvalidStatus, match="403"):
            connect(bare(viewer).replace("http", "ws") + path, **speaks)
    other = RigViewer(ball_rig, port=0)
    try:
        assert urlsplit(other.url).path != urlsplit(viewer.url).path
    finally:
        other.stop()


def test_a_name_that_was_made_to_point_here_is_refused(viewer: RigViewer) -> None:
    status, _, text = fetched(viewer.url, Host="evil.example")
    assert status == 403
    assert "<title>" not in text


def test_a_socket_of_another_origin_is_refused(viewer: RigViewer) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    address = viewer.url.replace("http", "ws")
    speaks: Any = {"subprotocols": [f"viser-v{viser.__version__}"], "proxy": None}
    with connect(address, origin=bare(viewer), **speaks) as own:
        assert own.recv(timeout=10)
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(address, origin=origin, **speaks)


def test_servers_of_others_are_left_alone() -> None:
    server = pytest.importorskip("websockets.asyncio.server", reason="the extra viewer is not installed")
    before = server.serve
    with only_this_page("x", "token"):
        assert server.serve is not before
    assert server.serve is before


@contextmanager
def other_page() -> Iterator[str]:
    """A page of another origin, as any site could be open in the same browser."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<title>other</title>")

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


_KNOCK = """
const [url, protocol, done] = arguments;
const socket = new WebSocket(url, [protocol]);
socket.onopen = () => { socket.close(); done("open"); };
socket.onerror = () => done("refused");
"""


@pytest.mark.bench
@pytest.mark.browser
def test_in_the_browser_only_the_page_itself_gets_through(chromium: Any, viewer: RigViewer) -> None:
    import viser

    knock = (viewer.url.replace("http", "ws"), f"viser-v{viser.__version__}")
    with other_page() as url:
        chromium.get(url)
        assert chromium.execute_async_script(_KNOCK, *knock) == "refused"
    chromium.get(viewer.url)
    assert chromium.title == "<two> balls – torchface"
    assert chromium.execute_async_script(_KNOCK, *knock) == "open"
    chromium.get("about:blank")
