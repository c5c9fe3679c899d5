"""``torchface attach``: where the markers sit, fitted to a range of motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.progress import Quiet, print_lines, print_path, progress_bars


def attach(
    rig: Annotated[Positional[Path], arg(metavar="RIG")],
    rom: Annotated[Positional[Path], arg(metavar="ROM")],
    out: Path = Path("attachment.json"),
    initial: Path | None = None,
    standoff: bool = False,
    picture: Path | None = None,
    part: str | None = None,
    labels: Path | None = None,
    frames: str | None = None,
    unit: Literal["mm", "cm", "m", "in"] | None = None,
    flip: Literal["x", "y", "z"] | None = None,
    insist: bool = False,
    quiet: Quiet = False,
) -> None:
    """Find where markers sit on a rig from a range-of-motion take, and write them as attachment JSON.

    Swapped labels, spikes and the motion of a slipping helmet are taken out; sites and shapes that the take leaves
    uncertain are named, and what the rig does not explain ends in an error.

    Args:
        rig: The performer's rig: a .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        rom: Markers over a range of motion: .c3d, .trc or .csv. Every expression, strongly; no frame need be neutral.
        out: The attachment to write.
        initial: Where the markers sit roughly: an attachment or landmarks as `torchface pick` writes them, labelled
            like the markers. Without it the pose is found by the markers' shape alone.
        standoff: Markers stand off the skin by one unknown distance: estimate it.
        picture: Also draw where each marker sat and sits, and its error after each iteration: .png or .jpg.
        part: Keep this region of the rig only, such as face.
        labels: What the take's labels are called in INITIAL, and from then on: CSV, a row LABEL OF THE TAKE,LABEL
            each; an empty second cell leaves the marker out, with Jane:* all of a subject's. Unlabelled points and
            subjects' prefixes (Actor:M001) are left out without it.
        frames: Use the frames A:B of the take only, from A up to, not including, B; counted from 0.
        unit: What the take's coordinates are in: mm, cm, m or in; else what the file says (CSV: millimetres).
        flip: Negate this axis of the take's coordinates: for takes exported in left-handed axes, which are mirrored.
        insist: Write the sites although the rig does not explain the markers, or the take leaves most of them
            uncertain.
        quiet: Show no progress.
    """
    from torchface.files.job_lock import file_lock
    from torchface.workflows.attach_markers import attach as find_sites
    from torchface.workflows.marker_input import MarkerOptions

    with file_lock(out), progress_bars(quiet) as progress:
        options = MarkerOptions(unit, labels, frames, flip)
        report = find_sites(rig, rom, out, initial, standoff, picture, part, progress, options, insist)
    print_lines(report.lines())
    print_path(out)
