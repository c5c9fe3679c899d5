"""The page of the viewer: who reaches it, which port it takes, and what is saved from it."""

import errno
import socket
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, Take, Track, load_take
from torchface.cli.pick import pick
from torchface.cli.terminal import serve_page
from torchface.cli.view import view
from torchface.errors import MissingExtraError, NameMismatchError, ValueRangeError
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.landmarks.images.appearance.annotated_frames import AnnotatedFrame
from torchface.viz.browser.annotation_session import AnnotationSession
from torchface.viz.browser.browser_page import LAST_PORT, BrowserPage, free_port
from torchface.viz.browser.landmark_editor import LandmarkEditor
from torchface.viz.browser.landmark_sets import custom_set
from torchface.viz.browser.pick_session import SurfacePoint
from torchface.viz.browser.picker import Picker
from torchface.viz.browser.rig_viewer import RigViewer

on_linux = pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="asks Linux who listens at which address")


@pytest.fixture
def viewer(ball_rig: BlendshapeRig, tmp_path) -> Iterator[RigViewer]:
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    opened = RigViewer(ball_rig, out=tmp_path / "edited.csv", port=0)
    yield opened
    opened.stop()


def listening_addresses(port: int) -> set[str]:
    """Addresses on which anything listens at this port, as the kernel says."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            place, number = address.split(":")
            if state == "0A" and int(number, 16) == port:
                found.add(place)
    return found


def test_without_viser_the_extra_is_named_before_anything_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    for command in (view, pick):
        with pytest.raises(MissingExtraError, match=r"-m pip install 'viser<2,>=1.1'"):
            command(Path("no_such_rig.glb"))


@on_linux
def test_the_page_listens_on_the_loopback_address_and_nowhere_else(viewer: RigViewer) -> None:
    port = viewer.server.get_port()
    assert viewer.url.startswith(f"http://127.0.0.1:{port}/")
    loopback = "".join(f"{byte:02X}" for byte in reversed((127, 0, 0, 1)))
    assert listening_addresses(port) == {loopback}


@on_linux
def test_another_address_of_this_machine_is_refused(viewer: RigViewer) -> None:
    port = viewer.server.get_port()
    with closing(socket.create_connection(("127.0.0.1", port), timeout=5)):
        pass
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", port), timeout=5)


def test_a_page_cannot_open_a_tunnel_to_the_outside(viewer: RigViewer) -> None:
    assert viewer.server.request_share_url() is None
    assert viewer.server._share_tunnel is None


def test_it_says_nothing_on_standard_output(ball_rig: BlendshapeRig, capfd: pytest.CaptureFixture) -> None:
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    opened = RigViewer(ball_rig, port=0)
    opened.stop()
    assert capfd.readouterr().out == ""


def test_only_the_pieces_that_moved_are_sent(viewer: RigViewer) -> None:
    assert viewer.set_weight("jawOpen", 0.5) == 1  # the head, not the nose
    assert viewer.set_weight("jawOpen", 0.5) == 0
    assert viewer.set_weight("noseSneerLeft", 1.0) == 1
    viewer.editor.rest()
    assert viewer.show_frame(0) == 2


def test_edited_weights_are_saved_for_the_frames_they_were_made_in(ball_rig: BlendshapeRig, tmp_path) -> None:
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    weights = torch.rand(30, 2, 1, generator=torch.Generator().manual_seed(0))
    take = Take(30.0, weights=Track(("jawOpen", "browInnerUp"), weights))
    opened = RigViewer(ball_rig, take, tmp_path / "new" / "edited.csv", port=0)
    try:
        opened.editor.spread = 0
        opened.show_frame(12)
        opened.set_weight("mouthSmileLeft", 0.625)
        found = load_take(opened.save())
    finally:
        opened.stop()
    assert found.fps == pytest.approx(30.0)
    expected = ball_rig.weights_from(take.weights)
    expected[12, [1, 2]] = 0.625  # symmetric
    assert found.weights.names == ball_rig.names
    torch.testing.assert_close(found.weights.values[..., 0], expected)


def test_what_was_not_saved_is_kept_when_the_page_is_closed(
    ball_rig: BlendshapeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("viser", reason="the extra viewer is not installed")

    def interrupted(page: BrowserPage) -> None:
        raise KeyboardInterrupt

    def closed(page: BrowserPage) -> list[Path]:
        before = set(tmp_path.rglob("*.*"))
        serve_page(page)
        new = [path for path in {*tmp_path.rglob("*.*")} - before if path.suffix != ".png"]
        said = "".join(capsys.readouterr().err.split())
        assert said.count("warning:") == len(new)
        assert all(str(path) in said for path in new)
        return new

    monkeypatch.setattr(BrowserPage, "wait", interrupted)
    viewer = RigViewer(ball_rig, out=tmp_path / "edited.csv", port=0)
    viewer.set_weight("jawOpen", 0.5)
    viewer.save()
    assert closed(viewer) == []
    viewer = RigViewer(ball_rig, out=tmp_path / "edited.csv", port=0)
    viewer.set_weight("jawOpen", 0.75)
    assert closed(viewer) == [tmp_path / "edited_unsaved.csv"]
    viewer = RigViewer(ball_rig, out=tmp_path / "edited.csv", port=0)
    viewer.set_weight("jawOpen", 0.25)
    assert closed(viewer) == [tmp_path / "edited_unsaved_2.csv"]
    ends = ("", "_unsaved", "_unsaved_2")
    kept = [load_take(tmp_path / f"edited{end}.csv").weights.values[0, :, 0] for end in ends]
    assert [float(row[ball_rig.names.index("jawOpen")]) for row in kept] == [0.5, 0.75, 0.25]
    picker, again = (Picker(ball_rig, None, tmp_path / "picks", custom_set(["ear", "chin"]), port=0) for _ in "ab")
    picker.session.pick_landmark(SurfacePoint(0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0))
    assert closed(picker) == [tmp_path / "picks" / "unsaved" / "landmarks.json"]
    picker.session.pick_landmark(SurfacePoint(0, (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 1))
    assert {path.parent for path in closed(picker)} == {tmp_path / "picks" / "unsaved_2"}
    again.session.resume(tmp_path / "picks" / "unsaved")
    again.save()
    assert again.session.picks.landmarks == (0, None)
    assert closed(again) == []
    frame = AnnotatedFrame("one", torch.zeros(3, 64, 64), 20 + torch.arange(136.0).reshape(68, 2) / 8)
    session = AnnotationSession([frame, replace(frame, name="two")], tmp_path / "frames")
    session.grab(30)
    session.drag(torch.tensor([50.0, 11.0]))
    points, later = (tmp_path / "frames" / folder / "one.pts" for folder in ("unsaved", "unsaved_2"))
    assert closed(LandmarkEditor(session, port=0)) == [points]
    session.drag(torch.tensor([40.0, 11.0]))
    assert closed(LandmarkEditor(session, port=0)) == [later]
    assert load_landmark_points(points).points[30].tolist() == [50.0, 11.0]


def test_a_take_that_cannot_be_played_is_refused(ball_rig: BlendshapeRig) -> None:
    with pytest.raises(ValueRangeError, match="no weights"):
        RigViewer(ball_rig, Take(60.0, markers=Track(("a",), torch.zeros(2, 1, 3))), port=0)
    with pytest.raises(NameMismatchError, match="wiggleEars"):
        RigViewer(ball_rig, Take(60.0, weights=Track(("wiggleEars",), torch.zeros(2, 1, 1))), port=0)


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
            def bind(self, address: tuple[str, int]) -> None:
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
