"""The pictures that lie beside a head model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchface.files.whole_files import make_folder
from torchface.geometry.sample_batches import Samples, blocks
from torchface.modeling import HeadModel, ModelQuality
from torchface.progress import Progress
from torchface.rendering.compositing import save_rendered_image
from torchface.viz import modes_figure, random_figure
from torchface.viz.figures.model_figures import (
    color_modes_figure,
    extrapolation_figure,
    morph_figure,
    quality_figure,
    scatter_figure,
)


def draw(
    model: HeadModel,
    folder: Path,
    seed: int,
    quality: ModelQuality | None,
    learn: Samples | None,
    test: Samples | None,
    progress: Progress,
) -> None:
    """Writes the pictures into a folder.

    Args:
        model: of heads.
        folder: made where it is missing.
        seed: draws random heads.
        quality: its curves, if it was measured.
        learn, test: the heads that it has learned from and others, where there are any.
        progress: called with each step and how far it is.
    """
    make_folder(folder)
    known, others = (
        torch.cat([model.shape.project(part.read(*block)) for block in blocks(part)])
        if part is not None and part.shape[0]
        else None
        for part in (learn, test)
    )
    pictures: dict[str, Callable[[], Tensor]] = {
        "modes": lambda: modes_figure(model),
        "random": lambda: random_figure(model, seed=seed),
        "morph": lambda: morph_figure(model, seed=seed),
        "far": lambda: extrapolation_figure(model, seed=seed),
    }
    if known is not None:
        pictures["components"] = lambda: scatter_figure(model.shape, known, others)
    if model.color is not None:
        pictures["color_modes"] = lambda: color_modes_figure(model)
    if quality is not None:
        pictures["quality"] = lambda: quality_figure(quality)
    for number, (name, picture) in enumerate(pictures.items()):
        progress("drawing pictures", number, len(pictures))
        save_rendered_image(picture(), folder / f"{name}.png")
