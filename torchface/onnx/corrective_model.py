"""``CorrectiveGraph`` as an ONNX model, steps unrolled."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce

import onnx
import torch
from torch import Tensor

from torchface import __version__
from torchface.correctives.activation import ROUNDED, CorrectiveActivation
from torchface.onnx.corrective_graph import (
    LENGTHS,
    LINEAR_SPLITTING,
    ROUNDED_STEPS,
    SMALLEST_DIAGONAL,
    SPLITTING,
    CorrectiveGraph,
    HybridCorrectiveGraph,
)
from torchface.onnx.graph_builder import GraphBuilder
from torchface.onnx.solver_graph import NEWTON_SCALE
from torchface.optim.operator_splitting import RELAXATION

_DOUBLE, _BOOL = onnx.TensorProto.DOUBLE, onnx.TensorProto.BOOL


def corrective_model(graph: CorrectiveGraph, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph as ONNX, its inputs, output and metadata those of ``solver_model``'s.

    Built node by node, as that one is: the exporter takes minutes for as many.
    """
    markers, shapes, hybrid = len(graph.labels), len(graph.names), isinstance(graph, HybridCorrectiveGraph)
    writer = _Writer(graph)
    writer.write()
    return writer.build.model(
        "hybrid_solver" if hybrid else "marker_solver",
        {name: ("batch", shapes) if name != "markers" else ("batch", markers, 3) for name in graph.inputs},
        {"weights": ("batch", shapes)},
        {
            "task": "hybrid_solver" if hybrid else "solver",
            "shape_names": list(graph.names),
            "marker_labels": list(graph.labels),
            "correctives": len(graph.activation.definitions),
            "units": "millimetres",
            "version": __version__,
            "sparsity": graph.sparsity,
            "ridge": graph.ridge,
            "steps": [graph.steps, graph.steps_with_gaps],
            **(facts or {}),
        },
    )


