"""The port of a page: the first free one from where the user says, found before the server starts."""

from __future__ import annotations

import errno
import os
import socket

from torchface.errors import ValueRangeError
from torchface.number_checks import checked_count

LAST_PORT = 65535
_TRIES = 100


def free_port(host: str, first: int) -> int:
    """The first port from ``first`` that can be listened on; 0 stays, for any.

    A server that looks for one by itself waits for ever where it runs out of them.

    Args:
        host: the address to listen on.
        first: 0 to 65535.

    Raises:
        ValueRangeError: no such port, this user may not listen on it, or all of a hundred are in use.
    """
    checked_count("port", first, 0, LAST_PORT)
    if first == 0:
        return 0
    last = min(first + _TRIES - 1, LAST_PORT)
    for port in range(first, last + 1):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as trial:
            if os.name == "posix":  # elsewhere it would take ports that are in use
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind((host, port))
            except OSError as error:
                if error.errno == errno.EACCES and port < 1024:
                    raise ValueRangeError(
                        f"port: found {port}, which this user may not listen on; expected one from 1024 to {LAST_PORT}"
                    ) from None
                continue
            return port
    raise ValueRangeError(f"port: found {first} to {last} in use, expected a free one among them; try another")
