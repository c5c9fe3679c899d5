"""``ExampleSolver`` of squared distances as an ONNX model: steps of splitting, unrolled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import onnx
import torch
from torch import Tensor

from torchface import __version__
from torchface.capture.anybody import AllAtOnce, ExampleSolver, LandmarkBoxes, LandmarkModel, Regional, SquaredDistances
from torchface.capture.anybody.examples.example_methods import head_rows, regional_basis
from torchface.capture.anybody.examples.example_shapes import EYE_CORNERS
from torchface.capture.anybody.examples.expression_regions import HEAD
from torchface.errors import ValueRangeError
from torchface.onnx.graph_builder import GraphBuilder
from torchface.optim.operator_splitting import RELAXATION

STEPS, STEPS_AT_ONCE = 13, 40
"""Of splitting, in frames in which every landmark is seen: one that goes on from the frame before, and many at once."""

RHO = 0.1

_PASSES, _STEPS_A_PASS = 10, 6
_BROWS = slice(17, 27)
_FAR = 1e9
_MODEL = "model"


@dataclass(frozen=True, eq=False)
class _Problem:
    r"""One box-constrained quadratic program of the solver, with x and y counting :math:`1 \pm a` times.

    .. math:: H(a) = (1 + a) H_x + (1 - a) H_y, \quad (H(a) + \rho D)^{-1} = T \, \mathrm{diag}(1 + a \delta)^{-1} T^T

    as one basis T makes both :math:`H_x + \rho D / 2` and :math:`H_y + \rho D / 2` diagonal.

    A landmark model counts both axes alike whatever the face's proportions, and so has one matrix.

    Args:
        name: prefix of its constants.
        columns: which weights of the solver, rows (n,).
        basis: what they add to landmarks, (136,n).
        onto: what turns residuals at zero, x and y weighted, into f, (136,n).
        constant: what is added to f, (n,).
        penalty: of the L1 penalty, what is added to f for x and for y, (2,n).
        H: of x and of y, (2,n,n).
        projection: of a landmark model: what turns residuals at zero into those of what the model takes the landmarks
            for, (136,136), and what is added, (136,) as a last row.
    """

    name: str
    columns: Tensor
    basis: Tensor
    onto: Tensor
    constant: Tensor
    penalty: Tensor
    H: Tensor
    projection: Tensor | None = None

    @property
    def fixed(self) -> bool:
        """Whether one matrix serves all frames."""
        return self.name == _MODEL

    def diagonalised(self, rho: float) -> tuple[Tensor, Tensor, Tensor]:
        """:math:`T` (n,n), :math:`\\delta` (n,) and the metric :math:`\\rho D` (n,)."""
        whole = self.H.sum(0)
        diagonal = whole.diagonal().clamp(min=1e-9 * float(whole.diagonal().max()))
        metric = rho * diagonal
        first, second = (part + torch.diag(metric / 2) for part in self.H)
        lower = torch.linalg.cholesky(first + second)
        inner = torch.linalg.solve_triangular(lower, first - second, upper=False)
        inner = torch.linalg.solve_triangular(lower, inner.T, upper=False)
        delta, vectors = torch.linalg.eigh(0.5 * (inner + inner.T))
        return torch.linalg.solve_triangular(lower.T, vectors, upper=True), delta, metric


def example_model(
    solver: ExampleSolver,
    steps: int = STEPS,
    steps_at_once: int = STEPS_AT_ONCE,
    rho: float = RHO,
    facts: Mapping[str, object] | None = None,
) -> onnx.ModelProto:
    r"""The solver as ONNX: ``landmarks`` (B,68,2) and ``previous`` (B,N) to ``weights`` and ``carried`` (B,N).

    What is carried, the weights before they were clipped with the multipliers of their bounds, is the next frame's
    ``previous``, so that few steps are enough; zeros or weights will do as well.

    Three branches: one frame in which every landmark is seen, many such frames, and frames with NaN landmarks, which
    are put where the weights have them, over and over: each time the sum of squares of those that are seen falls.

    Args:
        solver: of squared distances, or of a landmark model; with landmark boxes.
        steps, steps_at_once: of splitting.
        rho: of its metric.
        facts: further metadata.

    Raises:
        ValueRangeError: the solver is another.
    """
    problems = _problems(solver)
    shapes = len(solver.names)
    neutral = solver.neutral.double().cpu()
    kept = torch.ones(68, dtype=torch.bool)
    kept[_BROWS] = False
    low, high = neutral[kept].amin(0), neutral[kept].amax(0)
    build = GraphBuilder()
    far = torch.zeros(68, 2)
    far[_BROWS] = _FAR
    for name, value in (
        ("far", far),
        ("neutral", neutral),
        ("centred", neutral - (low + high) / 2),
        ("inverse_size", 1 / (high - low)),
    ):
        build.constant(name, value)
    for number, text in ((0.0, "zero"), (1.0, "one"), (0.5, "half"), (_FAR, "farthest")):
        build.constant(text, number)
    build.constant("minus_farthest", -_FAR)
    for name, integers in (("row", (-1, 136)), ("points", (-1, 68, 2)), ("pair", (-1, 2))):
        build.constant(name, integers)
    build.constant("single", (1,))
    build.constant("minus_relaxation", -RELAXATION)
    for problem in problems:
        _constants(build, problem, rho)
    if len(problems) > 1:
        for problem in problems:
            build.constant(f"{problem.name}_columns", problem.columns.tolist())
        order = torch.cat([problem.columns for problem in problems]).argsort().tolist()
        build.constant("order", order)
    # Of the two tests the first costs a frame least: a sum is itself unless something in it is NaN.
    total = build.op("ReduceSum", "landmarks", keepdims=0)
    whole = build.op("Equal", total, total)
    alone = build.op("Equal", build.op("Shape", "previous", start=0, end=1), "single")
    build.op(
        "If",
        build.op("And", whole, alone),
        then_branch=_complete_branch(build, problems, steps, single=True),
        else_branch=_batch_branch(build, problems, whole, steps_at_once),
        output="carried",
    )
    build.op("Clip", "carried", "zero", "one", output="weights")
    return build.model(
        "example_solver",
        {"landmarks": ("batch", 68, 2), "previous": ("batch", shapes)},
        {"weights": ("batch", shapes), "carried": ("batch", shapes)},
        {
            "task": "example_solver",
            "shape_names": list(solver.names),
            "units": "pixels",
            "version": __version__,
            "method": type(solver.method).__name__,
            "steps": [steps, steps_at_once],
            **(facts or {}),
        },
    )


def _problems(solver: ExampleSolver) -> list[_Problem]:
    """What the solver's method minimises, one problem after the other."""
    if type(solver.placement) is not LandmarkBoxes:
        raise ValueRangeError(
            f"export examples: found a solver with {type(solver.placement).__name__}, expected LandmarkBoxes"
        )
    neutral, basis = solver.neutral.double().cpu(), solver.basis.double().cpu()
    eyes = (neutral[EYE_CORNERS[0]] - neutral[EYE_CORNERS[1]]).square()
    every = torch.arange(len(solver.names))
    method = solver.method
    if isinstance(method, LandmarkModel):
        return [_of_model(method, neutral, basis, every)]
    objective = method.objective if isinstance(method, AllAtOnce | Regional) else None
    if not isinstance(objective, SquaredDistances):
        raise ValueRangeError(
            f"export examples: found {type(objective or method).__name__}, expected squared distances or a landmark "
            "model: distances take as many iterations as they need"
        )
    whole = torch.ones(68, dtype=torch.bool)
    if isinstance(method, AllAtOnce):
        return [_of_squares("all", objective, basis, whole, every, eyes)]
    regions = solver.regions
    of_head = torch.tensor([region == HEAD for region in regions])
    head, others = of_head.nonzero()[:, 0], (~of_head).nonzero()[:, 0]
    own = regional_basis(basis, regions)
    parts = [
        ("head", basis[..., head], head_rows(basis), head),
        ("expression", own[..., others], whole, others),
    ]
    return [_of_squares(name, objective, part, rows, ids, eyes) for name, part, rows, ids in parts if len(ids)]


