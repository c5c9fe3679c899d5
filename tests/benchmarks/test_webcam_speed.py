"""From a webcam's picture to weights: time of each part and of the whole at 640 x 480 on one thread.

And the memory of an application that has onnxruntime, numpy and OpenCV alone. MediaPipe's face mesh beside it, where
``TORCHFACE_MEDIAPIPE_PYTHON`` or the running Python has it.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from onnx import ModelProto, TensorProto

from torchface.landmarks.images.networks.mediapipe_finder import PYTHON
from torchface.onnx.graph_values import OPSET, Value, ValueGraph
from torchface.onnx.network_graphs import network_model
from torchface.onnx.webcam.eye_reader import read_eyes
from torchface.onnx.webcam.face_search import SearchSettings, search
from torchface.onnx.webcam.picture_pieces import cut_square
from torchface.onnx.webcam.webcam_model import webcam_model
from torchface.onnx.webcam.webcam_session import WebcamSession
from torchface.workflows.webcam.webcam_graph import webcam_graph, webcam_networks

EXAMPLE = Path(__file__).resolve().parents[2] / "export" / "README.md"
WEBCAM, NEAR = "webcam/again.mkv", "single_face.mp4"
FRAMES = 70
# Runs in any Python: the clip's path, then milliseconds of processor and of the clock a frame, faces, megabytes.
PEER = """
import sys, time, cv2
from mediapipe import solutions
mesh = solutions.face_mesh.FaceMesh(static_image_mode=False, max_num_faces=1, refine_landmarks=True)
camera, times, found = cv2.VideoCapture(sys.argv[1]), [], 0
while True:
    good, picture = camera.read()
    if not good or len(times) == 70:
        break
    begun = time.process_time(), time.perf_counter()
    found += bool(mesh.process(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)).multi_face_landmarks)
    times.append((time.process_time() - begun[0], time.perf_counter() - begun[1]))
