"""A video as a stream: its frames are sent as they are solved, whatever happens to the curves."""

import socket
from pathlib import Path
from typing import Any

import pytest
import torch
from received_frames import decode_frame

from tests.workflows.track.conftest import FRAMES, Filmed
from torchface import load_take
from torchface.errors import FileFormatError, ValueRangeError
from torchface.shape_names import ARKIT, mapping
from torchface.workflows.live.live_actor import track_live
from torchface.workflows.live.recordings import FrameLog


def test_a_played_video_is_sent_frame_by_frame(filmed: Filmed, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        address = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
        report = track_live(str(filmed.video), filmed.rig, [address], tmp_path)
        frames = [decode_frame(receiver.recv(2048)) for _ in range(report.figures.frames)]
    assert report.figures.frames + report.dropped == FRAMES
    assert report.figures.found == report.figures.frames
    sent = torch.stack([frame.weights for frame in frames])
    kept = load_take(tmp_path / "weights.csv").weights
    assert kept is not None
    torch.testing.assert_close(kept.select(["jawOpen"]).values[:, 0, 0], sent[:, ARKIT.index("jawOpen")])
    torch.testing.assert_close(kept.values[..., 0] @ mapping(kept.names, ARKIT).T, sent)
    assert sent.any()
    assert frames[-1].rotations[:3].abs().max() > 0
    with pytest.raises(ValueRangeError, match="expected an address"):
        track_live(str(filmed.video), filmed.rig, ["tcp://x"])
    with pytest.raises(FileFormatError, match="camera 97: cannot be opened"):
        track_live("97", filmed.rig, [address])


def test_a_disk_that_fills_ends_the_curves_and_not_the_stream(
    filmed: Filmed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = FrameLog.append

    def full(log: FrameLog, *given: Any) -> None:
        if log.count == 1:  # a slow machine drops most frames
            raise FileFormatError("the disk is full")
        append(log, *given)

    monkeypatch.setattr(FrameLog, "append", full)
    report = track_live(str(filmed.video), filmed.rig, ["udp://127.0.0.1:9"], tmp_path)
    assert report.figures.frames + report.dropped == FRAMES > 1
    assert "the curves end at frame 1: the disk is full" in report.notes
    assert len(load_take(tmp_path / "weights.csv")) == 1
