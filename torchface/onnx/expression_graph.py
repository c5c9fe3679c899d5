"""An expression regression as ONNX: neutral faces to the offsets of a rig."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface.errors import ValueRangeError
from torchface.modeling import ExpressionRegression
from torchface.onnx.checked_export import ExportReport, export_checked

_PARITY = 1e-3  # millimetres
_ROTATION_STEPS = 24  # a head's depth, which may vary by a tenth as much as its height, is found in a dozen


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

    Its rotation onto the mean neutral is the polar factor of the covariance C, by Newton's iteration
    :math:`X' = \tfrac32 X - \tfrac12 X X^\top X` from C over its norm.

    Source: Björck and Bowie 1971.
    """

    target: Tensor
    target_region: Tensor
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
        self.shape = (-1, shapes, vertices, 3)
        self.sizes = [[3 * size for size in sizes] for sizes in model.sizes]
        bases = model.neutral_components.split(model.sizes[0], 1)
        inputs = zip(bases, model.coefficients.view(len(bases), *model.coefficients.shape[-2:]), strict=True)
        for name, value in {
            "target": target,
            "target_region": target[model.region],
            "inputs": torch.cat([basis.flatten(1).T @ B for basis, B in inputs]),
            "offset_mean": model.offset_mean.flatten(),
            "offset_components": model.offset_components.flatten(1),
            "region": model.region,
            "rows": rows,
        }.items():
            self.register_buffer(name, value)

    def forward(self, neutrals: Tensor) -> Tensor:
        """Offsets (B,N,V,3) of neutrals (B,V,3)."""
        centred = neutrals - neutrals.mean(1, keepdim=True)
        covariance = self.target.T @ centred
        rotation = covariance / covariance.square().sum((1, 2), keepdim=True).sqrt()
        for _ in range(_ROTATION_STEPS):
            rotation = 1.5 * rotation - 0.5 * (rotation @ rotation.mT @ rotation)
        aligned = centred.index_select(1, self.region) @ rotation.mT
        beyond = (aligned - self.target_region).flatten(1).split(self.sizes[0], 1)
        inputs, outputs = self.inputs.split(self.sizes[0]), self.offset_components.split(self.sizes[1], 1)
        predicted = [part @ inner @ outer for part, inner, outer in zip(beyond, inputs, outputs, strict=True)]
        moving = (torch.cat(predicted, 1) + self.offset_mean).unflatten(1, (-1, 3))
        offsets = nn.functional.pad(moving, (0, 0, 0, 1)).index_select(1, self.rows)
        return (offsets @ rotation).reshape(self.shape)
