"""A rig's file with a corrective more, from a sculpted mesh."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from torchface.errors import FileFormatError
from torchface.io import load_mesh
from torchface.io.blender import BLENDER_ENDINGS
from torchface.modeling.rigging.sculpted_corrective import SculptedCorrective, checked_sculpt, corrective_from_sculpt
from torchface.progress import Progress, silent
from torchface.workflows.convert_file import maps_for, read_source, write_source
from torchface.workflows.posed_mesh import pose_row, pose_weights
from torchface.workflows.rig.actor_rig import check_out


@dataclass(frozen=True)
class SculptOptions:
    """How a sculpt becomes a corrective."""

    name: str | None = None  # of the corrective; its drivers' if absent
    unit: str | None = None  # of the sculpt, where it is not the format's own
    # `"remove"` a motion of the whole mesh, or `"keep"` it; refused if absent
    align: Literal["remove", "keep"] | None = None
    replace: bool = False  # take the place of a corrective that acts there


def sculpt_corrective(
    path: Path,
    at: Sequence[str],
    sculpt: Path,
    out: Path,
    options: SculptOptions | None = None,
    progress: Progress | None = None,
) -> tuple[SculptedCorrective, list[str]]:
    """Reads a rig, its animation and detail maps, adds a corrective, writes all; gives lines for people to read."""
    progress, options = progress or silent, options or SculptOptions()
    if out.suffix.lower() not in BLENDER_ENDINGS:
        check_out(out)
    progress("reading")
    source = read_source(path)
    if source.rig is None:
        raise FileFormatError(f"{path}: found a mesh without shapes, expected a rig")
    rig = source.rig
    weights = pose_row(rig, pose_weights(at, "--at"), "--at")
    with torch.no_grad():
        shown = rig(weights[None])[0]
    placed = checked_sculpt(sculpt, load_mesh(sculpt, options.unit), rig, shown, options.align)
    made = corrective_from_sculpt(rig, weights, placed, options.name, options.replace)
    detail, notes = maps_for(path, out)
    progress("writing")
    notes += write_source(made.rig, source.take, detail, out)
    return made, [*made.lines(), *notes]
