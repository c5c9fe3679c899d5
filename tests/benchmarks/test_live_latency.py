"""From a flash in the camera's picture to the packet and to the character's pixel: median and 95th percentile, printed.

A film is the camera: marks in its corner light up and, in the same picture, the jaw of a rendered face opens. The end
is the first packet, answer or drawn pixel in which the jaw is past half of its way. For ``live``, for the app, and for
MediaPipe's Face Landmarker in the same browser, which draws nothing. The marks are the picture's number in bits: pages
that see a later picture than the flash, as they were busy, know when it was.
"""

import base64
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from app_browser import Page, film_camera, static_host
from film import write_y4m
from headless_chromium import headless_chromium, until
from planted_faces import JAW, Endless
from recorded_take import allow_camera

from torchface.capture.anybody import WebcamControls
from torchface.io.protocols.live_link_packets import read_live_link
from torchface.progress import silent
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app import export_app
from torchface.workflows.live import live_anybody
from torchface.workflows.live.live_anybody import LiveSettings, PersonSolver, go_live, person_solver
from torchface.workflows.live.live_frames import LiveFrame
from train.rendered_people.webcam_performance import SittingSettings, sitting
from train.rendered_people.webcam_video import WebcamSettings, draw_subject, webcam_frames

pytestmark = [pytest.mark.bench, pytest.mark.browser]
SIZE, FPS, SHUT, OPEN = (640, 480), 30.0, 40, 40
MARK, BITS = 16, 7  # pixels a side; of a picture's number
FLASHES = 12
PEER = "@mediapipe/tasks-vision@1.1.0"

_WATCH = """
const milliseconds = (time) => performance.timeOrigin + time;
window.flashes = []; window.drawn = []; window.answered = [];
{ const canvas = new OffscreenCanvas(BITS, 1), context = canvas.getContext("2d", { willReadFrequently: true });
  let before = SHUT;
  const look = (video) => video.requestVideoFrameCallback((now, facts) => {
    look(video);
    context.drawImage(video, 0, 0, BITS * MARK, MARK, 0, 0, BITS, 1);
    const { data } = context.getImageData(0, 0, BITS, 1);
    let number = 0;
    for (let bit = 0; bit < BITS; bit++) number += (data[4 * bit + 1] > 128) << bit;
    if (number >= SHUT && before < SHUT)
      flashes.push(milliseconds((facts.captureTime ?? now) - (1000 * (number - SHUT)) / FPS));
    before = number;
  });
  document.addEventListener("DOMContentLoaded", () => document.querySelectorAll("video").forEach(look));
  const P = WebGL2RenderingContext.prototype, { fenceSync } = P; // follows each drawing
  P.fenceSync = function (...given) {
    const height = this.drawingBufferHeight, column = new Uint8Array(4 * height);
    this.readPixels(this.drawingBufferWidth >> 1, 0, 1, height, this.RGBA, this.UNSIGNED_BYTE, column);
    drawn.push([milliseconds(performance.now()), height, btoa(String.fromCharCode(...column))]);
    return fenceSync.apply(this, given);
  };
  const Own = window.Worker;
  window.Worker = class extends Own {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", ({ data }) => {
        if (!data.solved) return;
        const { weights, milliseconds: took, interval } = data.solved;
        answered.push([milliseconds(performance.now()), weights[JAW], took, interval]);
      });
    }
  };
}
"""
for name, value in {"BITS": BITS, "MARK": MARK, "SHUT": SHUT, "FPS": FPS, "JAW": JAW}.items():
    _WATCH = _WATCH.replace(name, str(value))
_PEER = """<!doctype html><video id="video" muted playsinline></video><script type="module">
import { FaceLandmarker, FilesetResolver } from "./peer/vision_bundle.mjs";
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
  const jaw = found.faceBlendshapes[0]?.categories.find((one) => one.categoryName === "jawOpen").score;
  if (jaw !== undefined) answered.push([performance.timeOrigin + ended, jaw, ended - begun, passed]);
  before = came;
  video.requestVideoFrameCallback(look);
};
video.requestVideoFrameCallback(look);
</script>"""


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    """Pictures (T,480,640,3) of a face whose jaw opens at once, and their numbers as marks."""
    weights = torch.zeros(2, len(ARKIT))
    weights[1, JAW] = 0.7
    generator = torch.Generator().manual_seed(7)
    person = draw_subject(generator)
    acted = sitting(weights, FPS, generator, SittingSettings(distance=450, yaw=0.0))
    frames = webcam_frames(person, acted, 7, WebcamSettings(320, 240, focal=300))
    rest, opened = (
        cv2.resize(one.picture.permute(1, 2, 0).numpy(), SIZE, interpolation=cv2.INTER_CUBIC) for one in frames
    )
    noise = np.random.default_rng(0)
    film = np.stack([rest] * SHUT + [opened] * OPEN).astype(np.int16)
    for number, bit in np.ndindex(len(film), BITS):
        film[number, :MARK, bit * MARK : (bit + 1) * MARK] = 255 * (number >> bit & 1)
    return np.clip(film + noise.integers(-3, 4, film.shape, np.int16), 0, 255).astype(np.uint8)


