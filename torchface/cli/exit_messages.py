"""How a command ends that cannot go on: with a line, never with a traceback for what the user can mend."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.text import Text

from torchface.cli.progress import console
from torchface.errors import TorchfaceError

_MISTAKE, _STOPPED = 2, 130


@contextmanager
def plain_errors() -> Iterator[None]:
    """Ends with a message and status 2 where the user made a mistake or a file cannot be used, with 130 on Ctrl-C.

    Raises:
        SystemExit: in place of what was raised inside.
    """
    try:
        yield
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
