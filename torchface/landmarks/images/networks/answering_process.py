"""A process that answers requests through pipes, each within a time limit; it ends with this one."""

import os
import signal
import subprocess
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import IO

from torchface.errors import TorchfaceError

_TO_END = 2.0  # seconds that a process has to end once nothing more comes in


class AnsweringProcess:
    """A process whose requests go in at its standard input and whose answers come out at its standard output.

    Args:
        error: what is raised where it fails.
    """

    def __init__(
        self,
        command: Sequence[str],
        name: str,
        error: type[TorchfaceError],
        environment: Mapping[str, str] | None = None,
        folder: str | None = None,
    ) -> None:
        self.name, self.error = name, error
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  lives as long as the process that writes it
        self._process = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=None if environment is None else dict(environment),
            cwd=folder,
        )
        self.close = weakref.finalize(self, _stop, self._process, self._errors)
        self._late: threading.Timer | None = None
        self._seconds = 0.0

    @contextmanager
    def within(self, seconds: float) -> Iterator[None]:
        """What is sent and received here must take no longer; else the process is killed."""
        self._seconds, self._late = seconds, threading.Timer(seconds, self._process.kill)
        self._late.daemon = True
        self._late.start()
        try:
            yield
        finally:
            self._late.cancel()

    def send(self, content: bytes) -> None:
        """Hands it a request."""
        pipe = self._open(self._process.stdin)
        try:
            pipe.write(content)
            pipe.flush()
        except OSError as error:
            raise self._broken("has ended") from error

    def receive(self, count: int, what: str = "has ended in the midst of an answer") -> bytes:
        """The next bytes of an answer."""
        content = self._open(self._process.stdout).read(count)
        if len(content) < count:
            raise self._broken(what)
        return content

    def failed(self, what: str) -> TorchfaceError:
        """An error that says what is wrong, and what the process said last."""
        said = ""
        if not self._errors.closed:
            self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - 4096))
            lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
            said = f": {lines[-1].strip()[:200]}" if lines else ""
        return self.error(f"{self.name} {what}{said}")

    def _broken(self, what: str) -> TorchfaceError:
        late = self._late is not None and self._late.finished.is_set()
        if late:
            return self.failed(f"gave no answer in {self._seconds:g} seconds")
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_TO_END)
            if code < 0:
                with suppress(ValueError):
                    what += f" with {signal.Signals(-code).name}"
        return self.failed(what)

    def _open(self, pipe: IO[bytes] | None) -> IO[bytes]:
        if pipe is None or pipe.closed:
            raise self.failed("was closed")
        return pipe


def _stop(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    """Ends the process: what comes in ends, and if that is not enough it is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # it has ended before what was written was read
                pipe.close()
    try:
        process.wait(_TO_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    errors.close()
