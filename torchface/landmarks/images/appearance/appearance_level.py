"""One resolution of an appearance model: its texture modes, and the step that improves an alignment."""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from torchface.optim.prepared_tensors import Prepared


class TextureResidual(NamedTuple):
    """What texture modes cannot explain of sampled features: ``left`` (B,C,N), and their coefficients (B,K)."""

    left: Tensor
    coefficients: Tensor


class AppearanceLevel(nn.Module):
    r"""Textures of one resolution, sampled at the same N places of every face.

    A step is one of the fast simultaneous inverse compositional algorithm. With sampled features I, mean texture
    :math:`A_0`, orthonormal modes A and the projection :math:`P = 1 - A A^\top`,

    .. math:: c = A^\top (I - A_0), \quad J = \nabla(A_0 + A c)\, \partial W / \partial q, \quad
        \Delta q = (J^\top P J / \sigma^2 + \Lambda^{-1})^{-1} (J^\top P (I - A_0) / \sigma^2 + \Lambda^{-1} q)

    moves the *template*, and so the face by its inverse. J is linear in c, hence :math:`J^\top P J` quadratic: its
    coefficients are computed once, and a step costs as much as sampling does.

    Args:
        motions: Q, shape modes and the similarity's four.

    Source: Tzimiropoulos and Pantic 2013; thesis 4.2.2.
    """

    corner: Tensor
    weight: Tensor
    mean: Tensor
    modes: Tensor
    slope: Tensor
    motion: Tensor
    scale: Tensor
    noise: Tensor
    typical: Tensor

    def __init__(self, places: int, channels: int, modes: int, motions: int) -> None:
        super().__init__()
        self.register_buffer("corner", torch.zeros(places, 3, dtype=torch.int64))
        self.register_buffer("weight", torch.zeros(places, 3))
        self.register_buffer("mean", torch.zeros(channels, places))
        self.register_buffer("modes", torch.zeros(modes, channels, places))
        self.register_buffer("slope", torch.zeros(modes + 1, channels, places, 2))
        self.register_buffer("motion", torch.zeros(places, 2, motions))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("noise", torch.ones(()))
        self.register_buffer("typical", torch.ones(()))
        self._curvature: Prepared[Tensor] = Prepared()
        self._placing: Prepared[Tensor] = Prepared()

    def sample(self, features: Tensor, points: Tensor) -> Tensor:
        """Features (B,C,h,w) at the level's places on faces with these points (B,P,2), pixels: (B,C,N)."""
        places = points.transpose(1, 2) @ self._placing_matrix(points.shape[1])
        return sample_pixels(features, places.transpose(1, 2).contiguous())

    def residual(self, sampled: Tensor) -> TextureResidual:
        """What the modes leave of sampled features (B,C,N), and the coefficients that explain the rest."""
        left = sampled - self.mean
        modes = self.modes.flatten(1)
        coefficients = left.flatten(1) @ modes.T
        return TextureResidual(left - (coefficients @ modes).view_as(left), coefficients)

    def error(self, residual: TextureResidual) -> Tensor:
        """Mean squared residual (B,) over what training images that were left out had: about 1 on a good fit."""
        return residual.left.square().mean((1, 2)) / self.typical

    def step(self, residual: TextureResidual, state: Tensor, precision: Tensor, terms: Tensor) -> Tensor:
        """By how much the template should move, (B,Q).

        State (B,Q) and the shape's precision (Q,) are 0 for the similarity's motions.
        """
        mixed = _with_one(residual.coefficients)
        slope = (mixed @ self.slope.flatten(1)).unflatten(1, self.slope.shape[1:])
        pull = (residual.left[..., None] * slope).sum(1)
        downhill = pull.flatten(1) @ self.motion.flatten(0, 1) / self.noise
        curvature = self.projected_curvature(residual.coefficients, terms) / self.noise
        damping = 1e-4 * curvature.diagonal(dim1=1, dim2=2).mean(1)[:, None] + 1e-9
        system = curvature + torch.diag_embed(precision + damping)
        return torch.linalg.solve(system, downhill + precision * state)

    def jacobian(self, coefficients: Tensor) -> Tensor:
        """J (B,C,N,Q) of the texture with these coefficients (B,K)."""
        return torch.einsum("bk,kcnd,ndq->bcnq", _with_one(coefficients), self.slope, self.motion)

    def projected_curvature(self, coefficients: Tensor, terms: Tensor) -> Tensor:
        """The projected curvature of the texture with these coefficients (B,K), (B,Q,Q)."""
        mixed = _with_one(coefficients)
        first, second = _pairs(mixed.shape[1], mixed.device)
        flat = (mixed[:, first] * mixed[:, second]) @ terms
        count = self.motion.shape[2]
        rows, columns = _pairs(count, mixed.device)
        whole = flat.new_empty(len(flat), count, count)
        whole[:, rows, columns] = flat
        whole[:, columns, rows] = flat
        return whole

    def _placing_matrix(self, points: int) -> Tensor:
        """What each of P points adds to each place, (P,N): a product with it takes an eighth of gathering corners."""

        def made() -> Tensor:
            return self.weight.new_zeros(points, len(self.weight)).scatter_add(0, self.corner.T, self.weight.T)

        return self._placing.get((self.weight, self.corner, points), made)

    def curvature_terms(self) -> Tensor:
        r"""What each product of two coefficients adds to each entry of the curvature, (J,R): upper triangles of both.

        A place's gradients meet in a 2 x 2 tensor, summed over the channels before the motions come in:

        .. math:: J_i^\top J_j = \sum_n M_n^\top \bigl( \textstyle\sum_c g_{icn} g_{jcn}^\top \bigr) M_n

        which takes a tenth of the work of the Jacobians' own products. Kept until the state changes.
        """
        return self._curvature.get((self.slope, self.motion, self.modes), self._new_curvature_terms)

    def _new_curvature_terms(self) -> Tensor:
        first, second = _pairs(len(self.slope), self.slope.device)
        rows, columns = _pairs(self.motion.shape[2], self.slope.device)
        x, y = self.slope.unbind(-1)
        crossed = torch.einsum("icn,jcn->ijn", x, y)
        tensors = torch.stack([
            torch.einsum("icn,jcn->ijn", x, x), (crossed + crossed.transpose(0, 1)) / 2,
            torch.einsum("icn,jcn->ijn", y, y),
        ], dim=-1)[first, second]  # fmt: skip
        across, down = self.motion.unbind(1)
        moved = torch.stack([
            across[:, rows] * across[:, columns],
            across[:, rows] * down[:, columns] + down[:, rows] * across[:, columns],
            down[:, rows] * down[:, columns],
        ], dim=1)  # fmt: skip
        whole = tensors.flatten(1) @ moved.flatten(0, 1)
        # What the projection takes away: the Jacobians' shares along the modes.
        pulls = torch.einsum("kcn,icnd->iknd", self.modes, self.slope)
        shares = pulls.flatten(2) @ self.motion.flatten(0, 1)
        along = torch.einsum("ikp,jkq->ijpq", shares, shares)
        taken = (along[first, second] + along[second, first])[:, rows, columns] / 2
        twice = torch.where(first == second, 1.0, 2.0).to(whole)
        return (whole - taken) * twice[:, None]


def _pairs(count: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows and columns of the upper triangle of a square."""
    rows, columns = torch.triu_indices(count, count, device=device)
    return rows, columns


def _with_one(coefficients: Tensor) -> Tensor:
    """Coefficients (B,K) with that of the mean texture before them, (B,K+1)."""
    return torch.cat([torch.ones_like(coefficients[:, :1]), coefficients], dim=1)


def sample_pixels(images: Tensor, places: Tensor) -> Tensor:
    """Images (B,C,h,w) at places (B,N,2), pixels, bilinear, the border continued: (B,C,N)."""
    size = images.new_tensor([images.shape[-1], images.shape[-2]])
    grid = (places + 0.5) * (2 / size) - 1
    return grid_sample(images, grid[:, None], padding_mode="border", align_corners=False)[:, :, 0]
