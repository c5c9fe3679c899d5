"""``torchface transfer``: a template's shapes on another head."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path


def transfer(
    template: Positional[Path],
    neutral: Positional[Path],
    out: OutputPath,
    part: str | None = None,
    unit: str | None = None,
    names: Literal["arkit"] | None = None,
    quiet: Quiet = False,
) -> None:
    """Give a neutral head the shapes of a template rig and write the rig as .glb.

    By deformation transfer: each shape's local stretch and turn is carried over, lids and lips keep touching.

    Args:
        template: A .glb or USD file with shapes, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        neutral: The new head: a mesh with the template's topology (.obj, .ply, .off, .glb).
        out: The .glb or USD file to write, or a name without an ending for a folder of OBJ files in the template's
            vertex order.
        part: Keep this region of the template only, such as face; the neutral then has this part's topology.
        unit: Unit of the neutral's file (um, mm, cm, m, in) where it is not the format's own.
        names: Names of the written shapes. "arkit": ARKit's where the template's mean the same, halves of one of its
            shapes merged (browInnerUp, cheekPuff); shapes that ARKit lacks keep theirs. All keep theirs if absent.
    """
    from torchface.io import load_mesh, load_rig, save_rig
    from torchface.modeling.rigging.deformation_transfer import transfer_with_report
    from torchface.modeling.rigging.neutral_check import neutral_notes
    from torchface.workflows.rig.actor_rig import check_out
    from torchface.workflows.rig_names import naming_lines, renamed

    check_out(out)
    with progress_bars(quiet) as progress:
        progress("reading the template")
        source, head = load_rig(template, part=part), load_mesh(neutral, unit=unit)
        transferred = transfer_with_report(source, head, progress=progress)
        notes = neutral_notes(source, head)
        progress("writing the rig")
        save_rig(renamed(transferred.rig, names), out)
    console.print(f"{len(transferred.rig.names)} shapes, {len(transferred.rig.vertices):,} vertices")
    print_lines([*(f"warning: {note}" for note in notes), *naming_lines(transferred.rig, names)])
    if summary := transferred.report.summary():
        console.print(summary)
    print_path(out)
