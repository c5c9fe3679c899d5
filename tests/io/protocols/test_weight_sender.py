"""Senders by the scheme of an address, and receivers that are not there."""

import errno
import socket
from contextlib import closing

import pytest
import torch
from received_frames import decode_frame

from torchface.errors import ValueRangeError
from torchface.io.protocols.stream_address import StreamAddress, parse_address
from torchface.io.protocols.weight_sender import WeightSender, open_sender
from torchface.shape_names import ARKIT


def test_frames_arrive_by_arkits_names() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        names = ["browInnerUp_L", "browInnerUp_R", "jawOpen"]
        with closing(open_sender(f"udp://127.0.0.1:{receiver.getsockname()[1]}", names, 60.0)) as sender:
            sender.send(torch.tensor([0.2, 0.6, 0.5]))
            sender.send(torch.tensor([0.0, 0.0, float("nan")]), torch.full((9,), torch.nan))
            first, second = (decode_frame(receiver.recv(2048)) for _ in range(2))
    assert first.weights[ARKIT.index("browInnerUp")] == pytest.approx(0.4)
    assert first.weights[ARKIT.index("jawOpen")] == 0.5
    assert (first.frame, second.frame, first.rate, first.subject) == (0, 1, (60000, 1000), "torchface")
    assert not second.weights.any()
    assert not second.rotations.any()


def test_addresses_name_protocol_and_port() -> None:
    assert parse_address("vmc://studio.local") == StreamAddress("vmc", "studio.local", 39539)
    assert parse_address("livelink://10.0.0.7") == StreamAddress("livelink", "10.0.0.7", 11111)
    assert parse_address("osc://[::1]:9000/a/b/") == StreamAddress("osc", "::1", 9000, "/a/b")
    for scheme, begin in {"udp": b"\x06", "livelink": b"\x06", "vmc": b"#bundle", "osc": b"#bundle"}.items():
        with closing(open_sender(f"{scheme}://127.0.0.1:9", ARKIT, 30.0)) as sender:
            assert all(packet.startswith(begin) for packet in sender._encode(torch.zeros(52), None))


@pytest.mark.parametrize(
    "address",
    [
        *("127.0.0.1:11111", "udp://127.0.0.1", "udp://h:70000", "tcp://h:1", "udp://:5", "osc://127.0.0.1"),
        *("vmc://h:0", "vmc://h:39539/x", "http://h:1", "vmc:/h", "osc://h:9000/a b", ""),
    ],
)
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(ValueRangeError, match=r"stream: found .* expected an address such as udp://.*vmc://.*osc://"):
        open_sender(address, ARKIT, 30.0)


HOSTS = ("a..b", "x" * 300, "x" * 64 + ".org", "\x00", "-", "1.2.3.4.5", "\u00e9", ".", "[::1::]", "no-such.invalid")


@pytest.mark.parametrize("host", HOSTS)
def test_hosts_that_cannot_be_are_refused(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def resolver(name: str, *_: object, **__: object) -> list[object]:
        name.encode("idna")  # as the real one does, without a network
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", resolver)
    with pytest.raises(ValueRangeError, match=r"^stream: found 'udp://"):
        open_sender(f"udp://{host}:11111", ARKIT, 60.0)


def test_broadcast_is_allowed_and_what_cannot_be_sent_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(open_sender("udp://255.255.255.255:9", ARKIT, 60.0)) as sender:
        opened = sender._socket
        assert opened.getsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST) != 0

        class Cut:
            def send(self, *_: object) -> None:
                raise OSError(errno.ENETUNREACH, "Network is unreachable")

            def close(self) -> None:
                opened.close()

        monkeypatch.setattr(sender, "_socket", Cut())
        with pytest.raises(ValueRangeError, match=r"cannot send to udp://255.* \(Network is unreachable\)"):
            sender.send(torch.zeros(52))


def test_a_receiver_at_ipv6_gets_the_weights() -> None:
    try:
        receiver = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
        receiver.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
    with receiver:
        receiver.settimeout(5)
        with closing(open_sender(f"livelink://[::1]:{receiver.getsockname()[1]}", ARKIT, 60.0)) as sender:
            assert sender.send(torch.full((52,), 0.5))
        assert decode_frame(receiver.recv(2048)).weights == pytest.approx([0.5] * 52)


def test_nobody_listening_is_reported_and_the_next_listener_gets_the_frames() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as empty:
        empty.bind(("127.0.0.1", 0))
        port = empty.getsockname()[1]
    with closing(WeightSender(f"vmc://127.0.0.1:{port}", lambda weights, _: [bytes(weights.tolist())])) as sender:
        assert [sender.send(torch.tensor([1])) for _ in range(4)] == [True, False, False, False]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
            late.bind(("127.0.0.1", port))
            late.settimeout(5)
            sender.send(torch.tensor([1]))  # the system reports the one before, and this one goes all the same
            assert sender.send(torch.tensor([2]))
            assert (late.recv(16), late.recv(16)) == (b"\x01", b"\x02")
