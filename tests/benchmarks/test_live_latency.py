"""From a camera's picture to the packet and to the drawn character: median and 95th percentile, printed.

For ``live``, for the app, and for MediaPipe's Face Landmarker in the same browser, which draws nothing. A picture's
time is when the camera gave it; a character is drawn when WebGL has finished its commands.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from app_browser import Page, film_camera, static_host
from film import write_y4m
from headless_chromium import headless_chromium, until
from planted_faces import Endless
from recorded_take import allow_camera

from torchface.capture.anybody import WebcamControls
from torchface.progress import silent
from torchface.workflows.browser_app import export_app
from torchface.workflows.live import live_anybody
from torchface.workflows.live.live_anybody import LiveSettings, PersonSolver, go_live, person_solver
from torchface.workflows.live.live_frames import LiveFrame
from train.rendered_people.webcam_video import talking_subject

pytestmark = [pytest.mark.bench, pytest.mark.browser]
SIZE, FPS, WARM, FRAMES = (640, 480), 30.0, 60, 200
PEER = "@mediapipe/tasks-vision@1.1.0"

_DRAWN = """
window.newest = null; window.drawn = []; window.answered = [];
const now = () => performance.timeOrigin + performance.now();
{ let began = null, last = null;
  const P = WebGL2RenderingContext.prototype, { fenceSync, deleteSync } = P;
  P.fenceSync = function (...given) { began = newest; return fenceSync.apply(this, given); };
  P.deleteSync = function (sync) {
    if (began !== null && began !== last) drawn.push(now() - began);
    last = began;
    return deleteSync.call(this, sync);
  };
  const Socket = window.WebSocket, Own = window.Worker;
  window.WebSocket = class extends Socket {
    constructor(address) {
      super(address);
      this.addEventListener("message", ({ data }) => {
        if (typeof data === "string" || new Uint32Array(data, 0, 1)[0] !== 1) return;
        newest = new Float64Array(data, 8, 1)[0] + OFFSET;
      });
    }
  };
  window.Worker = class extends Own {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", ({ data }) => {
        if (!data.solved) return;
        newest = performance.timeOrigin + data.solved.time;
        answered.push([now() - newest, data.solved.milliseconds, data.solved.interval]);
      });
    }
  };
}
"""
_PEER = """<!doctype html><video id="video" muted playsinline></video><script type="module">
import { FaceLandmarker, FilesetResolver } from "./peer/vision_bundle.mjs";
window.answered = [];
const files = await FilesetResolver.forVisionTasks("./peer/wasm");
const baseOptions = { modelAssetPath: "./face_landmarker.task", delegate: "CPU" };
const options = { baseOptions, runningMode: "VIDEO", outputFaceBlendshapes: true };
const finder = await FaceLandmarker.createFromOptions(files, options);
video.srcObject = await navigator.mediaDevices.getUserMedia({ video: { width: 640, height: 480, frameRate: 30 } });
await video.play();
let before = null;
const look = (now, facts) => {
  const came = facts.captureTime ?? now, begun = performance.now();
  const found = finder.detectForVideo(video, came);
  const ended = performance.now(), passed = before === null ? 0 : (came - before) / 1000;
  if (found.faceBlendshapes.length) answered.push([ended - came, ended - begun, passed]);
  before = came;
  video.requestVideoFrameCallback(look);
};
video.requestVideoFrameCallback(look);
</script>"""


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    return np.stack([cv2.resize(picture, SIZE, interpolation=cv2.INTER_CUBIC) for picture in talking_subject(60)])


def told(what: str, milliseconds: Any) -> float:
    times = np.asarray(milliseconds, float)
    print(
        f"\n{what}: {np.median(times):.0f} ms, 95th percentile {np.quantile(times, 0.95):.0f} ({len(times)} pictures)"
    )
    return float(np.median(times))


class Film(Endless):
    """Faces at the rate of a camera; of those that come while one is solved the newest is given."""

    def __init__(self, faces: np.ndarray) -> None:
        super().__init__(len(faces), FPS)
        self.faces, self.open = faces, True

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        begun, number = time.perf_counter(), 0
        while self.open:
            number = max(number + 1, int((time.perf_counter() - begun) * FPS))
            due = begun + number / FPS
            time.sleep(max(0.0, due - time.perf_counter()))
            yield due, self.faces[number % len(self.faces)]


class Timed:
    """A solver, and how long each of its steps took."""

    def __init__(self, solver: PersonSolver) -> None:
        self.solver, self.names, self.took = solver, solver.names, list[float]()

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        begun = time.perf_counter()
        solved = self.solver.step(picture, interval, controls)
        self.took.append(1000 * (time.perf_counter() - begun))
        return solved


def test_live(faces: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solver, film = Timed(person_solver(silent)), Film(faces)
    monkeypatch.setattr(live_anybody, "open_source", lambda *_: film)
    sent, arrived, urls = list[float](), list[float](), list[str]()
    frames = film.frames

    def noted() -> Iterator[tuple[float, np.ndarray]]:
        for came, picture in frames():
            sent.append(came)
            yield came, picture

    monkeypatch.setattr(film, "frames", noted)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as engine:
        engine.bind(("127.0.0.1", 0))
        engine.settimeout(0.5)

        def receive() -> None:
            while film.open:
                try:
                    engine.recv(4096)
                    arrived.append(time.perf_counter())
                except TimeoutError:
                    continue

        settings = LiveSettings("0", addresses=(f"livelink://127.0.0.1:{engine.getsockname()[1]}",), port=0)
        threads = [
            threading.Thread(target=receive),
            threading.Thread(target=lambda: go_live(settings, print, urls.append, lambda progress: solver)),
        ]
        for thread in threads:
            thread.start()
        try:
            until(lambda: len(arrived) > WARM + FRAMES)
            count = min(len(arrived), len(sent))
            packets = 1000 * (np.array(arrived[:count]) - np.array(sent[:count]))[WARM:]
            networks = told("live, networks and solver alone", solver.took[WARM:])
            packet = told("live, picture to packet", packets)
            url = until(lambda: urls and urls[0])
            with headless_chromium(tmp_path / "profile", size=(800, 700)) as driver:
                offset = 1000 * (time.time() - time.perf_counter())
                watch = _DRAWN.replace("OFFSET", str(offset))
                driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": watch})
                driver.get(url)
                until(lambda: driver.execute_script("return drawn.length") > WARM)
                told("live, picture to drawn character", driver.execute_script("return drawn")[20:])
        finally:
            film.open = False
            for thread in threads:
                thread.join(30)
    assert packet < networks + 1000 / FPS


def test_the_app_and_its_peer(faces: np.ndarray, data: Path, tmp_path: Path) -> None:
    export_app(tmp_path / "app")
    write_y4m(tmp_path / "film.y4m", faces)
    with (
        static_host(tmp_path / "app", isolated=True) as host,
        headless_chromium(tmp_path / "profile", *film_camera(tmp_path / "film.y4m"), size=(800, 700)) as driver,
    ):
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _DRAWN.replace("OFFSET", "0")})
        allow_camera(driver, "granted")
        driver.get(f"{host.url}/index.html")
        Page(driver).start()
        until(lambda: driver.execute_script("return answered.length") > WARM + FRAMES)
        until(lambda: driver.execute_script("return drawn.length") > 30)
        answers = np.array(driver.execute_script("return answered"), float)[WARM:]
        networks = told("app, networks and solver alone", answers[:, 1])
        answer = told("app, picture to weights", answers[:, 0])
        told("app, picture to drawn character", driver.execute_script("return drawn")[10:])
        print(f"app: {1 / answers[:, 2].mean():.0f} pictures a second")
    npm = shutil.which("npm")
    assert npm is not None
    command = [npm, "i", "--no-audit", "--no-fund", "--ignore-scripts", PEER]
    (tmp_path / "package.json").write_text("{}")
    if subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=300, check=False).returncode != 0:
        pytest.skip(f"{PEER} cannot be installed from npm")
    shutil.copytree(tmp_path / "node_modules" / "@mediapipe" / "tasks-vision", tmp_path / "app" / "peer")
    shutil.copyfile(data / "peers" / "face_landmarker.task", tmp_path / "app" / "face_landmarker.task")
    (tmp_path / "app" / "peer.html").write_text(_PEER)
    with (
        static_host(tmp_path / "app", isolated=True) as host,
        headless_chromium(tmp_path / "peer", *film_camera(tmp_path / "film.y4m"), size=(800, 700)) as driver,
    ):
        allow_camera(driver, "granted")
        driver.get(f"{host.url}/peer.html")
        until(lambda: driver.execute_script("return window.answered?.length ?? 0") > WARM + FRAMES)
        found = np.array(driver.execute_script("return answered"), float)[WARM:]
        told("MediaPipe, its own time", found[:, 1])
        told("MediaPipe, picture to weights, nothing drawn", found[:, 0])
        print(f"MediaPipe: {1 / found[:, 2].mean():.0f} pictures a second")
    assert answer < networks + 1000 / FPS
