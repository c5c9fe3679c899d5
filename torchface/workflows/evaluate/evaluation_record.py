"""How far a result is from the truth, as figures, frames for figures and lines to read."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchface.evaluation import ErrorFigures, ShapeErrors
from torchface.mesh import Mesh

ALL = "all vertices"
"""What the table of regions calls the whole mesh."""


@dataclass(frozen=True, eq=False)
class Compared:
    """One frame as it was compared, for figures.

    Args:
        frame: of the result.
        found, true: vertices (V,3); the found ones as they were compared, laid on the truth where that was asked for.
        errors: (V,), millimetres; NaN was not compared.
    """

    frame: int
    found: Tensor
    true: Tensor
    errors: Tensor


@dataclass(frozen=True, eq=False)
class Evaluation:
    """How far a result is from the truth.

    Args:
        result, truth: names of the files.
        mesh: topology and annotations, in the pose that errors are painted on.
        frames: which of the result were compared, (T,) int64.
        fps: frames a second, where that is known.
        errors: (T,V), millimetres; NaN was not compared.
        regions: figures by region, all vertices first.
        shapes: by shape, where both have weights.
        aligned: whether each frame was laid rigidly on the truth.
        rotation, translation: degrees and millimetres of that, (T,); none without.
        shown: frames for figures: the one of median error and the worst.
        maximum: of the heat maps' scale, millimetres.
        notes: what was found and done, for people to read.
        surface: where the truth was scans, how far the result is from their surface, aligned with it again where it was
            aligned.
    """

    result: str
    truth: str
    mesh: Mesh
    frames: Tensor
    fps: float | None
    errors: Tensor
    regions: dict[str, ErrorFigures]
    shapes: ShapeErrors | None
    aligned: bool
    rotation: Tensor | None
    translation: Tensor | None
    shown: tuple[Compared, ...]
    maximum: float
    notes: tuple[str, ...]
    surface: ErrorFigures | None = None

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
        how = "each frame laid rigidly on the truth" if self.aligned else "as they are, without alignment"
        lines = [f"{len(self.frames)} frames compared, {how}"]
        for name in (ALL, "face"):
            if name in self.regions:
                found = self.regions[name]
                lines.append(
                    f"{name}: mean {found.mean:.3f} mm, median {found.median:.3f}, 95th percentile "
                    f"{found.percentile_95:.3f}, largest {found.largest:.3f}; total {found.total:.4e} mm a frame"
                )
        if self.surface is not None:
            lines.append(f"to the scans' surface: mean {self.surface.mean:.3f} mm, median {self.surface.median:.3f}")
        if self.shapes is not None:
            error = self.shapes.error
            lines.append(
                f"weights: mean error {float(error.mean.mean()):.4f}, largest {float(error.largest.max()):.3f}, over "
                f"{len(self.shapes.names)} shapes"
            )
        return lines + list(self.notes)
