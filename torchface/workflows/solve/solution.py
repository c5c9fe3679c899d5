"""The result of a solve: weights, the markers as it used them, and its report."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers import Cleanup, HelmetMotion
from torchface.geometry.similarity import Similarity
from torchface.rig import BlendshapeRig
from torchface.take import Take
from torchface.workflows.solve.head_camera import Predicted
from torchface.workflows.solve.weight_stream import StreamReport

_SHOWN_DEFECTS = 12


@dataclass(frozen=True, eq=False)
class Solution:
    """The solution of a take's markers.

    Args:
        take: with the solved weights.
        markers: as the solve used them, (T,M,3), in rig space, without slip, bad samples NaN.
        attachment: the sites, with what was subtracted at rest; of the take's markers.
        alignment: marker space to rig space, where one was estimated.
        motion: the helmet's, where it was asked for.
        cleanup: what was wrong with the take, where that was asked for.
        warnings: what the user should know before they use the weights.
    """

    take: Take
    markers: Tensor
    attachment: Attachment
    alignment: Similarity | None
    motion: HelmetMotion | None
    cleanup: Cleanup | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SolveReport:
    """The report of a solve.

    Args:
        take: the solved weights.
        rmse: marker RMSE a frame, (T,), millimetres.
        seen: fraction of the samples of the attachment's markers that were seen.
        alignment: the similarity from marker space to rig space, where one was estimated.
        seconds: what the solve itself took.
        motion: the helmet's, where it was asked for.
        cleanup: what was wrong with the take, where that was asked for.
        predicted: what the head camera saw, where there was a video.
        sent: what was streamed, where that was asked for.
        warnings: what the user should know before they use the weights.
        rig: what was solved, where it is to be shown.
    """

    take: Take
    rmse: Tensor
    seen: float
    alignment: Similarity | None
    seconds: float
    motion: HelmetMotion | None = None
    cleanup: Cleanup | None = None
    predicted: Predicted | None = None
    sent: StreamReport | None = None
    warnings: tuple[str, ...] = ()
    rig: BlendshapeRig | None = None

    def lines(self) -> list[str]:
        """For people to read."""
        frames, worst = len(self.rmse), float(self.rmse.nan_to_num().max())
        lines = [
            f"{frames} frames at {self.take.fps:g} a second, {100 * self.seen:.1f} % of the attachment's "
            "marker samples seen",
            f"marker RMSE: median {float(self.rmse.nanmedian()):.3f} mm, "
            f"95th percentile {float(self.rmse.nanquantile(0.95)):.3f} mm, worst {worst:.3f} mm",
            f"solved in {self.seconds:.2f} s, {1000 * self.seconds / max(frames, 1):.3f} ms a frame",
        ]
        if self.alignment is not None:
            moved = self.alignment.translation[0].tolist()
            lines.insert(
                1,
                f"alignment: scale {float(self.alignment.scale[0]):.4f}, moved by "
                f"({moved[0]:.1f}, {moved[1]:.1f}, {moved[2]:.1f}) mm",
            )
        if self.motion is not None:
            translation = float(self.motion.translation.norm(dim=1).max())
            rotation = float(self.motion.degrees().norm(dim=1).max())
            lines.append(f"helmet: moved by up to {translation:.1f} mm and {rotation:.1f} degrees; not in the weights")
        if self.cleanup is not None:
            lines.append(f"cleanup: {self.cleanup.summary()}")
            rows = self.cleanup.table(gaps=False)
            lines.extend(f"  {' '.join(cell for cell in row if cell)}" for row in rows[:_SHOWN_DEFECTS])
            if len(rows) > _SHOWN_DEFECTS:
                lines.append(f"  and {len(rows) - _SHOWN_DEFECTS} more; the report (--report DIR) lists all")
        if self.predicted is not None:
            active = (self.predicted.gamma.values > 0).any(2)
            shapes = ", ".join(self.predicted.gamma.names) or "no shape"
            lines.append(f"video: predicts {shapes} in {100 * float(active.any(1).float().mean()):.0f} % of the frames")
            lines.extend(f"  {note}" for note in self.predicted.notes)
        if self.sent is not None:
            lines.extend(self.sent.lines())
        return [*(f"warning: {warning}" for warning in self.warnings), *lines]
