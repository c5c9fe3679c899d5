"""What three-vrm in Chromium makes of a VRM with added expressions: it loads, and each of them moves the mesh."""

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import posted
from scipy.spatial.transform import Rotation

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
def browser(chromium: Any) -> Any:
    """A Chromium, with three-vrm installed in ``web``; kept there for the next run."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed; three-vrm comes from it")
    if not (WEB / "node_modules" / "@pixiv").is_dir():
        command = [npm, "ci", "--no-audit", "--no-fund"]
        done = subprocess.run(command, cwd=WEB, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode != 0:
            pytest.skip(f"npm could not install three-vrm: {done.stderr[-300:]}")
    return chromium


def seen(browser: Any, avatar: Path, animation: Path | None = None) -> dict:
    """What the page posts of an avatar."""
    files = {"/avatar.vrm": avatar.read_bytes()}
    if animation is None:
        return posted(browser, WEB, "avatar.html", files)
    return posted(browser, WEB, "avatar.html?animation=1", files | {"/animation.vrma": animation.read_bytes()})


@pytest.mark.parametrize(("version", "preset", "meta"), [("VRMC_vrm", "blinkLeft", "1"), ("VRM", "blink_l", "0")])
def test_added_expressions_move_the_mesh(browser: Any, tmp_path: Path, version: str, preset: str, meta: str) -> None:
    before, after = tmp_path / "before.vrm", tmp_path / "after.vrm"
    lift = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 10, 0], [0, 0, 0]])
    count = write_character(before, HEAD, {"lid": lift}, Planted(vrm=version, expressions={preset: "lid"}))
    document = read_document(before)
    moved = np.zeros((2, count, 3), np.float32)
    moved[0, 0], moved[1, 1] = (0.0, -0.02, 0.0), (0.03, 0.0, 0.0)
    root, data = document_with_targets(document, [AddedTargets(0, (0,), moved)], NAMES)
    add_expressions(document, root, {name: [MorphBind(0, 0, 1 + row)] for row, name in enumerate(NAMES)})
    write_edited(document, root, data, after)
    found = seen(browser, after)
    assert found["version"] == meta
    assert found["moved"]["blinkLeft"] == pytest.approx(0.01, abs=1e-5)  # as before; three-vrm has VRM 1's names
    assert found["moved"]["jawOpen"] == pytest.approx(0.02, abs=1e-5)
    assert found["moved"]["mouthSmileLeft"] == pytest.approx(0.03, abs=1e-5)


@pytest.mark.real
def test_an_animation_still_plays(browser: Any, tmp_path: Path, data: Path) -> None:
    avatar = tmp_path / "avatar.vrm"
    write_character(avatar, HEAD, how=Planted(vrm="VRMC_vrm"))
    document = read_document(avatar)
    moved = np.zeros((1, 44, 3), np.float32)
    root, added = document_with_targets(document, [AddedTargets(0, (0,), moved)], ["jawOpen"])
    write_edited(document, root, added, avatar)
    found = seen(browser, avatar, data / "characters" / "test.vrma")
    turned = Rotation.from_quat(list(found["turned"].values()))
    assert turned.magnitude().max() > 0.01  # radians
