"""An expression regression as ONNX: neutral faces to the offsets of a rig."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface.errors import ValueRangeError
from torchface.modeling import ExpressionRegression
from torchface.onnx.checked_export import ExportReport, export_checked

_PARITY = 1e-3  # millimetres
# Each squares the ratio of the largest eigenvalue to the next: heads are far from round, a few would do.
_SQUARINGS = 12


def export_expression_regression(
    model: ExpressionRegression, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes a regression of the form "offsets", and checks it.

    The graph takes ``neutrals`` (B,V,3), millimetres, in any pose, and gives ``offsets`` (B,N,V,3), what a weight of 1
    of each expression adds. The metadata holds ``shape_names`` and ``topology``.
    """
    if model.form != "offsets":
        raise ValueRangeError(f"{path}: found a regression of the form {model.form!r}, expected 'offsets'")
    cases = []
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 3):
        neutrals = model.neutral_mean + torch.randn(batch, *model.neutral_mean.shape, generator=generator)
        orthonormal = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator))[0]
        orthonormal = orthonormal * torch.linalg.det(orthonormal)[:, None, None]
        neutrals = neutrals @ orthonormal + 100 * torch.randn(batch, 1, 3, generator=generator)
        # Where positions are rounded to float32 is no affair of the graph's.
        cases.append(({"neutrals": neutrals}, {"offsets": model.offsets(neutrals.double()).float()}))
    metadata = {
        "task": "expression_regression",
        "shape_names": list(model.names),
        "units": "millimetres",
        "topology": model.topology or "",
        **(facts or {}),
    }
    units = {"offsets": "millimetres"}
    return export_checked(OffsetRegression(model), path, cases, {"offsets": _PARITY}, units, metadata)


class OffsetRegression(nn.Module):
    r"""``ExpressionRegression.offsets`` in operators that ONNX has.

    Its rotation onto the mean neutral is Horn's: the largest eigenvector q of a symmetric 4×4 matrix A that is linear
    in the covariance. Squared again and again, A + I comes to :math:`q q^\top`, in which the rotation is linear.
    """

    target: Tensor
    target_region: Tensor
    to_quaternion: Tensor
    to_rotation: Tensor
    identity: Tensor
    inputs: Tensor
    offset_mean: Tensor
    offset_components: Tensor
    region: Tensor
    rows: Tensor

    def __init__(self, model: ExpressionRegression) -> None:
        super().__init__()
        vertices, shapes, places = len(model.neutral_mean), len(model.names), len(model.places)
        target = (model.neutral_mean.double() - model.neutral_mean.double().mean(0)).float()
        # A vertex that is not predicted takes the row of zeros that is put at the end.
        rows = torch.full((shapes * vertices,), places)
        rows[model.places] = torch.arange(places)
        self.sizes = (-1, shapes, vertices, 3)
        for name, value in {
            "target": target,
            "target_region": target[model.region],
            "to_quaternion": _horn(),
            "to_rotation": _rotation_of_products(),
            "identity": torch.eye(4),
            "inputs": model.neutral_components.flatten(1).T @ model.coefficients,
            "offset_mean": model.offset_mean.flatten(),
            "offset_components": model.offset_components.flatten(1),
            "region": model.region,
            "rows": rows,
        }.items():
            self.register_buffer(name, value)

    def forward(self, neutrals: Tensor) -> Tensor:
        """Offsets (B,N,V,3) of neutrals (B,V,3)."""
        centred = neutrals - neutrals.mean(1, keepdim=True)
        covariance = centred.mT @ self.target
        power = _unit((covariance.reshape(-1, 9) @ self.to_quaternion).reshape(-1, 4, 4)) + self.identity
        for _ in range(_SQUARINGS):
            power = _unit(power @ power)
        rotation = (power.reshape(-1, 16) @ self.to_rotation).reshape(-1, 3, 3)
        aligned = centred.index_select(1, self.region) @ rotation.mT
        coefficients = (aligned - self.target_region).flatten(1) @ self.inputs
        predicted = torch.addmm(self.offset_mean, coefficients, self.offset_components).unflatten(1, (-1, 3))
        offsets = nn.functional.pad(predicted, (0, 0, 0, 1)).index_select(1, self.rows)
        return (offsets @ rotation).reshape(self.sizes)


def _unit(matrix: Tensor) -> Tensor:
    """Matrices (B,4,4) over their norm."""
    return matrix / matrix.square().sum((1, 2), keepdim=True).sqrt()


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
