"""A linear model of landmarks: projected on its components they say the weights of examples."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.anybody.examples.example_shapes import EYE_CORNERS, ExampleShapes
from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations, Unknowns
from torchface.capture.energy import ridge_term, sparsity_term
from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, checked_number
from torchface.optim import BoxQP
from torchface.optim.prepared_tensors import Prepared


class LandmarkModel(nn.Module):
    r"""Principal components of landmark shapes, and the way from their coefficients to the weights of named shapes.

    Landmarks q, in the examples' space, are first taken for :math:`m + Vc` plus independent noise. The likeliest
    coefficients, with a variance :math:`\lambda` each, are

    .. math:: c = (V^\top V + s^2 \Lambda^{-1})^{-1} V^\top (q - m)

    with sums over the landmarks that are seen. The weights are those in [0,1] whose shapes have these coefficients:

    .. math::
        \min_{0 \le w \le 1} \frac{1}{68} \lVert V^\top (e_0 + E w - m) - c \rVert^2
        + \beta \sum_k w_k + \varepsilon \lVert w \rVert^2

    in units of the eyes' distance. Both are small, and the second has one matrix for all frames. What noise does beside
    the components is not followed. Its tensors are float64: weights follow from thousandths of a pixel.

    Args:
        mean: :math:`m`, (68,2), pixels of the examples.
        components: :math:`V`, orthonormal, (68,2,K).
        variances: :math:`\lambda`, (K,), pixels squared.
        noise: :math:`s`, of a coordinate over the eyes' distance.
        sparsity: :math:`\beta`, of the L1 penalty.
        ridge: :math:`\varepsilon`.

    Raises:
        ShapeError: the parts do not fit each other.
        ValueRangeError: a penalty or ``noise`` is negative or not finite.

    Source: realtime_facial_animation 5.2.2; Tipping and Bishop 1999, Probabilistic principal component analysis.

    Example:
        >>> from torchface.capture.anybody import ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, LandmarkModel.fit(examples))
        >>> weights = solver(examples.landmarks[:4].double())
        >>> weights.argmax(1).tolist()  # each of four is found to be itself
        [0, 1, 2, 3]
    """

    mean: Tensor
    components: Tensor
    variances: Tensor

    def __init__(
        self,
        mean: Tensor,
        components: Tensor,
        variances: Tensor,
        noise: float = 0.002,
        sparsity: float = 2e-5,
        ridge: float = 1e-7,
    ) -> None:
        super().__init__()
        count = components.shape[-1]
        if mean.shape != (68, 2) or components.shape != (68, 2, count) or variances.shape != (count,):
            raise ShapeError(
                f"landmark model: found mean {tuple(mean.shape)}, components {tuple(components.shape)} and variances "
                f"{tuple(variances.shape)}, expected (68,2), (68,2,K) and (K,)"
            )
        self.noise = checked_number("landmark model: noise", noise, 0.0, 1.0)
        self.sparsity = checked_number("landmark model: sparsity", sparsity, 0.0, LARGEST_WEIGHT)
        self.ridge = checked_number("landmark model: ridge", ridge, 0.0, LARGEST_WEIGHT)
        for name, value in (("mean", mean), ("components", components), ("variances", variances)):
            self.register_buffer(name, value)
        self._prepared: Prepared[BoxQP] = Prepared()

    @staticmethod
    def fit(
        examples: ExampleShapes,
        shapes: Tensor | None = None,
        variance: float = 0.9999,
        noise: float = 0.002,
        sparsity: float = 2e-5,
        ridge: float = 1e-7,
    ) -> "LandmarkModel":
        """Learns the components from examples.

        Args:
            examples: the neutral and N shapes; all of them are learned from where ``shapes`` is absent.
            shapes: landmarks to learn from instead, placed as the examples are, (S,68,2).
            variance: the share of it that the components keep, in (0,1]; that of the paper's code if absent.
            noise, sparsity, ridge: of the model.

        Raises:
            ShapeError: ``shapes`` is not (S,68,2) with at least two.
            ValueRangeError: nothing varies, or ``variance`` is out of range.
        """
        checked_number("LandmarkModel.fit: variance", variance, 0.0, 1.0, above=True)
        stacked = torch.cat([examples.neutral[None], examples.landmarks]) if shapes is None else shapes
        if stacked.ndim != 3 or stacked.shape[1:] != (68, 2) or len(stacked) < 2:
            raise ShapeError(f"LandmarkModel.fit: found shapes {tuple(stacked.shape)}, expected (S,68,2), S 2 or more")
        stacked = stacked.detach().double()
        mean = stacked.mean(0)
        _, values, directions = torch.linalg.svd((stacked - mean).flatten(1), full_matrices=False)
        variances = values.square() / len(stacked)
        if not float(variances.sum()) > 0:
            raise ValueRangeError("LandmarkModel.fit: found shapes that are all alike, expected some that differ")
        kept = variances > 1e-12 * variances[0]
        share = variances.cumsum(0) / variances.sum()
        count = min(int((share < variance - 1e-12).sum()) + 1, int(kept.sum()))
        components = directions[:count].T.unflatten(0, (68, 2))
        return LandmarkModel(mean, components.contiguous(), variances[:count], noise, sparsity, ridge)

    @property
    def config(self) -> dict[str, Any]:
        """What :meth:`from_config` needs beside the state."""
        return {
            "components": self.components.shape[-1],
            "noise": self.noise,
            "sparsity": self.sparsity,
            "ridge": self.ridge,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "LandmarkModel":
        """A model of zeros for the state to be loaded into."""
        count = config["components"]
        return cls(
            torch.zeros(68, 2, dtype=torch.float64),
            torch.zeros(68, 2, count, dtype=torch.float64),
            torch.ones(count, dtype=torch.float64),
            config["noise"],
            config["sparsity"],
            config["ridge"],
        )

    def solve(self, equations: LandmarkEquations, regions: tuple[str, ...], initial: Tensor | None) -> Unknowns:
        """Weights of N shapes, whatever their regions (N,)."""
        mean, components, variances = (part.double() for part in (self.mean, self.components, self.variances))
        neutral = equations.neutral
        eyes = (neutral[EYE_CORNERS[0]] - neutral[EYE_CORNERS[1]]).norm()
        model = equations.of_model(mean, components, eyes)
        squares = model.least_squares()
        # The mean over the landmarks that are seen of squares over the eyes' distance: so is the prior's.
        count = model.seen.sum(1).clamp(min=1)[:, None]
        H = squares.energy.H + torch.diag_embed(2 * (self.noise**2 / (variances + 1e-300)) / count)
        coefficients = -torch.linalg.solve(H, squares.energy.f)
        rows = components.flatten(0, 1)
        start = rows.T @ (neutral - mean).flatten()
        onto = (2 / (68 * eyes**2)) * (rows.T @ equations.basis.flatten(0, 1))  # (K,N)
        f = (start - coefficients) @ onto + self.sparsity
        weights = self._program(equations.basis, eyes)(f, initial)
        # The placement that goes with these weights, of the shapes themselves.
        return equations.least_squares().unknowns(weights)

    def _program(self, basis: Tensor, eyes: Tensor) -> BoxQP:
        """The way back from coefficients: prepared once for the examples."""

        def prepare() -> BoxQP:
            onto = self.components.double().flatten(0, 1).T @ basis.flatten(0, 1)
            H = (2 / (68 * eyes**2)) * (onto.T @ onto)
            shapes = H.shape[0]
            penalties = sparsity_term(shapes, self.sparsity, H) + ridge_term(shapes, self.ridge, H)
            return BoxQP(H + penalties.H)

        return self._prepared.get((self.components, basis), prepare)

    def extra_repr(self) -> str:
        return f"{self.components.shape[-1]} components"
