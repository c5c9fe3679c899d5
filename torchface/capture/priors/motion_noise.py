"""How far the next frame may lie from what is predicted: little where the face rests, much where it moves."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError

_ROUNDS = 60
_USUAL = -2.5  # of the logarithm of a share of the energy


class MotionNoise(nn.Module):
    r"""A variance that grows with how much a window moves.

    .. math:: \beta_i^{-1}(x) = a_i + \sum_o \big(b_{io}\, x_{oi}^2 + c_{io}\, s_{oi}^2 \operatorname{mean}_{k
        \in g(i)} x_{ok}^2 / s_{ok}^2\big)

    over a window's slope, curvature and last step x: the shape's own, and those of the shapes that it moves with.

    Args:
        rest: :math:`a`, the variance at rest, (N,).
        own: :math:`b`, (K,N).
        shared: :math:`c`, (K,N).
        scale: :math:`s`, usual sizes of the K kinds of motion, (K,N).
        together: (N,N), rows of :math:`1/|g(i)|` where k is in i's group.

    Source: Engle 1982 (autoregressive conditional heteroscedasticity), in place of the one noise of equation 54.
    """

    rest: Tensor
    own: Tensor
    shared: Tensor
    scale: Tensor
    together: Tensor

    def __init__(self, rest: Tensor, own: Tensor, shared: Tensor, scale: Tensor, together: Tensor) -> None:
        super().__init__()
        count = len(rest)
        if own.shape != shared.shape or own.shape != scale.shape or together.shape != (count, count):
            raise ShapeError(
                f"motion noise: found own {tuple(own.shape)}, shared {tuple(shared.shape)}, scale "
                f"{tuple(scale.shape)}, together {tuple(together.shape)}, expected (O,{count}) thrice and "
                f"({count},{count})"
            )
        named = (("rest", rest), ("own", own), ("shared", shared), ("scale", scale), ("together", together))
        for name, value in named:
            self.register_buffer(name, value.detach())

    @classmethod
    def fit(
        cls,
        motion: Tensor,
        errors: Tensor,
        known: Tensor,
        scale: Tensor,
        groups: tuple[tuple[int, ...], ...],
        floor: float,
    ) -> MotionNoise:
        """The likeliest coefficients for errors of predictions on takes left out, in float64.

        Args:
            motion: of the windows, see :func:`moving_parts`, (B,K,N).
            errors: (B,N).
            known: variance that the errors have besides, (B,N).
            scale: usual sizes of the K kinds of motion, (K,N).
            groups: shapes that move together.
            floor: the least standard deviation.
        """
        count = errors.shape[1]
        together = torch.zeros(count, count, dtype=torch.float64)
        for group in groups:
            rows = torch.tensor(group)
            together[rows[:, None], rows] = 1 / len(group)
        squared = motion.square()
        around = (squared / scale.square()) @ together.T * scale.square()
        energies = torch.cat([squared, around], dim=1)
        wanted = errors.square()
        rest = (0.3 * wanted.mean(0)).clamp(min=floor**2).log().requires_grad_()
        shares = torch.full(energies.shape[1:], _USUAL, dtype=torch.float64).requires_grad_()
        optimizer = torch.optim.LBFGS([rest, shares], max_iter=_ROUNDS, line_search_fn="strong_wolfe")

        def loss() -> Tensor:
            optimizer.zero_grad()
            variance = known + floor**2 + rest.exp() + (energies * shares.exp()).sum(1)
            value = 0.5 * (wanted / variance + variance.log()).mean(0).sum()
            value = value + 1e-4 * (shares - _USUAL).square().sum()
            value.backward()
            return value

        optimizer.step(loss)
        own, shared = shares.detach().exp().chunk(2)
        return cls(rest.detach().exp() + floor**2, own, shared, scale, together)

    def forward(self, motion: Tensor) -> Tensor:
        """The variance (B,N) after windows that move like this, (B,K,N)."""
        squared = motion.square()
        around = (squared / self.scale.square()) @ self.together.T * self.scale.square()
        return self.rest + (self.own * squared + self.shared * around).sum(1)
