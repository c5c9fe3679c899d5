"""Writes a graph only where ONNX Runtime computes what PyTorch does."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from torchface.errors import ValueRangeError
from torchface.files.whole_files import write_file
from torchface.landmarks.images.graph_session import graph_session
from torchface.onnx.exported_model import exported_model


@dataclass(frozen=True)
class WrittenGraph:
    """A graph's file."""

    path: Path
    size: int

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        return [("file", f"{self.path}, {self.size / 1000:.0f} kB")]

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self.rows())


@dataclass(frozen=True)
class ExportReport(WrittenGraph):
    """What was written, and how near ONNX Runtime is to PyTorch.

    Args:
        parity: by output, the largest difference found, in the output's unit.
        units: of the outputs.
    """

    parity: dict[str, float]
    units: dict[str, str]

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        rows = super().rows()
        for name, gap in self.parity.items():
            rows.append((name, f"ONNX Runtime against PyTorch: at most {gap:.1e} {self.units[name]} apart"))
        return rows


Cases = Sequence[tuple[Mapping[str, Tensor], Mapping[str, Tensor]]]  # inputs by name, and outputs that PyTorch gives


def export_checked(
    module: nn.Module,
    path: str | Path,
    cases: Cases,
    allowed: Mapping[str, float],
    units: Mapping[str, str],
    metadata: Mapping[str, object],
    sizes: Mapping[str, Sequence[str | None]] | None = None,
) -> ExportReport:
    """Exports a module of batches, the last case of two rows or more, and writes it as :func:`write_checked` does."""
    example = cases[-1][0]
    model = exported_model(module, example, list(allowed), metadata, sizes or dict.fromkeys(example, ("batch",)))
    return write_checked(model, path, cases, allowed, units)


def write_checked(
    model: onnx.ModelProto, path: str | Path, cases: Cases, allowed: Mapping[str, float], units: Mapping[str, str]
) -> ExportReport:
    """Runs a graph on cases of different batch sizes and writes it, complete, if they differ by no more than
    ``allowed``.

    Of deviations above 1 the difference counts in shares of them.
    """
    content = model.SerializeToString()
    session = graph_session(content)
    parity = dict.fromkeys(allowed, 0.0)
    for inputs, expected in cases:
        found = session.run(list(allowed), {name: value.detach().numpy() for name, value in inputs.items()})
        for name, values in zip(allowed, found, strict=True):
            given, wanted = torch.from_numpy(np.asarray(values)), expected[name].detach()
            gap = torch.where(given == wanted, 0.0, (given - wanted).abs())  # an infinite deviation is one in both
            if name.endswith("deviation"):  # an exponential, of which rounding takes a share
                gap = gap / wanted.abs().clamp(min=1.0)
            # What is not finite in one of them is a gap, though a comparison with a NaN is never true.
            parity[name] = max(parity[name], float(gap.nan_to_num(torch.inf).max()))
    for name, found_gap in parity.items():
        if not found_gap <= allowed[name]:
            raise ValueRangeError(
                f"{path}: ONNX Runtime's {name} differ from PyTorch's by {found_gap:.2g} {units[name]}, expected "
                f"{allowed[name]:.2g} at most"
            )
    write_file(path, content)
    return ExportReport(Path(path), len(content), parity, dict(units))