class _Writer:
    """Nodes of each part of ``CorrectiveGraph.forward``, under the names that it has there."""

    def __init__(self, graph: CorrectiveGraph) -> None:
        self.graph, self.build = graph, GraphBuilder()
        self.op, self.number = self.build.op, self.build.double
        shapes, rows = len(graph.names), graph.rows
        self.rows = self.number(rows.T)
        self.linear, self.corrective = self.number(rows[:, :shapes]), self.number(rows[:, shapes:])
        self.identity = self.number(graph.identity)
        self.build.constant("all", (-1, rows.shape[0]))
        self.build.constant("deep", (-1, rows.shape[0], 1))
        self.build.constant("wide", (-1, 1, rows.shape[0]))
        self.build.constant("row", (-1, 1, shapes))
        self.build.constant("flat", (-1, shapes))
        self.build.constant("column", (-1, 1))
        self.build.constant("cell", (-1, 1, 1))
        self.build.constant("three", (1, 1, 3))
        self.build.constant("last", (1,))
        self.build.constant("inner", (1, 2))
        self.zero, self.one = self.scalar(0.0), self.scalar(1.0)

    def scalar(self, value: float) -> str:
        return self.number(torch.tensor(value, dtype=torch.float64))

    def write(self) -> None:
        op, graph = self.op, self.graph
        nan = op("Cast", op("IsNaN", "markers"), to=onnx.TensorProto.FLOAT)
        missing = op("ReduceMax", nan, axes=[2], keepdims=1)
        clean = op("Where", op("Cast", missing, to=_BOOL), self.build.constant("nothing", 0.0), "markers")
        placed = op("MatMul", op("Cast", clean, to=_DOUBLE), self.number(graph.rotation.T))
        placed = op("Add", op("Mul", placed, self.number(graph.scale)), self.number(graph.translation))
        seen = op("Sub", self.one, op("Cast", missing, to=_DOUBLE))
        self.mask = op("Reshape", op("Expand", seen, "three"), "all")
        self.deep_mask = op("Reshape", self.mask, "deep")
        count = op("Reshape", op("ReduceSum", seen, "inner", keepdims=0), "column")
        self.ones = op("Add", op("Mul", count, self.zero), self.one)
        self.share = op("Div", self.scalar(2.0), op("Max", count, self.one))
        self.deep_share = op("Reshape", self.share, "cell")
        self.offset = op("Mul", op("Reshape", op("Sub", self.number(graph.rest), placed), "all"), self.mask)
        self._write_own_terms()
        before = op("Clip", op("Cast", "previous", to=_DOUBLE), self.zero, self.one)
        w = before
        moved = op("MatMul", w, self.number(graph.rows[:, : len(graph.names)].T))
        residual = op("Mul", op("Add", self.offset, moved), self.mask)
        w = op("Add", w, self._step(w, self.linear, residual, LINEAR_SPLITTING))
        for number in range(graph.steps):
            rounded = number < ROUNDED_STEPS and len(graph.activation.in_betweens) > 0
            w = self._gauss_newton(w, rounded)
        told = op("Greater", count, self.zero)
        op("Cast", op("Where", told, w, before), to=onnx.TensorProto.FLOAT, output="weights")

    def _write_own_terms(self) -> None:
        """Of the weights: slope at zero, second derivative, and the latter as matrices."""
        op, graph = self.op, self.graph
        self.penalty, self.curvature = self.number(graph.penalty), self.number(graph.curvature)
        if isinstance(graph, HybridCorrectiveGraph):
            gamma, zero = op("Cast", "gamma", to=_DOUBLE), self.zero
            pull = op("Mul", gamma, self.scalar(2 / len(graph.labels)))
            predicted = op("Clip", op("Cast", "predicted", to=_DOUBLE), zero, self.one)
            target = op("Where", op("Greater", gamma, zero), predicted, zero)
            self.penalty = op("Sub", self.penalty, op("Mul", pull, target))
            self.curvature = op("Add", self.curvature, pull)
        self.own_matrices = op("Mul", op("Reshape", self.curvature, "row"), self.identity)

    def _gauss_newton(self, w: str, rounded: bool) -> str:
        op = self.op
        J = op("Add", self.linear, op("MatMul", self.corrective, self._jacobian(w, rounded)))
        step = self._step(w, J, self._residual(w, rounded), SPLITTING)
        best, least = w, self._energy(w, rounded)
        for length in LENGTHS:
            there = op("Add", w, op("Mul", step, self.scalar(length)))
            value = self._energy(there, rounded)
            best, least = op("Where", op("Less", value, least), there, best), op("Min", value, least)
        return best

    def _residual(self, w: str, rounded: bool) -> str:
        op = self.op
        x = op("Concat", w, self._activation(w, rounded), axis=1)
        return op("Mul", op("Add", self.offset, op("MatMul", x, self.rows)), self.mask)

    def _energy(self, w: str, rounded: bool) -> str:
        op, residual = self.op, self._residual(w, rounded)
        squared = op("ReduceSum", op("Mul", residual, residual), "last", keepdims=1)
        data = op("Mul", op("Mul", self.share, self.scalar(0.5)), squared)
        slope = op("Add", self.penalty, op("Mul", op("Mul", w, self.curvature), self.scalar(0.5)))
        own = op("Mul", w, slope)
        return op("Add", data, op("ReduceSum", own, "last", keepdims=1))

    def _factors(self, w: str) -> list[str]:
        padded = self.op("Concat", w, self.ones, axis=1)
        drivers = self.graph.activation.drivers.T.tolist()
        names = [self.build.constant(f"drivers_{k}", row) for k, row in enumerate(drivers)]
        return [self.op("Gather", padded, name, axis=1) for name in names]

    def _product(self, factors: list[str]) -> str:
        return reduce(lambda first, second: self.op("Mul", first, second), factors or [self.ones])

    def _activation(self, w: str, rounded: bool) -> str:
        op = self.op
        product = self._product(self._factors(w))
        if not len(self.graph.activation.in_betweens):
            return product
        along, left, peak, right = self._along(w)
        if rounded:
            factor = self.number(ROUNDED / (self._knots[2] - self._knots[0]).square())
            value = op("Mul", op("Mul", op("Sub", along, left), op("Sub", right, along)), factor)
        else:
            rise = op("Div", op("Sub", along, left), op("Sub", peak, left))
            value = op("Min", rise, op("Div", op("Sub", right, along), op("Sub", right, peak)))
        return op("Add", op("Mul", product, self._products), op("MatMul", op("Max", value, self.zero), self._spread))

    def _jacobian(self, w: str, rounded: bool) -> str:
        op, activation = self.op, self.graph.activation
        factors = self._factors(w)
        slopes = [self._product([*factors[:k], *factors[k + 1 :]]) for k in range(len(factors))]
        if len(activation.in_betweens):
            own = op("MatMul", self._slope_along(w, rounded), self._spread)
            slopes[0] = op("Add", op("Mul", slopes[0], self._products), own)
        total = None
        for k, slope in enumerate(slopes):
            rows = torch.nn.functional.one_hot(activation.drivers[:, k], activation.shapes + 1)[:, :-1].double()
            part = op("Mul", op("Unsqueeze", slope, self.build.constant("behind", (2,))), self.number(rows))
            total = part if total is None else op("Add", total, part)
        assert total is not None
        return total

    def _slope_along(self, w: str, rounded: bool) -> str:
        op = self.op
        along, left, peak, right = self._along(w)
        low, at, high = self._knots
        beyond = op("Or", op("Less", along, left), op("Greater", along, right))
        if rounded:
            factor = self.number(-2 * ROUNDED / (high - low).square())
            slope = op("Mul", op("Sub", along, self.number(0.5 * (low + high))), factor)
        else:
            rise, fall = self.number(1 / (at - low)), self.number(-1 / (high - at))
            slope = op("Where", op("Less", along, peak), rise, fall)
            ends = op("Cast", self.number((high < 1).double()), to=_BOOL)
            beyond = op("Or", beyond, op("And", op("Not", op("Less", along, right)), ends))
        return op("Where", beyond, self.zero, slope)

    def _along(self, w: str) -> tuple[str, str, str, str]:
        activation: CorrectiveActivation = self.graph.activation
        drivers = activation.drivers[activation.in_betweens, 0].tolist()
        along = self.op("Gather", w, self.build.constant("in_between_drivers", drivers), axis=1)
        left, peak, right = (self.number(knot) for knot in self._knots)
        return along, left, peak, right

    @property
    def _knots(self) -> tuple[Tensor, Tensor, Tensor]:
        left, peak, right = self.graph.activation.knots.T
        return left, peak, right

    @property
    def _products(self) -> str:
        """1 for combinations, 0 for in-betweens, (C,)."""
        kept = torch.ones(len(self.graph.activation.definitions), dtype=torch.float64)
        kept[self.graph.activation.in_betweens] = 0.0
        return self.number(kept)

    @property
    def _spread(self) -> str:
        """In-betweens to their places among the correctives, (K,C)."""
        activation = self.graph.activation
        return self.number(torch.eye(len(activation.definitions), dtype=torch.float64)[activation.in_betweens])

    def _step(self, w: str, J: str, residual: str, steps: int) -> str:
        op, graph = self.op, self.graph

        def turned(matrix: str) -> str:
            return op("Transpose", matrix, perm=[0, 2, 1])

        masked = turned(op("Mul", J, self.deep_mask))
        H = op("Mul", self.deep_share, op("MatMul", masked, J))
        H = op("Add", H, self.own_matrices)
        slope = op("MatMul", op("Reshape", residual, "wide"), J)
        slope = op("Mul", self.deep_share, slope)
        own = op("Add", op("Mul", w, self.curvature), self.penalty)
        slope = op("Add", slope, op("Reshape", own, "row"))
        diagonal = op("ReduceSum", op("Mul", H, self.identity), "last", keepdims=1)
        least = op("Mul", op("ReduceMax", diagonal, axes=[2], keepdims=1), self.scalar(SMALLEST_DIAGONAL))
        diagonal = op("Max", op("Max", diagonal, least), self.scalar(1e-12))
        scale = op("Div", self.one, op("Sqrt", diagonal))
        scales = op("Mul", turned(scale), scale)
        A = op("Add", op("Mul", H, scales), self.number(graph.rho * graph.identity))
        norm = op("Sqrt", op("ReduceSum", op("Mul", A, A), "inner", keepdims=1))
        X = op("Mul", self.identity, op("Div", self.scalar(NEWTON_SCALE), norm))
        double_identity = self.number(2 * graph.identity)
        for _ in range(graph.newton_steps):
            X = op("MatMul", X, op("Sub", double_identity, op("MatMul", A, X)))
        inverse = op("Mul", op("Mul", X, scales), self.scalar(-RELAXATION))
        minus_step = op("Add", op("Mul", op("Mul", turned(diagonal), self.scalar(graph.rho)), inverse), self.identity)
        double_step = op("Sub", self.number((2 - RELAXATION) * graph.identity), op("Mul", self.scalar(2.0), minus_step))
        z = v = here = op("Reshape", w, "row")
        back = op("Add", op("MatMul", here, minus_step), op("Mul", here, self.scalar(RELAXATION - 1)))
        constant = op("Add", op("MatMul", slope, inverse), back)
        for _ in range(steps):
            v = op("Sum", constant, op("MatMul", v, minus_step), op("MatMul", z, double_step))
            z = op("Clip", v, self.zero, self.one)
        return op("Sub", op("Reshape", z, "flat"), w)
