"""``torchface demo``: the main job from end to end, with a report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from rich.table import Table

from torchface.cli.command_options import Output
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_path

_FILES = ("template.glb", "neutral.obj", "actor.glb", "attachment.json", "take.c3d", "weights.csv", "animation.glb")


def demo(
    template: Path | None = None,
    take: Path | None = None,
    target: Path | None = None,
    out: Annotated[Path, Output(_FILES)] = Path("out/demo"),
    seed: int = 1,
    quiet: Quiet = False,
) -> None:
    """Run the main job from end to end and open the result in a browser: OUT/index.html.

    A template rig is transferred to a new head; the head's true rig plays a take on a marker stage (noise, gaps); the
    take is written as C3D, solved with the transferred rig, and compared with the truth. Without arguments
    everything is the embedded performer's and nothing else is needed.

    Args:
        template: Rig to transfer: a .glb or USD file with shapes, a folder of OBJ files, or ICT-FaceKit's FaceXModel
            folder.
        take: Weight take that moves the head, such as a Live Link Face CSV.
        target: Neutral mesh with the template's topology; ICT-FaceKit's folder needs none (a random head is drawn).
        out: Folder for the report, rig, take, weights, animation and solver.
        seed: Decides the random head, the noise and the gaps.
    """
    from torchface.number_checks import LARGEST_SEED, checked_count

    checked_count("--seed", seed, 0, LARGEST_SEED)
    from torchface.files.job_lock import job_lock
    from torchface.workflows.demo.demo_page import result_rows, scene_rows, story, write_demo_page
    from torchface.workflows.demo.run_demo import run_demo, scene_from

    with job_lock(out), progress_bars(quiet) as progress:
        if (out / _FILES[0]).exists() and not (out / "index.html").exists():
            console.print(f"{out}: an earlier run did not come to its end; this one begins anew", highlight=False)
        progress("preparing head and take")
        scene = scene_from(template, take, target, seed, progress)
        result = run_demo(scene, out, seed, progress=progress)
        page = write_demo_page(result, out, progress)
    console.print(_table(scene.title, scene_rows(result)))
    console.print(_table("against the truth", result_rows(result), ("", "whole take", "frame by frame")))
    console.print(_table("solver.onnx", result.solver.rows()))
    console.print(f"solver.onnx: {result.solver.verdict()}")
    console.print(story(result), highlight=False)
    print_path(page)


def _table(title: str, rows: Sequence[Sequence[str]], heading: Sequence[str] = ("", "")) -> Table:
    table = Table(*heading, title=title, show_header=any(heading))
    for row in rows:
        table.add_row(*row)
    return table
