"""An expression regression as ONNX: neutral faces to the offsets of a rig."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx
import torch
from torch import Tensor

from torchface import __version__
from torchface.errors import ValueRangeError
from torchface.modeling import ExpressionRegression
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_builder import GraphBuilder

_PARITY = 1e-3  # millimetres
# Each squares the ratio of the largest eigenvalue to the next: heads are far from round, a few would do.
_SQUARINGS = 12


def export_expression_regression(
    model: ExpressionRegression, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes a regression of the form "offsets", and checks it.

    The graph takes ``neutrals`` (B,V,3), millimetres, in any pose, and gives ``offsets`` (B,N,V,3), what a weight of 1
    of each expression adds. The metadata holds ``shape_names`` and ``topology``.

    Args:
        model: in float32.
        path: the file to write.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: the form is another, or ONNX Runtime and PyTorch differ; nothing is written.
    """
    if model.form != "offsets":
        raise ValueRangeError(f"{path}: found a regression of the form {model.form!r}, expected 'offsets'")
    graph = expression_model(model, facts)
    cases = []
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 3):
        neutrals = model.neutral_mean + torch.randn(batch, *model.neutral_mean.shape, generator=generator)
        turn = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator))[0]
        turn = turn * torch.linalg.det(turn)[:, None, None]
        neutrals = neutrals @ turn + 100 * torch.randn(batch, 1, 3, generator=generator)
        # Where positions are rounded to float32 is no affair of the graph's.
        cases.append(({"neutrals": neutrals}, {"offsets": model.offsets(neutrals.double()).float()}))
    return write_checked(graph, path, cases, {"offsets": _PARITY}, {"offsets": "millimetres"})


def expression_model(model: ExpressionRegression, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    r"""The graph.

    Its rotation onto the mean neutral is Horn's: the largest eigenvector q of a symmetric 4×4 matrix A that is linear
    in the covariance. Squared again and again, A + I comes to :math:`q q^\top`, in which the rotation is linear.
    """
    build = GraphBuilder()
    op = build.op
    vertices, shapes = len(model.neutral_mean), len(model.names)
    centre = model.neutral_mean.double().mean(0)
    aim = (model.neutral_mean.double() - centre).float()
    for name, value in {
        "aim": aim,
        "aim_region": aim[model.region],
        "to_quaternion": _horn(),
        "to_rotation": _rotation_of_products(),
        "identity": torch.eye(4),
        "inputs": model.neutral_components.flatten(1).T @ model.coefficients,
        "offset_mean": model.offset_mean.flatten(),
        "offset_components": model.offset_components.flatten(1),
    }.items():
        build.constant(name, value)
    # A place that is not predicted takes the row of zeros that is put at the end.
    rows = torch.full((shapes * vertices,), len(model.places), dtype=torch.int64)
    rows[model.places] = torch.arange(len(model.places))
    for name, ids in {
        "region": model.region.tolist(),
        "rows": rows.tolist(),
        "nine": (-1, 9),
        "sixteen": (-1, 16),
        "four": (-1, 4, 4),
        "three": (-1, 3, 3),
        "wide": (-1, 3 * len(model.region)),
        "points": (-1, len(model.places), 3),
        "whole": (-1, shapes, vertices, 3),
        "one_row": (0, 0, 0, 0, 1, 0),
        "matrix_axes": (1, 2),
    }.items():
        build.constant(name, ids)

    def unit(matrix: str) -> str:
        return op("Div", matrix, op("Sqrt", op("ReduceSum", op("Mul", matrix, matrix), "matrix_axes", keepdims=1)))

    laid = op("Sub", "neutrals", op("ReduceMean", "neutrals", axes=[1], keepdims=1))
    covariance = op("MatMul", op("Transpose", laid, perm=[0, 2, 1]), "aim")
    horn = op("Reshape", op("MatMul", op("Reshape", covariance, "nine"), "to_quaternion"), "four")
    power = op("Add", unit(horn), "identity")
    for _ in range(_SQUARINGS):
        power = unit(op("MatMul", power, power))
    rotation = op("Reshape", op("MatMul", op("Reshape", power, "sixteen"), "to_rotation"), "three")
    seen = op("MatMul", op("Gather", laid, "region", axis=1), op("Transpose", rotation, perm=[0, 2, 1]))
    form = op("Reshape", op("Sub", seen, "aim_region"), "wide")
    told = op("Gemm", op("MatMul", form, "inputs"), "offset_components", "offset_mean")
    placed = op("Gather", op("Pad", op("Reshape", told, "points"), "one_row"), "rows", axis=1)
    op("Reshape", op("MatMul", placed, rotation), "whole", output="offsets")
    return build.model(
        "expression_regression",
        {"neutrals": ("batch", vertices, 3)},
        {"offsets": ("batch", shapes, vertices, 3)},
        {
            "task": "expression_regression",
            "shape_names": list(model.names),
            "units": "millimetres",
            "topology": model.topology or "",
            "version": __version__,
            **(facts or {}),
        },
    )


def _horn() -> Tensor:
    """(9,16): from the covariance of source and target, row by row, to Horn's matrix."""
    table = torch.zeros(3, 3, 4, 4)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = ((i, j) for i in range(3) for j in range(3))
    entries = {
        (0, 0): {xx: 1, yy: 1, zz: 1},
        (1, 1): {xx: 1, yy: -1, zz: -1},
        (2, 2): {xx: -1, yy: 1, zz: -1},
        (3, 3): {xx: -1, yy: -1, zz: 1},
        (0, 1): {yz: 1, zy: -1},
        (0, 2): {zx: 1, xz: -1},
        (0, 3): {xy: 1, yx: -1},
        (1, 2): {xy: 1, yx: 1},
        (1, 3): {zx: 1, xz: 1},
        (2, 3): {yz: 1, zy: 1},
    }
    for (row, column), terms in entries.items():
        for (i, j), sign in terms.items():
            table[i, j, row, column] = table[i, j, column, row] = sign
    return table.reshape(9, 16)


def _rotation_of_products() -> Tensor:
    """(16,9): from the products of a unit quaternion's parts, w first, to the rotation matrix."""
    table = torch.zeros(4, 4, 3, 3)
    for i in range(3):
        table[0, 0, i, i] = 1.0
        for j in range(3):
            table[j + 1, j + 1, i, i] += 1.0 if i == j else -1.0
            if i != j:
                table[i + 1, j + 1, i, j] += 2.0
    for i, j, k, sign in (
        (0, 1, 2, -1.0),
        (0, 2, 1, 1.0),
        (1, 0, 2, 1.0),
        (1, 2, 0, -1.0),
        (2, 0, 1, -1.0),
        (2, 1, 0, 1.0),
    ):
        table[0, k + 1, i, j] += 2.0 * sign
    return table.reshape(16, 9)