def _of_squares(
    name: str, objective: SquaredDistances, basis: Tensor, rows: Tensor, columns: Tensor, eyes: Tensor
) -> _Problem:
    # All over the mean of both axes' squared scales, times the squared distance of the eyes in the picture.
    counted = torch.where(rows[:, None, None], basis, 0.0) * (2 / int(rows.sum()))
    ridge = 2 * objective.ridge * eyes[:, None, None] * torch.eye(len(columns), dtype=torch.float64)
    H = torch.einsum("pcn,pcm->cnm", counted, basis) + ridge
    penalty = objective.sparsity * eyes[:, None].expand(2, len(columns))
    zero = torch.zeros(len(columns), dtype=torch.float64)
    return _Problem(name, columns, basis.flatten(0, 1), counted.flatten(0, 1), zero, penalty, H)


def _of_model(model: LandmarkModel, neutral: Tensor, basis: Tensor, columns: Tensor) -> _Problem:
    mean, components = model.mean.double().cpu(), model.components.double().cpu().flatten(0, 1)
    rows, shift = basis.flatten(0, 1), (mean - neutral).flatten()
    eyes = float((neutral[EYE_CORNERS[0]] - neutral[EYE_CORNERS[1]]).square().sum())
    prior = torch.diag(model.noise**2 * eyes / (model.variances.double().cpu() + 1e-300))
    inverse = torch.linalg.inv(components.T @ components + prior)
    # Coefficients of what lies between picture and mean, o the residual at the neutral: -(o + m - e0).
    back = components @ inverse @ (components.T @ rows)  # (136,N)
    scale = 2 / 68
    H = scale * (rows.T @ components) @ (components.T @ rows) + 2 * model.ridge * eyes * torch.eye(len(columns))
    constant = scale * (shift @ back - (components.T @ shift) @ (components.T @ rows)) + model.sparsity * eyes
    none = torch.zeros(2, len(columns), dtype=torch.float64)
    onto = components @ inverse @ components.T  # of what lies between the picture and the mean
    projection = torch.cat([onto, (shift @ onto - shift)[None]])
    return _Problem(_MODEL, columns, rows, scale * back, constant, none, torch.stack([H, H]) / 2, projection)


