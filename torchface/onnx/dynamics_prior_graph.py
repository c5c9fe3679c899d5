"""A dynamics prior as ONNX: the last frames' weights to mean and variance of the next."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface.capture.priors import DynamicsPrior
from torchface.onnx.checked_export import ExportReport, export_checked

_PARITY = {"mean": 1e-4, "deviation": 1e-4}
_UNITS = {"mean": "of a weight of 1", "deviation": "of a weight of 1"}


def export_dynamics_prior(
    model: DynamicsPrior, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes a dynamics prior, and checks it.

    The graph takes ``windows`` (B,J,N), the newest frame last, and gives ``mean`` (B,N) and ``deviation`` (B,N), the
    standard deviation of the next frame. The metadata holds ``shape_names``, ``window``, ``fps`` and ``input_noise``.

    Args:
        model: in float32.
        path: the file to write.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    cases = []
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 7):
        start = model.center + 0.2 * torch.randn(batch, 1, len(model.names), generator=generator)
        steps = 0.03 * torch.randn(batch, model.window, len(model.names), generator=generator)
        windows = (start + steps.cumsum(1)).clamp(model.limits[0], model.limits[1])
        mean, variance = model(windows)
        cases.append(({"windows": windows}, {"mean": mean, "deviation": variance.sqrt()}))
    metadata = {
        "task": "dynamics_prior",
        "shape_names": list(model.names),
        "window": model.window,
        "fps": model.fps,
        "input_noise": model.input_noise,
        "units": "weights, 1 is the whole shape",
        **(facts or {}),
    }
    return export_checked(_MeanAndDeviation(model), path, cases, _PARITY, _UNITS, metadata)


class _MeanAndDeviation(nn.Module):
    """``DynamicsPrior.forward``, with the standard deviation in place of the variance."""

    def __init__(self, prior: DynamicsPrior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        mean, variance = self.prior(windows)
        return mean, variance.sqrt()
