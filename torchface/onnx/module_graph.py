"""ONNX export of any module of tensors, such as a network with a solve in it or a prior's density."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface.capture.priors import ShapePrior
from torchface.capture.priors.student_t import StudentDensity
from torchface.errors import ShapeError, TraceError
from torchface.number_checks import checked_type
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.exported_model import exported_model

_PARITY = 1e-4  # of the largest number that an output has, or of 1


def export_module(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    path: str | Path,
    facts: Mapping[str, object] | None = None,
    parity: float = _PARITY,
) -> ExportReport:
    """Writes a module as ONNX with any batch size, and checks ONNX Runtime against PyTorch at two of them.

    Outputs have the names of the fields of the ``NamedTuple`` that the module returns, or the keys of its dict;
    ``output`` if it returns one tensor.

    Args:
        module: takes the inputs in their order, batch first; ``torch.export`` can trace it.
        inputs: examples by name, the same two rows or more each.
        path: the file to write; it appears only when it is complete and checked.
        facts: metadata, such as licence and data.
        parity: how far the two may be apart, of the largest number that an output has, or of 1.

    Raises:
        ShapeError: no inputs, or fewer than two rows.
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
        TraceError: the module calls what no graph can hold, such as ``box_qp``; the message says what can.

    Example:
        >>> from torchface.optim import ProjectedGradient
        >>> class Solve(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.linear, self.program = torch.nn.Linear(4, 3), ProjectedGradient(torch.eye(3), steps=20)
        ...     def forward(self, x):
        ...         return self.program(self.linear(x))
        >>> export_module(Solve(), {"x": torch.rand(2, 4)}, "solve.onnx").path.name
        'solve.onnx'
    """
    checked_type("module", module, nn.Module)
    checked_type("inputs", inputs, Mapping)  # type: ignore[type-abstract]
    rows = {len(value) if value.ndim else 0 for value in inputs.values()}
    if len(rows) != 1 or min(rows) < 2:
        shapes = {name: tuple(value.shape) for name, value in inputs.items()}
        raise ShapeError(f"inputs: found {shapes}, expected a tensor or more with the same two rows or more each")
    module, cases = module.eval(), []
    for count in (min(rows), 1):
        given = {name: value[:count] for name, value in inputs.items()}
        with torch.no_grad():
            cases.append((given, _named(module(*given.values()))))
    names = list(cases[0][1])
    metadata = {"task": type(module).__name__, **(facts or {})}
    try:
        model = exported_model(module, inputs, names, metadata, dict.fromkeys(inputs, ("batch",)))
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, TraceError):
            cause = cause.__cause__
        if cause is not None:  # says what is expected, below pages of the exporter's own
            raise cause from None
        raise
    scale = {name: max(1.0, *(float(out[name].nan_to_num(0, 0, 0).abs().max()) for _, out in cases)) for name in names}
    return write_checked(
        model, path, cases, {name: parity * scale[name] for name in names}, dict.fromkeys(names, "in value")
    )


def export_shape_prior(prior: ShapePrior, path: str | Path, facts: Mapping[str, object] | None = None) -> ExportReport:
    """Writes a shape prior's ``log_density`` (B,) of ``weights`` (B,N), and checks it; see :func:`export_module`."""
    start = torch.rand(4, len(prior.names), generator=torch.Generator().manual_seed(0))
    names = {"shape_names": list(prior.names), "units": "weights, 1 is the whole shape"}
    return export_module(_LogDensity(prior), {"weights": start}, path, names | dict(facts or {}))


class _LogDensity(nn.Module):
    """The log density of a shape prior; what does not depend on the weights is computed here, for ONNX has no gamma."""

    peak: Tensor

    def __init__(self, prior: ShapePrior) -> None:
        super().__init__()
        self.prior = prior
        rest = torch.zeros(1, len(prior.names))
        self.register_buffer("peak", prior.log_density(rest) - self._varying(rest))

    def forward(self, weights: Tensor) -> dict[str, Tensor]:
        return {"log_density": self.peak + self._varying(weights)}

    def _varying(self, weights: Tensor) -> Tensor:
        return torch.stack(
            [
                density.below_peak(part) if isinstance(density, StudentDensity) else density.log_density(part)
                for density, part in self.prior.parts(weights)
            ]
        ).sum(0)


def _named(found: object) -> dict[str, Tensor]:
    if isinstance(found, Tensor):
        return {"output": found}
    if isinstance(found, Mapping):
        return dict(found)
    fields = getattr(found, "_fields", None) or [f"output_{number}" for number in range(len(found))]  # type: ignore[arg-type]
    return dict(zip(fields, found, strict=True))  # type: ignore[call-overload]
