"""Wrinkle maps on the page move with the shapes, and are mixed as ``DetailMaps.blend`` mixes them."""

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from browser import WEB, posted
from test_gltf_viewers import node  # noqa: F401  (its packages)
from torch import Tensor

from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io import save_rig
from torchface.io.images.image_files import decode_image
from torchface.shape_names import ARKIT
from torchface.synthetic import performer

pytestmark = [pytest.mark.browser, pytest.mark.bench]
SOURCES = Path(__file__).resolve().parents[3] / "export" / "web" / "src"
PAGE = """<!doctype html><meta charset="utf-8"><script type="importmap">
{"imports": {"three": "/node_modules/three/build/three.module.js",
  "three/addons/": "/node_modules/three/examples/jsm/"}}
</script><script type="module">
import { readCharacter } from "/src/character.js";
import { Stage } from "/src/stage.js";
async function draw([file, weights]) {
  const canvas = document.createElement("canvas");
  const stage = new Stage(canvas, { width: 320, height: 320, background: "#707880" });
  const character = await readCharacter(await (await fetch(file)).arrayBuffer(), file);
  stage.show(character);
  character.pose({ weights, rotation: [1, 0, 0, 0, -1, 0, 0, 0, -1], gaze: [0, 0, 0, 0] });
  stage.drawNow();
  return canvas.toDataURL("image/png");
}
async function all() {
  const pictures = [];
  for (const shot of SHOTS) pictures.push(await draw(shot));
  return { pictures };
}
all().catch((error) => ({ error: String(error.stack ?? error) }))
  .then((result) => fetch("/result", { method: "POST", body: JSON.stringify(result) }));
</script>"""


def waves(side: int, across: float, up: float) -> Tensor:
    """Normals (3,side,side) of ridges."""
    at = torch.linspace(0, 1, side)
    slope = 0.7 * torch.cos(across * at[None] + up * at[:, None])
    return torch.nn.functional.normalize(torch.stack([slope, 0.5 * slope, torch.ones(side, side)]), dim=0)


def test_the_page_mixes_as_the_library_does(node: str, chromium: Any, tmp_path: Path) -> None:  # noqa: F811
    rig = performer(texture=False).select(["jawOpen", "browInnerUp"])
    maps = DetailMaps(rig.names, torch.stack([waves(256, 160, 0), waves(256, 0, 200)]), waves(256, 90, 90))
    weights = torch.tensor([0.4, 0.7])
    mixed = maps.blend(rig.names, weights)
    for name, detail in {
        "wrinkled": maps,
        "at_rest": DetailMaps((), maps.maps[:0], maps.neutral),
        "expected": DetailMaps((), maps.maps[:0], mixed),
    }.items():
        save_rig(rig, tmp_path / f"{name}.glb", detail)
    shutil.copytree(SOURCES, tmp_path / "src")
    (tmp_path / "node_modules").symlink_to(WEB / "node_modules")
    row = [0.0] * len(ARKIT)
    for shape, weight in zip(rig.names, weights.tolist(), strict=True):
        row[ARKIT.index(shape)] = weight
    files = [("wrinkled", row), ("expected", row), ("at_rest", row), ("wrinkled", [0.0] * 52), ("at_rest", [0.0] * 52)]
    shots = json.dumps([[f"/{name}.glb", values] for name, values in files])
    (tmp_path / "page.html").write_text(PAGE.replace("SHOTS", shots))
    found = posted(chromium, tmp_path, "page.html", {})["pictures"]
    pictures = [decode_image(base64.b64decode(url.partition(",")[2]), "the page's picture") for url in found]
    moved, expected, still, rest, rest_expected = pictures
    off = lambda a, b: float((a - b).abs().mean() * 255)  # noqa: E731
    assert off(expected, still) > 1.5  # what would be seen without them
    assert off(moved, expected) < 0.15 * off(expected, still)
    assert off(rest, rest_expected) < 0.15 * off(expected, still)
