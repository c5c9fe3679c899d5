"""What the page was shown and answered, recorded and downloaded; and what Python makes of the same pictures."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from app_browser import Page
from headless_chromium import until

from torchface.io.weights.live_link_csv import load_live_link

_TYPES = ("text/csv", "model/gltf-binary", "model/vnd.usdz+zip", "video/mp4")
_WATCH = (Path(__file__).parent / "watched_worker.js").read_text()


def watch(driver: Any, streamed: bool = False) -> None:
    """Has the pages that are opened from now on keep what ``watched`` reads.

    Args:
        streamed: whether the worker may take the camera's pictures itself, which are not kept then.
    """
    source = _WATCH.replace("delete window.MediaStreamTrackProcessor", "") if streamed else _WATCH
    driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})


def allow_camera(driver: Any, setting: str) -> None:
    driver.execute_cdp_cmd("Browser.setPermission", {"permission": {"name": "camera"}, "setting": setting})


def watched(page: Page, what: str) -> Any:
    return page.driver.execute_script(f"return JSON.parse(JSON.stringify({what}))")


def blob(page: Page, kind: str) -> bytes:
    """What saving the newest take as a kind of file downloads."""
    given = f"watched.blobs.filter(({{ type }}) => {json.dumps(_TYPES)}.includes(type))"  # and no pictures of textures
    count = page.driver.execute_script(f"return {given}.length")
    choose = "e.value = arguments[0]; e.dispatchEvent(new Event('change'))"
    page.driver.execute_script(f"const e = document.querySelector('#takes .save'); {choose}", kind)
    until(lambda: page.driver.execute_script(f"return {given}.length") > count or page.problem)
    assert not page.problem, page.problem
    script = f"const done = arguments[0]; watched.text({given}.at(-1)).then(done)"
    return base64.b64decode(page.driver.execute_async_script(script))


@dataclass
class Recorded:
    """What the page was shown and answered, and what it recorded of that."""

    sent: list[dict]
    solved: list[dict]
    csv: Path
    glb: Path

    @property
    def recorded(self) -> list[dict]:
        """The answers that the recording holds, found by their weights."""
        take = load_live_link(self.csv)
        first_row = take.weights.values[0, :, 0].numpy()
        first = next(i for i, one in enumerate(self.solved) if np.abs(one["weights"] - first_row).max() < 1e-6)
        return self.solved[first : first + len(take)]


def record(page: Page, folder: Path, frames: int) -> Recorded:
    """Starts the camera, records so many frames or a few more, stops both, and downloads what the page made of it."""
    page.driver.execute_script("watched.keep = true")
    page.start()
    kept = "return document.querySelectorAll('#takes li').length"
    takes = page.driver.execute_script(kept)
    page.click("record")
    until(lambda: page.recorded_frames >= frames)
    page.driver.execute_script("document.getElementById('record').click(); document.getElementById('start').click()")
    page.driver.execute_script("watched.keep = false")
    until(lambda: page.driver.execute_script(kept) > takes)
    script = """
    const done = arguments[0];
    const withText = async (one) => ({...one, pixels: one.pixels && await watched.text(one.pixels)});
    Promise.all(watched.sent.map(withText)).then(done);
    """
    sent = [one for one in page.driver.execute_async_script(script) if one["pixels"]]
    solved = page.driver.execute_script(
        "return watched.solved.map(s => ({...s, weights: [...s.weights], rotation: [...s.rotation]}))"
    )
    (folder / "take.csv").write_bytes(blob(page, ".csv"))
    (folder / "take.glb").write_bytes(blob(page, ".glb"))
    return Recorded(sent, solved, folder / "take.csv", folder / "take.glb")


def assert_same_weights(graph: Path | bytes, recorded: Recorded, tolerance: float) -> None:
    """Runs the graph over the pixels that the page gave its worker, and compares the page's answers."""
    session = onnxruntime.InferenceSession(graph)
    size = next(one.shape[0] for one in session.get_inputs() if one.name == "state")
    state = np.zeros(size, np.float32)
    for sent, solved in zip(recorded.sent, recorded.solved, strict=False):
        pixels = np.frombuffer(base64.b64decode(sent["pixels"]), np.uint8)
        inputs = {
            "image": pixels.reshape(sent["height"], sent["width"], 4),
            "interval": np.array(solved["interval"], np.float32),
            "controls": np.array([sent["pose"], sent["gain"], sent["smoothing"], sent["reset"], 0], np.float32),
            "state": state,
        }
        weights, state = session.run(["weights", "next_state"], inputs)
        np.testing.assert_allclose(solved["weights"], weights, rtol=0, atol=tolerance)
