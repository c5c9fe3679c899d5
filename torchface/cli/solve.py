"""``torchface solve``: markers in, weights out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchface.cli.progress import console, steps


def solve(
    rig: Annotated[Positional[Path], arg(metavar="RIG")],
    take: Annotated[Positional[Path], arg(metavar="TAKE")],
    attachment: Path,
    out: Path = Path("out/weights.csv"),
    animation: Path | None = None,
    neutral_frame: int | None = None,
    sparsity: float | None = None,
    ridge: float | None = None,
    part: str | None = None,
    quiet: bool = False,
) -> None:
    """Solve a marker take for blendshape weights and write them as Live Link Face CSV.

    Args:
        rig: A .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        take: Markers: .c3d, .trc or .csv.
        attachment: Where the markers sit on the rig, as JSON; markers match by label.
        out: The weights to write: Live Link Face CSV.
        animation: Also write the rig with this animation as .glb.
        neutral_frame: A frame with the face at rest: the take is moved onto the rig by it (rotation, translation,
            scale). Without it the markers are taken to be in the rig's space.
        sparsity: Pull of each weight toward zero, square millimetres; the default suits 0.3 mm noise.
        ridge: Quadratic pull of each weight toward zero, square millimetres.
        part: Keep this region of the rig only, such as face.
        quiet: Show no progress.
    """
    from torchface.workflows.solve import solve_take

    with steps(quiet) as step:
        report = solve_take(rig, take, attachment, out, animation, neutral_frame, sparsity, ridge, part, step)
    for line in report.lines():
        console.print(line)
    print(out)
