"""The variance of the next frame about its prediction: small at rest, larger the more a window moves."""

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError

_ITERATIONS = 60
_ROWS = 4096
_PRIOR_MEAN = -2.5  # of the logarithm of a coefficient


class MotionNoise(nn.Module):
    r"""A variance that grows with how much a window moves.

    .. math:: \beta_i^{-1}(x) = a_i + \sum_o \big(b_{io}\, x_{oi}^2 + c_{io}\, s_{oi}^2 \operatorname{mean}_{k
        \in g(i)} x_{ok}^2 / s_{ok}^2\big)

    over a window's slope, curvature and last step x: the shape's own, and those of its group of shapes.

    Args:
        rest_variance: :math:`a`, (N,).
        own_coefficients: :math:`b`, (K,N).
        group_coefficients: :math:`c`, (K,N).
        scale: :math:`s`, root mean squares of the K kinds of motion, (K,N).
        group_average: (N,N), rows of :math:`1/|g(i)|` where k is in i's group.

    Source: Engle 1982 (autoregressive conditional heteroscedasticity), in place of the one noise of equation 54.
    """

    rest_variance: Tensor
    own_coefficients: Tensor
    group_coefficients: Tensor
    scale: Tensor
    group_average: Tensor

    def __init__(
        self,
        rest_variance: Tensor,
        own_coefficients: Tensor,
        group_coefficients: Tensor,
        scale: Tensor,
        group_average: Tensor,
    ) -> None:
        super().__init__()
        count, terms = len(rest_variance), tuple(own_coefficients.shape)
        named = {
            "rest_variance": (rest_variance, (count,)),
            "own_coefficients": (own_coefficients, terms),
            "group_coefficients": (group_coefficients, terms),
            "scale": (scale, terms),
            "group_average": (group_average, (count, count)),
        }
        for name, (value, shape) in named.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"motion noise: found {name} {tuple(value.shape)}, expected {shape}")
            self.register_buffer(name, value.detach())

    @classmethod
    def fit(
        cls,
        motion: Tensor,
        errors: Tensor,
        model_variance: Tensor,
        scale: Tensor,
        groups: tuple[tuple[int, ...], ...],
        floor: float,
    ) -> "MotionNoise":
        """The likeliest coefficients for errors of predictions on takes left out, in float64.

        Args:
            model_variance: variance of the errors that the noise does not have to explain, (B,N).
            scale: root mean squares of the K kinds of motion, (K,N).
            floor: minimum of the standard deviation.
        """
        count = errors.shape[1]
        average = torch.zeros(count, count, dtype=torch.float64)
        for group in groups:
            rows = torch.tensor(group)
            average[rows[:, None], rows] = 1 / len(group)
        squared = motion.square()
        group_energy = (squared / scale.square()) @ average.T * scale.square()
        energies = torch.cat([squared, group_energy], dim=1).permute(2, 0, 1).contiguous()  # (N,B,2K)
        del squared, group_energy
        squared_errors = errors.square()
        log_rest = (0.3 * squared_errors.mean(0)).clamp(min=floor**2).log().requires_grad_()
        log_coefficients = torch.full((energies.shape[2], count), _PRIOR_MEAN, dtype=torch.float64).requires_grad_()
        optimizer = torch.optim.LBFGS([log_rest, log_coefficients], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

        def loss() -> Tensor:
            optimizer.zero_grad()
            total = 1e-4 * (log_coefficients - _PRIOR_MEAN).square().sum()
            total.backward()
            for rows in torch.arange(len(errors)).split(_ROWS):  # what is kept for a gradient is ten times the errors
                part = slice(int(rows[0]), int(rows[-1]) + 1)
                moved = (energies[:, part] @ log_coefficients.exp().T[..., None])[..., 0].T
                variance = model_variance[part] + floor**2 + log_rest.exp() + moved
                value = 0.5 * (squared_errors[part] / variance + variance.log()).sum() / len(errors)
                value.backward()
                total = total.detach() + value.detach()
            return total

        optimizer.step(loss)
        own, shared = log_coefficients.detach().exp().chunk(2)
        return cls(log_rest.detach().exp() + floor**2, own, shared, scale, average)

    def forward(self, motion: Tensor) -> Tensor:
        """The variance (B,N) after windows with this motion, (B,K,N)."""
        squared = motion.square()
        group_energy = (squared / self.scale.square()) @ self.group_average.T * self.scale.square()
        return self.rest_variance + (self.own_coefficients * squared + self.group_coefficients * group_energy).sum(1)
