"""A head model's decoder as ONNX: coefficients to vertices and colours."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface.modeling import HeadModel
from torchface.onnx.checked_export import ExportReport, export_checked

_PARITY = {"vertices": 1e-3, "colors": 1e-4}
_UNITS = {"vertices": "millimetres", "colors": "of the range"}


def export_head_decoder(model: HeadModel, path: str | Path, facts: Mapping[str, object] | None = None) -> ExportReport:
    """Writes a head model's decoder, and checks it.

    The graph takes ``shape`` (B,K) and, where the model knows colours, ``color`` (B,L), in standard deviations, and
    gives ``vertices`` (B,V,3), millimetres, and ``colors`` (B,V,3), clipped to [0,1]. The metadata holds ``triangles``
    and, where annotated, ``landmarks``, as JSON.
    """
    cases = []
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 5):
        shape = model.shape.sample(batch, generator)
        color = None if model.color is None else model.color.sample(batch, generator)
        heads = model(shape, color)
        inputs, outputs = {"shape": shape}, {"vertices": heads.vertices}
        if color is not None and heads.colors is not None:
            inputs["color"], outputs["colors"] = color, heads.colors.clamp(0, 1)
        cases.append((inputs, outputs))
    names = list(cases[0][1])
    metadata = {
        "task": "head_decoder",
        "units": "millimetres",
        "coefficients": "standard deviations",
        "triangles": model.faces.tolist(),
        **(facts or {}),
    }
    if model.landmarks is not None:
        metadata["landmarks"] = model.landmarks.tolist()
    allowed, units = {name: _PARITY[name] for name in names}, {name: _UNITS[name] for name in names}
    return export_checked(_Decoder(model), path, cases, allowed, units, metadata)


class _Decoder(nn.Module):
    """A matrix product for shape, another for colour, each with the mean in the same operation."""

    def __init__(self, model: HeadModel) -> None:
        super().__init__()
        for name, part in (("shape", model.shape), ("color", model.color)):
            if part is None:
                continue
            self.register_buffer(f"{name}_modes", part.modes.flatten(1))
            self.register_buffer(f"{name}_mean", part.mean.flatten())

    def forward(self, shape: Tensor, color: Tensor | None = None) -> tuple[Tensor, ...]:
        vertices = self._decoded("shape", shape)
        return (vertices,) if color is None else (vertices, self._decoded("color", color).clamp(0, 1))

    def _decoded(self, name: str, coefficients: Tensor) -> Tensor:
        mean, modes = getattr(self, f"{name}_mean"), getattr(self, f"{name}_modes")
        return torch.addmm(mean, coefficients, modes).unflatten(1, (-1, 3))
