"""Frames of weights go out in their own time, those of a solved take as its file holds them."""

import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from received_frames import decode_frame

from torchface import BlendshapeRig, Take, Track, load_take, save_rig, save_take
from torchface.capture import MarkerSolver
from torchface.cli import main
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT
from torchface.synthetic.stages.marker_stage import place_markers
from torchface.workflows.solve.weight_stream import stream_take


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as open_socket:
        open_socket.bind(("127.0.0.1", 0))
        open_socket.settimeout(5)
        yield open_socket


def address(receiver: socket.socket) -> str:
    return f"udp://127.0.0.1:{receiver.getsockname()[1]}"


def sent(take: Take, receiver: socket.socket) -> list[float]:
    """Sends a take by a clock of its own; the seconds at which it waited for a frame."""
    now, begun = [100.0], list[float]()

    def wait(seconds: float) -> None:
        now[0] += seconds
        begun.append(now[0] - 100)

    words = stream_take(take, address(receiver), lambda: now[0], wait)
    assert words.startswith(f"{len(take)} frames sent")
    assert words.endswith("ms)")
    return begun


def test_frames_arrive_in_their_order_and_time(receiver: socket.socket) -> None:
    weights = torch.rand(20, len(ARKIT), generator=torch.Generator().manual_seed(0))
    turns = torch.rand(20, 9, generator=torch.Generator().manual_seed(1))
    columns = dict(zip(ROTATIONS, turns.T, strict=True))
    begun = sent(Take(60.0, weights=Track(ARKIT, weights[..., None]), extras={"columns": columns}), receiver)
    frames = [decode_frame(receiver.recv(2048)) for _ in range(20)]
    assert [frame.frame for frame in frames] == list(range(20))
    assert begun == pytest.approx([frame / 60 for frame in range(1, 20)])
    assert torch.equal(torch.stack([frame.weights for frame in frames]), weights)
    assert torch.equal(torch.stack([frame.rotations for frame in frames]), turns)


def test_frames_at_uneven_times_go_out_at_these(receiver: socket.socket) -> None:
    times, columns = [0.0, 0.1, 0.15, 0.9, 1.0], dict.fromkeys(ROTATIONS, torch.zeros(5))
    still = Track(ARKIT, torch.zeros(5, len(ARKIT), 1))
    take = Take(30.0, weights=still, extras={"columns": columns}, seconds=torch.tensor(times))
    assert sent(take, receiver) == pytest.approx(times[1:])


def test_frames_that_nobody_receives_are_counted(receiver: socket.socket) -> None:
    there = address(receiver)
    receiver.close()
    take = Take(60.0, weights=Track(ARKIT, torch.zeros(4, len(ARKIT), 1)))
    take = replace(take, extras={"columns": dict.fromkeys(ROTATIONS, torch.zeros(4))})
    assert stream_take(take, there).endswith("; 3 were not received: nobody listens there yet")


@pytest.mark.parametrize("options", [(), ("--frame-by-frame",)])
def test_what_is_sent_is_what_the_file_holds(
    options: tuple[str, ...], dome_rig: BlendshapeRig, tmp_path: Path, receiver: socket.socket
) -> None:
    attachment = place_markers(dome_rig, 30)
    solver = MarkerSolver(dome_rig, attachment)
    save_rig(dome_rig, tmp_path / "rig.glb")
    attachment.save(tmp_path / "attachment.json")
    markers = solver.points(torch.rand(12, len(solver.names), generator=torch.Generator().manual_seed(1))).float()
    save_take(Take(240.0, markers=Track(solver.labels, markers)), tmp_path / "take.c3d")
    files = [tmp_path / "rig.glb", tmp_path / "take.c3d", "--attachment", tmp_path / "attachment.json"]
    command = ["solve", *files, "--out", tmp_path / "w.csv", "--quiet", *options, "--stream", address(receiver)]
    main([str(word) for word in command])
    frames = [decode_frame(receiver.recv(2048)) for _ in range(12)]
    written = load_take(tmp_path / "w.csv").weights
    jaw = torch.stack([frame.weights[ARKIT.index("jawOpen")] for frame in frames])
    assert frames[-1].rate == (240000, 1000)
    torch.testing.assert_close(jaw, written.select(["JawOpen"]).values[:, 0, 0], rtol=0, atol=1e-6)
