"""What a hostile browser says to a page reaches neither its state nor its files, and the page goes on."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import torch

from torchface.errors import ValueRangeError
from torchface.io import load_take
from torchface.landmarks.images.appearance.annotated_frames import AnnotatedFrame
from torchface.rig import BlendshapeRig
from torchface.viz.browser.annotation_session import AnnotationSession
from torchface.viz.browser.browser_page import BrowserPage
from torchface.viz.browser.landmark_editor import LandmarkEditor
from torchface.viz.browser.landmark_sets import custom_set
from torchface.viz.browser.page_messages import MessageCheck
from torchface.viz.browser.picker import Picker
from torchface.viz.browser.rig_viewer import RigViewer

viser = pytest.importorskip("viser", reason="the extra viewer is not installed")
msgpack = pytest.importorskip("msgspec.msgpack")

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0.0, 0.0, 5.0],
    "fov": 0.5,
    "near": 0.01,
    "far": 1000,
    "image_height": 600,
    "image_width": 800,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 1.0, 0.0],
}
NO_NUMBERS = [math.nan, math.inf, -math.inf, 1e30, -0.5, 5.0, "nan", "0.5", "", True, None, [0.5], {"a": 1}, 2**63]
NO_POINTS = [[math.nan, 0, 0], [0, 0], [1e300, 0, 0], ["0", 0, 0], None, 0, [0, 0, math.inf], [[0, 0, 0]], [True, 0, 0]]


def until(found: Callable[[], Any], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < end, "the page did not get there in time"
        time.sleep(0.01)


class Client:
    """A program that speaks the page's language, and knows its address."""

    def __init__(self, page: BrowserPage) -> None:
        from websockets.sync.client import connect

        self.socket = connect(
            page.url.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], proxy=None, max_size=None
        )
        self.send(CAMERA)
        until(lambda: len(page.server.get_clients()) > 0)

    def send(self, *messages: dict[str, Any]) -> None:
        for message in messages:
            self.socket.send(msgpack.encode(message))

    def close(self) -> None:
        self.socket.close()


def sets(handle: Any, value: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}


def click(origin: Any = (0.0, 0.0, 5.0), direction: Any = (0.0, 0.0, -1.0)) -> dict[str, Any]:
    message = {"type": "ScenePointerMessage", "event_type": "click", "screen_pos": [[0.5, 0.5]], "modifier": None}
    return {**message, "ray_origin": origin, "ray_direction": direction}


def uploads(handle: Any) -> list[dict[str, Any]]:
    """A file for an input that wants none, whole and in one part, and one of a gigabyte of which a part comes."""
    start = {"type": "FileTransferStartUpload", "source_component_uuid": handle._impl.uuid, "filename": "x.csv"}
    part = {"type": "FileTransferPart", "source_component_uuid": handle._impl.uuid, "content": b"x" * 100}
    return [
        {**start, "transfer_uuid": "a", "mime_type": "text/csv", "part_count": 1, "size_bytes": 100},
        {**part, "transfer_uuid": "a", "part_index": 0},
        {**start, "transfer_uuid": "b", "mime_type": "text/csv", "part_count": 2, "size_bytes": 2**30},
        {**part, "transfer_uuid": "b", "part_index": 0},
    ]


@pytest.fixture
def viewer(ball_rig: BlendshapeRig, tmp_path: Path) -> Iterator[RigViewer]:
    opened = RigViewer(ball_rig, out=tmp_path / "edited.csv", port=0)
    yield opened
    opened.stop()


def test_no_odd_value_reaches_weights_or_file_and_a_good_one_does(
    viewer: RigViewer, capfd: pytest.CaptureFixture
) -> None:
    slider = viewer.sliders["jawOpen"].handle
    with closing(Client(viewer)) as client:
        client.send(*(sets(slider, value) for value in NO_NUMBERS))
        update = sets(slider, 0.5)
        client.send(
            *({**update, "updates": odd} for odd in ({"removed": True}, {"value": 0.5, "update_cb": []}, {}, 7))
        )
        client.send({**update, "uuid": "nobody"}, {**update, "uuid": None}, {**update, "more": [1]}, *uploads(slider))
        client.send({"type": "ShareUrlRequest"}, {"type": "Nothing"}, {"type": ["x"]}, {})
        client.send(*({**CAMERA, "position": odd} for odd in NO_POINTS))
        for raw in (b"", b"\xc1", b"\x91" * 5000, "text", msgpack.encode([update])):
            client.socket.send(raw)
        client.send(sets(viewer.sliders["cheekPuff"].handle, 0.25))
        until(lambda: viewer.editor.pose[5] == 0.25)
        assert slider.value == 0.0
        assert viewer.server.gui._current_file_upload_states == {}
        (visitor,) = viewer.server.get_clients().values()
        assert visitor.camera.position.tolist() == CAMERA["position"]
    expected = torch.zeros(8)
    expected[5] = 0.25
    assert torch.equal(load_take(viewer.save()).weights.values[0, :, 0], expected)
    assert "Traceback" not in capfd.readouterr().err


