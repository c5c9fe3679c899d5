"""Panoramas light chalk as the integral over all directions does; files that are none are refused."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.io.images.radiance_hdr import load_panorama
from torchface.rendering.environment_light import EnvironmentLight
from torchface.rendering.point_light import PointLight, irradiance


def normals_of_a_ball() -> torch.Tensor:
    """Of a ball before the camera, one a pixel of its disc, (P,3)."""
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, 201).double()] * 2, indexing="ij")
    inside = x * x + y * y < 1
    x, y = x[inside], y[inside]
    return torch.stack([x, y, -(1 - x * x - y * y).sqrt()], 1)


@pytest.mark.parametrize("toward", [(0.0, 0.0, -1.0), (0.7, -0.3, -0.5), (1.0, 0.0, 0.0), (-0.5, 0.1, 0.8)])
def test_light_on_what_the_camera_sees_of_a_ball_is_its_mean(toward: tuple[float, float, float]) -> None:
    ambient, intensity = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([1.0, 0.5, 0.25])
    light, ball = PointLight.directional(ambient, intensity, torch.tensor(toward)), normals_of_a_ball()
    expected = irradiance(torch.zeros_like(ball), ball, light).mean(0)
    torch.testing.assert_close(light.on_front(), expected.float(), atol=2e-3, rtol=0)
    assert torch.equal(light.on_front(least=0.0) > light.on_front(), torch.full((3,), toward[2] > 0))


def test_a_panorama_lights_as_the_integral_of_the_clamped_cosine() -> None:
    """A bright quarter of the sky: by summing over 200,000 random directions."""
    generator = torch.Generator().manual_seed(0)
    panorama = torch.full((3, 64, 128), 0.2)
    panorama[:, :32, 64:96] = torch.tensor([3.0, 2.0, 1.0])[:, None, None]  # up, on the right of the middle
    light = EnvironmentLight.of(panorama)
    toward = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=generator).double(), dim=-1)
    # As the docstring says: the middle is the camera (z back), up is -y, the right half lies at the viewer's left.
    up, around = -toward[:, 1].asin(), torch.atan2(-toward[:, 0], -toward[:, 2])
    rows, columns = (0.5 - up / math.pi) * 64, (around / (2 * math.pi) + 0.5) * 128
    seen = panorama[:, rows.long().clamp(0, 63), columns.long().clamp(0, 127)].double()
    normals = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator).double(), dim=-1)
    expected = 4 * (seen @ (toward @ normals.T).clamp(min=0)).T / len(toward)
    found = light.irradiance(normals)
    assert float((found - expected).abs().mean() / expected.mean()) < 0.04
    ball = normals_of_a_ball()
    torch.testing.assert_close(light.on_front, light.irradiance(ball).mean(0), atol=0.01, rtol=0.01)
    brightest = torch.nn.functional.normalize(torch.tensor([-0.5, -0.7, -0.5]).double(), dim=0)
    assert light.irradiance(brightest)[0] > 3 * light.irradiance(-brightest)[0]


def test_a_radiance_file_is_read_and_others_are_refused(tmp_path: Path) -> None:
    image = np.random.default_rng(0).uniform(0, 40, (8, 16, 3)).astype(np.float32)
    path = tmp_path / "sky.hdr"
    assert cv2.imwrite(str(path), image)
    found = load_panorama(path)
    assert found.shape == (3, 8, 16)
    away = np.abs(found.permute(1, 2, 0).numpy()[..., ::-1] - image)
    assert away.max() < 0.01 * image.max()  # eight bits beside an exponent that three channels share
    data = path.read_bytes()
    for name, content, said in (
        ("text.hdr", b"a panorama", "found no Radiance picture"),
        ("cut.hdr", data[:90], "cut off|damaged"),
        ("square.hdr", data.replace(b"-Y 8 +X 16", b"-Y 8 +X 8"), "found 8 x 8 pixels"),
        ("huge.hdr", data.replace(b"-Y 8 +X 16", b"-Y 80000 +X 160000"), "at most"),
        ("noise.hdr", data[: data.index(b"+X 16") + 6] + b"\xff" * 64, "damaged"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=said):
            load_panorama(tmp_path / name)
    with pytest.raises(ShapeError, match=r"panorama: found \(8, 16\)"):
        EnvironmentLight.of(torch.ones(8, 16))
    with pytest.raises(ValueRangeError, match="negative"):
        EnvironmentLight.of(-torch.ones(3, 8, 16))