def _constants(build: GraphBuilder, problem: _Problem, rho: float) -> None:
    T, delta, metric = problem.diagonalised(rho)
    identity = torch.eye(len(delta))
    constants = {"basis": problem.basis.T, "onto": problem.onto, "constant": problem.constant}
    if problem.fixed:
        inverse = T @ T.T
        minus_step = identity - RELAXATION * metric[:, None] * inverse
        constants |= {"minus_step": minus_step, "inverse": inverse}
        constants |= {"double_step": (2 - RELAXATION) * identity - 2 * minus_step}
        if problem.projection is not None:
            build.constant("projection", problem.projection[:-1])
            build.constant("projected_mean", problem.projection[-1])
    else:
        constants |= {
            "penalty": problem.penalty,
            "ends": torch.stack([1 + delta, 1 - delta]) / 2,
            "lifted_basis": RELAXATION * metric[:, None] * T,
            "plain_basis": T,
            "other_basis": T.T,
            "identity": identity,
        }
    for name, value in constants.items():
        build.constant(f"{problem.name}_{name}", value)


def _batch_branch(parent: GraphBuilder, problems: list[_Problem], whole: str, steps: int) -> onnx.GraphProto:
    build = GraphBuilder(parent)
    build.op(
        "If",
        whole,
        then_branch=_complete_branch(build, problems, steps, single=False),
        else_branch=_missing_branch(build, problems),
        output="carried_of_many",
    )
    return build.branch("carried_of_many")


