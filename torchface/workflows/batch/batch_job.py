"""One item of a batch, from file to file: what every engine runs, here, in another process, or on another machine."""

import errno
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from torchface import zoo
from torchface.errors import MissingExtraError, TorchfaceError
from torchface.files.input_files import kept_inputs
from torchface.rendering.compositing import save_rendered_image
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.outcomes import Made, Outcome, record_path, write_record

_FULL = (errno.ENOSPC, errno.EDQUOT)


class BatchJob(Protocol):
    """What is done with each item; travels to other processes and machines by pickle."""

    def key(self, item: BatchItem) -> str:
        """Changes when anything does that the item's results depend on."""

    def run(self, item: BatchItem, out: Path) -> Made:
        """Works on an item and writes its results, whole files, into the folder ``out``."""


def attempt(job: BatchJob, item: BatchItem, out: Path) -> Outcome:
    """Works on an item and writes its record; whatever is wrong with the item is reported, not raised."""
    begin, spent, made, key = time.perf_counter(), time.process_time(), None, ""
    try:
        key = job.key(item)  # before the work: what changes meanwhile is seen by the next run
        with kept_inputs([item.path], [("out", out)]), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            made = job.run(item, out)
        warned = dict.fromkeys(str(row.message) for row in caught if issubclass(row.category, UserWarning))
        outcome = Outcome(item, made.results, made.figures, made.headline, (*made.notes, *warned))
        if made.picture is not None:
            save_rendered_image(made.picture, picture_path(out, item))
    except TorchfaceError as error:
        numbers = {cause.errno for cause in _causes(error) if isinstance(cause, OSError)}
        # The same file would give the same error; a disk may be free again, a package be installed.
        lasting = not numbers and not isinstance(error, MissingExtraError)
        outcome = Outcome(item, error=str(error), lasting=lasting, fatal=bool(numbers & {*_FULL}))
    except Exception as error:  # one item must not stop the others, whatever it has come upon
        fatal = isinstance(error, OSError) and error.errno in _FULL
        outcome = Outcome(item, error=f"{type(error).__name__}: {error}", fatal=fatal)
    spent = time.process_time() - spent
    outcome = replace(outcome, seconds=time.perf_counter() - begin, processor_seconds=spent)
    try:
        if not outcome.fatal:
            write_record(outcome, key, out, made.details if made is not None and outcome.done else {})
    except (TorchfaceError, OSError) as error:
        numbers = {cause.errno for cause in _causes(error) if isinstance(cause, OSError)}
        return Outcome(item, error=str(error), fatal=bool(numbers & {*_FULL}), seconds=outcome.seconds)
    return outcome


def picture_path(out: Path, item: BatchItem) -> Path:
    """Where an item's picture for the contact sheet lies."""
    return record_path(out, item).with_suffix(".png")


def _causes(error: BaseException) -> Iterator[BaseException]:
    """An error and what it came from."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__


def model_content(name: str | Path | None) -> str | Path | None:
    """The folder or file of a model, of which a key takes the content; the name itself where there is none."""
    if name is None or Path(name).exists():
        return None if name is None else Path(name)
    try:
        return zoo.find(name)
    except TorchfaceError:  # not a model of the zoo, such as "none"
        return name
