"""From a picture to one face's landmarks in a graph: pieces agree with the library, faces are kept, lost and found."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnxruntime
import pytest
import torch
from onnx import ModelProto, TensorProto, helper, numpy_helper
from torch import Tensor

from torchface import zoo
from torchface.capture.anybody.webcam_state import CONTROLS
from torchface.landmarks import FaceReading, LandmarkTracker
from torchface.landmarks.images.boxes.network_detector import shipped_detector
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.networks.crop_finder import CropFinder
from torchface.landmarks.images.networks.eye_finder import EyeFinder
from torchface.onnx.graph_values import OPSET, Value, ValueGraph
from torchface.onnx.webcam import face_place, picture_pieces
from torchface.onnx.webcam.eye_reader import read_eyes
from torchface.onnx.webcam.face_reader import WebcamNetworks

USUAL = (0.0, 1.0, 0.5, 0.0, 0.0)
Found = dict[str, np.ndarray]


def run_values(make: Callable[[ValueGraph], Value], inputs: dict[str, np.ndarray], axes: int = 1) -> np.ndarray:
    """What a graph of values computes."""
    graph = ValueGraph()
    graph.build.op("Identity", make(graph).name, output="out")
    shapes = {name: tuple(f"{name}{axis}" for axis in range(value.ndim)) for name, value in inputs.items()}
    types = {name: helper.np_dtype_to_tensor_dtype(value.dtype) for name, value in inputs.items()}
    model = graph.root.model("values", shapes, {"out": tuple(f"out{axis}" for axis in range(axes))}, {}, OPSET, types)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, inputs)[0])


def place_of(box: Tensor, tilt: float) -> np.ndarray:
    middle = box[:2] + box[2:] / 2
    return np.array([*middle, box[2], np.cos(tilt), np.sin(tilt)], np.float32)


@pytest.mark.parametrize(
    ("box", "tilt"), [((60, 40, 70, 70), 0.4), ((90, 60, 300, 300), -0.3), ((-40, 150, 90, 90), 1.0)]
)
def test_squares_are_cut_as_the_library_cuts_them(box: tuple[float, ...], tilt: float) -> None:
    """Inside, larger than their copy, and beyond the border; a fourth channel counts for nothing."""
    coarse = torch.rand(1, 3, 30, 40, generator=torch.Generator().manual_seed(1))
    picture = (255 * torch.nn.functional.interpolate(coarse, (240, 320), mode="bilinear")[0]).byte()
    opaque = torch.cat([picture, torch.full((1, 240, 320), 7, dtype=torch.uint8)])
    place = place_of(torch.tensor(box).float(), tilt)

    def make(graph: ValueGraph) -> Value:
        return picture_pieces.cut_square(graph.value("image"), graph.value("place"), 64, 1.25)

    way = crop_transform(torch.tensor(box).float(), tilt, 64)
    expected = cut_crop(picture, way, 64).float() / 255
    for frame in (picture, opaque):
        found = run_values(make, {"image": frame.permute(1, 2, 0).contiguous().numpy(), "place": place}, axes=4)[0]
        assert float((torch.from_numpy(found) - expected).abs().max()) < 0.02
    points = torch.rand(9, 2) * 64
    back = run_values(
        lambda graph: picture_pieces.from_square(graph.value("points"), graph.value("place"), 64, 1.25),
        {"points": points.numpy(), "place": place},
        axes=2,
    )
    np.testing.assert_allclose(back, from_crop(points, way), atol=1e-3)


def test_eyes_are_read_as_the_library_reads_them(portrait: tuple[Tensor, Tensor], networks: WebcamNetworks) -> None:
    """Lids, irises, and what is told of each eye; of eyes too small to be seen nothing."""
    picture, marks = portrait
    deviation = torch.linspace(0.5, 2.0, 68)
    finder = EyeFinder(networks.eyes, networks.eyes.width, networks.eyes.height)
    sure = torch.ones(68)
    for size in (1.0, 0.05):
        face = finder(picture, FaceReading(size * marks, deviation, sure, sure[0]))
        read = (face.landmarks, face.deviation, face.iris, face.openness, face.closed, face.eye_visibility)
        expected = torch.cat([one.flatten() for one in read])

        def make(graph: ValueGraph) -> Value:
            found = read_eyes(graph.value("image"), graph.value("marks"), graph.value("deviation"), networks.eyes)
            parts = (found.landmarks, found.deviation, found.iris, found.openness, found.closed, found.visibility)
            return graph.cat(*(part.shaped(-1) for part in parts))

        image = picture.permute(1, 2, 0).contiguous().numpy()
        found = run_values(make, {"image": image, "marks": (size * marks).numpy(), "deviation": deviation.numpy()})
        np.testing.assert_allclose(found, expected, atol=0.05)
    assert np.isnan(found[-6:-2]).all()
    assert (found[-2:] == 0).all()


def test_places_are_the_boxes_of_landmarks(portrait: tuple[Tensor, Tensor]) -> None:
    """And a face is looked for again where it was found, however it has turned, moved and grown meanwhile."""
    marks = 1.7 * portrait[1] @ torch.tensor([[0.8, 0.6], [-0.6, 0.8]]) + torch.tensor([300.0, 200.0])
    found = run_values(lambda graph: face_place.place_around(graph.value("marks")), {"marks": marks.numpy()})
    box, tilt = turned_box(marks)
    np.testing.assert_allclose(found, place_of(box, float(tilt)), atol=1e-3)
    looked = np.array([found[0] + 5, found[1] - 10, 1.1 * found[2], *found[3:]], np.float32)

    def again(graph: ValueGraph) -> Value:
        anchor = face_place.relation(graph.value("own"), graph.value("looked"))
        return face_place.sought(graph.value("moved"), anchor)

    same = run_values(again, {"own": found, "looked": looked, "moved": found})
    np.testing.assert_allclose(same, looked, atol=1e-3)
    twice = np.concatenate([2 * found[:3], found[3:]]).astype(np.float32)
    moved = run_values(again, {"own": found, "looked": looked, "moved": twice})
    np.testing.assert_allclose(moved[:3], 2 * looked[:3], atol=1e-3)


class Webcam:
    """The graph with the state that it hands on."""

    def __init__(self, content: bytes) -> None:
        self.session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        self.names = [one.name for one in self.session.get_outputs()]
        self.start = np.zeros(self.session.get_inputs()[3].shape, np.float32)
        self.state = self.start

    def step(
        self, frame: Tensor, interval: float = 1 / 30, controls: tuple[float, ...] = (0.0, 1.0, 0.5, 0.0, 0.0)
    ) -> Found:
        inputs = {
            "image": frame.permute(1, 2, 0).contiguous().numpy(),
            "interval": np.array(interval, np.float32),
            "controls": np.array(controls, np.float32),
            "state": self.state,
        }
        found = dict(zip(self.names, self.session.run(None, inputs), strict=True))
        self.state = found["next_state"]
        return found


@pytest.fixture(scope="module")
def graph(webcam_file: bytes) -> Webcam:
    return Webcam(webcam_file)


@pytest.fixture
def webcam(graph: Webcam) -> Webcam:
    graph.state = graph.start
    return graph


def scene(portrait: Tensor, *corners: tuple[int, int], size: tuple[int, int] = (240, 400)) -> Tensor:
    """Portraits at corners (column, row) on an empty wall."""
    frame = torch.tensor([76, 89, 102], dtype=torch.uint8)[:, None, None].expand(3, *size).clone()
    for left, top in corners:
        frame[:, top : top + portrait.shape[1], left : left + portrait.shape[2]] = portrait
    return frame


def apart(found: np.ndarray, expected: Tensor | np.ndarray) -> float:
    """Mean distance over that of the eyes' outer corners."""
    expected = np.asarray(expected)
    return float(np.linalg.norm(found - expected, axis=1).mean() / np.linalg.norm(expected[36] - expected[45]))


