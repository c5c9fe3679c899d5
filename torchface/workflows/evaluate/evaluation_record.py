"""The record of an evaluation: figures, frames to draw, lines to read, and tables by region, frame and shape."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.evaluation import ErrorFigures, ShapeErrors
from torchface.files.documents import write_json
from torchface.files.whole_files import delete_file
from torchface.io.tables.csv_table import write_table
from torchface.mesh import Mesh

ALL = "all vertices"  # what the table of regions calls the whole mesh
_SUMMARY = "torchface.evaluation/1"


@dataclass(frozen=True, eq=False)
class Compared:
    """One frame as it was compared, for figures."""

    frame: int
    # found, true: vertices (V,3); the found ones as they were compared, aligned with the truth where asked for
    found: Tensor
    true: Tensor
    errors: Tensor  # (V,), millimetres; NaN was not compared


@dataclass(frozen=True, eq=False)
class Evaluation:
    """How far a result is from the truth."""

    result: str
    truth: str
    mesh: Mesh  # topology and annotations, in the pose that errors are painted on
    frames: Tensor  # which of the result were compared, (T,) int64
    fps: float | None  # frames a second, where that is known
    errors: Tensor  # (T,V), millimetres; NaN was not compared
    regions: dict[str, ErrorFigures]  # figures by region, all vertices first
    shapes: ShapeErrors | None  # by shape, where both have weights
    aligned: bool  # whether each frame was aligned rigidly with the truth
    # rotation, translation: degrees and millimetres of that, (T,); none without
    rotation: Tensor | None
    translation: Tensor | None
    shown: tuple[Compared, ...]  # frames for figures: the one of median error and the worst
    maximum: float  # of the heat maps' scale, millimetres
    notes: tuple[str, ...]  # what was found and done, for people to read

    @property
    def frame_mean(self) -> Tensor:
        """Mean error of each frame, (T,); NaN where nothing was compared."""
        return self.errors.nanmean(1)

    @property
    def vertex_mean(self) -> Tensor:
        """Mean error of each vertex over the frames, (V,); NaN where it never was compared."""
        return self.errors.nanmean(0)

    def lines(self) -> list[str]:
        """For people to read."""
        how = "each frame aligned rigidly with the truth" if self.aligned else "as they are, without alignment"
        lines = [f"{len(self.frames)} frames compared, {how}"]
        for name in (ALL, "face"):
            if name in self.regions:
                errors = self.regions[name]
                lines.append(
                    f"{name}: mean {errors.mean:.3f} mm, median {errors.median:.3f}, 95th percentile "
                    f"{errors.percentile_95:.3f}, largest {errors.largest:.3f}; total {errors.total:.3f} mm a frame"
                )
        if self.shapes is not None:
            error = self.shapes.error
            lines.append(
                f"weights: mean error {float(error.mean.mean()):.4f}, largest {float(error.largest.max()):.3f}, over "
                f"{len(self.shapes.names)} shapes"
            )
        return lines + list(self.notes)


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
