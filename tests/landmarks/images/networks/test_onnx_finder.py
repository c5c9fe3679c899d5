"""A graph of the agreed signature finds landmarks in turned crops; one of another signature is told what it has."""

import json
import math
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.networks import graph_process
from torchface.landmarks.images.networks.onnx_finder import GraphLimits, onnx_finder
from torchface.workflows.named_finders import load_finder

S = 16
POINTS = np.stack([np.linspace(0, 15, 68), np.linspace(3, 12, 68)], 1).astype(np.float32)


def graph(path: Path, crop: str | None = None, landmarks: int = 68, inputs: str = "image", size: int | str = S) -> Path:
    """Landmarks where POINTS are, deviation 0.256 pixels, and the mean of red as visibility and presence."""
    constants = {"points": POINTS[None, :landmarks], "deviations": np.full((1, landmarks), 0.256, np.float32)}
    nodes = [
        helper.make_node("Gather", [inputs, "zero"], ["red"], axis=1),
        helper.make_node("ReduceMean", ["red"], ["presence"], axes=[1, 2], keepdims=0),
        helper.make_node("Reshape", ["presence", "column"], ["level"]),
        helper.make_node("Mul", ["level", "nothing"], ["silent"]),
        helper.make_node("Add", ["silent", "deviations"], ["deviation"]),
        helper.make_node("Sub", ["level", "silent"], ["one"]),
        helper.make_node("Add", ["one", "nothing_each"], ["visibility"]),
        helper.make_node("Reshape", ["silent", "cube"], ["shift"]),
        helper.make_node("Add", ["shift", "points"], ["landmarks"]),
    ]
    constants |= {"nothing": np.zeros(1, np.float32), "nothing_each": np.zeros((1, landmarks), np.float32)}
    whole = {"zero": np.array(0), "column": np.array([-1, 1]), "cube": np.array([-1, 1, 1])}
    made = helper.make_graph(
        nodes,
        "stand-in",
        [helper.make_tensor_value_info(inputs, TensorProto.FLOAT, ["B", 3, size, size])],
        [
            helper.make_tensor_value_info("landmarks", TensorProto.FLOAT, ["B", landmarks, 2]),
            *(
                helper.make_tensor_value_info(n, TensorProto.FLOAT, ["B", landmarks])
                for n in ("deviation", "visibility")
            ),
            helper.make_tensor_value_info("presence", TensorProto.FLOAT, ["B"]),
        ],
        [numpy_helper.from_array(value, name) for name, value in (constants | whole).items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if crop is not None:
        helper.set_model_props(model, {"crop": crop})
    onnx.save(model, path)
    return path


def test_landmarks_come_back_from_the_turned_crop(tmp_path: Path) -> None:
    finder = load_finder(graph(tmp_path / "net.onnx", "2.0")).finder
    image = torch.zeros(3, 60, 80, dtype=torch.uint8)
    image[0] = 51
    for tilt in (0.0, 0.6, -2.5):
        found = finder(image, torch.tensor([30.0, 20.0, 8.0, 8.0]), tilt)
        cos, sin = math.cos(tilt), math.sin(tilt)
        ahead = torch.from_numpy(POINTS) - 7.5  # a crop of twice eight pixels: one to one
        expected = torch.tensor([34.0, 24.0]) + ahead @ torch.tensor([[cos, sin], [-sin, cos]])
        torch.testing.assert_close(found.landmarks, expected, atol=1e-4, rtol=0)
        assert found.presence == pytest.approx(0.2, abs=1e-6)
        torch.testing.assert_close(found.visibility, torch.full((68,), 0.2))
        torch.testing.assert_close(found.confidence, torch.full((68,), 1 / (1 + (0.032 / 0.02) ** 2)))
    usual = onnx_finder(graph(tmp_path / "usual.onnx"))
    assert (usual.size, usual.margin, usual.name) == (16, 1.25, "usual.onnx")


def test_a_crop_shows_what_lies_there() -> None:
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    image = (x / 2 + y).round().to(torch.uint8)
    for side, tilt in ((60.0, 0.0), (60.0, 0.5), (9.0, -1.0), (30.0, 2.5)):
        transform = crop_transform(torch.tensor([60.0, 40.0, side, side]), tilt, 24)
        row, column = torch.meshgrid(torch.arange(24.0), torch.arange(24.0), indexing="ij")
        at = from_crop(torch.stack([column, row], -1), transform)
        crop = cut_crop(image, transform, 24).float()
        inside = ((at >= 2) & (at <= at.new_tensor([157.0, 117.0]))).all(-1)
        assert (crop - (at[..., 0] / 2 + at[..., 1]))[:, inside].abs().max() < 1.6
        assert (crop[0] == crop[2]).all()
    noise = torch.randint(0, 256, (3, 120, 160), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    coarse = cut_crop(noise, crop_transform(torch.tensor([20.0, 0.0, 96.0, 96.0]), 0.0, 12), 12).float()
    assert coarse.std() < 12  # the mean over 100 pixels each, not one of them
    with pytest.raises(ValueRangeError, match="box"):
        crop_transform(torch.full((4,), torch.nan), 0.0, 16)
    with pytest.raises(ShapeError, match="box"):
        crop_transform(torch.zeros(3), 0.0, 16)


def test_other_graphs_are_told_what_they_have(tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    cases = [
        (lambda: graph(path, landmarks=5), r"outputs landmarks \(B,5,2\).*expected an input image .*\(B,68,2\)"),
        (lambda: graph(path, inputs="pixels"), r"found inputs pixels \(B,3,16,16\) tensor\(float\)"),
        (lambda: graph(path, size="S"), "crops of 'S' pixels, expected a fixed 16 to 1024"),
        (lambda: graph(path, "40"), "the metadata crop '40', expected a number from 0.5 to 4"),
        (lambda: graph(path, "wide"), "the metadata crop 'wide'"),
        (lambda: path.write_bytes(b"no graph at all"), "cannot be used as an ONNX graph"),
        (lambda: path.write_bytes(b""), "found an empty file"),
    ]
    for make, message in cases:
        make()
        with pytest.raises(FileFormatError, match=message):
            onnx_finder(path)


def hostile(path: Path, grown: int, loops: bool) -> Path:
    """A graph of the right signature whose visibility is gathered from so many numbers, or that never ends."""
    info, F, I = helper.make_tensor_value_info, TensorProto.FLOAT, TensorProto.INT64
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["goes_on"]), helper.make_node("Sin", ["x"], ["y"])],
        "body",
        [info("i", I, []), info("go", TensorProto.BOOL, []), info("x", F, None)],
        [info("goes_on", TensorProto.BOOL, []), info("y", F, None)],
    )
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["presence"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Reshape", ["presence", "one"], ["level"]),
        helper.make_node("Loop", ["", "always", "level"], ["level_after"], body=body)
        if loops
        else helper.make_node("Identity", ["level"], ["level_after"]),
        helper.make_node("Expand", ["level_after", "many"], ["grown"]),
        helper.make_node("Sin", ["grown"], ["waves"]),
        helper.make_node("Slice", ["waves", "from", "to"], ["some"]),
        helper.make_node("Reshape", ["some", "row"], ["visibility"]),
        helper.make_node("Identity", ["visibility"], ["deviation"]),
        helper.make_node("Reshape", ["visibility", "cube"], ["visibility_column"]),
        helper.make_node("Add", ["visibility_column", "points"], ["landmarks"]),
    ]
    values = {"one": [1], "many": [grown], "from": [0], "to": [68], "row": [1, 68], "cube": [1, 68, 1]}
    constants = [numpy_helper.from_array(np.array(value), name) for name, value in values.items()]
    constants += [numpy_helper.from_array(POINTS[None], "points"), numpy_helper.from_array(np.array(True), "always")]
    outputs = {"landmarks": [1, 68, 2], "deviation": [1, 68], "visibility": [1, 68], "presence": [1]}
    made = helper.make_graph(
        nodes,
        "hostile",
        [info("image", F, [1, 3, S, S])],
        [info(name, F, shape) for name, shape in outputs.items()],
        constants,
    )
    onnx.save(helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def test_a_graph_that_takes_too_much_is_ended(tmp_path: Path) -> None:
    """Gigabytes, or a loop without an end; the same graph of a usual size is used."""
    harmless = onnx_finder(hostile(tmp_path / "small.onnx", 100, loops=False))
    assert harmless.network(torch.full((1, 3, S, S), 0.5))[2].shape == (1, 68)
    if sys.platform == "linux":
        with pytest.raises(FileFormatError, match=r"large.onnx: .*(cannot be run|ended with|memory)"):
            onnx_finder(hostile(tmp_path / "large.onnx", 2**29, loops=False), GraphLimits(megabytes=512))
    begin = time.perf_counter()
    with pytest.raises(FileFormatError, match=r"loop.onnx: the graph, .* gave no answer in 1.5 seconds"):
        onnx_finder(hostile(tmp_path / "loop.onnx", 100, loops=True), GraphLimits(load_seconds=1.5))
    assert time.perf_counter() - begin < 10


def test_a_graph_that_never_ends_ends_with_its_parent(tmp_path: Path) -> None:
    """Killed, the parent cannot end what runs the graph: it ends where its input does."""
    graph = hostile(tmp_path / "loop.onnx", 100, loops=True).read_bytes()
    crop = graph_process.packed(np.full((1, 3, S, S), 0.5, np.float32))
    command = [sys.executable, "-I", graph_process.__file__, "512"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdin.write(b"".join(struct.pack("<Q", len(one)) + one for one in (graph, crop)))
        process.stdin.flush()
        (count,) = struct.unpack("<I", process.stdout.read(4))
        assert json.loads(process.stdout.read(count))["inputs"] == [["image", [1, 3, S, S], "tensor(float)"]]
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.3)
        process.stdin.close()
        assert process.wait(30) == 0
