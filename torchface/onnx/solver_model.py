"""``SolverGraph`` as an ONNX model, steps unrolled."""

from __future__ import annotations

from collections.abc import Mapping

import onnx
import torch

from torchface import __version__
from torchface.onnx.graph_builder import GraphBuilder
from torchface.onnx.hybrid_graph import HybridGraph
from torchface.onnx.solver_graph import NEWTON_SCALE, SolverGraph, stretches
from torchface.optim.operator_splitting import RELAXATION


def solver_model(graph: SolverGraph, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph as ONNX: plain operators, two branches of unrolled steps under one ``If``.

    A ``HybridGraph`` has two inputs more. Built node by node: at batch 1 the number of nodes is what costs, and a step
    needs only three (two products and a clamp) where a traced graph has six.
    """
    markers, shapes = len(graph.labels), len(graph.names)
    build = GraphBuilder()
    for name in ("rest", "rows", "double_step", "offset"):
        build.constant(name, getattr(graph, name))
    build.constant("minus_step", -graph.step)
    build.constant("zero", 0.0)
    build.constant("one", 1.0)
    build.constant("l1_penalty", graph.l1_penalty)
    build.constant("double_ridge", float(graph.double_ridge))
    build.constant("relaxation_less_one", RELAXATION - 1)
    build.constant("row", (-1, 3 * markers))
    offset = build.op("Sub", "rest", "markers")
    missing = build.op("IsNaN", offset)
    gone = build.op("ReduceMax", build.op("Cast", missing, to=onnx.TensorProto.FLOAT), axes=[2], keepdims=1)
    own = build.op("ReduceMax", gone, keepdims=0)
    hybrid, pull, target = isinstance(graph, HybridGraph), None, None
    if hybrid:
        pull = build.op("Mul", "gamma", build.constant("pull_scale", 2 / markers))
        led = build.op("Greater", pull, "zero")
        target = build.op("Where", led, build.op("Clip", "predicted", "zero", "one"), "zero")
        own = build.op("Max", own, build.op("ReduceMax", build.op("Cast", led, to=onnx.TensorProto.FLOAT), keepdims=0))
    start = build.op("Clip", "previous", "zero", "one")
    build.op(
        "If",
        build.op("Cast", own, to=onnx.TensorProto.BOOL),
        then_branch=_gaps_branch(build, graph, offset, gone, start, pull, target),
        else_branch=_complete_branch(build, graph, offset, start),
        output="weights",
    )
    return build.model(
        "hybrid_solver" if hybrid else "marker_solver",
        {name: ("batch", shapes) if name != "markers" else ("batch", markers, 3) for name in graph.inputs},
        {"weights": ("batch", shapes)},
        {
            "task": "hybrid_solver" if hybrid else "solver",
            "shape_names": list(graph.names),
            "marker_labels": list(graph.labels),
            "units": "millimetres",
            "version": __version__,
            "sparsity": graph.sparsity,
            "ridge": graph.ridge,
            "steps": [graph.steps, graph.steps_with_gaps],
            **(facts or {}),
        },
    )


def _complete_branch(parent: GraphBuilder, graph: SolverGraph, offset: str, start: str) -> onnx.GraphProto:
    build = GraphBuilder(parent)
    offset = build.op("Reshape", offset, "row")
    z = v = start
    for steps in stretches(graph.steps):
        distance = build.op("Gemm", z, "rows", offset, transB=1, alpha=graph.gram_scale)
        gradient = build.op("Gemm", distance, "rows", "l1_penalty")
        gradient = build.op("Add", gradient, build.op("Mul", z, "double_ridge"))
        constant = _constant(build, z, gradient)
        for _ in range(steps):
            v = build.op("Gemm", v, "minus_step", constant)
            v = build.op("Gemm", z, "double_step", v)
            z = build.op("Clip", v, "zero", "one")
    return build.branch(z)


def _constant(build: GraphBuilder, w: str, gradient: str) -> str:
    back = build.op("Gemm", w, "minus_step", build.op("Mul", w, "relaxation_less_one"))
    return build.op("Gemm", gradient, "offset", back)


def _gaps_branch(
    parent: GraphBuilder,
    graph: SolverGraph,
    offset: str,
    gone: str,
    start: str,
    pull: str | None,
    target: str | None,
) -> onnx.GraphProto:
    build = GraphBuilder(parent)
    shapes = len(graph.names)
    for name, value in (
        ("gram_scale", float(graph.gram_scale)),
        ("two", 2.0),
        ("rho", float(graph.rho)),
        ("minus_relaxation", -RELAXATION),
        ("relaxation_rest", 2 - RELAXATION),
        ("newton_start", NEWTON_SCALE),
        ("smallest", float(graph.smallest_diagonal)),
        ("identity", torch.eye(shapes)),
        ("wide", (-1, 1, 3 * len(graph.labels))),
        ("vector", (-1, 1, shapes)),
        ("flat", (-1, shapes)),
        ("three", (1, 1, 3)),
    ):
        build.constant(name, value)
    op = build.op

    def turned(matrix: str) -> str:
        return op("Transpose", matrix, perm=[0, 2, 1])

    hidden = op("Cast", gone, to=onnx.TensorProto.BOOL)
    seen_offset = op("Reshape", op("Where", hidden, "zero", offset), "wide")
    seen = op("Sub", "one", gone)
    visible = op("ReduceMean", seen, axes=[1], keepdims=1)
    seen = op("Reshape", op("Expand", seen, "three"), "wide")
    basis = op("Transpose", "rows", perm=[1, 0])
    H = op("Mul", op("MatMul", op("Mul", seen, basis), "rows"), "gram_scale")
    ridge, first_penalty = "double_ridge", "l1_penalty"
    if pull is not None and target is not None:
        ridge = op("Reshape", op("Add", pull, "double_ridge"), "vector")
        first_penalty = op("Sub", "l1_penalty", op("Reshape", op("Mul", pull, target), "vector"))
    H = op("Add", H, op("Mul", op("Mul", ridge, "identity"), visible))
    diagonal = op("ReduceMax", op("Mul", H, "identity"), axes=[1], keepdims=1)
    diagonal = op("Max", diagonal, "smallest")
    scale = op("Div", "one", op("Sqrt", diagonal))
    scales = op("Mul", turned(scale), scale)
    A = op("Add", op("Mul", H, scales), op("Mul", "rho", "identity"))
    norm = op("Sqrt", op("ReduceSum", op("Mul", A, A), build.constant("matrix_axes", (1, 2)), keepdims=1))
    X = op("Mul", "identity", op("Div", "newton_start", norm))
    double_identity = op("Mul", "two", "identity")
    for _ in range(graph.newton_steps):
        X = op("MatMul", X, op("Sub", double_identity, op("MatMul", A, X)))
    inverse = op("Mul", op("Mul", X, scales), "minus_relaxation")
    minus_step = op("Add", op("Mul", op("Mul", turned(diagonal), "rho"), inverse), "identity")
    double_step = op("Sub", op("Mul", "relaxation_rest", "identity"), op("Mul", "two", minus_step))
    z = v = op("Reshape", start, "vector")
    for steps in stretches(graph.steps_with_gaps):
        distance = op("Add", seen_offset, op("Mul", op("MatMul", z, basis), "gram_scale"))
        penalty = op("Mul", visible, op("Add", first_penalty, op("Mul", z, ridge)))
        gradient = op("Add", op("MatMul", op("Mul", distance, seen), "rows"), penalty)
        back = op("Add", op("MatMul", z, minus_step), op("Mul", z, "relaxation_less_one"))
        constant = op("Add", op("MatMul", gradient, inverse), back)
        for _ in range(steps):
            v = op("Sum", constant, op("MatMul", v, minus_step), op("MatMul", z, double_step))
            z = op("Clip", v, "zero", "one")
    return build.branch(op("Reshape", z, "flat"))
