"""Errors summed up: of all vertices, and region by region."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError


@dataclass(frozen=True)
class ErrorFigures:
    """Distances over frames and vertices in a few numbers, millimetres.

    Args:
        mean, median, percentile_95, largest: over all vertices of all frames that were compared.
        total: sum over the vertices of a frame, mean over the frames; for a single frame what the thesis calls the
            total error.
        vertices: how many were compared in any frame.

    Example:
        >>> figures = error_figures(torch.tensor([[1.0, 2.0, 6.0]]))
        >>> figures.mean, figures.median, figures.largest, figures.total
        (3.0, 2.0, 6.0, 9.0)
    """

    mean: float
    median: float
    percentile_95: float
    largest: float
    total: float
    vertices: int


def error_figures(errors: Tensor) -> ErrorFigures:
    """The figures of distances (T,V); NaN was not compared.

    Raises:
        ValueRangeError: nothing was compared.

    Source: thesis 4.2.13.

    Example:
        >>> error_figures(torch.tensor([[1.0, torch.nan, 3.0]])).mean
        2.0
    """
    present = torch.isfinite(errors)
    if not present.any():
        raise ValueRangeError("error_figures: found no distance that is a number, expected at least one")
    values = errors[present].double().numpy()
    median, high = np.quantile(values, (0.5, 0.95))
    totals = torch.where(present, errors, 0).double().sum(1)[present.any(1)]
    return ErrorFigures(
        float(values.mean()),
        float(median),
        float(high),
        float(values.max()),
        float(totals.mean()),
        int(present.any(0).sum()),
    )


def region_figures(errors: Tensor, regions: Mapping[str, Tensor]) -> dict[str, ErrorFigures]:
    """The figures of distances (T,V) in each region, a mask (V,) by name; one where nothing was compared is left out.

    Raises:
        ShapeError: a mask is not (V,).

    Example:
        >>> chin, lips = torch.tensor([True, False, False]), torch.tensor([False, True, True])
        >>> figures = region_figures(torch.tensor([[1.0, 2.0, 4.0]]), {"chin": chin, "lips": lips})
        >>> {name: one.mean for name, one in figures.items()}
        {'chin': 1.0, 'lips': 3.0}
    """
    for name, mask in regions.items():
        if mask.shape != errors.shape[1:] or mask.dtype != torch.bool:
            raise ShapeError(
                f"regions[{name!r}]: found {mask.dtype} {tuple(mask.shape)}, expected a mask of "
                f"{tuple(errors.shape[1:])}"
            )
    inside = {name: errors[:, mask] for name, mask in regions.items()}
    return {name: error_figures(part) for name, part in inside.items() if torch.isfinite(part).any()}
