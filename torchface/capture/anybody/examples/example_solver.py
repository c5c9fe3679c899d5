"""Weights of anybody's example expressions from the 68 landmarks of anybody's face."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.anybody.examples.example_methods import AllAtOnce, ExampleMethod, Regional, SquaredDistances
from torchface.capture.anybody.examples.example_shapes import ExampleShapes
from torchface.capture.anybody.examples.expression_regions import shape_regions
from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations
from torchface.capture.anybody.examples.landmark_model import LandmarkModel
from torchface.capture.anybody.examples.landmark_placement import (
    LandmarkBoxes,
    Placement,
    PlacementModel,
    SolvedSimilarity,
)
from torchface.capture.weight_observability import Observability, weight_observability
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import as_real, checked_type
from torchface.optim.data_dependent import data_dependent

_METHODS = {"all_at_once": AllAtOnce, "regional": Regional}
_PLACEMENTS: dict[str, Callable[[], PlacementModel]] = {
    "landmark_boxes": LandmarkBoxes,
    "solved_similarity": SolvedSimilarity,
}
_LEAST_LANDMARKS = 6


@dataclass(frozen=True, eq=False)
class ExampleFit:
    """What was found in B frames.

    Args:
        weights: in [0,1], (B,N).
        placement: of the examples in the picture.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> twice = 2 * examples.neutral.double()[None]  # the same face, nearer
        >>> ExampleSolver(examples).fit(twice).placement.matrix.round(decimals=3).tolist()
        [[[2.0, 0.0], [0.0, 2.0]]]
    """

    weights: Tensor
    placement: Placement


class ExampleSolver(nn.Module):
    r"""Solves 2D landmarks for the weights of example expressions, every frame on its own.

    .. math:: p = s \circ \Bigl(e_0 + \sum_k w_k (e_k - e_0)\Bigr) + t, \qquad 0 \le w \le 1

    The examples may be anybody's. How landmarks become weights is the method's business, where the face lies in the
    picture the placement's.

    Args:
        examples: the neutral :math:`e_0` and N expressions :math:`e_k`.
        method: :class:`AllAtOnce`, :class:`Regional`, or a :class:`LandmarkModel` fitted to the examples; the first
            if absent.
        placement: :class:`LandmarkBoxes`, the paper's, if absent; or :class:`SolvedSimilarity`.

    Raises:
        ValueRangeError: all examples are the neutral.

    Source: realtime_facial_animation 5.2.2.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples)
        >>> shown = examples.neutral + 0.5 * examples.basis[..., 0]
        >>> weights = solver(shown[None].double())[0]
        >>> examples.names[int(weights.argmax())] == examples.names[0]
        True
    """

    neutral: Tensor
    basis: Tensor

    def __init__(
        self, examples: ExampleShapes, method: ExampleMethod | None = None, placement: PlacementModel | None = None
    ) -> None:
        super().__init__()
        checked_type("examples", examples, ExampleShapes)
        if not bool(examples.basis.any()):
            raise ValueRangeError("examples: found expressions that are all the neutral, expected some that differ")
        self._register(examples.names, examples.neutral, examples.basis, method, placement)

    def _register(
        self,
        names: Sequence[str],
        neutral: Tensor,
        basis: Tensor,
        method: ExampleMethod | None,
        placement: PlacementModel | None,
    ) -> None:
        self.names: tuple[str, ...] = tuple(names)
        self.register_buffer("neutral", neutral)
        self.register_buffer("basis", basis)
        self.method: ExampleMethod = method or AllAtOnce()
        self.placement: PlacementModel = placement or LandmarkBoxes()

    @property
    def examples(self) -> ExampleShapes:
        """The neutral and the expressions."""
        return ExampleShapes(self.names, self.neutral, self.neutral + self.basis.permute(2, 0, 1))

    @property
    def config(self) -> dict[str, Any]:
        """What :meth:`from_config` needs beside the state: plain values only.

        Raises:
            ValueRangeError: method or placement is of a class of one's own.
        """
        placement = _name_of(self.placement, _PLACEMENTS)
        if isinstance(self.method, LandmarkModel):
            method: dict[str, Any] = {"kind": "landmark_model", **self.method.config}
        else:
            kind = _name_of(self.method, _METHODS)
            objective = getattr(self.method, "objective")  # noqa: B009
            method = {"kind": kind, "settings": asdict(objective)}
        return {"names": list(self.names), "method": method, "placement": placement}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "ExampleSolver":
        """A solver of zeros for the state to be loaded into.

        Raises:
            NameMismatchError: a name is no text, or there twice.
            ValueRangeError: there is no such method or placement, or a penalty is out of range.
        """
        names, method = config["names"], dict(config["method"])
        if (
            not isinstance(names, list)
            or not all(isinstance(name, str) for name in names)
            or len(set(names)) < len(names)
        ):
            raise NameMismatchError(f"names: found {names!r:.80}, expected a list of distinct names")
        kind = method.pop("kind")
        made: ExampleMethod
        if kind == "landmark_model":
            made = LandmarkModel.from_config(method)
        else:
            made = _of_name("method", kind, _METHODS)(SquaredDistances(**method["settings"]))
        self = cls.__new__(cls)
        nn.Module.__init__(self)
        placement = _of_name("placement", config["placement"], _PLACEMENTS)()
        self._register(names, torch.zeros(68, 2), torch.zeros(68, 2, len(names)), made, placement)
        return self

    @property
    def regions(self) -> tuple[str, ...]:
        """Of the shapes: ``head``, ``brows``, ``eyes`` or ``mouth``."""
        return shape_regions(self.names, self.basis)

    def equations(self, landmarks: Tensor) -> LandmarkEquations:
        """What landmarks (B,68,2) say of weights and placement, float64."""
        return self.placement.equations(landmarks.double(), self.neutral.double(), self.basis.double())

    @data_dependent("the graph that `torchface export examples` writes")
    def fit(self, landmarks: Tensor, initial: Tensor | None = None) -> ExampleFit:
        """Weights and placement.

        Args:
            landmarks: iBUG's 68, (B,68,2), pixels; a landmark with a NaN coordinate is not seen.
            initial: guess of the weights, (B,N), such as the frame before's.

        Returns:
            In the dtype of ``landmarks``, differentiable in them.

        Raises:
            ShapeError: ``landmarks`` is not (B,68,2), or ``initial`` not (B,N).
            ValueRangeError: a coordinate is infinite, or frames show fewer than six landmarks.
        """
        landmarks = as_real(landmarks, "landmarks")
        self._check(landmarks, initial)
        equations = self.equations(landmarks)
        unknowns = self.method.solve(equations, self.regions, None if initial is None else initial.double())
        placement = self.placement.placement(landmarks.double(), self.neutral.double(), unknowns.free)
        return ExampleFit(
            unknowns.weights.to(landmarks.dtype),
            Placement(placement.matrix.to(landmarks.dtype), placement.translation.to(landmarks.dtype)),
        )

    def forward(self, landmarks: Tensor, initial: Tensor | None = None) -> Tensor:
        """Weights in [0,1], (B,N); see :meth:`fit`."""
        return self.fit(landmarks, initial).weights

    def landmarks(self, fit: ExampleFit) -> Tensor:
        """Where a fit puts the landmarks in the picture, (B,68,2)."""
        basis = self.basis.to(fit.weights).flatten(0, 1)
        return fit.placement.apply(self.neutral.to(fit.weights) + (fit.weights @ basis.T).unflatten(1, (68, 2)))

    def _check(self, landmarks: Tensor, initial: Tensor | None) -> None:
        if landmarks.ndim != 3 or landmarks.shape[1:] != (68, 2):
            raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (B,68,2)")
        if initial is not None and initial.shape != (len(landmarks), len(self.names)):
            raise ShapeError(
                f"initial: found {tuple(initial.shape)}, expected ({len(landmarks)},{len(self.names)}) for the shapes "
                f"{', '.join(self.names[:5])}, ..."
            )
        if bool(torch.isinf(landmarks).any()):
            frames = torch.isinf(landmarks).flatten(1).any(1).nonzero()[:, 0].tolist()
            raise ValueRangeError(f"landmarks: infinite in frames {frames[:5]}; expected pixels, or NaN for not seen")
        seen = torch.isfinite(landmarks).all(-1).sum(1)
        few = (seen < _LEAST_LANDMARKS).nonzero()[:, 0].tolist()
        if few:
            raise ValueRangeError(
                f"landmarks: found {int(seen.min())} in frame {few[0]} and too few in {len(few)} of {len(seen)} "
                f"frames, expected at least {_LEAST_LANDMARKS} of 68: leave these frames out"
            )

    def extra_repr(self) -> str:
        return f"{len(self.names)} shapes, {type(self.method).__name__}, {type(self.placement).__name__}"


def _name_of(part: object, kinds: Mapping[str, object]) -> str:
    for name, kind in kinds.items():
        if type(part) is kind:
            return name
    raise ValueRangeError(f"examples: found a {type(part).__name__}, expected one of {', '.join(kinds)} to be saved")


def _of_name(what: str, name: object, kinds: Mapping[str, Any]) -> Any:
    if not isinstance(name, str) or name not in kinds:
        raise ValueRangeError(f"{what}: found {name!r:.60}, expected one of {', '.join(kinds)}")
    return kinds[name]


@torch.no_grad()
def landmark_observability(solver: ExampleSolver, noise: float = 0.5) -> Observability:
    """What 68 landmarks in a picture can see of a solver's examples; see :func:`weight_observability`.

    What the placement explains, where it is solved for, does not distinguish shapes: a head that tilts is not seen
    beside :class:`SolvedSimilarity`, which gives the roll itself.

    Args:
        solver: examples and placement.
        noise: percent of the eyes' distance; a direction whose unit change moves the landmarks less is not seen.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> seen = landmark_observability(ExampleSolver(examples))
        >>> seen.rank <= seen.shapes == 15
        True
    """
    neutral = solver.neutral.double()
    equations = solver.equations(neutral[None])
    shapes = len(solver.names)
    columns = 100 * equations.columns()[0].flatten(0, 1)
    basis, free = columns[:, :shapes], columns[:, shapes:]
    if free.shape[1]:
        known = torch.linalg.qr(free)[0]
        basis = basis - known @ (known.T @ basis)
    return weight_observability(
        basis.unflatten(0, (68, 2)).to(solver.basis.dtype), solver.names, noise, "landmarks", "% of the eyes' distance"
    )
