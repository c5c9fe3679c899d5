"""A take goes out frame by frame in its own time."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
import torch
from received_frames import decode_frame

from planted.take_filters import filtered
from torchface import BlendshapeRig, Take, Track, load_take, save_rig, save_take
from torchface.capture import MarkerSolver
from torchface.cli import main
from torchface.errors import ValueRangeError
from torchface.evaluation import weight_jitter
from torchface.onnx.live_solver import LiveMarkerSolver
from torchface.onnx.solver_graph_export import random_frames
from torchface.shape_names import ARKIT
from torchface.synthetic.stages.marker_stage import place_markers
from torchface.temporal import OneEuroFilter
from torchface.workflows.solve.weight_stream import stream_markers


def test_what_arrives_is_what_was_solved_in_time(dome_rig: BlendshapeRig) -> None:
    solver = MarkerSolver(dome_rig, place_markers(dome_rig, 30))
    markers = random_frames(solver, 20)
    now = [100.0]

    def wait(seconds: float) -> None:
        now[0] += seconds

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        address = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
        report = stream_markers(LiveMarkerSolver(solver), markers, 60.0, address, lambda: now[0], wait)
        frames = [decode_frame(receiver.recv(2048)) for _ in range(20)]
    assert [frame.frame for frame in frames] == list(range(20))
    assert now[0] == pytest.approx(100 + 20 / 60)
    jaw = torch.stack([frame.weights[ARKIT.index("jawOpen")] for frame in frames])
    assert torch.equal(jaw, report.weights[:, dome_rig.names.index("jawOpen")])
    torch.testing.assert_close(report.weights, solver(markers), rtol=0, atol=2e-3)


def test_smoothed_frames_know_only_those_before(dome_rig: BlendshapeRig) -> None:
    solver = MarkerSolver(dome_rig, place_markers(dome_rig, 30))
    markers = random_frames(solver, 30)

    def sent(smoothing: OneEuroFilter | None) -> torch.Tensor:
        clock = (0.0, lambda seconds: None)
        address = "udp://127.0.0.1:11111"
        return stream_markers(
            LiveMarkerSolver(solver), markers, 60.0, address, lambda: clock[0], clock[1], smoothing
        ).weights

    single = sent(None)
    expected = filtered(OneEuroFilter(60.0), single)
    torch.testing.assert_close(sent(OneEuroFilter(60.0)), expected, rtol=0, atol=1e-6)
    assert weight_jitter(sent(OneEuroFilter(60.0))) < 0.5 * weight_jitter(single)


def test_no_frames(dome_rig: BlendshapeRig) -> None:
    live = LiveMarkerSolver(MarkerSolver(dome_rig, place_markers(dome_rig, 30)))
    with pytest.raises(ValueRangeError, match="no frame"):
        stream_markers(live, [], 60.0, "udp://127.0.0.1:11111")


def test_a_take_that_the_command_solves_goes_out_frame_by_frame(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    attachment = place_markers(dome_rig, 30)
    solver = MarkerSolver(dome_rig, attachment)
    save_rig(dome_rig, tmp_path / "rig.glb")
    attachment.save(tmp_path / "attachment.json")
    save_take(Take(240.0, markers=Track(solver.labels, random_frames(solver, 12))), tmp_path / "take.c3d")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        files = [str(tmp_path / name) for name in ("rig.glb", "take.c3d")]
        options = ["--attachment", str(tmp_path / "attachment.json"), "--out", str(tmp_path / "w.csv"), "--quiet"]
        main(
            ["solve", *files, *options, "--frame-by-frame", "--stream", f"udp://127.0.0.1:{receiver.getsockname()[1]}"]
        )
        frames = [decode_frame(receiver.recv(2048)) for _ in range(12)]
    written = load_take(tmp_path / "w.csv").weights
    assert written is not None
    jaw = torch.stack([frame.weights[ARKIT.index("jawOpen")] for frame in frames])
    assert frames[-1].rate == (240000, 1000)
    torch.testing.assert_close(jaw, written.select(["JawOpen"]).values[:, 0, 0], rtol=0, atol=2e-3)
