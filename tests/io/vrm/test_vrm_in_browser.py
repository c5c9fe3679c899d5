"""What three-vrm in Chromium makes of a VRM with added expressions: it loads, and each of them moves the mesh."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch

from planted.characters import Planted, write_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.morph_insertion import AddedTargets, document_with_targets, write_edited
from torchface.io.vrm.vrm_expressions import MorphBind, add_expressions
from torchface.mesh import Mesh

WEB = Path(__file__).resolve().parent / "web"
HEAD = Mesh(torch.tensor([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, 50]]), torch.tensor([[0, 1, 2], [0, 3, 1]]))
NAMES = ("jawOpen", "mouthSmileLeft")
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser() -> str:
    """A Chromium, with three-vrm installed in ``web``; kept there for the next run."""
    chromium = next((found for name in ("chromium", "google-chrome") if (found := shutil.which(name))), None)
    npm = shutil.which("npm")
    if chromium is None or npm is None:
        pytest.skip("Chromium and npm are not installed; three-vrm comes from npm")
    if not (WEB / "node_modules" / "@pixiv").is_dir():
        command = [npm, "ci", "--no-audit", "--no-fund"]
        done = subprocess.run(command, cwd=WEB, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode != 0:
            pytest.skip(f"npm could not install three-vrm: {done.stderr[-300:]}")
    return chromium


def seen(browser: str, avatar: Path, folder: Path, animation: Path | None = None) -> dict:
    """What the page posts of an avatar."""
    results: list[dict] = []
    done = threading.Event()
    files = {"/avatar.vrm": avatar, "/animation.vrma": animation}

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            file = files.get(self.path)
            if file is None:
                return super().do_GET()
            body = file.read_bytes()
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

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(WEB)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-dev-shm-usage"]
    page = f"http://127.0.0.1:{server.server_port}/avatar.html" + ("" if animation is None else "?animation=1")
    command = [browser, *flags, f"--user-data-dir={folder / 'profile'}", page]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        assert done.wait(120), "the page posted nothing"
    finally:
        process.terminate()
        process.wait(30)
        server.shutdown()
        server.server_close()
    assert "error" not in results[0], results[0]["error"]
    return results[0]


@pytest.mark.parametrize(("version", "preset", "meta"), [("VRMC_vrm", "blinkLeft", "1"), ("VRM", "blink_l", "0")])
def test_added_expressions_move_the_mesh(browser: str, tmp_path: Path, version: str, preset: str, meta: str) -> None:
    before, after = tmp_path / "before.vrm", tmp_path / "after.vrm"
    lift = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 10, 0], [0, 0, 0]])
    count = write_character(before, HEAD, {"lid": lift}, Planted(vrm=version, expressions={preset: "lid"}))
    document = read_document(before)
    moved = np.zeros((2, count, 3), np.float32)
    moved[0, 0], moved[1, 1] = (0.0, -0.02, 0.0), (0.03, 0.0, 0.0)
    root, data = document_with_targets(document, [AddedTargets(0, (0,), moved)], NAMES)
    add_expressions(document, root, {name: [MorphBind(0, 0, 1 + row)] for row, name in enumerate(NAMES)})
    write_edited(document, root, data, after)
    found = seen(browser, after, tmp_path)
    assert found["version"] == meta
    assert found["moved"]["blinkLeft"] == pytest.approx(0.01, abs=1e-5)  # as before; three-vrm has VRM 1's names
    assert found["moved"]["jawOpen"] == pytest.approx(0.02, abs=1e-5)
    assert found["moved"]["mouthSmileLeft"] == pytest.approx(0.03, abs=1e-5)


@pytest.mark.real
def test_an_animation_still_plays(browser: str, tmp_path: Path, data: Path) -> None:
    avatar = tmp_path / "avatar.vrm"
    write_character(avatar, HEAD, how=Planted(vrm="VRMC_vrm"))
    document = read_document(avatar)
    moved = np.zeros((1, 44, 3), np.float32)
    root, added = document_with_targets(document, [AddedTargets(0, (0,), moved)], ["jawOpen"])
    write_edited(document, root, added, avatar)
    found = seen(browser, avatar, tmp_path, data / "characters" / "test.vrma")
    assert max(found["turned"].values()) > 0.01  # radians
