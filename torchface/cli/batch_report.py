"""Many scans, takes or videos by one command: its options, and what is shown of the results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from rich.table import Table
from rich.text import Text
from tyro.conf import arg

from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import console, print_path
from torchface.errors import AlignmentError
from torchface.escaped_text import listed

if TYPE_CHECKING:
    from torchface.workflows.batch.batch_items import ItemKind
    from torchface.workflows.batch.batch_job import BatchJob
    from torchface.workflows.batch.outcomes import Outcome
    from torchface.workflows.batch.run_batch import BatchReport

Jobs = Annotated[int, arg(help="How many processes, of one thread each, work on several inputs.")]
Cluster = Annotated[
    str | None,
    arg(
        help='Address of a Ray cluster, or "auto" on one of its machines, instead of --jobs; inputs and OUT must lie '
        "where all its machines see them. Needs Ray (torchface's extra `cluster`)."
    ),
]
TimeLimit = Annotated[
    float | None,
    arg(help="Seconds that one of several inputs may take; then its process is killed, and it is skipped."),
]

SOME_SKIPPED = 1
"""Exit status of a command that has left inputs out; those done are whole."""
_MAX_ROWS = 40
_NAMED = 3


class Column(NamedTuple):
    """A column of the table that is shown: its head, the figure in it, and how that is written."""

    head: str
    figure: str
    form: str


def work_on(
    job: BatchJob,
    kind: ItemKind,
    inputs: Sequence[Path],
    out: Path,
    options: tuple[int, str | None, float | None],
    columns: Sequence[Column],
    worst_by: str,
    quiet: bool,
) -> None:
    """Works on each input by itself, with the command's --jobs, --cluster and --time-limit, and shows the table."""
    from torchface.workflows.batch.batch_items import find_items
    from torchface.workflows.batch.run_batch import BatchOptions, run_batch

    with progress_bars(quiet) as progress:
        found = find_items(inputs, kind)
        report = run_batch(job, kind, found, out, BatchOptions(*options), progress, skipped_lines(quiet))
    show_batch(report, columns, worst_by)


def skipped_lines(quiet: bool) -> Callable[[Outcome], None]:
    """A function that reports each item as it is skipped; nothing when quiet."""

    def report(outcome: Outcome) -> None:
        if not outcome.done and not quiet:
            console.print(Text("skipped", "yellow"), f"{outcome.item.path.name}: {outcome.error}", highlight=False)

    return report


def show_batch(report: BatchReport, columns: Sequence[Column], worst_by: str = "", legend: str = "") -> None:
    """Prints the table, the worst items first, what there is to say of them, and where table and contact sheet lie.

    Args:
        report: of the batch.
        columns: to show.
        worst_by: the figure whose largest values come first, after what was skipped.
        legend: what the columns mean.

    Raises:
        AlignmentError: not one item could be worked on.
        SystemExit: some could not; the status is :data:`SOME_SKIPPED`.
    """
    outcomes, noun, verb = report.outcomes, report.kind.noun, report.kind.done
    if not report.done:
        raise AlignmentError(
            f"{report.out}: none of {len(outcomes)} {noun}s could be {verb}, see {report.summary.name}; the first, "
            f"{outcomes[0].item.path.name}: {outcomes[0].error}"
        )
    reused = sum(outcome.reused for outcome in outcomes)
    title = f"{len(report.done)} of {len(outcomes)} {noun}s {verb}"
    table = Table(title=title + (f", {reused} known from an earlier run" if reused else ""))
    for head in (noun, *(column.head for column in columns), "seconds"):
        table.add_column(head)
    ranked = sorted(outcomes, key=lambda outcome: (outcome.done, -_number(outcome, worst_by)))
    for outcome in ranked[:_MAX_ROWS]:
        cells = [_written(outcome, column) for column in columns] if outcome.done else ["skipped"]
        table.add_row(outcome.name, *cells, *[""] * (len(columns) - len(cells)), f"{outcome.seconds:.1f}")
    console.print(table)
    if verdict := _verdict(report.done):
        console.print(Text(verdict))
    if legend:
        console.print(legend, highlight=False)
    remarks: dict[str, list[str]] = {}
    for outcome in ranked:
        for remark in outcome.notes or ([outcome.error] if outcome.error else []):
            remarks.setdefault(remark, []).append(outcome.name)
    for remark, names in list(remarks.items())[:_MAX_ROWS]:
        who = ", ".join(names) if len(names) <= _NAMED else f"{len(names)} of {len(outcomes)} {noun}s"
        console.print(f"{who}: {remark}", highlight=False)
    if len(outcomes) > _MAX_ROWS:
        console.print(f"the {_MAX_ROWS} worst; all are in {report.summary}")
    for line in report.left_out:
        console.print(f"warning: {line}", style="bold yellow")
    print_path(report.summary)
    print_path(report.contact_sheet)
    if report.skipped:
        raise SystemExit(SOME_SKIPPED)


def _verdict(done: Sequence[Outcome]) -> str:
    """Which results are to be used, in a line; empty where the job does not say."""
    from torchface.workflows.batch.outcomes import RESULT

    words: dict[str, list[str]] = {}
    for outcome in done:
        words.setdefault(str(outcome.figures.get(RESULT, "")), []).append(outcome.name)
    words.pop("", None)
    ranked = sorted(words, key=["good", "partly usable", "poor", "none"].index)
    parts = []
    for word in ranked:
        names = words[word]
        which = f" ({listed(names, _MAX_ROWS)})" if word != "good" else ""
        parts.append(word if len(done) == 1 else f"{len(names)} {word}{which}")
    return f"result: {', '.join(parts)}" if parts else ""


def _number(outcome: Outcome, figure: str) -> float:
    value = outcome.figures.get(figure, 0.0)
    return 0.0 if isinstance(value, str) or isnan(value) else float(value)


def _written(outcome: Outcome, column: Column) -> str:
    value = outcome.figures.get(column.figure, "")
    if isinstance(value, float) and isnan(value):
        return "?"
    return column.form.format(value) if value != "" else ""