def test_a_face_is_followed_as_the_library_follows_it(webcam: Webcam, portrait: tuple[Tensor, Tensor]) -> None:
    network = zoo.get_model("landmark_network")
    tracker = LandmarkTracker(CropFinder(network, network.size, network.margin), detector=shipped_detector())
    head, truth = portrait
    for left in (60, 66, 72, 95, 95):
        frame = scene(head, (left, 50))
        found = webcam.step(frame)
        assert float(found["presence"]) > 0.9
        assert apart(found["landmarks"], tracker.step(frame).landmarks) < 0.01
        assert apart(found["landmarks"], truth + torch.tensor([left, 50.0])) < 0.06
        np.testing.assert_allclose(found["weights"][0], found["landmarks"][:, 0].mean(), rtol=1e-5)
        assert np.abs(found["iris"] - found["landmarks"][[[36, 39], [42, 45]]].mean(1)).max() < 5
    clear = torch.cat([frame, torch.zeros(1, *frame.shape[1:], dtype=torch.uint8)])
    before = webcam.state
    once = webcam.step(frame)["landmarks"]
    webcam.state = before
    np.testing.assert_array_equal(webcam.step(clear)["landmarks"], once)


def test_it_stays_with_the_largest_and_finds_it_again(webcam: Webcam, portrait: tuple[Tensor, Tensor]) -> None:
    head, _ = portrait
    small = torch.nn.functional.interpolate(head[None].float(), (110, 110), mode="area")[0].byte()

    def both(large: Tensor, other: Tensor) -> Tensor:
        frame = scene(large, (20, 40))
        frame[:, 60 : 60 + other.shape[1], 220 : 220 + other.shape[2]] = other
        return frame

    assert webcam.step(both(head, small))["weights"][0] < 190
    assert webcam.step(both(head, small))["weights"][0] < 190
    assert webcam.step(both(small, head))["weights"][0] < 190  # now the other is larger, and not it
    for _ in range(4):
        gone = webcam.step(scene(head))
        assert float(gone["presence"]) == 0
        assert np.isnan(gone["landmarks"]).all()
        assert np.isnan(gone["iris"]).all()
        assert np.isfinite(gone["next_state"]).all()
    back = webcam.step(both(small, head))  # the one that is where it was, though another is larger
    assert back["weights"][0] < 190
    webcam.step(both(small, head), controls=(0.0, 1.0, 0.5, 1.0, 0.0))
    assert webcam.step(both(small, head))["weights"][0] > 190  # forgotten: the largest