def test_who_goes_on_with_nonsense_or_says_too_much_is_disconnected_and_the_others_stay(viewer: RigViewer) -> None:
    slider = viewer.sliders["jawOpen"].handle
    with closing(Client(viewer)) as good, closing(Client(viewer)) as bad, closing(Client(viewer)) as large:
        large.socket.send(b"x" * 2**17)
        bad.send(*[sets(slider, math.nan)] * 101)
        for client, code in ((bad, 1008), (large, 1009)):
            until(lambda client=client: client.socket.close_code is not None)
            assert client.socket.close_code == code
        good.send(sets(slider, 0.5))
        until(lambda: viewer.editor.pose[0] == 0.5)


def test_clicks_from_nowhere_pick_nothing_and_labels_are_short_plain_text(
    ball_rig: BlendshapeRig, tmp_path: Path
) -> None:
    picker = Picker(ball_rig, out=tmp_path, landmark_set=custom_set(("chin", "brow")), port=0)
    try:
        with closing(Client(picker)) as client:
            client.send(*(click(origin=odd) for odd in NO_POINTS), *(click(direction=odd) for odd in NO_POINTS))
            client.send(click(direction=[0, 0, 0]), {**click(), "event_type": "rect-select"})
            client.send(*(sets(picker._landmark, odd) for odd in ("nose", 3, None, math.nan)))
            client.send(*(sets(picker._mode, odd) for odd in ("correspondences", 3)), sets(picker._mirrored, "yes"))
            client.send(*(sets(picker._marker_label, odd) for odd in ("a" * 300, "a\x1b[2J", "a\n", 5, ["b"])))
            client.send(sets(picker._landmark, "brow"), click())
            until(lambda: picker.session.steps == 1)
        assert picker.session.picks.landmarks[0] is None
        assert picker.session.picks.landmarks[1] is not None
        assert (picker._mode.value, picker._marker_label.value, picker._mirrored.value) == ("landmarks", "", False)
    finally:
        picker.stop()
    for odd in ([0.0, 0.0, 0.0], [math.nan, 0.0, 1.0]):
        with pytest.raises(ValueRangeError, match="click"):
            picker.click(torch.tensor([0.0, 0.0, 500.0]), torch.tensor(odd))


def test_dots_that_are_not_there_are_neither_chosen_nor_dragged(tmp_path: Path) -> None:
    rows = torch.arange(68)
    face = torch.stack([40 + 12.0 * (rows % 10), 40 + 22.0 * (rows // 10)], dim=1)
    session = AnnotationSession([AnnotatedFrame("actor", torch.zeros(3, 240, 200), face)], tmp_path)
    editor = LandmarkEditor(session, port=0)
    node = {"name": "/landmarks", "owner": "", "modifier": None}
    on_dot = {**node, **click(), "type": "SceneNodeClickMessage", "screen_pos": [0.5, 0.5]}
    del on_dot["event_type"]
    drag = {
        "type": "SceneNodeDragMessage",
        **node,
        "button": "left",
        "start_screen_pos": [0, 0],
        "end_screen_pos": [0, 0],
    }
    try:
        with closing(Client(editor)) as client:
            for odd in (68, -1, 10**5, 1e300, "3", math.nan, None):
                client.send({**on_dot, "instance_index": odd})
                for phase in ("start", "end"):
                    ends = {"start_position": [0.0, 0.0, 0.0], "end_position": [0.1, 0.1, 0.0]}
                    client.send({**drag, **ends, "instance_index": odd, "phase": phase})
            for odd in NO_POINTS:
                moved = {"start_position": [0.0, 0.0, 0.0], "end_position": odd}
                client.send({**drag, **moved, "instance_index": 3, "phase": "start"})
            client.send(*(sets(editor._frame, odd) for odd in ("other", 1)), sets(editor._reach, math.nan))
            client.send({**on_dot, "instance_index": 7})
            until(lambda: editor.chosen == 7)
        assert torch.equal(session.landmarks, face.double())
        assert session.steps == 0
    finally:
        editor.stop()


def test_before_the_page_is_there_no_input_takes_a_value() -> None:
    check = MessageCheck()
    assert check.accepts(msgpack.encode(CAMERA))
    assert check.accepts(msgpack.encode({**CAMERA, "later": 1.5}))
    update = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": True}}
    assert not check.accepts(msgpack.encode(update))
