"""``torchface retime``: a motion between two keyframes in an actor's timing."""

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from torchface.cli.command_options import Output
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path

_FILES = ("retimed.safetensors", "retimed.glb", "timing.csv", "index.html")


def retime(
    *,
    first: Annotated[str, arg(name="from", metavar="A")],
    last: Annotated[str, arg(name="to", metavar="B")],
    frames: int,
    model: str,
    out: Annotated[Path, Output(_FILES)] = Path("out/retimed"),
    extend: bool = False,
    fps: float | None = None,
    rig: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Time the motion between two keyframes as a captured actor moves.

    A and B are meshes in the model's topology, or frames of an animation (take.glb@12, weights.csv@40 with --rig). Each
    region of the face gets the course of the captured motions that come nearest; the keyframes stay as they are.

    Writes into OUT: retimed.safetensors (every frame's mesh; `torchface enhance` adds the wrinkles), retimed.glb,
    timing.csv and the page index.html with the curves that were chosen.

    Args:
        first: The first keyframe.
        last: The last keyframe.
        frames: How many frames the motion lasts, both keyframes counted; at least 2.
        model: The actor's model, by name or folder; see `torchface train enhancement`.
        out: Folder for everything.
        extend: Take the course of the whole captured motion where the keyframes meet a part of it, as a small smile
            does of a large one.
        fps: Frames a second; the model's if absent.
        rig: The rig that weights move.
    """
    from torchface.workflows.enhance.retime_keyframes import Keyframe, retime_keyframes

    with progress_bars(quiet) as progress:
        ends = Keyframe.parse(first, rig), Keyframe.parse(last, rig)
        done = retime_keyframes(*ends, frames, model, out, fps, extend, progress)
    print_lines(done.lines())
    for path in done.products.values():
        print_path(path)
