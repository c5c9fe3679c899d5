"""From a webcam's picture to weights: time of each part and of the whole at 640 x 480 on one thread.

And the memory of an application that has onnxruntime, numpy and OpenCV alone. MediaPipe's Face Landmarker
beside it, in this process, from a picture to blendshapes.
"""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from planted.mediapipe_tracker import MediaPipeTracker
from torchface.io.video import open_video
from torchface.onnx.network_graphs import network_model
from torchface.onnx.webcam.webcam_model import WebcamAnswer, reading_model, solving_model, webcam_model
from torchface.onnx.webcam.webcam_session import WebcamSession
from torchface.shape_names import ARKIT
from torchface.workflows.webcam.webcam_graph import webcam_graph, webcam_module

EXAMPLE = Path(__file__).resolve().parents[2] / "export" / "README.md"
WEBCAM, NEAR = "webcam/again.mkv", "single_face.mp4"
FRAMES = 70


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


class Reading(nn.Module):
    """The graph's part that reads a face."""

    state_size = 1

    def forward(self, *given: Tensor) -> WebcamAnswer:
        nothing = torch.zeros(len(ARKIT)), torch.eye(3), torch.zeros(3), torch.zeros(2, 2)
        return WebcamAnswer(*nothing, *torch.zeros(3).unbind(), given[-1])


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
    content, module = webcam_graph(), webcam_module()
    near, frames = clip(data / "video" / NEAR), clip(data / "video" / WEBCAM)
    size, empty = (640, 480), [np.full((480, 640, 3), 90, np.uint8)] * 30
    network = module.reader.landmarks
    crops = {"image": np.random.default_rng(0).random((1, 3, network.size, network.size), np.float32)}
    solver = Reading()
    parts = reading_model(module.reader, solver.state_size), solving_model(solver)
    reading = webcam_model(*parts).SerializeToString()

    print("\nmilliseconds of processor time, one thread (quietest tenth of frames)")
    rows = {"landmark network": milliseconds(network_model(network).SerializeToString(), crops)}
    rows["picture to reading, face followed"] = whole(reading, frames, 30)[0]
    rows["whole, nobody there"] = whole(content, empty, 30)[0]
    for name, shown in {WEBCAM: frames, f"{NEAR}, enlarged": [cv2.resize(one, size) for one in near]}.items():
        rows[f"whole, {name}"], share = whole(content, shown, 30)
        assert share == 1
    rows["solve (the difference)"] = rows[f"whole, {WEBCAM}"] - rows["picture to reading, face followed"]
    for name, took in rows.items():
        print(f"{name:<36} {took:7.2f}")
    took, share = mediapipe(data / "peers" / "face_landmarker.task", data / "video" / WEBCAM)
    print(f"MediaPipe's Face Landmarker, {WEBCAM}: {took:.2f}, a face in {share:.0%} of the frames")
    fps, memory = example(content, data / "video" / WEBCAM, tmp_path)
    print(f"the example of export/README.md: {fps:.0f} frames a second with decoding, {memory:.0f} MB resident")
    assert rows[f"whole, {WEBCAM}"] < 1000 / 60
    assert rows["whole, nobody there"] < 1000 / 30
    assert memory < 300


def example(content: bytes, video: Path, folder: Path) -> tuple[float, float]:
    """Frames a second of processor time, and megabytes, of the example in Python, without the start."""
    section = EXAMPLE.read_text().split("\n## From a webcam's picture")[1]
    code, *_ = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
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
    return values[0], values[1]


def mediapipe(task: Path, video: Path) -> tuple[float, float]:
    """Milliseconds a frame from its picture to blendshapes, and the share of frames with a face."""
    pytest.importorskip("ai_edge_litert")
    tracker, times, found = MediaPipeTracker(task), [], 0
    for picture, _ in zip(open_video(video).color_frames(), range(FRAMES), strict=False):
        begun = time.process_time()
        face = tracker.mesh(picture)
        if face is not None:
            tracker.landmarker.blendshapes(face.points)
            found += 1
        times.append(time.process_time() - begun)
    return quiet(times), found / len(times)


def figures(command: list[str], folder: Path) -> list[float] | None:
    """What a process prints after ``figures``; None where it fails."""
    alone = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False, env={**os.environ, **alone}
    )
    lines = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("figures")]
    return json.loads(f"[{', '.join(lines[0])}]") if lines else None
