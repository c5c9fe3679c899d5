"""Takes the picture of the viewer that the README shows:
``TORCHFACE_PICTURES=docs/images pytest tests/viz/browser/test_readme_picture.py``
"""

import io
import os
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.synthetic.stages.weight_curves import GESTURES, perform
from torchface.viz.browser.rig_viewer import RigViewer

FOLDER = os.environ.get("TORCHFACE_PICTURES")
_CLOSE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"


def shoot(chromium: Any, rig: BlendshapeRig, path: Path) -> None:
    """The viewer with a take loaded and a surprised smile dialled in, as an image."""
    take = perform(600, torch.Generator().manual_seed(1))
    viewer = RigViewer(rig, take, "performance_edited.csv", label="performer.glb", port=0)
    try:
        viewer.show_frame(240)
        viewer.editor.rest()
        dialled = {
            **GESTURES["smile"],
            "browInnerUp": 0.4,
            "jawOpen": 0.15,
            "cheekSquintLeft": 0.2,
            "cheekSquintRight": 0.2,
        }
        weights = mapping(tuple(dialled), rig.names) @ torch.tensor(list(dialled.values()))
        for row in weights.nonzero()[:, 0].tolist():
            viewer.set_weight(rig.names[row], float(weights[row]))
        chromium.set_window_size(1280, 900)
        chromium.get(viewer.url)
        drawn = "return Object.keys(window.__viserSceneTree?.getState() ?? {}).some(n => n.startsWith('/head/'))"
        end = time.monotonic() + 60
        while not chromium.execute_script(drawn) and time.monotonic() < end:
            time.sleep(0.2)
        time.sleep(6)  # the texture is shown at rest, and a software renderer takes its time
        chromium.execute_script(_CLOSE)
        time.sleep(2)
        picture = Image.open(io.BytesIO(chromium.get_screenshot_as_png())).convert("RGB")
    finally:
        chromium.get("about:blank")
        viewer.stop()
    picture.save(path, quality=88)


@pytest.mark.browser
@pytest.mark.skipif(FOLDER is None, reason="set TORCHFACE_PICTURES to the folder that the README's pictures lie in")
def test_the_picture_is_small_enough_for_a_readme(chromium: Any) -> None:
    from torchface.synthetic import character

    assert FOLDER is not None
    path = Path(FOLDER) / "viewer.jpg"
    path.parent.mkdir(parents=True, exist_ok=True)
    shoot(chromium, character(size=1024).rig, path)
    assert path.stat().st_size < 150_000
