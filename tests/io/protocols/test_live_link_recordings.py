"""Recorded packets of an iPhone as takes."""

import gzip
import struct
from pathlib import Path

import pytest
import torch
from mutation import check_reader
from received_frames import decode_frame
from recordings_of_phones import gesichter, some_frames

from torchface import load_take
from torchface.errors import FileFormatError
from torchface.io.protocols import live_link_recordings
from torchface.io.protocols.live_link_recordings import recorded_packets
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT


def test_lost_and_late_packets_leave_gaps_in_order(tmp_path: Path) -> None:
    weights, rotations = some_frames()
    take = load_take(gesichter(tmp_path / "take.gesichter", weights, rotations, [7, 8, 12, 10, 13]))
    order = [0, 1, 3, 2, 4]
    torch.testing.assert_close(take.weights.values[..., 0], weights[order])
    assert (take.times * 60).round().int().tolist() == [0, 1, 3, 5, 6]
    found = torch.stack([take.extras["columns"][name] for name in ROTATIONS], 1)
    torch.testing.assert_close(found.float(), rotations[order])


@pytest.mark.real
def test_an_iphones_packets_are_what_they_are_byte_by_byte(data: Path) -> None:
    for path in sorted((data / "protocols").glob("live_link_*.gesichter")):
        raw, at, expected = gzip.decompress(path.read_bytes()), 5, []
        while at < len(raw):
            size = int.from_bytes(raw[at : at + 4], "big")
            expected.append(struct.unpack("!61f", raw[at + 4 + size - 244 : at + 4 + size]))
            at += 4 + size
        values = torch.tensor(expected)
        take = load_take(path)
        assert (take.fps, take.weights.names) == (60.0, ARKIT)
        torch.testing.assert_close(take.weights.values[..., 0], values[:, :52], rtol=0, atol=0)
        turned = torch.stack([take.extras["columns"][name] for name in ROTATIONS], 1).float()
        torch.testing.assert_close(turned, values[:, 52:], rtol=0, atol=0)
        assert len(list(recorded_packets(path))) == len(expected)


@pytest.mark.real
@pytest.mark.parametrize(("file", "moved"), [("jawopen", "jawOpen"), ("headyaw", "HeadYaw")])
def test_each_debug_file_moves_the_shape_that_it_is_named_after(file: str, moved: str, data: Path) -> None:
    take = load_take(data / "protocols" / f"live_link_debug-{file}.gesichter")
    channels = dict(zip(ARKIT, take.weights.values[..., 0].T, strict=True)) | take.extras["columns"]
    assert [name for name, values in channels.items() if float(values.abs().max()) > 0] == [moved]
    assert float(channels[moved].abs().max()) == pytest.approx(1.0, abs=0.05)


@pytest.mark.real
def test_the_file_of_all_shapes_moves_one_after_the_other_in_live_links_order(data: Path) -> None:
    take = load_take(data / "protocols" / "live_link_debug-all-blendshapes.gesichter")
    values = torch.cat(
        [take.weights.values[..., 0], *(take.extras["columns"][n].float()[:, None] for n in ROTATIONS)], 1
    )
    assert len(values) == 61 * 60
    moving = values.abs().reshape(61, 60, 61).amax(1)
    assert torch.equal(moving > 0, torch.eye(61, dtype=torch.bool))


def test_damaged_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_link_recordings, "_MOST_BYTES", 2**16)
    path = gesichter(tmp_path / "take.gesichter", *some_frames())
    whole = gzip.decompress(path.read_bytes())
    packets = [decode_frame(packet) for packet in recorded_packets(path)]
    assert [packet.frame for packet in packets] == list(range(5))
    other = bytearray(whole)
    other[9] = 7  # the first packet's version
    for data, found in (
        (b"no gzip", "found no gzip"),
        (path.read_bytes()[:-9], "cut off"),
        (gzip.compress(whole[:3]), "found 3 bytes"),
        (gzip.compress(whole[:100]), "packet 1 of 5: found a size of"),
        (gzip.compress(struct.pack("!BI", 6, 0)), "found no packet"),
        (gzip.compress(struct.pack("!BII", 6, 2**32 - 1, 2**31) + whole), "packet 1 of 4294967295"),
        (gzip.compress(bytes(other)), "packet 1: packet: found version 7, expected Live Link Face's version 6"),
        (gzip.compress(bytes(2**16 + 10)), "larger than"),
    ):
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match=rf"take\.gesichter: .*{found}"):
            load_take(path)


def test_a_mutated_recording_is_read_or_refused(tmp_path: Path) -> None:
    check_reader(load_take, [gesichter(tmp_path / "take.gesichter", *some_frames(3))], ".gesichter")
