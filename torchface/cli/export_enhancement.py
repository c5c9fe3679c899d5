"""``torchface export enhancement``: an actor's wrinkles for a game engine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from torchface.cli.command_options import Output
from torchface.cli.terminal import Quiet, print_lines, print_path, progress_bars

_FILES = ("wrinkles.glb", "map_weights.csv")


def export_enhancement(
    *,
    model: str,
    rig: Path,
    out: Annotated[Path, Output(_FILES)],
    maps: int = 4,
    size: int = 1024,
    poses: int = 300,
    animation: Path | None = None,
    pairs: Path | None = None,
    part: str | None = None,
    quiet: Quiet = False,
) -> None:
    """Write an actor's wrinkles as maps for a rig, with ONNX graphs that give the maps' weights every frame.

    Writes into OUT: wrinkles.glb (the rig, its normal map at rest, and the wrinkle maps of normals and heights with the
    masks of the regions, listed in `extras.torchface.wrinkleRegions`), map_weights.onnx (`weights` (B,N) of the rig's
    shapes to `map_weights` (B,R,M)), map_weights_of_vertices.onnx (the same of `vertices` (B,V,3), millimetres), maps/
    (every map as a PNG of 16 bits) and summary.json (how much of the actor's detail the maps show). How an engine
    blends them: export/README.md.

    Args:
        model: The actor's model, by name or folder; see `torchface train enhancement`.
        rig: The rig that the engine moves, with texture coordinates; of any topology.
        out: Folder for everything.
        maps: How many wrinkle maps; each region has a weight for each.
        size: Of each map, texels a side.
        poses: Of the rig, for which the model is asked for wrinkles and that the weights are learned from.
        animation: Weights (.csv) that wrinkles.glb plays; then map_weights.csv holds the maps' weights of every frame.
        pairs: Where vertices of the rig lie on the model; see `torchface enhance`. By registration if absent.
        part: Keep this region of the rig only, such as face.
        quiet: Show no progress.
    """
    from torchface.files.job_lock import job_lock
    from torchface.workflows.enhance.wrinkle_export import WrinkleSettings, export_wrinkles

    settings = WrinkleSettings(maps, size, poses, pairs, part, animation)
    with job_lock(out), progress_bars(quiet) as progress:
        done = export_wrinkles(model, rig, out, settings, progress)
    print_lines(done.lines())
    for path in done.products.values():
        print_path(path)