def told(what: str, milliseconds: Any) -> float:
    times = np.asarray(milliseconds, float)
    print(f"\n{what}: {np.median(times):.0f} ms, 95th percentile {np.quantile(times, 0.95):.0f} ({len(times)})")
    return float(np.median(times))


def checked_pace(networks: float) -> float:
    """The networks' time, if pictures come often enough to see each flash."""
    if networks > 1000 * SHUT / FPS / 4:
        pytest.skip(f"this machine is busy: the networks alone take {networks:.0f} ms")
    return networks


def after_flashes(flashes: Any, times: Any, values: Any) -> np.ndarray:
    """From each flash to the first value on the other side of half between lowest and highest, milliseconds (F,)."""
    times, values = np.asarray(times, float), np.asarray(values, float)
    past = values > (np.quantile(values, 0.1) + np.quantile(values, 0.9)) / 2
    found: dict[bool, list[float]] = {False: [], True: []}
    for flash in np.asarray(flashes, float)[1:-1]:  # the first comes while all is made ready
        later = np.flatnonzero(times > flash)
        if len(later) and later[0] > 0:
            before = bool(past[later[0] - 1])
            changed = later[past[later] != before]
            found[before] += [times[changed[0]] - flash] * bool(len(changed))
    taken = max(found.values(), key=len)  # a pixel of the mouth becomes darker or lighter
    assert len(taken) >= len(flashes) // 2
    return np.array(taken)


def pixels(drawn: Any) -> tuple[np.ndarray, np.ndarray]:
    """When each drawing was finished, and the pixel of its middle column that changes most."""
    height = drawn[-1][1]
    kept = [one for one in drawn if one[1] == height]
    columns = np.stack([np.frombuffer(base64.b64decode(code), np.uint8).reshape(height, 4) for *_, code in kept])
    green = columns[:, :, 1].astype(float)
    low, high = np.quantile(green, [0.2, 0.8], axis=0)
    return np.array([one[0] for one in kept]), green[:, int((high - low).argmax())]


def seen(driver: Any, name: str) -> list[Any]:
    found: list[Any] = driver.execute_script(f"return window.{name} ?? []")
    return found


def told_of_page(driver: Any, what: str, flashes: Any) -> None:
    until(lambda: len(seen(driver, "drawn")) > 20)
    told(f"{what}, flash to the character's pixel", after_flashes(flashes, *pixels(seen(driver, "drawn"))))


