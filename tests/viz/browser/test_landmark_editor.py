"""The annotation page as a user meets it: the frame is the right way up, a dot is dragged, Save writes its files."""

import io
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from headless_chromium import until
from PIL import Image
from torch import Tensor

from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.landmarks.images.appearance.annotated_frames import AnnotatedFrame
from torchface.viz.browser.annotation_session import AnnotationSession
from torchface.viz.browser.landmark_editor import LandmarkEditor

pytestmark = pytest.mark.browser

_PROJECT = """
const view = window.__viserMutable, node = view && view.nodeRefFromName[arguments[0]];
if (!node || !view.camera || !view.canvas) return null;
const camera = view.camera, box = view.canvas.getBoundingClientRect();
camera.updateMatrixWorld(); node.updateWorldMatrix(true, false);
const p = node.position.clone().set(...arguments[1]).applyMatrix4(node.matrixWorld).project(camera);
return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
"""


def face(shift: float) -> Tensor:
    """68 points that lie like a face's in a picture of 200 x 240 pixels, well apart from one another."""
    rows = torch.arange(68)
    return torch.stack([40 + 12.0 * (rows % 10) + shift, 40 + 22.0 * (rows // 10) + 3.0 * (rows % 3)], dim=1)


@pytest.fixture
def editor(chromium: Any, tmp_path: Path) -> Iterator[LandmarkEditor]:
    picture = torch.zeros(3, 240, 200)
    picture[0, :120], picture[2, 120:] = 1.0, 1.0  # red above, blue below
    picture[1, :, 100:] = 0.8  # green to the right
    frames = [AnnotatedFrame(f"actor_{i:06d}", picture, face(i)) for i in (3, 7)]
    opened = LandmarkEditor(AnnotationSession(frames, tmp_path / "frames"), "actor", port=0)
    chromium.get(opened.url)
    until(lambda: position(chromium, opened, opened.session.landmarks[0]))
    # The camera is put straight before the face once the visitor is known.
    until(lambda: abs(position(chromium, opened, face(3).mean(0))[1] - middle(chromium)) < 2)
    yield opened
    chromium.get("about:blank")
    opened.stop()


def middle(chromium: Any) -> float:
    box = chromium.execute_script(
        "const b = window.__viserMutable.canvas.getBoundingClientRect(); return [b.top, b.height]"
    )
    return float(box[0] + box[1] / 2)


def position(chromium: Any, editor: LandmarkEditor, pixels: Tensor) -> list[float] | None:
    """Where in the browser's window a pixel of the picture is shown."""
    x, y = editor.to_page(pixels).tolist()
    return chromium.execute_script(_PROJECT, "/landmarks", [x, y, 0.0])


def colour(chromium: Any, editor: LandmarkEditor, pixels: tuple[float, float]) -> np.ndarray:
    x, y = position(chromium, editor, torch.tensor(pixels)) or (0, 0)
    page = np.asarray(Image.open(io.BytesIO(chromium.get_screenshot_as_png())).convert("RGB"), dtype=float)
    return page[round(y), round(x)]


def press(chromium: Any, words: str) -> None:
    button = until(lambda: chromium.find_elements("xpath", f"//button[contains(., '{words}')]"))[0]
    chromium.execute_script("arguments[0].click()", button)


def drag(chromium: Any, begin: list[float], end: list[float]) -> None:
    from selenium.webdriver import ActionChains

    points = np.linspace(begin, end, 9).round().astype(int).tolist()
    moves = ActionChains(chromium, duration=50).move_by_offset(*points[0]).click_and_hold()
    for before, after in pairwise(points):
        moves = moves.move_by_offset(after[0] - before[0], after[1] - before[1]).pause(0.03)
    moves.pause(0.2).release().move_by_offset(-points[-1][0], -points[-1][1]).perform()


@pytest.mark.bench
def test_a_frame_is_upright_and_its_dots_are_dragged_and_saved(chromium: Any, editor: LandmarkEditor) -> None:
    session = editor.session
    until(lambda: colour(chromium, editor, (25.0, 60.0))[0] > 150)  # red, above
    above, below = colour(chromium, editor, (25.0, 60.0)), colour(chromium, editor, (25.0, 200.0))
    right = colour(chromium, editor, (180.0, 60.0))
    assert above[0] > above[2] + 100
    assert below[2] > below[0] + 100
    assert right[1] > above[1] + 100
    # A dot goes where the pointer takes it, as far as the pointer went.
    target = session.landmarks[33] + torch.tensor([14.0, -9.0])
    drag(
        chromium,
        position(chromium, editor, session.landmarks[33]) or [],
        position(chromium, editor, target) or [],
    )
    until(lambda: (session.landmarks[33] - target).norm() < 1.0)
    assert (session.landmarks[:33] - face(3)[:33]).abs().max() < 1e-6  # the others stay
    until(lambda: editor.chosen == 33)
    assert "nose base 3" in until(lambda: chromium.find_element("tag name", "body").text)
    press(chromium, "Undo")
    until(lambda: torch.equal(session.landmarks[33].float(), face(3)[33]))
    # The one that was chosen comes to a click on the picture.
    from selenium.webdriver import ActionChains

    place = torch.tensor([22.0, 215.0])
    x, y = position(chromium, editor, place) or (0, 0)
    ActionChains(chromium).move_by_offset(round(x), round(y)).click().move_by_offset(-round(x), -round(y)).perform()
    until(lambda: (session.landmarks[33] - place).norm() < 1.0)
    kept = session.landmarks.clone()
    press(chromium, "Save and next")
    path = session.folder / "actor_000003.pts"
    until(path.is_file)
    torch.testing.assert_close(load_landmark_points(path).points, kept, atol=1e-3, rtol=0)
    assert path.with_suffix(".png").is_file()
    until(lambda: session.frame.name == "actor_000007")
    until(lambda: "1 of 2" in chromium.find_element("tag name", "body").text)
    # Saving the last one stays, and says that nothing is left.
    press(chromium, "Save and next")
    until((session.folder / "actor_000007.pts").is_file)
    until(lambda: "all frames are saved now" in chromium.find_element("tag name", "body").text)
