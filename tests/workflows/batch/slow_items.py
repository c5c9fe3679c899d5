"""A job that does what the text of its items says: what the tests of batches are run with, in other processes too."""

import os
import signal
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torchface.errors import ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.whole_files import write_file
from torchface.workflows.batch.batch_items import BatchItem, ItemKind
from torchface.workflows.batch.outcomes import Made

WORDS = ItemKind("word", "spelled", (".txt",))


@dataclass(frozen=True)
class SpellJob:
    """Writes a word backwards.

    ``dies`` kills its process, ``dies once`` at the first attempt, ``sleeps`` takes a minute, ``nan`` is refused.
    """

    log: Path  # a folder; every attempt at an item leaves a file in it
    pause: float = 0.0  # seconds that each word takes

    def key(self, item: BatchItem) -> str:
        return content_key("spell", text=item.path, pause=self.pause)

    def run(self, item: BatchItem, out: Path) -> Made:
        (self.log / f"{item.name}.{time.time_ns()}").touch()
        word = item.path.read_text()
        if word == "dies" or (word == "dies once" and self.attempts(item.name) == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if word == "sleeps":
            time.sleep(60)
        if word == "nan":
            raise ValueRangeError(f"{item.path}: found NaN, expected a word")
        if word == "odd":
            warnings.warn("an odd word", stacklevel=1)
        time.sleep(self.pause)
        result = out / item.name / "word.txt"
        result.parent.mkdir(exist_ok=True)
        write_file(result, word[::-1].encode())
        return Made((result,), {"letters": len(word), "half": len(word) / 2}, f"{len(word)} letters")

    def attempts(self, name: str) -> int:
        """How often an item was begun."""
        return len(list(self.log.glob(f"{name}.*")))


def written_words(folder: Path, texts: Mapping[str, str]) -> Path:
    """The folder ``words`` with a file of each text, beside ``log``, in a folder."""
    for name in ("words", "log"):
        (folder / name).mkdir()
    for name, text in texts.items():
        (folder / "words" / f"{name}.txt").write_text(text)
    return folder / "words"
