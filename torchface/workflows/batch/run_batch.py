"""Many items worked on: one at a time, in processes, or on a cluster; killed, it continues where it was."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.job_lock import within_job
from torchface.progress import Progress, silent
from torchface.rendering.compositing import save_rendered_image
from torchface.workflows.batch.batch_items import SUMMARY, BatchItem, FoundItems, ItemKind
from torchface.workflows.batch.batch_job import BatchJob, attempt
from torchface.workflows.batch.contact_sheet import CONTACT_SHEET, contact_sheet
from torchface.workflows.batch.outcomes import Outcome, finished_outcome, record_path, write_summary
from torchface.workflows.batch.processes import in_processes
from torchface.workflows.batch.ray_cluster import check_cluster, on_cluster


@dataclass(frozen=True)
class BatchOptions:
    """Where items are worked on."""

    # How many processes of one thread each; 1 works in this one, with all its threads. A script that asks for more must
    # call under if __name__ == "__main__".
    jobs: int = 1
    # The address of a Ray cluster, or "auto" on one of its machines, instead of jobs; inputs and results must lie where
    # all its machines see them.
    cluster: str | None = None
    time_limit: float | None = None  # seconds that an item may take; then its process is killed, and it is skipped

    def check(self) -> None:
        """Raises where the options make no sense, ray is missing, or no cluster answers."""
        if self.jobs < 1:
            raise ValueRangeError(f"jobs: found {self.jobs}, expected at least 1")
        if self.time_limit is not None and not self.time_limit > 0:
            raise ValueRangeError(f"time_limit: found {self.time_limit:g} seconds, expected more than 0")
        if self.cluster is not None:
            check_cluster(self.cluster)


ONE_BY_ONE = BatchOptions()  # in this process, without a time limit


@dataclass(frozen=True)
class BatchReport:
    """What became of a batch."""

    kind: ItemKind
    outcomes: tuple[Outcome, ...]  # one an item, in the order found
    out: Path  # the folder of results and records
    left_out: tuple[str, ...] = ()  # what lay beside the items and is none

    @property
    def summary(self) -> Path:
        """The table of all items, CSV."""
        return self.out / SUMMARY

    @property
    def contact_sheet(self) -> Path:
        """The picture of all items."""
        return self.out / CONTACT_SHEET

    @property
    def done(self) -> tuple[Outcome, ...]:
        """Those with results."""
        return tuple(outcome for outcome in self.outcomes if outcome.done)

    @property
    def skipped(self) -> tuple[Outcome, ...]:
        """Those without."""
        return tuple(outcome for outcome in self.outcomes if not outcome.done)


def run_batch(
    job: BatchJob,
    kind: ItemKind,
    inputs: FoundItems,
    out: str | Path,
    options: BatchOptions = ONE_BY_ONE,
    progress: Progress | None = None,
    finished: Callable[[Outcome], None] | None = None,
) -> BatchReport:
    """Works on each item by itself: results and a record ``records/NAME.json`` of each, a table and a contact sheet.

    An item that cannot be worked on is named in report, record and table, and the others go on. Results are whole
    files and a record comes after its results: a run that was killed, started again, takes what is finished and goes
    on with the rest. An item is worked on again when the job's key of it has changed, a result is no longer what was
    written, or its record has been deleted; one that failed for another reason than what it holds (a process that
    died, the time limit) is tried again.

    Args:
        out: the folder of results, made where it is missing; not one that holds items.
    """
    options.check()
    folder, progress = Path(out).resolve(), progress or silent
    step, items = f"{kind.noun}s {kind.done}", inputs.items
    _check_apart(folder, inputs.items, kind)
    with within_job(folder):
        earlier = [outcome for item in items if (outcome := _kept(job, item, folder)) is not None]
        outcomes = {outcome.name: outcome for outcome in earlier}
        progress(step, len(outcomes), len(items))
        todo = [item for item in items if item.name not in outcomes]
        for outcome in chain(earlier, _worked_on(job, todo, folder, options)):
            if outcome.fatal:
                raise FileFormatError(
                    f"{outcome.item.path}: {outcome.error}; {len(outcomes)} of {len(items)} {kind.noun}s are finished "
                    "and kept, and the same command goes on there"
                )
            outcomes[outcome.name] = outcome
            if finished is not None:
                finished(outcome)
            if not outcome.reused:
                progress(step, len(outcomes), len(items))
        report = BatchReport(kind, tuple(outcomes[item.name] for item in items), folder, inputs.left_out)
        write_summary(report.outcomes, report.summary)
        save_rendered_image(contact_sheet(report.outcomes, folder), report.contact_sheet)
    return report


def _check_apart(folder: Path, items: Sequence[BatchItem], kind: ItemKind) -> None:
    """Raises a ``ValueRangeError`` where results and records would fall onto items, or among them."""
    for item in items:
        if folder in (item.path, item.path.parent):
            raise ValueRangeError(f"out: found {folder}, which holds {kind.noun}s; expected another folder")


def _kept(job: BatchJob, item: BatchItem, folder: Path) -> Outcome | None:
    """What an earlier run has made of an item; without a record its content need not be read for that."""
    if not record_path(folder, item).is_file():
        return None
    return finished_outcome(item, job.key(item), folder)


def _worked_on(job: BatchJob, todo: list[BatchItem], out: Path, options: BatchOptions) -> Iterable[Outcome]:
    if not todo:
        return []
    if options.cluster is not None:
        return on_cluster(job, todo, out, options.cluster, options.time_limit)
    if options.jobs > 1 or options.time_limit is not None:
        return in_processes(job, todo, out, options.jobs, options.time_limit)
    return (attempt(job, item, out) for item in todo)