middle = [1000 * sorted(column)[len(times) // 10] for column in zip(*times)]
high = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
print("figures", *middle, found / len(times), int(high[0].split()[1]) / 1024)
"""


def quiet(times: list[float]) -> float:
    """Milliseconds of the quietest tenth: others share the machine."""
    return 1000 * float(np.quantile(times, 0.1))


def milliseconds(model: bytes, inputs: dict[str, np.ndarray]) -> float:
    """Processor time of a run on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    times = []
    for _ in range(33):
        begun = time.process_time()
        session.run(None, inputs)
        times.append(time.process_time() - begun)
    return quiet(times[3:])


def part(make: Callable[[ValueGraph], Value], inputs: dict[str, np.ndarray], shape: tuple[int | str, ...]) -> float:
    """Of a piece of the graph."""
    graph = ValueGraph()
    graph.build.op("Identity", make(graph).name, output="out")
    kinds = {name: TensorProto.UINT8 for name, value in inputs.items() if value.dtype == np.uint8}
    given = {name: value.shape for name, value in inputs.items()}
    model = graph.root.model("part", given, {"out": shape}, {}, OPSET, kinds)
    return milliseconds(model.SerializeToString(), inputs)


def no_solver() -> ModelProto:
    """A solver that solves nothing."""
    graph = ValueGraph()
    shapes = {"weights": (52,), "rotation": (3, 3), "translation": (3,), "gaze": (2, 2), "calibrated": ()}
    for name, shape in shapes.items():
        graph.build.op("Identity", graph.as_value(torch.zeros(shape)).name, output=name)
    graph.build.op("Identity", "state", output="next_state")
    return graph.root.model("none", {"state": (1,)}, {**shapes, "next_state": (1,)}, {}, OPSET)


def whole(model: bytes, frames: list[np.ndarray], fps: float) -> tuple[float, float]:
    """Processor time of a frame, milliseconds, after the first; share of frames with a face."""
    session, times, found = WebcamSession(model), [], 0
    for frame in frames:
        begun = time.process_time()
        found += session.step(frame, 1 / fps).presence > 0
        times.append(time.process_time() - begun)
    return quiet(times[1:]), found / len(frames)


def clip(path: Path) -> list[np.ndarray]:
    """Its first frames, (H,W,3) red first."""
    camera, frames = cv2.VideoCapture(str(path)), []
    while len(frames) < FRAMES and (read := camera.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return frames


@pytest.mark.bench
@pytest.mark.real
def test_the_whole_way_is_quick_and_small(data: Path, tmp_path: Path) -> None:
    content, networks = webcam_graph(), webcam_networks()
    near, frames = clip(data / "video" / NEAR), clip(data / "video" / WEBCAM)
    picture, size = near[40], (640, 480)
    place = np.array([297, 188, 198, 1, 0], np.float32)
    session = WebcamSession(content)
    for frame in near[:41]:
        found = session.step(frame, 1 / 30)
    marks = {"image": picture, "marks": found.landmarks.numpy(), "deviation": np.ones(68, np.float32)}
    empty = [np.full((480, 640, 3), 90, np.uint8)] * 30
    network, side = networks.landmarks, networks.landmarks.size
    crops = {"image": np.random.default_rng(0).random((1, 3, side, side), np.float32)}
    reading = webcam_model(networks, no_solver()).SerializeToString()

    def box(graph: ValueGraph) -> Value:
        no = graph.as_value(torch.zeros(1))
        place = graph.as_value(torch.zeros(5))
        return search(graph.value("image"), networks.boxes, SearchSettings(), place, no > 1.0, no)

    def crop(graph: ValueGraph) -> Value:
        return cut_square(graph.value("image"), graph.value("place"), network.size, network.margin)

    def eyes(graph: ValueGraph) -> Value:
        return read_eyes(graph.value("image"), graph.value("marks"), graph.value("deviation"), networks.eyes).iris

    print("\nmilliseconds of processor time, one thread (quietest tenth of frames)")
    rows = {
        "box search, 640 x 480": part(box, {"image": frames[0]}, (7,)),
        "crop of a face of 200 pixels": part(crop, {"image": picture, "place": place}, (1, 3, side, side)),
        "landmark network": milliseconds(network_model(network).SerializeToString(), crops),
        "both eyes": part(eyes, marks, (2, 2)),
    }
    rows["picture to reading, face followed"] = whole(reading, frames, 30)[0]
    rows["whole, nobody there"] = whole(content, empty, 30)[0]
    for name, shown in {WEBCAM: frames, f"{NEAR}, enlarged": [cv2.resize(one, size) for one in near]}.items():
        rows[f"whole, {name}"], share = whole(content, shown, 30)
        assert share == 1
    rows["solve (the difference)"] = rows[f"whole, {WEBCAM}"] - rows["picture to reading, face followed"]
    for name, took in rows.items():
        print(f"{name:<36} {took:7.2f}")
    peer = mediapipe(data / "video" / WEBCAM)
    if peer is not None:
        used, clock, share, memory = peer
        print(f"MediaPipe's face mesh, {WEBCAM}: {used:.2f} ms of processor time, {clock:.2f} ms by the clock")
        print(f"  a face in {share:.0%} of the frames, {memory:.0f} MB resident")
    fps, memory = example(content, data / "video" / WEBCAM, tmp_path)
    print(f"the example of export/README.md: {fps:.0f} frames a second with decoding, {memory:.0f} MB resident")
    assert rows[f"whole, {WEBCAM}"] < 1000 / 60
    assert rows["whole, nobody there"] < 1000 / 30
    assert memory < 300


def example(content: bytes, video: Path, folder: Path) -> tuple[float, float]:
    """Frames a second of processor time, and megabytes, of the example in Python, without the start."""
    section = EXAMPLE.read_text().split("\n## From a webcam's picture")[1]
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    code = code.replace('"webcam.avi"', repr(str(video))).replace(
        "while True:", "begun, count = clock(), 0\nwhile True:"
    )
    code = code.replace("    good, picture", "    count += 1\n    good, picture")
    # What getrusage says would be the process' that started it, where that is larger.
    code = f"from time import process_time as clock\n{code}\nimport sys\n" + (
        "used = int(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')).split()[1]) / 1024\n"
        "assert not {'torch', 'torchface'} & set(sys.modules)\n"
        "print('figures', count / (clock() - begun), used)\n"
    )
    (folder / "webcam.onnx").write_bytes(content)
    (folder / "example.py").write_text(code)
    values = figures([sys.executable, "example.py"], folder)
    assert values is not None
    return values[0], values[1]


def mediapipe(video: Path) -> list[float] | None:
    """Of MediaPipe, where it is installed."""
    return figures([os.environ.get(PYTHON, sys.executable), "-c", PEER, str(video)], Path.cwd())


def figures(command: list[str], folder: Path) -> list[float] | None:
    """What a process prints after ``figures``; None where it fails."""
    alone = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False, env={**os.environ, **alone}
    )
    lines = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("figures")]
    return json.loads(f"[{', '.join(lines[0])}]") if lines else None
