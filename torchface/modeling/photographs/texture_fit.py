"""A colour model fitted to photographs: the thesis's colour error over the skin that they show."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.errors import AlignmentError, ShapeError, TopologyError
from torchface.geometry.cameras.pinhole import Camera
from torchface.mesh import Mesh
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.number_checks import checked_number
from torchface.optim import box_qp
from torchface.rendering.camera_visibility import PosedSurface

_STRENGTH = 0.1 / 0.05  # of the model's own distribution beside one vertex at a colour error of 0.05
_SQUARELY = 0.2  # cosine; what is seen more obliquely is blurred and mixed with what stands behind
_MIN_ERROR = 0.01  # of full white: below it the colour error counts squared, so that it has a derivative
_MIN_VERTICES = 50
_LIGHT_PRIOR = 1.0
_BLACK = 0.01  # what has no shade that can be divided out, and counts no more for being darker
_MAX_ITERATIONS, _DONE = 30, 1e-5


@dataclass(frozen=True, eq=False)
class ColorFit:
    """A colour model fitted to I photographs.

    Args:
        coefficients: (L,), standard deviations.
        colors: of the vertices under even light, (V,3) in [0,1].
        light: of each photograph's channels, linear: ambient, then along x, y, z of the normal, (I,3,4); even light
            of strength 1 is (1,0,0,0).
        error: mean Euclidean colour distance at visible vertices, (I,).
    """

    coefficients: Tensor
    colors: Tensor
    light: Tensor
    error: Tensor


def fit_colors(
    model: MorphableModel,
    mesh: Mesh | Sequence[Mesh],
    images: Sequence[Tensor],
    cameras: Sequence[Camera],
    lighting: bool = True,
    bound: float = 3.0,
) -> ColorFit:
    r"""The coefficients of a colour model under which a head resembles its photographs.

    .. math:: E_T = \frac1n \sum_v \lVert g(L_i(n_v)\, g^{-1}(C_v(b))) - c_{iv} \rVert, \quad |b| \le 3

    with g from linear light to sRGB, over the vertices that each photograph shows: distances, not their squares, so
    that a highlight, a strand of hair or a shadow counts little. Solved by reweighted least squares, each step a
    quadratic program in a box. The light L is the thesis's missing part: per channel an ambient and a directed share;
    without it photographs must be lit evenly.

    Args:
        model: of vertex colours.
        mesh: the head as the photographs show it, or as each of them does.
        images: photographs, (3,H,W) each.
        cameras: one each.
        lighting: estimate each photograph's light.
        bound: on each coefficient, standard deviations.

    Raises:
        ShapeError: not one camera an image, or an image of another size than its camera's.
        TopologyError: the model has other vertices than the mesh.
        AlignmentError: a photograph shows next to nothing of the head.

    Source: thesis 3.2.5, algorithm 3, equation 16.

    Example:
        >>> from torchface import zoo
        >>> from torchface.geometry.cameras.pinhole import look_at
        >>> model = zoo.get_model("head")
        >>> head = model.mesh(torch.zeros(model.shape.count), torch.zeros(model.color.count))
        >>> camera = look_at(head.vertices[head.landmarks].mean(0), 0.0, width=60, height=80)
        >>> from torchface.rendering.clay_shading import Lighting, render
        >>> even = Lighting(lights=(), ambient=1.0, occlusion_rays=0, gloss=0.0)
        >>> photograph = render(head, camera, lighting=even, samples=1)
        >>> fit_colors(model.color, head, [photograph], [camera], lighting=False).error.item() < 0.1
        True
    """
    if len(images) != len(cameras) or not images:
        raise ShapeError(f"fit_colors: found {len(images)} images and {len(cameras)} cameras, expected one each")
    surfaces = PosedSurface.each(mesh, len(images))
    count = len(surfaces[0].vertices)
    if len(model.mean) != count:
        raise TopologyError(f"fit_colors: found a model of {tuple(model.mean.shape)} for a mesh of {count} vertices")
    checked_number("fit_colors: bound", bound, above=True)
    views = _shown_vertices(surfaces, images, cameras)
    mean, modes = model.mean.cpu().double(), model.modes.cpu().double()
    coefficients = torch.zeros(len(modes), dtype=torch.float64)
    light = torch.zeros(len(views), 3, 4, dtype=torch.float64)
    light[..., 0] = 1.0
    before = torch.inf
    for _ in range(_MAX_ITERATIONS):
        H, f, total = _STRENGTH * torch.eye(len(modes), dtype=torch.float64), torch.zeros_like(coefficients), 0.0
        for i, view in enumerate(views):  # photographs: each shows other vertices
            albedo = mean[view.ids] + torch.einsum("l,lvc->vc", coefficients, modes[:, view.ids])
            weight = view.share / (view.lit(albedo, light[i]) - view.colors).norm(dim=-1).clamp(min=_MIN_ERROR)
            if lighting:
                light[i] = _light(albedo, view, weight, light[i])
            albedo = albedo.clamp(min=_BLACK)
            shade = view.lit(albedo, light[i]) / albedo
            A = (modes[:, view.ids] * shade).flatten(1)
            b = (mean[view.ids] * shade - view.colors).flatten()
            w = weight.repeat_interleave(3)
            H, f = H + (A * w) @ A.T, f + (A * w) @ b
            total += float((view.share * (albedo * shade - view.colors).norm(dim=-1)).sum())
        coefficients = box_qp(H, f[None], -bound, bound, start=coefficients[None])[0]
        energy = total + 0.5 * _STRENGTH * float(coefficients.square().sum())
        if abs(before - energy) < _DONE * energy:
            break
        before = energy
    colors = mean + torch.einsum("l,lvc->vc", coefficients, modes)
    errors = [
        (view.share * (view.lit(colors[view.ids], lit) - view.colors).norm(dim=-1)).sum() / view.share.sum()
        for view, lit in zip(views, light, strict=True)
    ]
    return ColorFit(coefficients.float(), colors.clamp(0, 1).float(), light.float(), torch.stack(errors).float())


@dataclass(frozen=True, eq=False)
class _View:
    """The vertices (Q,) that a photograph shows: colours (Q,3), 1 and the normal (Q,4), how squarely (Q,)."""

    ids: Tensor
    colors: Tensor
    basis: Tensor
    share: Tensor

    def lit(self, albedo: Tensor, light: Tensor) -> Tensor:
        """What the photograph shows of an albedo (Q,3) in light (3,4), both as ``ColorFit`` has them."""
        return to_srgb(to_linear(albedo) * (self.basis @ light.T).clamp(min=0))


def _shown_vertices(
    surfaces: Sequence[PosedSurface], images: Sequence[Tensor], cameras: Sequence[Camera]
) -> list[_View]:
    views = []
    for i, (surface, image, camera) in enumerate(zip(surfaces, images, cameras, strict=True)):
        shown = surface.shown_in(image, camera)
        ids = (shown.cosine > _SQUARELY).nonzero()[:, 0]
        if len(ids) < _MIN_VERTICES:
            raise AlignmentError(
                f"images: found {len(ids)} of {len(surface.vertices)} vertices in view {i}, expected at least "
                f"{_MIN_VERTICES}; does the camera see the head?"
            )
        basis = torch.cat([torch.ones(len(ids), 1, dtype=torch.float64), surface.normals[ids]], dim=1)
        views.append(_View(ids, shown.colors[ids].double(), basis, shown.cosine[ids]))
    return views


def _light(albedo: Tensor, view: _View, weight: Tensor, light: Tensor) -> Tensor:
    """Of each channel, (3,4), by a step of Gauss and Newton from ``light`` on weighted squares of errors in sRGB; held
    a little to even light of strength 1."""
    X = to_linear(albedo.clamp(0, 1)).T[:, :, None] * view.basis
    lit = (X @ light[:, :, None])[..., 0].clamp(min=_BLACK)
    slope = 1.055 / 2.4 * lit ** (1 / 2.4 - 1)  # of to_srgb
    goal = lit + (view.colors.T - to_srgb(lit)) / slope
    weight = weight * slope.square()
    H = torch.einsum("cq,cqi,cqj->cij", weight, X, X)
    g = torch.einsum("cq,cqi,cq->ci", weight, X, goal)
    even = torch.zeros(4, dtype=torch.float64)
    even[0] = 1.0
    return torch.linalg.solve(H + _LIGHT_PRIOR * torch.eye(4, dtype=torch.float64), g + _LIGHT_PRIOR * even)
