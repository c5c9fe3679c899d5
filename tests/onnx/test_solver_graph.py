"""The fixed-step graph is the solve, and ONNX Runtime computes the graph."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Mesh, __version__
from torchface.capture import MarkerSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.onnx import SolverGraph, export_solver
from torchface.onnx.solver_graph_export import hide_markers, random_frames
from torchface.onnx.solver_model import solver_model


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    """A sheet of 12 × 12 vertices, 110 mm wide, with 10 bumps of very different size that overlap."""
    line = torch.linspace(-55, 55, 12)
    x, y = torch.meshgrid(line, line, indexing="xy")
    vertices = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    corner = (torch.arange(11)[:, None] * 12 + torch.arange(11)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, 1, 13]), corner + torch.tensor([0, 13, 12])])
    generator = torch.Generator().manual_seed(0)
    centers = vertices[torch.randperm(144, generator=generator)[:10]]
    directions = torch.nn.functional.normalize(torch.randn(10, 1, 3, generator=generator), dim=-1)
    size = torch.logspace(0, 1.3, 10)[:, None, None]
    near = torch.exp(-torch.cdist(centers, vertices).square() / (2 * 20.0**2))
    return BlendshapeRig(Mesh(vertices, faces), near[..., None] * directions * size, [f"shape{i}" for i in range(10)])


@pytest.fixture(scope="module")
def attachment(rig: BlendshapeRig) -> Attachment:
    return Attachment.from_vertices(rig.neutral, range(0, 144, 4), [f"m{i}" for i in range(36)])


def turned() -> Similarity:
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(6)))[0]
    rotation = rotation * torch.linalg.det(rotation).sign()
    return Similarity(torch.tensor([0.8]), rotation[None], torch.tensor([[10.0, -20.0, 300.0]]))


def session(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def run(path: Path, markers: Tensor, previous: Tensor) -> Tensor:
    (weights,) = session(path).run(["weights"], {"markers": markers.numpy(), "previous": previous.numpy()})
    return torch.from_numpy(np.asarray(weights))


@pytest.mark.parametrize("alignment", [None, turned()])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_many_steps_are_the_exact_solve(
    rig: BlendshapeRig, attachment: Attachment, alignment: Similarity | None, share: float
) -> None:
    solver = MarkerSolver(rig, attachment, alignment).double()
    markers = hide_markers(random_frames(MarkerSolver(rig, attachment, alignment), 40), share).double()
    graph = SolverGraph(solver, steps=1500, steps_with_gaps=1500)
    start = torch.rand(40, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    # An alignment is orthonormal only to float32, which shapes that hardly move the markers feel.
    close = 1e-6 if alignment is None else 1e-4
    torch.testing.assert_close(graph(markers, start), solver(markers), rtol=0, atol=close)


def test_a_frame_without_markers_keeps_the_weights_before(rig: BlendshapeRig, attachment: Attachment) -> None:
    solver = MarkerSolver(rig, attachment)
    markers = random_frames(solver, 3)
    markers[1] = torch.nan
    before = torch.rand(3, 10, generator=torch.Generator().manual_seed(0))
    held = SolverGraph(solver)(markers, before)
    torch.testing.assert_close(held[1], before[1], rtol=0, atol=1e-5)


def test_the_file_is_the_graph(rig: BlendshapeRig, attachment: Attachment, tmp_path: Path) -> None:
    path = tmp_path / "solver.onnx"
    report = export_solver(rig, attachment, path, turned())
    assert [gap.missing for gap in report.gaps] == [0.0, 0.1, 0.3]
    assert max(gap.parity for gap in report.gaps) <= 1e-5
    assert max(gap.worst for gap in report.gaps) <= 1e-5
    assert report.size == path.stat().st_size
    assert "30% missing" in str(report)
    assert list(tmp_path.iterdir()) == [path]

    solver = MarkerSolver(rig, attachment, turned())
    graph = SolverGraph(solver, report.steps, report.steps_with_gaps, report.rho)
    markers = random_frames(solver, 20, seed=5)
    markers[3, 7] = torch.nan
    previous = torch.rand(20, 10, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(run(path, markers, previous), graph(markers, previous), rtol=0, atol=1e-5)
    # One by one the frames without gaps go through the other branch, to the same weights.
    alone = torch.cat([run(path, markers[i : i + 1], previous[i : i + 1]) for i in range(20)])
    exact = solver.double()
    energy = exact.energy(markers.double())
    least = energy.value(exact(markers.double()))
    assert ((energy.value(alone.double()) - least) / least).max() <= 1e-5


def test_the_metadata_says_what_goes_in_and_out(rig: BlendshapeRig, attachment: Attachment, tmp_path: Path) -> None:
    path = tmp_path / "solver.onnx"
    export_solver(rig, attachment, path)
    loaded = session(path)
    assert {i.name: i.shape for i in loaded.get_inputs()} == {"markers": ["batch", 36, 3], "previous": ["batch", 10]}
    assert [o.name for o in loaded.get_outputs()] == ["weights"]
    metadata = loaded.get_modelmeta().custom_metadata_map
    assert tuple(json.loads(metadata["shape_names"])) == rig.names
    assert tuple(json.loads(metadata["marker_labels"])) == attachment.labels
    assert metadata["units"] == "millimetres"
    assert metadata["version"] == __version__
    model = onnx.load(path)
    assert {opset.domain for opset in model.opset_import} == {""}


def test_a_graph_that_disagrees_is_not_written(
    rig: BlendshapeRig, attachment: Attachment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = solver_model(SolverGraph(MarkerSolver(rig, attachment, sparsity=0.031)))
    monkeypatch.setattr("torchface.onnx.solver_graph_export.solver_model", lambda graph, facts: other)
    with pytest.raises(ValueRangeError, match="ONNX Runtime differs from PyTorch"):
        export_solver(rig, attachment, tmp_path / "solver.onnx")
    assert not list(tmp_path.iterdir())


def test_inputs_of_another_shape_are_refused(rig: BlendshapeRig, attachment: Attachment) -> None:
    graph = SolverGraph(MarkerSolver(rig, attachment))
    with pytest.raises(ShapeError, match=r"expected \(B,36,3\) and \(B,10\)"):
        graph(torch.zeros(2, 36, 3), torch.zeros(1, 10))
