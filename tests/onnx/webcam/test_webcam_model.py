"""From a picture to weights in a graph: the graph is the module, and whatever comes is taken safely."""

import numpy as np
import onnxruntime
import pytest
import torch
from onnx import ModelProto
from torch import Tensor, nn

from torchface.landmarks import BoxNetwork, EyeNetwork, LandmarkNetwork
from torchface.landmarks.images.frame_reader.face_reader import STATE, FaceReader, ReaderSettings, WebcamNetworks
from torchface.landmarks.images.frame_reader.picture_pieces import cut_square, whole_picture
from torchface.onnx.exported_model import exported_model
from torchface.onnx.webcam.webcam_model import (
    OUTPUTS,
    AnswerSolver,
    WebcamGraph,
    reading_model,
    solving_model,
    webcam_model,
)

USUAL = (0.0, 1.0, 0.5, 0.0, 0.0)
FRAME = np.full((90, 120, 3), 200, np.uint8)


class Webcam:
    """A graph with the state that it hands on."""

    def __init__(self, content: bytes) -> None:
        self.session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        self.state = np.zeros(self.session.get_inputs()[3].shape, np.float32)

    def step(
        self, frame: np.ndarray, interval: float = 1 / 30, controls: tuple[float, ...] = USUAL
    ) -> dict[str, np.ndarray]:
        given = {"interval": np.array(interval, np.float32), "controls": np.float32(controls), "state": self.state}
        found = dict(zip(OUTPUTS, self.session.run(list(OUTPUTS), {"image": frame} | given), strict=True))
        self.state = found["next_state"]
        return found


def test_whatever_comes_is_taken_safely(webcam_file: bytes) -> None:
    webcam = Webcam(webcam_file)
    expected = webcam.step(FRAME)
    np.testing.assert_array_equal(expected["gaze"], [[120, 90]] * 2)
    for interval, used in ((float("nan"), 1 / 30), (0.0, 1e-3), (-3.0, 1e-3), (10.0, 1.0), (float("inf"), 1 / 30)):
        assert float(webcam.step(FRAME, interval)["calibrated"]) == pytest.approx(used)
    found = webcam.step(FRAME, controls=(float("nan"), float("inf"), -1.0, 0.0, 0.0))
    np.testing.assert_array_equal(found["translation"], [0.0, 1.0, 0.0])
    assert webcam.state[0] == 7
    forgotten = webcam.step(FRAME, controls=(0.0, 1.0, 0.5, 1.0, 0.0))["next_state"]
    assert (forgotten[0], forgotten[-1]) == (1, 8)  # the reader's, and the solver's, which forgets by itself
    webcam.state = webcam.state.copy()
    webcam.state[3] = np.nan
    np.testing.assert_array_equal(webcam.step(FRAME)["next_state"], expected["next_state"])


def test_the_file_says_what_it_takes(webcam_file: bytes) -> None:
    model = ModelProto.FromString(webcam_file)
    facts = {one.key: one.value for one in model.metadata_props}
    assert (facts["task"], facts["licence"]) == ("webcam", "MIT")
    assert int(facts["state"]) == model.graph.input[3].type.tensor_type.shape.dim[0].dim_value
    assert [one.name for one in model.graph.input] == ["image", "interval", "controls", "state"]
    assert [one.name for one in model.graph.output] == list(OUTPUTS)


class Pieces(nn.Module):
    """A square of a picture, and the whole made smaller."""

    def forward(self, image: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return cut_square(image, place, 32, 1.25), *whole_picture(image, 100)


@pytest.mark.bench
def test_pieces_of_pictures_of_any_size_are_cut_in_a_graph() -> None:
    """Their sizes are known when it runs."""
    given = {"image": torch.zeros(96, 128, 4, dtype=torch.uint8), "place": torch.tensor([40.0, 30.0, 50.0, 1.0, 0.0])}
    sizes = {"image": ("height", "width", "channels")}
    model = exported_model(Pieces(), given, ["square", "whole", "ratio"], {}, sizes, optimize=False)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for size, side, angle in (((90, 120, 3), 30.0, 0.3), ((300, 40, 4), 190.0, -0.8), ((1, 1, 3), 12.0, 0.0)):
        image = torch.randint(256, size, generator=torch.Generator().manual_seed(1)).byte()
        place = torch.tensor([20.0, 30.0, side, np.cos(angle), np.sin(angle)]).float()
        found = session.run(None, {"image": image.numpy(), "place": place.numpy()})
        for value, expected in zip(found, Pieces()(image, place), strict=True):
            np.testing.assert_allclose(value, expected, atol=0.01)


@pytest.fixture(scope="module")
def reader() -> FaceReader:
    """With small networks that have learned nothing, and so easily content that it follows what they find."""
    with torch.random.fork_rng([]):
        torch.manual_seed(1)
        boxes, landmarks = (
            BoxNetwork((4, 4, 4, 4), (1, 1, 1, 1), 4),
            LandmarkNetwork(32, channels=(4, 4, 4, 4), blocks=(0, 0, 0), decoder=4),
        )
        eyes = EyeNetwork(16, 16, (4, 4, 4), (0, 0, 0), 4)
        with torch.no_grad():
            landmarks.heat.weight.normal_(0, 3)
            for part in (boxes.said, landmarks.presence):
                part.weight.normal_()
    settings = ReaderSettings(new=0.0, vague=0.0, sure=0.0, likely=0.0, least=0.0, smallest=1.0, score=0.0, again=0.0)
    return FaceReader(WebcamNetworks(boxes, landmarks, eyes), settings).eval()


@pytest.mark.bench
def test_the_graph_is_the_module(reader: FaceReader, solver: AnswerSolver) -> None:
    """Where a face is searched, followed, looked at once more and lost, and after a cut; networks that run twice are
    stored once."""
    graph = WebcamGraph(reader, solver)
    model = webcam_model(reading_model(reader, solver.state_size), solving_model(solver))
    webcam, followed, generator = Webcam(model.SerializeToString()), 0, torch.Generator().manual_seed(3)
    changes, sizes = [], ((90, 120), (90, 120), (90, 120), (200, 150), (200, 150), (64, 64), (64, 64))
    drawn = [(size, torch.rand(1, 4, 9, 12, generator=generator)) for size in sizes]
    film = [*drawn, *drawn[2:3] * 3, drawn[1], ((90, 120), torch.zeros(1, 4, 9, 12)), *drawn[1:3]]
    for size, coarse in film:
        image = (255 * nn.functional.interpolate(coarse, size, mode="bilinear")[0]).byte().permute(1, 2, 0)
        before = torch.from_numpy(webcam.state)
        found = webcam.step(image.contiguous().numpy())
        with torch.inference_mode():
            expected = graph(image, torch.tensor(1 / 30), torch.tensor(USUAL), before)
        for name, value in zip(OUTPUTS, expected, strict=True):
            np.testing.assert_allclose(found[name], value, atol=0.05, rtol=5e-3, err_msg=name)
        followed += int(expected[-1][8] > 0.5)
        changes.append(float(expected[-1][STATE - 2]))
    assert followed > 2
    assert (changes[9] < 0.01, changes[10] > 0.25) == (True, True)  # a cut comes
    names = {one.name for one in model.graph.initializer}
    assert sum(name.startswith("reader.landmarks.stem.0.0.weight") for name in names) == 1
    assert len(webcam.state) == STATE + 2
