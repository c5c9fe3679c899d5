"""The port of a page is found before its server starts, or refused with the reason."""

from __future__ import annotations

import errno
import socket

import pytest

from torchface.errors import ValueRangeError
from torchface.viz.browser.browser_page import LAST_PORT, free_port

HOST = "127.0.0.1"


@pytest.mark.parametrize("port", [-1, 65536, 99999, 10**30, 80.0, float("nan")])
def test_what_is_no_port_is_refused(port: int) -> None:
    with pytest.raises(ValueRangeError, match=r"port: found .*, expected a whole number from 0 to 65535"):
        free_port(HOST, port)


def test_a_port_in_use_is_passed_over() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port(HOST, port) <= port + 100
    assert free_port(HOST, 0) == 0


def test_no_permission_and_no_port_left_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def refuse(number: int) -> type[socket.socket]:
        class Refused(socket.socket):
            def bind(self, address: tuple[str, int]) -> None:  # type: ignore[override]
                tried.append(address[1])
                raise OSError(number, "refused")

        return Refused

    monkeypatch.setattr(socket, "socket", refuse(errno.EACCES))
    with pytest.raises(
        ValueRangeError, match="port: found 80, which this user may not listen on; expected one from 1024"
    ):
        free_port(HOST, 80)
    monkeypatch.setattr(socket, "socket", refuse(errno.EADDRINUSE))
    with pytest.raises(ValueRangeError, match=f"port: found 65500 to {LAST_PORT} in use"):
        free_port(HOST, 65500)
    assert tried == [80, *range(65500, LAST_PORT + 1)]
