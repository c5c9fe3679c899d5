"""Methods that solve landmarks for the weights of examples: all shapes at once, or the head first, then regions."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchface.capture.anybody.examples.expression_regions import HEAD, HEAD_LANDMARKS, REGION_LANDMARKS
from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations, Unknowns
from torchface.capture.energy import Quadratic, ridge_term, sparsity_term
from torchface.number_checks import LARGEST_WEIGHT, checked_number
from torchface.optim import box_qp


class ExampleMethod(Protocol):
    """Finds weights in [0,1], and the placement, from the equations of landmarks.

    Example:
        >>> ways: list[ExampleMethod] = [AllAtOnce(), Regional()]
        >>> len(ways)
        2
    """

    def solve(self, equations: LandmarkEquations, regions: tuple[str, ...], initial: Tensor | None) -> Unknowns: ...


@dataclass(frozen=True)
class SquaredDistances:
    r"""The mean squared distance over that of the eyes, squared, with penalties: a box-constrained quadratic program.

    .. math:: \frac{1}{|S|} \sum_{i \in S} \lVert r_i(w) \rVert^2 + \beta \sum_k w_k + \varepsilon \lVert w \rVert^2

    Args:
        sparsity: :math:`\beta`, of the L1 penalty.
        ridge: :math:`\varepsilon`, which makes the solution unique where shapes look alike.

    Raises:
        ValueRangeError: a penalty is negative or not finite.

    Source: realtime_facial_animation, equation 2.

    Example:
        >>> from torchface.capture.anybody import AllAtOnce, ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, AllAtOnce(SquaredDistances(sparsity=0.0)))
        >>> round(solver(examples.landmarks[:1].double())[0, 0].item(), 2)
        1.0
    """

    sparsity: float = 2e-5
    ridge: float = 1e-7

    def __post_init__(self) -> None:
        for name in ("sparsity", "ridge"):
            checked_number(f"SquaredDistances: {name}", getattr(self, name), 0.0, LARGEST_WEIGHT)

    def minimise(self, equations: LandmarkEquations, initial: Tensor | None = None) -> Unknowns:
        """The minimum, differentiable in the equations.

        Args:
            equations: of B frames and N shapes, float64.
            initial: guess of the weights, (B,N); the result does not depend on it.
        """
        squares = equations.least_squares()
        shapes, like = equations.basis.shape[-1], equations.basis.detach()
        energy = squares.energy + sparsity_term(shapes, self.sparsity, like) + ridge_term(shapes, self.ridge, like)
        return squares.unknowns(self.solved(energy, initial))

    def solved(self, energy: Quadratic, initial: Tensor | None) -> Tensor:
        """The weights in [0,1] of least energy, (B,N)."""
        return box_qp(energy.H, energy.f, start=initial)


@dataclass(frozen=True)
class AllAtOnce:
    """All shapes from all landmarks in one problem.

    Args:
        objective: what is minimised.

    Source: realtime_facial_animation 5.2.2, listings 3 and 4.

    Example:
        >>> from torchface.capture.anybody import ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, AllAtOnce())
        >>> weights = solver(examples.landmarks[:4].double())
        >>> weights.argmax(1).tolist()  # each of four is found to be itself
        [0, 1, 2, 3]
    """

    objective: SquaredDistances = SquaredDistances()

    def solve(self, equations: LandmarkEquations, regions: tuple[str, ...], initial: Tensor | None) -> Unknowns:
        """Weights of N shapes, whatever their regions (N,)."""
        return self.objective.minimise(equations, initial)


@dataclass(frozen=True)
class Regional:
    """Shapes of the head first; then those of brows, eyes and mouth, each from its region's landmarks alone.

    The head's are solved from nose and corners of the eyes, which expressions move least. What they and the neutral
    make is the base of the expressions. The paper's code took a base that held the expression of the frame before as
    well, so that it was counted twice, and gave ``suck`` to the brows; both are mended.

    Args:
        objective: what is minimised in each of the two steps.

    Source: realtime_facial_animation 5.2.2, listings 5 and 6.

    Example:
        >>> from torchface.capture.anybody import ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, Regional())
        >>> weights = solver(examples.landmarks[:4].double())
        >>> weights.argmax(1).tolist()  # each of four is found to be itself
        [0, 1, 2, 3]
    """

    objective: SquaredDistances = SquaredDistances()

    def solve(self, equations: LandmarkEquations, regions: tuple[str, ...], initial: Tensor | None) -> Unknowns:
        """Weights of N shapes in their regions (N,)."""
        basis = equations.basis
        head = [column for column, region in enumerate(regions) if region == HEAD]
        others = [column for column, region in enumerate(regions) if region != HEAD]
        rows = head_rows(basis)
        # Where a hand hides nose and eyes the whole face must do.
        shown = (equations.seen & rows).sum(1, keepdim=True) >= len(HEAD_LANDMARKS) // 2
        first = equations.with_basis(basis[..., head]).among(rows | ~shown)
        if len(head):
            placed = self.objective.minimise(first, None if initial is None else initial[:, head])
        else:  # the placement alone
            placed = first.least_squares().unknowns(first.offset.new_zeros(len(first.offset), 0))
        rest = equations.moved(basis[..., head], placed).with_basis(regional_basis(basis, regions)[..., others])
        expression = self.objective.minimise(rest, None if initial is None else initial[:, others])
        order = torch.tensor([*head, *others], device=basis.device).argsort()
        return Unknowns(torch.cat([placed.weights, expression.weights], dim=1)[:, order], placed.free)


def head_rows(like: Tensor) -> Tensor:
    """The landmarks that say how the head is turned, (68,) bool, on the device of ``like``."""
    rows = torch.zeros(68, dtype=torch.bool, device=like.device)
    rows[list(HEAD_LANDMARKS)] = True
    return rows


def regional_basis(basis: Tensor, regions: tuple[str, ...]) -> Tensor:
    """The basis (68,2,N) with each shape of a region moving that region's landmarks alone."""
    kept = torch.zeros(len(basis), len(regions), dtype=torch.bool, device=basis.device)
    for column, region in enumerate(regions):
        if region != HEAD:
            kept[list(REGION_LANDMARKS[region]), column] = True
    return torch.where(kept[:, None], basis, 0.0)