def _complete_branch(parent: GraphBuilder, problems: list[_Problem], steps: int, single: bool) -> onnx.GraphProto:
    build = GraphBuilder(parent)
    op = build.op
    high = op("ReduceMax", op("Sub", "landmarks", "far"), axes=[1], keepdims=1)
    low = op("ReduceMin", op("Add", "landmarks", "far"), axes=[1], keepdims=1)
    scale = op("Mul", op("Sub", high, low), "inverse_size")
    middle = op("Mul", op("Add", high, low), "half")
    weighted = op("Sub", "centred", op("Div", op("Sub", "landmarks", middle), scale))
    share = ""
    if not problems[0].fixed:
        share = _share(build, scale)
        weighted = op("Mul", weighted, _as_points(build, share))
    carried = []
    for number, problem in enumerate(problems):
        stepper = _Stepper(build, problem, share, single)
        v = _own(build, problems, problem, "previous")
        residuals = build.op("Reshape", weighted, "row")
        weights, v = stepper.solve(build.op("Clip", v, "zero", "one"), v, residuals, stepper.penalty, steps)
        carried.append(v)
        if number + 1 < len(problems):
            moved = _moved(build, problem, weights)
            weighted = build.op("Add", weighted, build.op("Mul", moved, _as_points(build, share)))
    return build.branch(_joined(build, carried))


def _missing_branch(parent: GraphBuilder, problems: list[_Problem]) -> onnx.GraphProto:
    build = GraphBuilder(parent)
    op = build.op
    missing = op("ReduceMax", op("Cast", op("IsNaN", "landmarks"), to=onnx.TensorProto.FLOAT), axes=[2], keepdims=1)
    hidden = op("Cast", missing, to=onnx.TensorProto.BOOL)
    shown = op("Where", hidden, "neutral", "landmarks")
    counted = op("ReduceMean", op("Sub", "one", missing), axes=[1], keepdims=0)  # (B,1)
    # Boxes of the landmarks that are seen, here and on the neutral.
    high, low = (op("Where", hidden, end, shown) for end in ("minus_farthest", "farthest"))
    high0, low0 = (op("Where", hidden, end, "neutral") for end in ("minus_farthest", "farthest"))
    high, high0 = (op("ReduceMax", op("Sub", one, "far"), axes=[1], keepdims=1) for one in (high, high0))
    low, low0 = (op("ReduceMin", op("Add", one, "far"), axes=[1], keepdims=1) for one in (low, low0))
    scale = op("Div", op("Sub", high, low), op("Sub", high0, low0))
    middle, middle0 = (op("Mul", op("Add", one, two), "half") for one, two in ((high, low), (high0, low0)))
    offset = op("Sub", op("Sub", "neutral", middle0), op("Div", op("Sub", shown, middle), scale))
    share = _share(build, scale)
    steppers = [_Stepper(build, problem, share, False) for problem in problems]
    if problems[0].fixed:
        for _ in range(_PASSES):
            projected = op("Gemm", op("Reshape", offset, "row"), "projection", "projected_mean")
            offset = op("Where", hidden, op("Reshape", projected, "points"), offset)
    carried = [_own(build, problems, problem, "previous") for problem in problems]
    weights = [op("Clip", v, "zero", "one") for v in carried]
    axes = _as_points(build, share)
    for _ in range(_PASSES):
        filled = offset
        if not problems[0].fixed:
            moved = [_moved(build, problem, own) for problem, own in zip(problems, weights, strict=True)]
            filled = op("Where", hidden, op("Neg", moved[0] if len(moved) == 1 else op("Sum", *moved)), offset)
        for number, problem in enumerate(problems):
            if number:  # on the base that the head's shapes have moved
                filled = op("Add", filled, _moved(build, problems[0], weights[0]))
            weighted = op("Reshape", filled if problem.fixed else op("Mul", filled, axes), "row")
            stepper = steppers[number]
            penalty = stepper.penalty if problem.fixed else op("Mul", stepper.penalty, counted)
            weights[number], carried[number] = stepper.solve(
                weights[number], carried[number], weighted, penalty, _STEPS_A_PASS
            )
    return build.branch(_joined(build, carried))


