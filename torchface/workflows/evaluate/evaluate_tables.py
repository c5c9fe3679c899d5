"""An evaluation's figures as files: a table by region, by frame, by shape, and a summary."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from torchface.files.documents import write_json
from torchface.files.whole_files import delete_file
from torchface.io.tables.csv_table import write_table
from torchface.workflows.evaluate.evaluation_record import Evaluation

_SUMMARY = "torchface.evaluation/1"


def write_tables(evaluation: Evaluation, out: Path) -> None:
    """Writes the figures as CSV and ``summary.json`` into a folder that is there."""
    columns = ("mean_mm", "median_mm", "percentile_95_mm", "largest_mm", "total_mm", "vertices")
    rows = [[name, *map(_number, asdict(figures).values())] for name, figures in evaluation.regions.items()]
    write_table(out / "regions.csv", ["region", *columns], rows)
    known = torch.isfinite(evaluation.errors)
    values = np.where(known.numpy(), evaluation.errors.double().numpy(), np.nan)
    empty = ~known.any(1).numpy()
    values[empty] = 0.0  # so that no quantile is asked of nothing; these rows are written empty
    high, largest = np.nanquantile(values, 0.95, axis=1), np.nanmax(values, axis=1)
    means, totals = np.nanmean(values, axis=1), np.nansum(values, axis=1)
    moved = (evaluation.rotation, evaluation.translation)
    rows = [
        [
            str(frame),
            *("" if empty[i] else _number(x) for x in (means[i], high[i], largest[i], totals[i])),
            *(_number(float(column[i])) for column in moved if column is not None),
        ]
        for i, frame in enumerate(evaluation.frames.tolist())
    ]
    extra = ["turned_degrees", "moved_mm"] if evaluation.aligned else []
    write_table(out / "frames.csv", ["frame", "mean_mm", "percentile_95_mm", "largest_mm", "total_mm", *extra], rows)
    if evaluation.shapes is not None:
        error = evaluation.shapes.error
        columns_of = zip(evaluation.shapes.names, error.mean, error.largest, error.correlation, strict=True)
        rows = [[name, *(_number(float(x)) for x in numbers)] for name, *numbers in columns_of]
        write_table(out / "shapes.csv", ["shape", "mean", "largest", "correlation"], rows)
    else:
        delete_file(out / "shapes.csv")  # one of an earlier run would be of other files
    write_json(out / "summary.json", summary(evaluation))


def summary(evaluation: Evaluation) -> dict[str, object]:
    """The figures as JSON has them."""
    shapes = evaluation.shapes
    return {
        "format": _SUMMARY,
        "result": evaluation.result,
        "truth": evaluation.truth,
        "frames": len(evaluation.frames),
        "alignment": "rigid, a frame" if evaluation.aligned else "none",
        "unit": "millimetres",
        "regions": {name: asdict(figures) for name, figures in evaluation.regions.items()},
        "surface": None if evaluation.surface is None else asdict(evaluation.surface),
        "weights": None
        if shapes is None
        else {
            "mean": float(shapes.error.mean.mean()),
            "largest": float(shapes.error.largest.max()),
            "shapes": len(shapes.names),
            "missing": list(shapes.missing),
            "frames": shapes.frames,
        },
        "notes": list(evaluation.notes),
    }


def _number(value: float) -> str:
    return "" if value != value else f"{value:.6g}" if isinstance(value, float) else str(value)
