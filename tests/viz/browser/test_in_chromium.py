"""The pages as a user meets them: Chromium renders them, a slider is dragged, the head is clicked on."""

import io
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from headless_chromium import until
from PIL import Image
from torch import Tensor

from torchface import BlendshapeRig, Mesh, Take, Track
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.operators import vertex_normals
from torchface.viz.browser.browser_page import SCALE
from torchface.viz.browser.head_mesh import OVER
from torchface.viz.browser.landmark_sets import custom_set
from torchface.viz.browser.picker import Picker
from torchface.viz.browser.rig_viewer import RigViewer

pytestmark = pytest.mark.browser

_VERTICES = """
const node = window.__viserMutable && window.__viserMutable.nodeRefFromName[arguments[0]];
let found = null;
if (node) node.traverse(x => { if (x.isMesh && found === null && x.geometry.attributes.position)
    found = [x.geometry.attributes.position.version, Array.from(x.geometry.attributes.position.array)]; });
return found;
"""
_PROJECT = """
const view = window.__viserMutable, camera = view.camera, box = view.canvas.getBoundingClientRect();
const node = view.nodeRefFromName[arguments[0]];
camera.updateMatrixWorld(); node.updateWorldMatrix(true, false);
const p = node.position.clone().set(...arguments[1]).applyMatrix4(node.matrixWorld).project(camera);
return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
"""
_STILL = """
const done = arguments[0], camera = window.__viserMutable.camera;
let before = "", same = 0;
const look = () => {
    const now = camera.matrixWorld.elements.join();
    same = now === before ? same + 1 : 0;
    before = now;
    if (same < 6) requestAnimationFrame(look); else done();
};
look();
"""
_THUMB = """
const label = [...document.querySelectorAll('label')].filter(e => e.textContent.trim() === arguments[0])[arguments[1]];
return label ? document.getElementById(label.getAttribute('for')).querySelector('[role=slider]') : null;
"""


def shown(chromium: Any, node: str) -> tuple[int, Tensor]:
    """How often the browser was given a mesh, and its vertices (V,3) as they lie in its memory."""
    version, flat = until(lambda: chromium.execute_script(_VERTICES, node))
    return version, torch.tensor(flat).reshape(-1, 3)


