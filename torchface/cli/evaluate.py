"""``torchface evaluate``: how far a result is from the truth."""

from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import Positional

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, work_on
from torchface.cli.command_options import Output
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path

_SHOWN = 8  # regions
_COLUMNS = (
    Column("mean", "mean_mm", "{:.3f} mm"),
    Column("95 %", "p95_mm", "{:.3f} mm"),
    Column("largest", "largest_mm", "{:.2f} mm"),
    Column("frames", "frames", "{}"),
)


_FILES = ("regions.csv", "frames.csv", "shapes.csv", "methods.csv")


def evaluate(
    result: Positional[Path],
    truth: Positional[Path],
    out: Annotated[Path, Output(_FILES)] = Path("out/evaluation"),
    rig: Path | None = None,
    truth_rig: Path | None = None,
    part: str | None = None,
    frames: tuple[int, ...] | None = None,
    by_number: bool = False,
    benchmark: bool = False,
    align: bool = False,
    scale: float | None = None,
    height: int = 290,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Compare a result with the truth: error of every vertex, by region, by shape, over time, as heat maps.

    RESULT and TRUTH are each weights (.csv, with the rig that they move), an animated .glb, a mesh sequence
    (.safetensors), a mesh, or a folder of meshes, a frame each; both of one topology. Raw scans are registered first
    (`torchface register`).

    With --benchmark TRUTH is a folder of films with true weights, NAME.csv, as `python -m train.expression_films`
    renders them, and RESULT a folder of what was found in them, NAME.csv or NAME/live_link.csv, or a folder of such
    folders, one a method: errors, correlation, lag, jitter, blinks and more, a row a method, also in OUT/methods.csv
    and, by shape, in OUT/shapes.csv. A column that is empty says that the method does not give the shape.

    Writes OUT/index.html with its images, OUT/regions.csv, frames.csv, shapes.csv where both have weights, and
    summary.json.

    A RESULT that is a folder of several results: each is compared with the truth of its name in the folder TRUTH, or
    with the one TRUTH, and OUT gets a folder NAME of each. {name} in an option's path is the
    result's name. One that cannot be worked on is reported and skipped, and the exit status is 1; started again, the
    command goes on where it was.

    Args:
        result: What came back.
        truth: What was.
        out: Folder of the report.
        rig: The rig that the result's weights move, or whose topology its meshes have.
        truth_rig: The rig that the truth's weights move; --rig if absent.
        part: Keep this region only, such as face.
        frames: Which of the result's frames, from 0, the truth's are, in order; those of the truth's times if absent.
        by_number: Compare the first frame with the first, and so on, whatever their times say.
        benchmark: RESULT and TRUTH are folders of films' weights.
        align: Turn and move each frame of the result to where it is nearest to the truth.
        scale: Where the heat maps' red begins, millimetres; at a rounded 95th percentile if absent.
        height: Of each view of a face in the report, pixels.
    """
    from torchface.files.job_lock import job_lock
    from torchface.number_checks import checked_count
    from torchface.viz.figures.face_views import PICTURE_HEIGHTS
    from torchface.workflows.batch.batch_items import is_batch
    from torchface.workflows.evaluate.compare_with_truth import EvaluationSettings
    from torchface.workflows.evaluate.compare_with_truth import evaluate as run
    from torchface.workflows.evaluate.evaluate_page import write_evaluation_page
    from torchface.workflows.evaluate.result_job import RESULTS, ResultJob

    if benchmark:
        _benchmark(result, truth, out, quiet)
        return
    checked_count("--height", height, *PICTURE_HEIGHTS)
    settings = EvaluationSettings(rig, truth_rig, part, frames, align, scale, by_number)
    if cluster is not None or is_batch([result], RESULTS):
        job = ResultJob(truth, settings, height)
        work_on(job, RESULTS, [result], out, (jobs, cluster, time_limit), _COLUMNS, "mean_mm", quiet)
        return
    with job_lock(out), progress_bars(quiet) as progress:
        evaluation = run(result, truth, out, settings, progress)
        progress("drawing")
        page = write_evaluation_page(evaluation, out, height)
    table = Table(title=f"{evaluation.result} against {evaluation.truth}, millimetres")
    for head in ("region", "mean", "median", "95 %", "largest", "total", "vertices"):
        table.add_column(head, justify="left" if head == "region" else "right")
    whole, *regions = evaluation.regions.items()
    regions.sort(key=lambda region: -region[1].mean)
    for name, figures in (whole, *regions[:_SHOWN]):
        numbers = (figures.mean, figures.median, figures.percentile_95, figures.largest)
        table.add_row(name, *(f"{x:.3f}" for x in numbers), f"{figures.total:.3f}", str(figures.vertices))
    if len(regions) > _SHOWN:
        table.caption = f"the {_SHOWN} regions that are farthest off; regions.csv has all {len(regions)}"
    console.print(table)
    print_lines(evaluation.lines())
    print_path(page)


def _benchmark(result: Path, truth: Path, out: Path, quiet: bool) -> None:
    """Compares films' weights, and prints a row a method."""
    from torchface.errors import ValueRangeError
    from torchface.files.job_lock import job_lock
    from torchface.workflows.evaluate.expression_benchmark import expression_benchmark

    if not (result.is_dir() and truth.is_dir()):
        raise ValueRangeError("evaluate --benchmark: expected a folder of results and one folder of films with truth")
    with job_lock(out), progress_bars(quiet) as progress:
        found = expression_benchmark(result, truth, out, progress)
    rows = found.table()
    table = Table(title=f"{len(found.films)} films, {found.frames} frames")
    for number, head in enumerate(rows.heading):
        table.add_column(head, justify="right" if number else "left")
    for row in rows.rows:
        table.add_row(*row)
    console.print(table)
    print_lines(found.lines()[1:])
    print_path(out / "index.html")
