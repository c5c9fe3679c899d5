"""Pictures of a ``.glb`` by three.js in a headless Chromium."""

import base64
import json
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.io.images.image_files import decode_image

WEB = Path(__file__).resolve().parent / "web"
_SECONDS = 120


@dataclass(frozen=True)
class Shot:
    """What is seen."""

    weights: dict[str, float] = field(default_factory=dict)  # of shapes by name; the others are 0
    yaw: float = 0.0  # degrees that the camera stands to the side of the front
    target: tuple[float, float, float] = (0.0, -0.02, 0.05)  # what it looks at, metres
    span: float = 0.32  # metres that the picture is wide
    turns: dict[str, tuple[float, float]] = field(default_factory=dict)  # pitch and yaw of nodes by name, radians


def posted(browser: Any, web: Path, page: str, files: dict[str, bytes]) -> dict:
    """What a page of a folder posts, drawn without a GPU.

    Args:
        browser: the driver of ``chromium``.
        web: the folder that is served.
        page: of it, with its query.
        files: what is served beside, by path.
    """
    results: list[dict] = []
    done = threading.Event()

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            body = files.get(self.path)
            if body is None:
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            return None

        def do_POST(self) -> None:
            results.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()
            done.set()

        def log_message(self, *words: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(web)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        browser.get(f"http://127.0.0.1:{server.server_port}/{page}")
        assert done.wait(_SECONDS), "the page posted nothing"
    finally:
        browser.get("about:blank")
        server.shutdown()
        server.server_close()
    assert "error" not in results[0], results[0]["error"]
    return results[0]


def pictures(browser: Any, shots: Sequence[tuple[Path, Shot]], side: int = 512) -> list[Tensor]:
    """What three.js draws of ``.glb`` files, a picture (3,side,side) a shot.

    Args:
        shots: the file, and what is seen of it.
        side: pixels.
    """
    files = {f"/{i}.glb": file for i, file in enumerate(dict.fromkeys(file for file, _ in shots))}
    names = {file: name for name, file in files.items()}
    order = json.dumps(
        {"side": side, "shots": [{"file": names[file], **asdict(shot)} for file, shot in shots]}
    ).encode()
    found = posted(
        browser,
        WEB,
        "look.html",
        {"/shots.json": order, **{name: file.read_bytes() for name, file in files.items()}},
    )
    rows = [base64.b64decode(url.partition(",")[2]) for url in found["pictures"]]
    return [decode_image(row, "the browser's picture") for row in rows]


def grid(rows: Sequence[Tensor], columns: int) -> Tensor:
    """Pictures of one size beside and below each other."""
    lines = [torch.cat(list(rows[i : i + columns]), dim=2) for i in range(0, len(rows), columns)]
    return torch.cat(lines, dim=1)