def test_whatever_comes_is_taken_safely(webcam: Webcam, portrait: tuple[Tensor, Tensor]) -> None:
    frame = scene(portrait[0], (60, 50))
    expected = webcam.step(frame)
    for interval, used in ((float("nan"), 1 / 30), (0.0, 1e-3), (-3.0, 1e-3), (10.0, 1.0), (float("inf"), 1 / 30)):
        found = webcam.step(frame, interval)
        assert float(found["calibrated"]) == pytest.approx(used)
        assert apart(found["landmarks"], expected["landmarks"]) < 0.02
    found = webcam.step(frame, controls=(float("nan"), float("inf"), -1.0, 0.0, 0.0))
    np.testing.assert_array_equal(found["translation"], [0.0, 1.0, 0.0])
    webcam.state = webcam.state.copy()
    webcam.state[3] = np.nan
    found = webcam.step(frame)
    np.testing.assert_array_equal(found["landmarks"], expected["landmarks"])
    np.testing.assert_array_equal(found["next_state"], expected["next_state"])
    small = webcam.step(frame[:, 30:, 40:260])  # another camera
    assert apart(small["landmarks"], expected["landmarks"] - np.array([40.0, 30.0])) < 0.02
    for size in ((64, 64), (1, 1), (2000, 40)):
        assert np.isfinite(webcam.step(torch.zeros(3, *size, dtype=torch.uint8))["next_state"]).all()


def test_the_file_says_what_it_takes(webcam_file: bytes) -> None:
    model = ModelProto.FromString(webcam_file)
    facts = {one.key: one.value for one in model.metadata_props}
    assert (facts["task"], facts["licence"]) == ("webcam", "MIT")
    assert int(facts["state"]) == model.graph.input[3].type.tensor_type.shape.dim[0].dim_value
    assert [one.name for one in model.graph.input] == ["image", "interval", "controls", "state"]
    assert len(CONTROLS) == 5
    sizes = [numpy_helper.to_array(one).nbytes for one in model.graph.initializer]
    assert sum(sizes) < 2e6  # networks that run in two places are stored once
    assert all(one.data_type != TensorProto.DOUBLE for one in model.graph.initializer)
