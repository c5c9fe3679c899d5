"""``torchface attach``: a range of motion tells where the markers sit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchface.cli.progress import console, steps


def attach(
    rig: Annotated[Positional[Path], arg(metavar="RIG")],
    rom: Annotated[Positional[Path], arg(metavar="ROM")],
    out: Path = Path("attachment.json"),
    initial: Path | None = None,
    standoff: bool = False,
    picture: Path | None = None,
    part: str | None = None,
    quiet: bool = False,
) -> None:
    """Find where markers sit on a rig from a range-of-motion take, and write them as attachment JSON.

    Args:
        rig: The performer's rig: a .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        rom: Markers over a range of motion: .c3d, .trc or .csv. Every expression, strongly; no frame need be neutral.
        out: The attachment to write.
        initial: Where the markers sit roughly: an attachment or landmarks as `torchface pick` writes them, labelled
            like the markers. Without it the pose is found by the markers' shape alone.
        standoff: Markers stand off the skin by one unknown distance: estimate it.
        picture: Also draw where each marker sat and sits, and its error after each round: .png or .jpg.
        part: Keep this region of the rig only, such as face.
        quiet: Show no progress.
    """
    from torchface.workflows.attach import attach as find_sites

    with steps(quiet) as step:
        report = find_sites(rig, rom, out, initial, standoff, picture, part, step)
    for line in report.lines():
        console.print(line)
    print(out)
