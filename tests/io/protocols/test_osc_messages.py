"""OSC as python-osc reads and writes it."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from osc_receiver import values_by_address
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from torchface.errors import FileFormatError
from torchface.io.protocols.osc_messages import osc_bundles, osc_message, read_osc

TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FF), max_size=20)
VALUES = st.lists(TEXT | st.integers(-(2**31), 2**31 - 1) | st.floats(width=32, allow_nan=False) | st.booleans())


@given(st.lists(VALUES, min_size=1, max_size=5))
def test_python_osc_reads_what_is_written_and_so_do_we(messages: list[list[str | int | float | bool]]) -> None:
    (packet,) = osc_bundles(osc_message(f"/a/{i}", *values) for i, values in enumerate(messages))
    expected = [(f"/a/{i}", tuple(values)) for i, values in enumerate(messages)]
    assert read_osc(packet) == expected
    theirs = values_by_address([packet])
    assert [(address, values[0]) for address, values in theirs.items()] == expected


def test_what_python_osc_writes_is_read() -> None:
    inner, outer = OscBundleBuilder(IMMEDIATELY), OscBundleBuilder(IMMEDIATELY)
    for bundle, address in ((inner, "/in"), (outer, "/out")):
        builder = OscMessageBuilder(address)
        for value, kind in (
            (1, "i"),
            (2**40, "h"),
            (math.pi, "d"),
            ("é", "s"),
            (b"abc", "b"),
            (None, "N"),
            (True, "T"),
        ):
            builder.add_arg(value, kind)
        bundle.add_content(builder.build())
    outer.add_content(inner.build())
    values = (1, 2**40, math.pi, "é", b"abc", None, True)
    assert read_osc(outer.build().dgram) == [("/out", values), ("/in", values)]


def test_bundles_are_not_larger_than_asked_for() -> None:
    messages = [osc_message(f"/{i}", float(i)) for i in range(100)]
    packets = osc_bundles(messages, 200)
    assert max(map(len, packets)) <= 200
    assert [message[0] for packet in packets for message in read_osc(packet)] == [f"/{i}" for i in range(100)]


@pytest.mark.parametrize(
    "packet",
    [
        *(b"", b"jaw\0,f\0\0", b"/a", b"/a\0\0,f\0\0\1", b"/a\0\0,q\0\0", b"/a\0\0f\0\0\0", b"#bundle\0", b"\xff/\0\0"),
        *(b"#bundle\0" + b"\0" * 8 + size for size in (b"\0\0\0\0", b"\x7f\0\0\0", b"\xff\xff\xff\xff", b"\0\0")),
        b"/a\0\0,b\0\0\x7f\xff\xff\xff",
        (b"#bundle\0" + b"\0" * 8 + b"\0\0\0\x08") * 40,
    ],
)
def test_bytes_that_are_no_osc_are_refused(packet: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"^packet: found .*, expected OSC messages"):
        read_osc(packet)
