"""The pictures that lie beside an enhancement model: its regions, the detail it keeps, what compression loses."""

from dataclasses import replace
from pathlib import Path

import torch
from matplotlib import colormaps
from matplotlib.patches import Patch
from torch import Tensor

from torchface import Mesh
from torchface.enhancement import EnhancementModel
from torchface.files.whole_files import make_folder
from torchface.geometry.meshes.operators import vertex_normals
from torchface.progress import Progress
from torchface.rendering.compositing import caption, from_figure, new_figure, save_rendered_image, sheet
from torchface.viz.figures.error_maps import error_views, round_maximum
from torchface.viz.figures.face_views import face_views

from .restored_frames import Restored, Shown, restored

_TRIED = 24  # frames among which the most detailed one is looked for
_HEIGHT = 420
_NAMES_A_LINE = 6


def draw(
    model: EnhancementModel, neutral: Mesh, learned: Shown, test: Shown | None, folder: Path, progress: Progress
) -> None:
    """Writes the pictures into a folder: ``regions.png``, ``learned.png`` and ``held_out.png``."""
    make_folder(folder)
    progress("drawing the regions")
    save_rendered_image(_regions(model, neutral), folder / "regions.png")
    for name, frames in {"learned": learned, "held_out": test}.items():
        if frames is not None:
            progress(f"drawing a frame, {name.replace('_', ' ')}")
            shown = _most_detailed(model, frames)
            save_rendered_image(_frame(neutral, shown, frames.coarse is not None), folder / f"{name}.png")


def _regions(model: EnhancementModel, neutral: Mesh) -> Tensor:
    """The region that counts most at each vertex, in a colour of its own."""
    hues = torch.tensor(colormaps["tab20"](range(len(model.region_names))))[:, :3].to(neutral.vertices)
    row = face_views(neutral, colors=hues[model.vertex_weights.argmax(0)], width=_HEIGHT * 4 // 5, height=_HEIGHT)
    lines = -(-len(model.region_names) // _NAMES_A_LINE)
    figure = new_figure(row.shape[2] / 100, 0.1 + 0.25 * lines)
    keys = [Patch(color=hue, label=name) for hue, name in zip(hues.tolist(), model.region_names, strict=True)]
    figure.legend(handles=keys, loc="center", ncol=_NAMES_A_LINE, frameon=False)
    return sheet([from_figure(figure), row], 1)


def _most_detailed(model: EnhancementModel, frames: Shown) -> Restored:
    """The frame whose normals the smooth part lacks most of: the most wrinkled one."""
    tried = range(0, len(frames), max(1, len(frames) // _TRIED))
    found = (restored(model, frames, number) for number in tried)
    return max(found, key=lambda one: _bent(one, model.faces))


def _bent(frame: Restored, faces: Tensor) -> float:
    own, smooth = (vertex_normals(vertices, faces) for vertices in (frame.truth, frame.smooth))
    return float((own - smooth).square().sum())


def _frame(neutral: Mesh, shown: Restored, paired: bool) -> Tensor:
    views, given = [], "coarse" if paired else "smooth part"
    for name, vertices in {given: shown.smooth, "restored": shown.restored, "captured": shown.truth}.items():
        row = face_views(replace(neutral, vertices=vertices), width=_HEIGHT * 4 // 5, height=_HEIGHT, framed_by=neutral)
        views.append(caption(row, name))
    errors = (shown.restored - shown.truth).norm(dim=-1)
    scale = round_maximum(float(errors.quantile(0.99)))
    views.append(error_views(replace(neutral, vertices=shown.truth), errors, scale, "restored from captured, mm"))
    return sheet(views, 1)
