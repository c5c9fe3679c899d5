"""Colours of heads for a model: each scan freed from its cast; and the model of them."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface import Mesh
from torchface.errors import ValueRangeError
from torchface.geometry.sample_batches import Samples, blocks
from torchface.modeling import MorphableModel
from torchface.progress import Progress

from .color_casts import color_casts, texture_areas, without_cast
from .head_samples import Gathered
from .sample_views import SampleRange

_CAST_VERTICES = 4000
_CAST_SAMPLES = 6_000_000


def fitted_colors(
    gathered: Gathered, white_balance: bool, components: int | None, checkpoint: Path, progress: Progress
) -> tuple[MorphableModel | None, Samples | None]:
    """A model of the heads' colours, and those that are held out; None where they have none, or all the same."""
    if gathered.colors is None:
        return None, None
    progress("fitting the colours")
    count, total = len(gathered.shapes) - gathered.held_out, len(gathered.shapes)
    balanced = balanced_colors(gathered.colors, gathered.template, white_balance, progress)
    try:
        color = MorphableModel.fit(SampleRange(balanced, 0, count), components, checkpoint, progress)
    except ValueRangeError as error:
        progress(f"no model of colours: {error}")
        return None, None
    return color, SampleRange(balanced, count, total)


@dataclass(frozen=True, eq=False)
class Balanced:
    """Colours with each scan's cast taken off as they are read."""

    colors: Samples
    casts: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        """M, V, 3."""
        return self.colors.shape

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        return without_cast(self.colors.read(begin, end), self.casts[begin:end])


def balanced_colors(colors: Samples, template: Mesh, white_balance: bool, progress: Progress) -> Samples:
    """The colours, freed from casts that are estimated at some thousands of vertices, weighted by their texels."""
    if not white_balance:
        return colors
    weights = texture_areas(template) if template.uvs is not None else torch.ones(len(template.vertices))
    most = max(200, min(_CAST_VERTICES, _CAST_SAMPLES // colors.shape[0]))
    chosen = torch.arange(0, len(weights), max(1, -(-len(weights) // most)))
    some = torch.cat([colors.read(*block)[:, chosen] for block in blocks(colors)])
    casts = color_casts(some, weights[chosen])
    brightest = float(casts.mean(1).abs().max().exp())
    progress(f"casts taken off; the strongest exposure is {brightest:.2f} times the mean")
    return Balanced(colors, casts)
