"""``torchface retarget``: one rig's weights on another rig."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchface.cli.command_options import OptionalOutputPath, OutputPath, Reduce
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path
from torchface.escaped_text import listed


def retarget(
    weights: Positional[Path],
    to: Path,
    from_: Annotated[Path | None, arg(name="from")] = None,
    table: Path | None = None,
    poses: Path | None = None,
    out: OutputPath = Path("out/retargeted.csv"),
    live_link: OptionalOutputPath = None,
    animation: OptionalOutputPath = None,
    reduce: Reduce = None,
    part: str | None = None,
    quiet: Quiet = False,
) -> None:
    """Carry weights over to another rig by what its shapes are called, or by a table.

    A mouthClose that opens the jaw itself, as in rigs for Audio2Face, is distinguished from ARKit's by the chin. Its
    weight is subtracted from jawOpen's, or added to it; not where the table drives either.

    Args:
        weights: Live Link Face CSV, frame,time,<shape>,..., OpenFace's CSV for its action units, a recording (.json of
            MediaPipe, Audio2Face or ARKit; .txt, .gesichter), or an animated rig.
        to: The rig that shall move: .glb, USD, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        from_: The rig that the weights were solved on; its shapes must all be known to the table or by name. Without
            it the names in WEIGHTS are taken as they are.
        table: Mapping table, TOML: a [shape] of the target rig each, with sum = {source = factor} and/or
            product = [sources], and gain, lower, upper.
        poses: Example poses from which the table is learned, TOML or CSV: for each pose weights of the source (from)
            and of the target rig (to). OUT_table.toml keeps what was learned, OUT_poses.png shows the poses and what
            the table gives. Shapes in --table are not learned.
        out: The weights to write, with the timecode and the head and eye rotations of WEIGHTS: Live Link Face CSV if
            each of the target's shapes is one of ARKit's, otherwise frame,time,<shape>,... with the target's own names.
        live_link: Also write Live Link Face CSV whatever the target's names are: halves are merged, shapes that ARKit
            does not have are left out.
        animation: Also write the target rig with this animation as .glb, USD or .ma (Maya). From a .glb or .vrm to a
            .glb all that the file has is kept, and the head and the eyes turn where WEIGHTS has their rotations.
        part: Keep this region of the target rig only, such as face.
    """
    from torchface.files.job_lock import file_lock
    from torchface.workflows.retarget_weights import retarget_weights
    from torchface.workflows.weight_files import WeightFiles

    files = WeightFiles(out, animation, live_link, reduce)
    with file_lock(out, ".csv"), progress_bars(quiet) as progress:
        done = retarget_weights(weights, to, files, from_, table, part, progress, poses)
    count = len(done.driven) + len(done.undriven) + len(done.still)
    console.print(f"{len(done.take)} frames; {len(done.driven)} of {count} shapes driven")
    for what, names in (
        ("nothing drives", done.undriven),
        ("drives nothing:", done.shapes.unused),
        ("has no motion in the target:", done.still),
    ):
        if names:
            console.print(f"{what} {listed(names, 12)}", highlight=False)
    print_lines(done.notes)
    print_lines(f"warning: {warning}" for warning in done.warnings)
    for path in (out, animation, live_link):
        if path is not None:
            print_path(path)
