"""Values of an ONNX graph that are written as arithmetic: ``a + b`` adds a node."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import onnx
import torch
from onnx import TensorProto
from torch import Tensor

from torchface.onnx.graph_builder import GraphBuilder

OPSET = 18


class ValueGraph:
    """A graph under construction, whose nodes come where the writing is: in a branch or outside."""

    def __init__(self) -> None:
        self.root = GraphBuilder()
        self._inside: list[GraphBuilder] = [self.root]

    @property
    def build(self) -> GraphBuilder:
        """Where nodes are added now."""
        return self._inside[-1]

    @property
    def none(self) -> Value:
        """In the place of an input that is left out."""
        return Value(self, "")

    def value(self, name: str) -> Value:
        """A value that has a name already."""
        return Value(self, name)

    def op(self, kind: str, *inputs: Value | Tensor | float | Sequence[int], **attributes: Any) -> Value:
        """A node's only output; numbers are float32, sequences int64."""
        return Value(self, self.build.op(kind, *(self.as_value(one).name for one in inputs), **attributes))

    def two_of(
        self, kind: str, *inputs: Value | Tensor | float | Sequence[int], **attributes: Any
    ) -> tuple[Value, Value]:
        """A node's two outputs."""
        first, second = self.build.two_of(kind, *(self.as_value(one).name for one in inputs), **attributes)
        return Value(self, first), Value(self, second)

    def as_value(self, given: Value | Tensor | float | Sequence[int]) -> Value:
        """A value, or a constant: a number becomes float32 (1,), a sequence int64, a tensor float32."""
        if isinstance(given, Value):
            return given
        if isinstance(given, Tensor):
            return Value(self, self.root.unnamed(given))
        if isinstance(given, int | float):
            return Value(self, self.root.constant(f"number {float(given)!r}", torch.tensor([float(given)])))
        return Value(self, self.root.constant(f"whole {list(given)!r}", given))

    def where(self, condition: Value, one: Value | Tensor | float, other: Value | Tensor | float) -> Value:
        """One where the condition holds, the other elsewhere."""
        return self.op("Where", condition, one, other)

    def cat(self, *values: Value | Tensor | float | Sequence[int], axis: int = 0) -> Value:
        """Values one after the other."""
        return self.op("Concat", *values, axis=axis)

    def either(self, condition: Value, then: Callable[[], Value], otherwise: Callable[[], Value]) -> Value:
        """What one of two functions gives, of which the other's nodes do not run."""
        branches = {}
        for key, function in {"then_branch": then, "else_branch": otherwise}.items():
            with self._within():
                given = function()
                # A branch's output is one of its own nodes.
                branches[key] = self.build.branch(self.build.op("Identity", given.name))
        return Value(self, self.build.op("If", condition.name, **branches))

    @contextmanager
    def _within(self) -> Iterator[None]:
        """Nodes of the block come into a graph inside the present one."""
        self._inside.append(GraphBuilder(self.build))
        try:
            yield
        finally:
            self._inside.pop()

    def include(self, model: onnx.ModelProto, prefix: str, inputs: Mapping[str, Value]) -> dict[str, Value]:
        """The nodes of a whole model.

        Args:
            model: of the same operators, without functions.
            prefix: of the names of its nodes and values.
            inputs: of all its inputs, the values that it takes.

        Returns:
            Its outputs by name.
        """
        renamed = onnx.GraphProto()
        renamed.CopyFrom(model.graph)
        _rename(renamed, prefix)
        for name, value in inputs.items():
            self.build.op("Identity", value.name, output=prefix + name)
        self.root._nodes.extend(renamed.node)
        for constant in renamed.initializer:
            self.root._constants[constant.name] = constant
        return {one.name: self.value(prefix + one.name) for one in model.graph.output}


class Value:
    """A value of a graph.

    Args:
        graph: that it is of.
        name: in the graph.
    """

    def __init__(self, graph: ValueGraph, name: str) -> None:
        self.graph, self.name = graph, name

    def __add__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("Add", self, other)

    def __sub__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("Sub", self, other)

    def __rsub__(self, other: float) -> Value:
        return self.graph.op("Sub", other, self)

    def __mul__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("Mul", self, other)

    def __truediv__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("Div", self, other)

    def __rtruediv__(self, other: float) -> Value:
        return self.graph.op("Div", other, self)

    def __neg__(self) -> Value:
        return self.graph.op("Neg", self)

    def __lt__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("Less", self, other)

    def __gt__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("Greater", self, other)

    def __le__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("LessOrEqual", self, other)

    def __ge__(self, other: Value | Tensor | float) -> Value:
        return self.graph.op("GreaterOrEqual", self, other)

    def __and__(self, other: Value) -> Value:
        return self.graph.op("And", self, other)

    def __or__(self, other: Value) -> Value:
        return self.graph.op("Or", self, other)

    def __invert__(self) -> Value:
        return self.graph.op("Not", self)

    __radd__, __rmul__ = __add__, __mul__

    def equals(self, other: Value | Tensor | float) -> Value:
        """Where the two are the same."""
        return self.graph.op("Equal", self, other)

    def rows(self, first: int, end: int, axis: int = 0) -> Value:
        """Those from ``first`` to before ``end`` along an axis."""
        return self.graph.op("Slice", self, [first], [end], [axis])

    def shaped(self, *sizes: int) -> Value:
        """The same numbers in another form; -1 is what remains."""
        return self.graph.op("Reshape", self, list(sizes))

    def least(self, other: Value | Tensor | float) -> Value:
        """The smaller of the two."""
        return self.graph.op("Min", self, other)

    def most(self, other: Value | Tensor | float) -> Value:
        """The larger of the two."""
        return self.graph.op("Max", self, other)

    def whole(self) -> Value:
        """As int64, cut off."""
        return self.graph.op("Cast", self, to=TensorProto.INT64)

    def number(self) -> Value:
        """As float32."""
        return self.graph.op("Cast", self, to=TensorProto.FLOAT)

    def reduced(self, kind: str, axis: int, keep: bool = False) -> Value:
        """Over an axis: ``ReduceMin``, ``ReduceMax``, ``ReduceSum`` or ``ReduceMean``."""
        return self.graph.op(kind, self, [axis], keepdims=int(keep))


def _rename(graph: onnx.GraphProto, prefix: str) -> None:
    """Puts a prefix before all names, those in branches and loops too, which ``onnx.compose`` does not reach."""
    for value in (*graph.input, *graph.output, *graph.initializer):
        value.name = prefix + value.name
    for node in graph.node:
        node.name = prefix + node.name if node.name else ""
        for names in (node.input, node.output):
            names[:] = [prefix + name if name else "" for name in names]
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                _rename(attribute.g, prefix)
