"""Light of a photograph, estimated on the skin and divided out of its colours."""

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import Camera
from torchface.rendering.camera_visibility import Shown
from torchface.rendering.environment_light import EnvironmentLight, harmonics

_SQUARE, _LEAST = 0.3, 60
_UNLIKE = 0.18  # of a logarithm: shadows, stubble and highlights further off count little
_ROUNDS = 8
# Precision of the first and second degree beside as many vertices as count: cheeks and beards are no light.
_HELD = (0.0, *(0.02,) * 3, *(0.10,) * 5)
_HELD_TO_GREY = 0.3
_FAINT, _BRIGHT, _TINT = 0.4, 2.2, 1.12  # beside the mean: what the estimate may divide by


def skin_light(shown: Shown, normals: Tensor, camera: Camera, skin: Tensor) -> EnvironmentLight | None:
    r"""The light in which a photograph shows skin of one colour, in mean 1; None where it shows too little of it.

    .. math:: \min_L \sum_v \rho\bigl(\log c_v - \log \rho_0 L(n_v)\bigr) + \lVert L \rVert^2_\Lambda

    First for the mean of the channels, then for each, held to that: what is red all over is the skin, not the light.

    Args:
        normals: unit, (V,3), in the world.
        skin: vertices that are surely skin, (V,) bool.

    Source: Ramamoorthi and Hanrahan 2001 (irradiance in spherical harmonics).
    """
    rows = (skin & (shown.cosine > _SQUARE)).nonzero()[:, 0]
    if len(rows) < _LEAST:
        return None
    colors = to_linear(shown.colors[rows].double().clamp(0.01, 1))
    basis = harmonics(in_camera(normals[rows], camera))
    even = basis.new_zeros(basis.shape[1])
    even[0] = 1 / basis[0, 0]
    held = basis.new_tensor(_HELD).diag()
    grey = _fitted(colors.mean(1), basis, even, held)
    held_to_grey = held + _HELD_TO_GREY * torch.eye(len(even), dtype=torch.float64)
    channels = [_fitted(colors[:, k], basis, grey, held_to_grey) for k in range(3)]
    return EnvironmentLight(torch.stack(channels, dim=1))


def _fitted(color: Tensor, basis: Tensor, goal: Tensor, held: Tensor) -> Tensor:
    """Harmonics (9,) of light that is 1 in the mean over the vertices, by reweighted least squares."""
    weight, light = torch.ones_like(color), goal
    for _ in range(_ROUNDS):
        level = (color / (basis @ light).clamp(min=0.1)).log()
        albedo = ((weight * level).sum() / weight.sum()).exp()
        apart = (level - albedo.log()) / _UNLIKE
        weight = 1 / (1 + apart.square())
        total = weight.sum()
        H = (basis * weight[:, None]).T @ basis / total + held
        light = torch.linalg.solve(H, (basis * weight[:, None]).T @ (color / albedo) / total + held @ goal)
        light = light / ((weight * (basis @ light)).sum() / total).clamp(min=0.1)
    return light


def unlit(colors: Tensor, normals: Tensor, camera: Camera, light: EnvironmentLight | None) -> Tensor:
    """Colours (Q,3), sRGB, of a photograph at points with normals (Q,3) in even light of the same brightness."""
    if light is None:
        return colors
    shade = light.irradiance(in_camera(normals.double(), camera))
    grey = shade.mean(-1, keepdim=True).clamp(_FAINT, _BRIGHT)
    tint = (shade / grey).clamp(1 / _TINT, _TINT)  # what is dark has hardly a hue to be divided by
    return to_srgb((to_linear(colors.double().clamp(0, 1)) / (grey * tint)).clamp(0, 1)).to(colors)


def in_camera(normals: Tensor, camera: Camera) -> Tensor:
    """Directions (...,3) of the world in the camera's frame."""
    return normals.double() @ camera.rotation.double().T