def _moved(build: GraphBuilder, problem: _Problem, weights: str) -> str:
    """What weights add to the landmarks, (B,68,2)."""
    return build.op("Reshape", build.op("MatMul", weights, f"{problem.name}_basis"), "points")


def _share(build: GraphBuilder, scale: str) -> str:
    """What x and y count, (B,2), from the scales (B,1,2); their mean is 1."""
    squared = build.op("Mul", scale, scale)
    return build.op("Reshape", build.op("Div", squared, build.op("ReduceMean", squared, axes=[2], keepdims=1)), "pair")


def _as_points(build: GraphBuilder, share: str) -> str:
    return build.op("Unsqueeze", share, build.constant("middle_axis", (1,)))


def _own(build: GraphBuilder, problems: list[_Problem], problem: _Problem, weights: str) -> str:
    if len(problems) == 1:
        return weights
    return build.op("Gather", weights, f"{problem.name}_columns", axis=1)


def _joined(build: GraphBuilder, weights: list[str]) -> str:
    if len(weights) == 1:
        return build.op("Identity", weights[0])
    return build.op("Gather", build.op("Concat", *weights, axis=1), "order", axis=1)


class _Stepper:
    """Steps of splitting of one problem, its matrices made once for what x and y count in a batch.

    Args:
        build: of the branch.
        problem: which one.
        share: what x and y count, (B,2).
        single: B is 1. Then the matrices of a step are made, and it takes three nodes; a batch has a matrix a frame,
            which is never made: it is two that are the same for all, and a factor a frame between them.
    """

    def __init__(self, build: GraphBuilder, problem: _Problem, share: str, single: bool) -> None:
        self._build, self._name = build, problem.name
        op, name = build.op, problem.name
        self.penalty = f"{name}_constant"
        self._minus_step, self._double_step = f"{name}_minus_step", f"{name}_double_step"
        self._plain, self._factor = single or problem.fixed, ""
        if problem.fixed:
            return
        self.penalty = op("MatMul", share, f"{name}_penalty")
        self._factor = op("Reciprocal", op("MatMul", share, f"{name}_ends"))
        if not single:
            return
        lifted, other = op("Mul", f"{name}_lifted_basis", self._factor), f"{name}_other_basis"
        self._minus_step = op("Gemm", lifted, other, f"{name}_identity", alpha=-1.0)
        self._double_step = op("Gemm", lifted, other, f"{name}_identity", alpha=2.0, beta=-RELAXATION)

    def solve(self, z: str, v: str, residuals: str, penalty: str, steps: int) -> tuple[str, str]:
        """Weights, and before they were clipped, after some steps from such two, all (B,n).

        Args:
            z, v: where to go on from.
            residuals: at weights of zero, (B,136).
            penalty: of the L1 penalty, (B,n).
            steps: how many.
        """
        op, name = self._build.op, self._name
        f = op("Gemm", residuals, f"{name}_onto", penalty, alpha=-RELAXATION, beta=-RELAXATION)
        constant = self._times(f, "plain_basis") if self._factor else op("MatMul", f, f"{name}_inverse")
        if self._plain:
            for _ in range(steps):
                v = op("Gemm", v, self._minus_step, constant)
                v = op("Gemm", z, self._double_step, v)
                z = op("Clip", v, "zero", "one")
            return z, v
        for _ in range(steps):
            # v + c - relaxation z + (2z - v) L, where 2z - v goes through L's two factors.
            turned = op("Sub", op("Add", z, z), v)
            v = op("Sum", v, constant, op("Mul", z, "minus_relaxation"), self._times(turned, "lifted_basis"))
            z = op("Clip", v, "zero", "one")
        return z, v

    def _times(self, rows: str, basis: str) -> str:
        op, name = self._build.op, self._name
        return op("MatMul", op("Mul", op("MatMul", rows, f"{name}_{basis}"), self._factor), f"{name}_other_basis")
