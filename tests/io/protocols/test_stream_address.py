"""Addresses: schemes, hosts of every kind, ports and options."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import ValueRangeError
from torchface.io.protocols.stream_address import StreamAddress, parse_address, parse_source
from torchface.io.protocols.weight_sender import open_sender
from torchface.shape_names import ARKIT


def test_schemes_have_the_ports_that_their_programs_listen_at() -> None:
    ports = {
        scheme: parse_address(f"{scheme}://h").port for scheme in ("livelink", "vmc", "ifacialmocap", "vrchat", "vts")
    }
    assert ports == {"livelink": 11111, "vmc": 39539, "ifacialmocap": 49983, "vrchat": 9000, "vts": 8001}
    sources = {scheme: parse_source(f"{scheme}://").port for scheme in ("livelink", "ifacialmocap", "vmc")}
    assert sources == {"livelink": 11111, "ifacialmocap": 49983, "vmc": 39539}
    assert parse_source("osc://:9000/face/") == StreamAddress("osc", "", 9000, "/face")
    assert parse_source("ifacialmocap://10.0.0.7") == StreamAddress("ifacialmocap", "10.0.0.7", 49983)


def test_options_stand_behind_a_question_mark() -> None:
    parts = parse_address("vmc://[fe80::1]:39540?rate=29.97&names=vrm0+arkit&map=/a b/map.toml")
    assert (parts.host, parts.port, parts.rate(), parts.namings()) == ("fe80::1", 39540, 29.97, ("vrm0", "arkit"))
    assert parts.options["map"] == "/a b/map.toml"
    assert parse_address("vmc://h").namings() is None


@pytest.mark.parametrize(
    ("address", "found"),
    [
        ("vmc://h?speed=3", "the option 'speed'"),
        ("livelink://h?names=arkit", "the option 'names'"),
        ("vmc://h?rate=fast", "expected a rate"),
        ("vmc://h?rate=0", "expected a rate"),
        ("vmc://h?rate=nan", "expected a rate"),
        ("vmc://h?names=vrm2", "names='vrm2'"),
        ("vmc://h?rate", "expected an address"),
        ("vts://h/path", "expected an address"),
    ],
)
def test_options_that_are_none_are_refused(address: str, found: str) -> None:
    with pytest.raises(ValueRangeError, match=rf"^stream: found .*{found}"):
        open_sender(address, ARKIT, 30.0)


@pytest.mark.parametrize(
    "address", ["midi://:1", "vts://:8001", "osc://", "livelink://:70000", "vmc://:1?rate=3", "vmc:/"]
)
def test_sources_that_are_none_are_refused(address: str) -> None:
    with pytest.raises(ValueRangeError, match=r"^stream: found .* expected what receives a face: livelink://:11111"):
        parse_source(address)


@given(st.text(max_size=60) | st.from_regex(r"(vmc|osc|vts|livelink)://.{0,40}", fullmatch=True))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    for parse in (parse_address, parse_source):
        try:
            assert 0 <= parse(text).port < 65536
        except ValueRangeError:
            continue