class Film(Endless):
    """Faces at the rate of a camera; of those that come while one is solved the newest is given."""

    def __init__(self, faces: np.ndarray) -> None:
        super().__init__(len(faces), FPS)
        self.faces, self.open = faces, True
        self.flashes = list[float]()

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        begun, number, lit = time.perf_counter(), 0, True
        while self.open:
            number = max(number + 1, int((time.perf_counter() - begun) * FPS))
            due = begun + number / FPS
            time.sleep(max(0.0, due - time.perf_counter()))
            shown = number % len(self.faces) >= SHUT
            if shown and not lit:
                first = number - (number % len(self.faces) - SHUT)  # which was let go where the solver was busy
                self.flashes.append(begun + first / FPS)
            lit = shown
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
    arrived, jaws, urls = list[float](), list[float](), list[str]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as engine:
        engine.bind(("127.0.0.1", 0))
        engine.settimeout(0.5)

        def receive() -> None:
            while film.open:
                try:
                    packet = engine.recv(4096)
                except TimeoutError:
                    continue
                arrived.append(time.perf_counter())
                jaws.append(float(read_live_link(packet)[0].weights[JAW]))

        settings = LiveSettings("0", addresses=(f"livelink://127.0.0.1:{engine.getsockname()[1]}",), port=0)
        threads = [
            threading.Thread(target=receive),
            threading.Thread(target=lambda: go_live(settings, print, urls.append, lambda progress: solver)),
        ]
        for thread in threads:
            thread.start()
        try:
            until(lambda: len(film.flashes) > FLASHES)
            networks = checked_pace(told("live, networks and solver alone", solver.took[len(solver.took) // 5 :]))
            count = len(jaws)
            packets = after_flashes(film.flashes, arrived[:count], jaws[:count])
            packet = told("live, flash to packet", 1000 * packets)
            url, before = until(lambda: urls and urls[0]), len(film.flashes)
            with headless_chromium(tmp_path / "profile", size=(800, 700)) as driver:
                driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _WATCH})
                driver.get(url)
                until(lambda: seen(driver, "drawn"))
                until(lambda: len(film.flashes) > before + FLASHES)
                offset = time.time() - time.perf_counter()
                told_of_page(driver, "live", 1000 * (np.array(film.flashes[before:]) + offset))
        finally:
            film.open = False
            for thread in threads:
                thread.join(30)
    assert_soon(packet, networks)


def assert_soon(flash: float, networks: float) -> None:
    """At most a picture's time after the networks' own; networks slower than the camera are waited for."""
    assert flash < networks + max(networks, 1000 / FPS)


def test_the_jaw_is_past_half_in_the_flashs_own_picture(faces: np.ndarray) -> None:
    """So smoothing delays nothing: what is above the networks' time is waiting, for the picture and for the drawing."""
    solver = person_solver(silent)
    jaw = np.array(
        [float(solver.step(one, 1 / FPS, WebcamControls()).weights[JAW]) for one in np.tile(faces, (2, 1, 1, 1))]
    )
    half = (jaw[len(faces) :].min() + jaw[len(faces) :].max()) / 2
    for flash in (SHUT, len(faces) + SHUT):
        assert jaw[flash - 1] < half < jaw[flash]
    assert jaw[len(faces)] < half


def test_the_app_and_its_peer(faces: np.ndarray, data: Path, tmp_path: Path) -> None:
    export_app(tmp_path / "app")
    write_y4m(tmp_path / "film.y4m", faces)
    with browser(tmp_path / "app", tmp_path / "film.y4m", tmp_path / "profile", "index.html") as driver:
        Page(driver).start()
        until(lambda: len(seen(driver, "flashes")) > FLASHES)
        app = told_answers(driver, "app")
        told_of_page(driver, "app", seen(driver, "flashes"))
    npm = shutil.which("npm")
    assert npm is not None
    command = [npm, "i", "--no-audit", "--no-fund", "--ignore-scripts", PEER]
    (tmp_path / "package.json").write_text("{}")
    if subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=300, check=False).returncode != 0:
        pytest.skip(f"{PEER} cannot be installed from npm")
    shutil.copytree(tmp_path / "node_modules" / "@mediapipe" / "tasks-vision", tmp_path / "app" / "peer")
    shutil.copyfile(data / "peers" / "face_landmarker.task", tmp_path / "app" / "face_landmarker.task")
    (tmp_path / "app" / "peer.html").write_text(_PEER)
    with browser(tmp_path / "app", tmp_path / "film.y4m", tmp_path / "peer", "peer.html") as driver:
        until(lambda: seen(driver, "answered"))
        before = len(seen(driver, "flashes"))
        until(lambda: len(seen(driver, "flashes")) > before + FLASHES)
        told_answers(driver, "MediaPipe")
    assert_soon(app[1], app[0])


@contextmanager
def browser(folder: Path, film: Path, profile: Path, page: str) -> Iterator[Any]:
    """Chromium on a page that an isolated host serves, before a film."""
    with (
        static_host(folder, isolated=True) as host,
        headless_chromium(profile, *film_camera(film), size=(800, 700)) as driver,
    ):
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _WATCH})
        allow_camera(driver, "granted")
        driver.get(f"{host.url}/{page}")
        yield driver


def told_answers(driver: Any, what: str) -> tuple[float, float]:
    """The networks' own time and that from flash to answer, medians."""
    flashes, answers = seen(driver, "flashes"), np.array(seen(driver, "answered"), float)
    steady = answers[len(answers) // 5 :]
    networks = checked_pace(told(f"{what}, networks and solver alone", steady[:, 2]))
    flash = told(f"{what}, flash to weights", after_flashes(flashes, answers[:, 0], answers[:, 1]))
    print(f"{what}: {1 / steady[:, 3].mean():.0f} pictures a second")
    return networks, flash
