"""A video of nothing, for takes whose pictures are not there."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torchface.io.video.video_file import VideoFile

_GREY = 96


@dataclass(frozen=True)
class BlankVideo(VideoFile):
    """Plain grey frames; the path names what they stand for, such as a table of landmarks."""

    seconds: Tensor | None = None  # when each is shown, (count,) from 0, where they come unevenly

    def check(self) -> None:
        """There is nothing to refuse."""

    def uneven_seconds(self) -> tuple[Tensor | None, str]:
        """The times given, and how far they are apart."""
        if self.seconds is None:
            return None, ""
        steps = self.seconds.diff()
        return self.seconds, f"frames {float(steps.min()):.3g} to {float(steps.max()):.3g} s apart"

    def _decoded(self) -> Iterator[np.ndarray]:
        frame = np.full((self.height, self.width, 3), _GREY, np.uint8)
        for _ in range(self.count):
            yield frame
