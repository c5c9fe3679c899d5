"""The shape prior: a density of weights, of all shapes or of each part of the face, as an energy for the solvers."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, cast

import torch
from torch import Tensor, nn

from torchface.capture.energy import Quadratic
from torchface.capture.priors.name_translation import checked_names, name_matrices, require_same_names
from torchface.capture.priors.parzen_window import ParzenDensity
from torchface.capture.priors.student_t import PARTING_VARIANCE, StudentDensity, StudentGroups
from torchface.capture.priors.take_frames import TakeFrames
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, as_real, checked_number
from torchface.optim.full_precision import full_precision
from torchface.shape_names import read_as_arkit

_UPPER = re.compile(r"(eye|brow|pupil)", re.IGNORECASE)
LearnedDensity = ParzenDensity | StudentDensity
_KINDS: dict[str, type[ParzenDensity] | type[StudentDensity]] = {
    "parzen": ParzenDensity,
    "student": StudentDensity,
}
STRENGTH = 0.15  # of a fitted prior: chosen by the error of solves of real takes that were left out of the learning


class Density(Protocol):
    """A density as a prior uses it; see ``StudentDensity`` and ``ParzenDensity``."""

    @full_precision
    def log_density(self, samples: Tensor) -> Tensor:
        """(B,D) to (B,)."""

    def bound(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """A quadratic (B,D,D), (B,D) that touches the negative log density at samples (B,D) from above."""


def face_halves(names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """The shapes of eyes and brows, and all others: two groups of rows, or one where a half has none.

    Brows and jaw move independently, and no take holds all combinations of both.

    Example:
        >>> face_halves(["jawOpen", "browInnerUp", "eyeBlink_L", "mouthPucker"])
        ((1, 2), (0, 3))

    Source: thesis 4.2.9.
    """
    upper = tuple(i for i, name in enumerate(read_as_arkit(names)) if _UPPER.match(name))
    lower = tuple(i for i in range(len(names)) if i not in upper)
    return tuple(group for group in (upper, lower) if group)


class ShapePrior(nn.Module):
    r"""The negative log density of weights, as an energy.

    .. math:: E(w) = -\lambda \sum_g \log p_g(w_g)

    over groups of shapes that are independent of each other. The energy that a solver gets is quadratic, touches this
    one at the weights where it is asked for and lies above it elsewhere, so that minimising it
    never raises the energy, without step control.

    Args:
        names: N shapes; solvers refuse others.
        groups: rows of ``names`` that belong together, (G) tuples; every shape in one group.
        densities: one a group.
        strength: :math:`\lambda`; 1 is Bayes' rule where the other terms are negative log likelihoods.

    Raises:
        ShapeError: not one density a group, or groups that do not divide the shapes.

    Source: thesis 4.2.7 and 4.2.9; expectation maximisation's bound for the quadratic.

    Example:
        >>> take = torch.rand(200, 1, generator=torch.Generator().manual_seed(0)).repeat(1, 2)
        >>> prior = ShapePrior.fit([take], ["mouthSmileLeft", "mouthSmileRight"])
        >>> both, one = torch.tensor([[0.5, 0.5], [0.5, 0.0]], dtype=torch.float64)
        >>> bool(prior.log_density(both[None]) > prior.log_density(one[None]))
        True
    """

    def __init__(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]],
        densities: Sequence[LearnedDensity],
        strength: float = 1.0,
    ) -> None:
        super().__init__()
        if sorted(i for group in groups for i in group) != list(range(len(names))) or len(groups) != len(densities):
            raise ShapeError(
                f"shape prior: found {len(densities)} densities of {len(groups)} groups, expected one each, and every "
                f"one of {len(names)} shapes in one group"
            )
        self.names, self.groups = tuple(names), tuple(tuple(map(int, group)) for group in groups)
        self.strength = _checked_strength(strength)
        self.densities = nn.ModuleList(densities)

    @classmethod
    def fit(
        cls, takes: Sequence[Tensor], names: Sequence[str], groups: Sequence[Sequence[int]] | None = None
    ) -> ShapePrior:
        """Learns a Student's t-distribution about the face at rest, a :class:`StudentDensity` a group.

        Of the densities that were compared by the error of solves of left-out takes it is the best: it keeps the
        correlation of shapes, does not draw toward the mean of its takes, and draws less on expressions beyond them.
        Takes are read one after the other, a few dozen times; memory is that of the longest.

        Args:
            takes: weights of each take, (T,N), a list or what reads them from a disk; frames with a NaN are left out.
            names: of the N shapes.
            groups: all shapes together if absent: brows and mouth are correlated in real takes.

        Raises:
            ShapeError: no takes, or of another number of shapes.
            NameMismatchError: a name stands twice.
            ValueRangeError: fewer than two frames with all weights.
        """
        names = checked_names(names)
        TakeFrames(takes, len(names)).count()
        groups = (tuple(range(len(names))),) if groups is None else groups
        seen = [TakeFrames(takes, len(names), tuple(group)) for group in groups]
        return cls(names, groups, [StudentDensity.fit(frames) for frames in seen], STRENGTH)

    def log_density(self, weights: Tensor) -> Tensor:
        """:math:`\\sum_g \\log p_g` of weights (B,N), (B,)."""
        weights = self._checked(weights)
        return torch.stack([density.log_density(part) for density, part in self.parts(weights)]).sum(0)

    @full_precision
    def energy(self, weights: Tensor) -> Quadratic:
        """The quadratic that touches the energy at weights (B,N) from above."""
        weights = self._checked(weights)
        factors = weights.new_full((len(self.groups), len(weights)), self.strength)
        return self._assembled(weights, factors, -self.strength * self.log_density(weights))

    def _assembled(self, weights: Tensor, factors: Tensor, values: Tensor) -> Quadratic:
        """The groups' bounds at weights (B,N), each times its factor (G,B), with the values (B,) there."""
        if self.groups == (tuple(range(len(self.names))),):
            (density,) = cast("Sequence[Density]", self.densities)
            own, pull = density.bound(weights)
            H, f = factors[0, :, None, None] * own, factors[0, :, None] * pull
        else:
            H = weights.new_zeros(len(weights), len(self.names), len(self.names))
            f = weights.new_zeros(len(weights), len(self.names))
            for (density, part), group, factor in zip(self.parts(weights), self.groups, factors, strict=True):
                own, pull = density.bound(part)
                rows = torch.tensor(group, device=weights.device)
                H[:, rows[:, None], rows] = factor[:, None, None] * own
                f[:, rows] = factor[:, None] * pull
        return Quadratic(H, f, values - Quadratic(H, f).value(weights))

    def parts(self, weights: Tensor) -> list[tuple[Density, Tensor]]:
        """Each group's density, with its columns of weights (B,N)."""
        densities: list[Any] = list(self.densities)
        return [(density, weights[:, list(group)]) for density, group in zip(densities, self.groups, strict=True)]

    def _checked(self, weights: Tensor) -> Tensor:
        weights = as_real(weights, "weights")
        if weights.ndim != 2 or weights.shape[1] != len(self.names):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected (B,{len(self.names)})")
        return weights

    def prepared(self, strength: float | None = None) -> StudentGroups:
        """The same energy for solvers that are exported, or one of another strength.

        Raises:
            ValueRangeError: the prior is none of Student's distributions, as :meth:`fit` learns.
        """
        densities = [density for density in self.densities if isinstance(density, StudentDensity)]
        if type(self) is not ShapePrior or len(densities) < len(self.groups):
            kinds = " and ".join(sorted({type(density).__name__ for density in self.densities}))
            raise ValueRangeError(
                f"shape prior: found a {type(self).__name__} of {kinds}, expected one of Student's distributions, as "
                "ShapePrior.fit learns"
            )
        return StudentGroups(self.groups, densities, self.strength if strength is None else strength)

    def widened(self, variance: Tensor) -> ShapePrior:
        """The prior with a variance (N,) added to each weight: what it says less of, and goes with others less."""
        densities = [
            density.mapped(torch.eye(len(group)), variance[list(group)])  # type: ignore[operator]
            for group, density in zip(self.groups, self.densities, strict=True)
        ]
        made = copy.copy(self)
        made._modules = {**self._modules, "densities": nn.ModuleList(densities)}
        return made

    def renamed(self, names: Sequence[str]) -> ShapePrior:
        """The prior for a rig's shapes, which may have other names: itself where they are the same.

        A whole shape becomes two halves that move together, two halves their mean, with the variance that
        ``StudentDensity`` adds to shapes that always moved together. What the prior has not
        learned stays near 0, as in a prior that ``train.priors --rig`` learns for these names; see :func:`unlearned`.

        Args:
            names: of the rig's N shapes.

        Raises:
            NameMismatchError: less than half of them are among those learned.
        """
        if tuple(names) == self.names:
            return self
        _, back = name_matrices(self.names, names)
        nearest = back.argmax(1)
        group_of = {row: place for place, group in enumerate(self.groups) for row in group}
        # A shape that was not learned joins the first group.
        member = [group_of[int(row)] if bool(learned) else 0 for row, learned in zip(nearest, back.any(1), strict=True)]
        split = ((back > 0) & ((back > 0).sum(0) > 1)).any(1)
        groups, densities = [], []
        for place, group in enumerate(self.groups):
            rows = [row for row, found in enumerate(member) if found == place]
            if rows:
                floor = torch.where(split | ~back.any(1), PARTING_VARIANCE, 0.0)[rows]
                groups.append(rows)
                densities.append(self.densities[place].mapped(back[rows][:, list(group)], floor))  # type: ignore[operator]
        config = {**self.config, "names": list(names), "groups": groups, "densities": [d.config for d in densities]}
        other = type(self).from_config(config)
        other.densities = nn.ModuleList(densities)
        return other.to(next(self.buffers()))

    def require(self, names: Sequence[str]) -> None:
        """Checks that a rig's shapes are the prior's.

        Raises:
            NameMismatchError: they are others, or in another order.
        """
        require_same_names(self.names, names)

    @property
    def config(self) -> dict[str, Any]:
        """From which :meth:`from_config` makes a prior for the state to be loaded into."""
        return {
            "names": list(self.names),
            "groups": [list(group) for group in self.groups],
            "densities": [density.config for density in self.densities],
            "strength": self.strength,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ShapePrior:
        """A prior with the sizes of a ``config``.

        Raises:
            FileFormatError: a part of it is not what it should be.
        """
        densities = []
        for entry in config.get("densities", []):
            kind = _KINDS.get(entry.get("kind", "")) if isinstance(entry, Mapping) else None
            if kind is None:
                raise FileFormatError(
                    f"shape prior: found the density {entry!r:.80}, expected one of {', '.join(_KINDS)}"
                )
            densities.append(kind.from_config(entry))
        try:
            return cls(config["names"], config["groups"], densities, config["strength"])
        except (KeyError, TypeError) as error:
            raise FileFormatError(f"shape prior: found a config without {error}, expected one") from error


class ReciprocalPrior(ShapePrior):
    r"""The paper's own form of the prior.

    .. math:: E(w) = \lambda \sum_g \frac{1}{p_g(w_g) + p_0}

    It is flat where weights are likely and rises steeply where they are not; :math:`p_0` guards it far from the data,
    where 1/p has no bound and no direction. Its quadratic is the density's bound times the slope of
    :math:`1/(p+p_0)` in :math:`-\log p`, which touches the energy at the weights but need not lie above it.

    Args:
        names, groups, densities, strength: as ``ShapePrior``.
        guard: :math:`p_0`, relative to kernels of height 1.

    Source: thesis 4.2.9, equation 44.

    Example:
        >>> take = torch.rand(200, 1, generator=torch.Generator().manual_seed(0)).repeat(1, 2)
        >>> prior = ReciprocalPrior.fit([take], ["mouthSmileLeft", "mouthSmileRight"])
        >>> both, one = torch.tensor([[0.5, 0.5], [0.5, 0.0]], dtype=torch.float64)
        >>> bool(prior.energy(both[None]).value(both[None]) < prior.energy(one[None]).value(one[None]))
        True
    """

    def __init__(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]],
        densities: Sequence[LearnedDensity],
        strength: float = 1.0,
        guard: float = 1e-2,
    ) -> None:
        super().__init__(names, groups, densities, strength)
        self.guard = checked_number("guard", guard, above=True)

    @classmethod
    def fit(
        cls, takes: Sequence[Tensor], names: Sequence[str], groups: Sequence[Sequence[int]] | None = None, seed: int = 0
    ) -> ReciprocalPrior:
        """Learns a Parzen window a group, over centres binned by mean shift with its automatic bandwidth.

        Mean shift needs all frames at once: of more than 40,000, so many are drawn.

        Args, Raises: as ``ShapePrior.fit``; seed: of the draws.

        Source: thesis 4.2.8.
        """
        names = checked_names(names)
        together = TakeFrames(takes, len(names)).some(seed=seed)
        groups = face_halves(names) if groups is None else groups
        return cls(names, groups, [ParzenDensity.fit(together[:, list(group)], seed=seed) for group in groups])

    @full_precision
    def energy(self, weights: Tensor) -> Quadratic:
        """The quadratic with the energy's value and slope at weights (B,N)."""
        weights = self._checked(weights)
        density = torch.stack([density.log_density(part) for density, part in self.parts(weights)]).exp()
        reciprocal = 1 / (density + self.guard)
        # d/dL of 1/(exp(-L) + p0) for L = -log p.
        return self._assembled(
            weights, self.strength * density * reciprocal.square(), self.strength * reciprocal.sum(0)
        )

    @property
    def config(self) -> dict[str, Any]:
        """From which :meth:`from_config` makes a prior for the state to be loaded into."""
        return {**super().config, "guard": self.guard}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ReciprocalPrior:
        """A prior with the sizes of a ``config``."""
        made = ShapePrior.from_config(config)
        densities: list[Any] = list(made.densities)
        return cls(made.names, made.groups, densities, made.strength, float(config.get("guard", 1e-2)))


def _checked_strength(strength: float) -> float:
    return checked_number("strength", strength, 0.0, LARGEST_WEIGHT)
