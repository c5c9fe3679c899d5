"""Estimates of weights and head pose, with their covariance, from one frame to the next."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.gauss_newton import HeadState


@dataclass(frozen=True, eq=False)
class StateEstimate:
    r"""A Gaussian over B faces' weights and poses, from landmarks and dynamics alone.

    The prior of which weights faces have and the weights' bounds are left out: they hold in every frame anew, and were
    they folded in, each frame would count them again. So the means may lie outside [0,1] where little was seen.
    """

    mean: HeadState  # weights (B,N) and pose
    covariance: Tensor  # of weights, rotation and translation in the camera's frame, (B,N+6,N+6)

    def predicted(self, steps: Tensor, variance: Tensor, motion_variance: Tensor) -> "StateEstimate":
        """One frame on, by expected steps (B,N) of the weights, their variance (B,N), and that of the head's motion,
        (6,)."""
        noise = torch.cat([variance, motion_variance.expand(len(variance), 6)], dim=1)
        mean = HeadState(self.mean.weights + steps, self.mean.rotation, self.mean.translation)
        return StateEstimate(mean, self.covariance + torch.diag_embed(noise))

    def expectation(self) -> "Expectation":
        """As an energy."""
        return Expectation(self.mean, torch.cholesky_inverse(torch.linalg.cholesky(self.covariance)))


@dataclass(frozen=True, eq=False)
class Expectation:
    r"""What is expected of a frame before it is seen, :math:`E(x) = \tfrac12 (x - m)^\top \Lambda (x - m)`."""

    mean: HeadState  # m, weights (B,N) and pose
    information: Tensor  # \Lambda, of weights, rotation and translation, (B,N+6,N+6)

    def energy(self, head: HeadState) -> Quadratic:
        """Of a step (B,N+6) from a state."""
        off = head.step_from(self.mean)
        return Quadratic(self.information, (self.information @ off[..., None])[..., 0])

    def updated(self, head: HeadState, seen: Quadratic) -> StateEstimate:
        """After a frame whose landmarks' energy, of a step from a state, was linearised there. Source: Kalman 1960,
        in its information form."""
        both = seen + self.energy(head)
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(both.H))
        return StateEstimate(head.stepped(-(covariance @ both.f[..., None])[..., 0]), covariance)
