"""How a command ends that cannot go on: with a line, never with a traceback for what the user can mend."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.text import Text

from torchface.cli.progress import console
from torchface.errors import TorchfaceError

_MISTAKE, _STOPPED, _NOBODY_READS = 2, 130, 141  # as shells tell of SIGPIPE


@contextmanager
def plain_errors() -> Iterator[None]:
    """Ends with a message and status 2 where the user made a mistake or a file cannot be used, with 130 on Ctrl-C.

    What reads the output may stop doing so, as ``head`` does: that ends quietly, with 141.

    Raises:
        SystemExit: in place of what was raised inside.
    """
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # What is left in the buffer would raise again at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_NOBODY_READS) from None
    except TorchfaceError as error:
        _say("error", str(error))
        raise SystemExit(_MISTAKE) from None
    except OSError as error:
        if error.filename is None:
            raise  # nothing that a user could look at
        _say("error", f"{error.filename}: {error.strerror}")
        raise SystemExit(_MISTAKE) from None
    except KeyboardInterrupt:
        _say("stopped", "what was not complete is not written")
        raise SystemExit(_STOPPED) from None


def _say(what: str, line: str) -> None:
    console.print(Text(f"{what}:", "bold red"), line, highlight=False, soft_wrap=True)
