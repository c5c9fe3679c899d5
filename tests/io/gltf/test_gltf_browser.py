"""What three.js draws of our rigs in a real browser: eyes that are eyes, expressions shaded as they are shaped."""

from pathlib import Path
from typing import Any

import pytest
import torch
from browser import Shot, pictures
from test_gltf_viewers import node  # noqa: F401  (its packages)
from torch import Tensor

from planted.glb_files import rewrite
from torchface import BlendshapeRig, load_rig, save_mesh, save_rig
from torchface.synthetic import performer

pytestmark = pytest.mark.browser
SIDE = 240


def frame(rig: BlendshapeRig, region: Tensor, margin: float = 1.2) -> tuple[tuple[float, float, float], float]:
    """The middle of a region and how wide it is, metres."""
    low, high = rig.vertices[region].amin(0), rig.vertices[region].amax(0)
    x, y, z = ((low + high) / 2000).tolist()
    return (x, y, z), float((high - low)[:2].max()) / 1000 * margin


def at(picture: Tensor, point: Tensor, shot: Shot) -> Tensor:
    """The colour (3,) where a point (3,) in millimetres is seen from in front, the mean of 3 x 3 pixels."""
    column = int(((float(point[0]) / 1000 - shot.target[0]) / shot.span + 0.5) * SIDE)
    row = int((0.5 - (float(point[1]) / 1000 - shot.target[1]) / shot.span) * SIDE)
    return picture[:, row - 1 : row + 2, column - 1 : column + 2].mean((1, 2))


def shaded_apart(first: Tensor, second: Tensor) -> float:
    """The mean difference of the pixels that are not background in either, of 255."""
    ground = first[:, 0, 0]
    shown = ((first - ground[:, None, None]).abs().amax(0) > 0.02) & (
        (second - ground[:, None, None]).abs().amax(0) > 0.02
    )
    return float((first - second).abs().mean(0)[shown].mean()) * 255


def without_turned_normals(path: Path, out: Path) -> Path:
    """The file with morph targets that carry positions alone."""

    def strip(root: dict[str, Any]) -> None:
        for mesh in root["meshes"]:
            for primitive in mesh["primitives"]:
                primitive["targets"] = [{"POSITION": target["POSITION"]} for target in primitive["targets"]]

    return rewrite(path, strip, out)


def as_shaped(rig: BlendshapeRig, shape: str, folder: Path) -> list[Path]:
    """The rig; a mesh in the shape at 1, whose normals are its own; the rig without turned normals."""
    save_rig(rig, folder / "rig.glb")
    moved = rig.neutral.with_vertices(rig.vertices + rig.deltas[rig.index([shape])[0]])
    save_mesh(moved, folder / "moved.glb")
    return [folder / "rig.glb", folder / "moved.glb", without_turned_normals(folder / "rig.glb", folder / "stiff.glb")]


def assert_shaded_alike(morphed: Tensor, expected: Tensor, stiff: Tensor) -> None:
    assert shaded_apart(stiff, expected) > 1.0
    assert shaded_apart(morphed, expected) < 0.1 * shaded_apart(stiff, expected)


@pytest.mark.usefixtures("node")
def test_a_smile_of_the_performer_is_shaded_as_it_is_shaped(chromium: Any, tmp_path: Path) -> None:
    rig = performer().select(["mouthSmileLeft"])
    shot = Shot({"mouthSmileLeft": 1.0}, 25, *frame(rig, rig.neutral.annotations.regions["face"]))
    files = as_shaped(rig, "mouthSmileLeft", tmp_path)
    assert_shaded_alike(*pictures(chromium, [(file, shot) for file in files], SIDE))


@pytest.mark.bench
@pytest.mark.real
@pytest.mark.usefixtures("node")
def test_a_real_head_has_eyes_and_skin_in_their_own_colours_and_shaded_shapes(
    chromium: Any, tmp_path: Path, ict_folder: Path
) -> None:
    rig = load_rig(ict_folder, shapes=["eyeBlink_L", "eyeBlink_R", "jawOpen"])
    regions = rig.neutral.annotations.regions
    view = frame(rig, regions["narrow_face"])
    front, closed, jaw = (
        Shot({}, 0, *view),
        Shot({"eyeBlink_L": 1, "eyeBlink_R": 1}, 0, *view),
        Shot({"jawOpen": 1}, 25, *view),
    )
    files = as_shaped(rig, "jawOpen", tmp_path)
    wanted = [(files[0], front), (files[0], closed), *((file, jaw) for file in files)]
    eyes_open, eyes_closed, *jaws = pictures(chromium, wanted, SIDE)
    assert_shaded_alike(*jaws)
    ball = rig.vertices[regions["eyeball_left"]]
    pupil = ball[ball[:, 2].argmax()]
    white = pupil + torch.tensor([8.5, -1.5, 0.0])  # outward of the iris, clear of the upper lashes
    skin = at(eyes_open, rig.vertices[rig.neutral.landmarks[30]] + torch.tensor([0.0, 25.0, 0.0]), front)
    assert float(at(eyes_open, pupil, front).mean()) < 0.4
    eye = at(eyes_open, white, front)
    assert float(eye.amax() - eye.amin()) < 0.5 * float(skin.amax() - skin.amin())  # greyer than skin
    lid = at(eyes_closed, pupil + torch.tensor([0.0, 1.5, 0.0]), closed)
    assert float((lid - skin).abs().max()) < 0.2
