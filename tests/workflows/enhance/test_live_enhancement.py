"""A live session's takes with an actor's wrinkles."""

import socket
import threading
from pathlib import Path

import pytest
import torch
from planted_faces import ShadeSolver, film

from tests.workflows.enhance.conftest import Actor
from torchface.errors import NameMismatchError
from torchface.io import MeshSequence
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.shape_names import ARKIT
from torchface.workflows.enhance.enhance_animation import load_model
from torchface.workflows.live.live_anybody import LiveSettings, go_live
from torchface.workflows.live.recordings import SavedTake


@pytest.mark.bench
def test_a_take_gets_the_models_wrinkles(actor: Actor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played, said = film(tmp_path / "film.avi", [0.0, 0.4, 0.8]), list[str]()
    settings = LiveSettings(
        str(played), actor.folder / "rig.glb", record=tmp_path / "out", page=False, enhance=actor.model
    )
    _, (take,) = go_live(settings, said.append, print, ShadeSolver)
    check_wrinkles(actor, take, slice(None), 2e-3)
    assert f"{take.frames} frames of" in " ".join(said)


@pytest.mark.bench
def test_a_phones_take_gets_the_models_wrinkles(actor: Actor, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
        phone.bind(("127.0.0.1", 0))
        port = int(phone.getsockname()[1])
    packets, ended = LiveLinkPackets(ARKIT, 60.0), threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
            while not ended.wait(1 / 60):
                for packet in packets(torch.full((len(ARKIT),), 0.4), torch.zeros(9)):
                    phone.sendto(packet, ("127.0.0.1", port))

    settings = LiveSettings(
        f"livelink://127.0.0.1:{port}", actor.folder / "rig.glb", record=tmp_path / "out", page=False, seconds=0.5,
        enhance=actor.model,
    )  # fmt: skip
    thread = threading.Thread(target=send)
    thread.start()
    try:
        _, (take,) = go_live(settings, print, print, lambda progress: pytest.fail("no solver is needed"))
    finally:
        ended.set()
        thread.join()
    check_wrinkles(actor, take, slice(-1, None), 0.025)  # frames came at uneven times, and the file's are even


def check_wrinkles(actor: Actor, take: SavedTake, frames: slice, within: float) -> None:
    """The take's enhanced meshes are what the model makes of its weights, within so many millimetres."""
    moved = read_gltf_weights(take.folder / "animation.glb")
    coarse = actor.rig(moved.weights.select(actor.rig.names).values[..., 0])
    expected = load_model(actor.model)(coarse)
    assert float((expected - coarse).norm(dim=-1).max()) > 0.05
    found = MeshSequence(take.folder / "enhanced" / "enhanced.safetensors")
    torch.testing.assert_close(found.read(0, len(found))[frames], expected[frames], atol=within, rtol=0)


def test_a_model_that_is_none_is_said_before_the_take(tmp_path: Path) -> None:
    settings = LiveSettings("0", page=False, enhance="face_boxes")
    with pytest.raises(NameMismatchError, match="expected an EnhancementModel"):
        go_live(settings, print, print, ShadeSolver)
