"""A small rig, and a headless Chromium that skips visibly where there is none."""

from typing import Any

import pytest
import torch
import trimesh

from torchface import BlendshapeRig, Mesh


def ball(subdivisions: int, radius: float, centre: tuple[float, float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and triangles of a round thing, as a mesher that is not ours makes them."""
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    vertices = torch.tensor(sphere.vertices, dtype=torch.float32) + torch.tensor(centre)
    return vertices, torch.tensor(sphere.faces, dtype=torch.int64)


@pytest.fixture(scope="session")
def two_balls() -> Mesh:
    """A large ball (a head) and a small one in front of it (a nose), millimetres; symmetric in x."""
    head, head_faces = ball(4, 90.0, (0.0, 0.0, 0.0))
    nose, nose_faces = ball(2, 15.0, (0.0, 0.0, 110.0))
    return Mesh(torch.cat([head, nose]), torch.cat([head_faces, nose_faces + len(head)]))


@pytest.fixture(scope="session")
def ball_rig(two_balls: Mesh) -> BlendshapeRig:
    """Shapes that move the head's left, right and lower side; ``noseSneerLeft`` moves the nose alone."""
    vertices = two_balls.vertices
    x, y, _ = vertices.unbind(1)
    on_nose = torch.arange(len(vertices)) >= 2562
    up, out = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    masks = {
        "jawOpen": (torch.relu(-y - 20) * ~on_nose, -up),
        "mouthSmileLeft": (torch.relu(x - 20) * ~on_nose, up),
        "mouthSmileRight": (torch.relu(-x - 20) * ~on_nose, up),
        "browInnerUp": (torch.relu(y - 20) * ~on_nose, out),
        "noseSneerLeft": (5.0 * on_nose, out),
        "cheekPuff": (torch.relu(x.abs() - 40) * ~on_nose, out),
        "eyeBlinkLeft": (0.2 * torch.relu(x - 30) * ~on_nose, out),
        "tongueOut": (8.0 * on_nose, out),
    }
    deltas = torch.stack([amount[:, None] * way for amount, way in masks.values()])
    return BlendshapeRig(two_balls, deltas, tuple(masks))


@pytest.fixture(scope="module")
def chromium(chromium: Any) -> Any:
    """Wide enough for a page with a panel."""
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    chromium.set_window_size(1280, 900)
    return chromium
