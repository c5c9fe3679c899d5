"""``torchface corrective``: a corrective from a sculpted mesh."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path


def corrective(
    rig: Positional[Path],
    at: tuple[str, ...],
    sculpt: Path,
    out: OutputPath,
    name: str | None = None,
    unit: str | None = None,
    align: Literal["remove", "keep"] | None = None,
    replace: bool = False,
    quiet: Quiet = False,
) -> None:
    """Make a corrective of a rig from a sculpted mesh: what the artist changed where shapes act together.

    At the pose the written rig shows the sculpt; where one of the pose's shapes is off, nothing changes. One shape
    below 1 gives an in-between. Animation and detail maps of RIG stay.

    Args:
        rig: .glb, USD, .fbx, .blend, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        at: The pose, such as mouthSmileLeft=1 jawOpen=0.7: up to eight shapes.
        sculpt: The rig in that pose with the artist's changes, in its topology and order of vertices (.obj, .ply, .glb,
            USD). `torchface convert RIG POSED.obj --at ...` writes the mesh to begin from.
        out: The rig to write: .glb, USD, .ma, .blend, or a name without an ending for a folder of OBJ files.
        name: Name of the corrective; the names of its shapes if absent.
        unit: Unit of the sculpt (um, mm, cm, m, in) where it is not the format's own.
        align: A sculpt of which the whole mesh has moved is refused; "remove" takes that motion out, "keep" takes it as
            part of the sculpt.
        replace: Take the place of a corrective that RIG has at this pose.
    """
    from torchface.workflows.sculpt_corrective import SculptOptions, sculpt_corrective

    options = SculptOptions(name, unit, align, replace)
    with progress_bars(quiet) as progress:
        _, lines = sculpt_corrective(rig, at, sculpt, out, options, progress)
    print_lines(lines)
    print_path(out)