def picture(chromium: Any) -> np.ndarray:
    """The left part of the page, which is the scene."""
    whole = np.asarray(Image.open(io.BytesIO(chromium.get_screenshot_as_png())).convert("RGB"), dtype=float)
    return whole[200:, : whole.shape[1] // 2]


def thumb(chromium: Any, label: str, which: int = 0) -> Any:
    """The knob of a slider, rolled into view; labels are short, so the same may stand in two groups."""
    element = until(lambda: chromium.execute_script(_THUMB, label, which))
    chromium.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    return element


_BOX = "return arguments[0].closest('[id]').parentElement.querySelector('input[inputmode]')"


@pytest.fixture(scope="module")
def viewer(chromium: Any, ball_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RigViewer]:
    ramp = torch.linspace(0, 1, 240)[:, None, None]
    take = Take(20.0, weights=Track(("jawOpen",), ramp))  # long: a slow machine looks seldom while it plays
    opened = RigViewer(ball_rig, take, tmp_path_factory.mktemp("out") / "edited.csv", label="two balls", port=0)
    chromium.get(opened.url)
    shown(chromium, "/head/part0")
    yield opened
    chromium.get("about:blank")
    opened.stop()


def test_the_page_loads_with_head_panel_and_a_slider_a_shape(chromium: Any, viewer: RigViewer) -> None:
    until(lambda: "two balls" in chromium.find_element("tag name", "body").text)
    _, vertices = shown(chromium, "/head/part0")
    torch.testing.assert_close(vertices, viewer.rig.vertices[:2562])
    words = until(lambda: t if "Jaw" in (t := chromium.find_element("tag name", "body").text) else "")
    for word in ("Timeline", "Editing", "Active shapes", "Brows", "Eyes", "Jaw", "Mouth", "Cheeks", "Nose", "Other"):
        assert word in words
    for name in ("InnerUp", "Blink L", "Open", "Smile L", "Smile R", "Sneer L", "Puff", "tongueOut"):
        thumb(chromium, name)
    middle = picture(chromium)
    assert middle.std() > 15  # the head is drawn: background alone is a soft gradient


def test_a_slider_moves_the_mesh_that_the_browser_shows(chromium: Any, viewer: RigViewer) -> None:
    from selenium.webdriver.common.keys import Keys

    before = picture(chromium)
    nose_version, nose = shown(chromium, "/head/part1")
    thumb(chromium, "Smile L").send_keys(Keys.ARROW_RIGHT * 40)
    until(lambda: abs(float(viewer.editor.pose[1]) - 0.40) < 1e-6)
    expected = viewer.rig(torch.tensor([[0, 0.4, 0.4, 0, 0, 0, 0, 0]]))[0, :2562]  # symmetric: the right one too
    until(lambda: (shown(chromium, "/head/part0")[1] - expected).abs().max() < 1e-4)
    twin = thumb(chromium, "Smile R")
    until(lambda: float(twin.get_attribute("aria-valuenow")) == 0.4)
    assert shown(chromium, "/head/part1")[0] == nose_version  # what did not move was not sent
    assert torch.equal(shown(chromium, "/head/part1")[1], nose)
    until(lambda: np.abs(picture(chromium) - before).max() > 40)
    until(lambda: "mouthSmileLeft" in chromium.find_element("tag name", "body").text)


def test_a_number_that_is_typed_beyond_the_slider_ends_at_its_end(chromium: Any, viewer: RigViewer) -> None:
    from selenium.webdriver.common.keys import Keys

    box = chromium.execute_script(_BOX, thumb(chromium, "Blink L"))
    box.send_keys(Keys.CONTROL + "a")
    box.send_keys("57", Keys.TAB)
    until(lambda: float(viewer.editor.pose[6]) == 1.0)
    until(lambda: box.get_attribute("value") == "1")
    viewer.editor.reset()
    viewer.show_frame(0)


def test_reset_and_save_are_buttons_of_the_page(chromium: Any, viewer: RigViewer) -> None:
    viewer.set_weight("jawOpen", 0.5)
    assert not torch.equal(viewer.editor.weights, viewer.editor._loaded)
    button = until(lambda: chromium.find_elements("xpath", "//button[contains(., 'Save weights')]"))[0]
    chromium.execute_script("arguments[0].click()", button)
    until(viewer.out.exists)
    until(lambda: viewer.out.name in chromium.find_element("tag name", "body").text)
    reset = chromium.find_elements("xpath", "//button[contains(., 'Reset all')]")[0]
    chromium.execute_script("arguments[0].click()", reset)
    until(lambda: torch.equal(viewer.editor.weights, viewer.editor._loaded))
    until(lambda: (shown(chromium, "/head/part0")[1] - viewer.rig.vertices[:2562]).abs().max() < 1e-4)


@pytest.mark.bench
def test_play_moves_the_mesh_along_the_take(chromium: Any, viewer: RigViewer) -> None:
    play = until(lambda: chromium.find_elements("xpath", "//button[contains(., 'Play')]"))[0]
    chromium.execute_script("arguments[0].click()", play)
    chin = int(viewer.rig.vertices[:2562, 1].argmin())
    seen: list[float] = []

    def moved() -> bool:
        height = float(shown(chromium, "/head/part0")[1][chin, 1])
        seen.extend([height] if not seen or seen[-1] != height else [])
        return len(seen) >= 4

    until(moved)
    assert seen[:3] == sorted(seen[:3], reverse=True)  # the jaw opens along the ramp
    pause = until(lambda: chromium.find_elements("xpath", "//button[contains(., 'Pause')]"))[0]
    chromium.execute_script("arguments[0].click()", pause)
    until(lambda: not viewer.playback.playing)
    expected = viewer.rig(viewer.editor.pose[None])[0, :2562]
    until(lambda: (shown(chromium, "/head/part0")[1] - expected).abs().max() < 1e-4)
    until(lambda: thumb(chromium, "Frame").get_attribute("aria-valuenow") == str(viewer.editor.frame))


@pytest.mark.bench
def test_the_texture_is_hidden_in_motion_and_shown_at_rest(chromium: Any, ball_rig: BlendshapeRig) -> None:
    mesh = ball_rig.neutral
    colors = (mesh.vertices - mesh.vertices.amin(0)) / (mesh.vertices.amax(0) - mesh.vertices.amin(0))
    rig = BlendshapeRig(replace(mesh, colors=colors), ball_rig.deltas, ball_rig.names)
    opened = RigViewer(rig, port=0)
    try:
        chromium.get(opened.url)
        visible = "return (n => n ? n.visible : null)(window.__viserMutable?.nodeRefFromName['/head/textured'])"
        until(lambda: chromium.execute_script(visible) is True)

        with dragged(opened):
            until(lambda: chromium.execute_script(visible) is False)
        expected = opened.rig(opened.editor.pose[None])[0]
        until(lambda: chromium.execute_script(visible) is True)
        over = OVER * vertex_normals(expected, opened.rig.neutral.faces)  # where pieces in motion do not show through
        until(lambda: (1000 * shown(chromium, "/head/textured")[1] - expected - over).abs().max() < 1e-3)
        opened.head.enable_texture(False)
        until(lambda: chromium.execute_script(visible) is False)
    finally:
        chromium.get("about:blank")
        opened.stop()


_IN_VIEW = """
const view = window.__viserMutable;
for (const name of ['/head/textured', '/head/next0', '/head/next1', '/head/next2']) {
    const node = view && view.nodeRefFromName[name];
    let found = null;
    if (node && node.visible) node.traverse(x => { const map = x.isMesh && x.material.normalMap;
        if (map && map.image && map.image.width) {
            const canvas = new OffscreenCanvas(1, 1), pen = canvas.getContext('2d');
            pen.drawImage(map.image, 0, 0, 1, 1, 0, 0, 1, 1);
            found = [pen.getImageData(0, 0, 1, 1).data[0], Math.min(...x.geometry.attributes.position.array)];
        } });
    if (found) return found;
}
return null;
"""


@pytest.mark.bench  # a page that draws in software reads one head a second
def test_wrinkles_follow_the_weights_in_motion(
    chromium: Any, ball_rig: BlendshapeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head in view leans and has the normals of one weight, which changes while a shape moves."""
    monkeypatch.setattr("torchface.viz.browser.rig_viewer._TEXTURE_INTERVAL", 2.0)
    mesh, slope = ball_rig.neutral, 0.8
    uvs = mesh.vertices[:, :2] / 200 + 0.5
    move = torch.zeros_like(ball_rig.deltas[:1])
    move[:, :, 0] = -300.0  # the least coordinate of all says the weight
    rig = BlendshapeRig(replace(mesh, uvs=uvs, uv_faces=mesh.faces), move, ("jawOpen",))
    tilted = torch.nn.functional.normalize(torch.tensor([slope, 0.0, 1.0]), dim=0)[None, :, None, None]
    flat = torch.tensor([0.0, 0.0, 1.0])[:, None, None].expand(3, 16, 16)
    opened = RigViewer(rig, detail=DetailMaps(("jawOpen",), tilted.expand(1, 3, 16, 16), flat), port=0)
    seen = []
    try:
        chromium.get(opened.url)
        until(lambda: chromium.execute_script(_IN_VIEW))
        with dragged(opened):
            until(lambda: seen.append(chromium.execute_script(_IN_VIEW)) or len(set(map(str, filter(None, seen)))) > 2)
        opened.set_weight("jawOpen", 0.5)
        until(lambda: abs(weight_of(chromium.execute_script(_IN_VIEW), mesh) - 0.5) < 0.01)
    finally:
        chromium.get("about:blank")
        opened.stop()
    for found in filter(None, seen):
        steep = slope * weight_of(found, mesh)
        expected = 255 * (0.5 + 0.5 * steep / math.hypot(1, steep))
        assert abs(found[0] - expected) < 4


def weight_of(found: list[float] | None, mesh: Mesh) -> float:
    return math.nan if found is None else (float(mesh.vertices[:, 0].min()) - OVER - 1000 * found[1]) / 300


@contextmanager
def dragged(viewer: RigViewer) -> Iterator[None]:
    """The jaw moves all the time, however slowly the browser is looked at."""
    ended = threading.Event()

    def drag() -> None:
        while not ended.wait(0.08):
            viewer.set_weight("jawOpen", time.monotonic() % 1.0)

    hand = threading.Thread(target=drag)
    hand.start()
    try:
        yield
    finally:
        ended.set()
        hand.join()


@pytest.fixture
def picker(chromium: Any, two_balls: Mesh, tmp_path) -> Iterator[Picker]:
    scan = two_balls.with_vertices(two_balls.vertices * 1.1 + torch.tensor([400.0, 30.0, -50.0]))
    marks = custom_set(["left ear", "right ear", "chin"])
    opened = Picker(two_balls, scan, tmp_path / "picks", marks, "landmarks", "picking", port=0)
    chromium.get(opened.url)
    shown(chromium, "/head/part0")
    shown(chromium, "/scan/part0")
    yield opened
    chromium.get("about:blank")
    opened.stop()


def settle(chromium: Any) -> None:
    """Waits until the camera has glided to its place: until it has stood still for some of the page's frames."""
    time.sleep(1.0)
    chromium.execute_async_script(_STILL)


def click_on(chromium: Any, node: str, point: Tensor) -> None:
    """A real click at the pixel under which a point of the node (its own units) lies."""
    from selenium.webdriver import ActionChains

    x, y = chromium.execute_script(_PROJECT, node, [float(c) * SCALE for c in point])
    ActionChains(chromium).move_by_offset(round(x), round(y)).click().perform()
    ActionChains(chromium).move_by_offset(-round(x), -round(y)).perform()


def front_vertices(mesh: Mesh) -> list[int]:
    """Two vertices of the large ball that face the camera and lie beside the small one."""
    wanted = torch.tensor([[45.0, 35.0, 70.0], [-50.0, -30.0, 68.0]])
    return torch.cdist(wanted, mesh.vertices[:2562]).argmin(1).tolist()


def test_a_click_picks_the_vertex_under_the_cursor(chromium: Any, picker: Picker, two_balls: Mesh) -> None:
    settle(chromium)
    first, second = front_vertices(two_balls)
    click_on(chromium, "/head/part0", two_balls.vertices[first])
    until(lambda: picker.session.picks.landmarks[0] is not None)
    assert picker.session.picks.landmarks == (first, None, None)
    click_on(chromium, "/head/part0", two_balls.vertices[second])
    until(lambda: picker.session.picks.landmarks[1] is not None)
    assert picker.session.picks.landmarks == (first, second, None)
    until(lambda: "2 of 3" in chromium.find_element("tag name", "body").text)
    until(lambda: chromium.execute_script("return '/picks/landmarks' in window.__viserSceneTree.getState()"))
    undo = chromium.find_elements("xpath", "//button[contains(., 'Undo')]")[0]
    chromium.execute_script("arguments[0].click()", undo)
    until(lambda: picker.session.picks.landmarks == (first, None, None))


@pytest.mark.bench
def test_clicks_on_head_and_scan_make_a_pair(chromium: Any, picker: Picker, two_balls: Mesh) -> None:
    settle(chromium)
    picker._mode.value = "correspondences"
    vertex, other = front_vertices(two_balls)
    scan = picker.session.scan
    click_on(chromium, "/head/part0", two_balls.vertices[vertex])
    until(lambda: picker.session.picks.waiting == vertex)
    click_on(chromium, "/scan/part0", scan.vertices[other])
    until(lambda: picker.session.picks.pairs)
    pairs = picker.session.correspondences()
    assert pairs.vertices.tolist() == [vertex]
    # A pixel is about 1 mm here; the scan's own space, not the page's.
    assert (pairs.points[0] - scan.vertices[other].double()).norm() < 2.0
