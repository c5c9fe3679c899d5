"""The video solve's graph recovers what was planted, frame after frame, and ONNX Runtime computes the graph."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from torchface import BlendshapeRig, Corrective, Correctives, __version__, save_rig
from torchface.capture import DynamicsPrior, DynamicsSettings, ShapePrior, VideoSolver
from torchface.capture.own_rig import VideoSettings
from torchface.capture.priors import ParzenDensity
from torchface.cli import main
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io import save_calibration
from torchface.onnx import VideoGraph, VideoReport, export_video_solver
from torchface.onnx import video_graph_export as video_export
from torchface.onnx.exported_model import exported_model
from torchface.onnx.unrolled_operators import TRANSLATIONS
from torchface.onnx.video_graph_export import synthetic_landmarks
from torchface.optim.exported_operators import symmetric_inverse
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = CameraCalibration(K, torch.zeros(5, dtype=torch.float64), 640, 480, None)
SEEN = ("jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "eyeBlinkLeft", "mouthLeft")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    """The performer with a few shapes that landmarks show well."""
    return performer(texture=False).select(SEEN)


@pytest.fixture(scope="module")
def takes(rig: BlendshapeRig) -> list[Tensor]:
    return [synthetic_landmarks(VideoSolver(rig, None, K), 200, seed)[0] for seed in (1, 2)]


@pytest.fixture(scope="module")
def dynamics(takes: list[Tensor]) -> DynamicsPrior:
    return DynamicsPrior.fit(takes, SEEN, 3, settings=DynamicsSettings(inducing=20, subset=100, iterations=2))


@pytest.fixture(scope="module")
def written(
    rig: BlendshapeRig, takes: list[Tensor], dynamics: DynamicsPrior, tmp_path_factory: pytest.TempPathFactory
) -> VideoReport:
    path = tmp_path_factory.mktemp("graph") / "video_solver.onnx"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(video_export, "FRAMES", 40)
        return export_video_solver(rig, CAMERA, path, ShapePrior.fit(takes, SEEN), dynamics, facts={"licence": "MIT"})


def played(graph: VideoGraph, landmarks: Tensor, trust: Tensor | None = None) -> list[dict[str, Tensor]]:
    """Every frame's outputs, each from the state that the one before handed on."""
    state, found = graph.start(), []
    for marks, sure in zip(landmarks, torch.ones(landmarks.shape[:2]) if trust is None else trust, strict=True):
        with torch.no_grad():
            outputs = dict(zip(graph.outputs, graph(marks, sure, *state), strict=True))
        state = tuple(outputs[name] for name in graph.state)
        found.append(outputs)
    return found


class Inverse(nn.Module):
    def forward(self, matrix: Tensor) -> Tensor:
        return symmetric_inverse(matrix)


def test_the_operator_of_the_graph_inverts(tmp_path: Path) -> None:
    rows = torch.randn(9, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows = rows * torch.logspace(-2, 2, 6, dtype=torch.float64)
    matrix = rows.T @ rows
    model = exported_model(Inverse(), {"matrix": matrix}, ["inverse"], {}, translations=TRANSLATIONS)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"matrix": matrix.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), torch.linalg.inv(matrix), rtol=1e-9, atol=0)
    torch.testing.assert_close(symmetric_inverse(matrix), torch.linalg.inv(matrix), rtol=1e-9, atol=0)


@pytest.mark.parametrize("remembers", [False, True])
def test_planted_weights_are_recovered_frame_after_frame(
    rig: BlendshapeRig, dynamics: DynamicsPrior, remembers: bool
) -> None:
    """From no more than landmarks: the first frame's pose is found too, and missing landmarks are skipped."""
    memory = dynamics if remembers else None
    settings = VideoSettings(sparsity=0.0, ridge=1e-9, pixel_noise=0.01, steps=6)
    solver = VideoSolver(rig, None, K, None, memory, settings)
    weights, landmarks = synthetic_landmarks(solver, 30)
    assert bool(torch.isnan(landmarks).any())
    found = torch.stack([frame["weights"] for frame in played(VideoGraph(solver), landmarks)])
    assert float((found - weights).square().mean().sqrt()) < 2e-3
    assert float((found - weights).abs().max()) < 0.02


def test_it_is_the_exact_solve_and_its_memory(rig: BlendshapeRig, takes: list[Tensor], dynamics: DynamicsPrior) -> None:
    """With steps enough, weights, pose and covariance are those of ``VideoSolver`` after many frames."""
    solver = VideoSolver(rig, None, K, ShapePrior.fit(takes, SEEN), dynamics, VideoSettings(tolerance=1e-8))
    _, landmarks = synthetic_landmarks(solver, 12)
    landmarks[5] = torch.nan
    states, _ = solver.states(landmarks)
    for frame, state in zip(played(VideoGraph(solver), landmarks), states, strict=True):
        torch.testing.assert_close(frame["weights"].double(), state.weights, atol=1e-4, rtol=0)
        torch.testing.assert_close(frame["rotation"].double(), state.rotation, atol=1e-4, rtol=0)
        torch.testing.assert_close(frame["translation"].double(), state.translation, atol=2e-2, rtol=0)
        spread = state.estimate.covariance[0]
        size = spread.diagonal().sqrt()
        torch.testing.assert_close(
            frame["covariance"] / size / size[:, None], spread / size / size[:, None], atol=1e-3, rtol=0
        )


def test_without_a_dynamics_prior_it_walks_as_the_exact_solve_does(rig: BlendshapeRig, takes: list[Tensor]) -> None:
    """Hidden shapes keep their weights, then rest, and so does a face that is lost."""
    settings = VideoSettings(motion=0.3, interval=0.1, tolerance=1e-8)
    solver = VideoSolver(rig, None, K, ShapePrior.fit(takes, SEEN), settings=settings)
    _, landmarks = synthetic_landmarks(solver, 14)
    landmarks[2:8, 48:] = torch.nan
    landmarks[10:] = torch.nan
    states, _ = solver.states(landmarks)
    for frame, state in zip(played(VideoGraph(solver), landmarks), states, strict=True):
        torch.testing.assert_close(frame["weights"].double(), state.weights, atol=1e-4, rtol=0)
        torch.testing.assert_close(frame["hidden"].double(), state.hidden[0], atol=1e-6, rtol=0)
    assert float(states[-1].weights.max()) < float(states[9].weights.max())


@pytest.mark.bench  # torch.export takes twenty seconds; the module is tried above
def test_the_file_is_the_graph(written: VideoReport) -> None:
    assert written.frames == 40
    assert written.parity <= 1e-4
    assert written.gap < 0.01
    assert abs(written.error - written.exact_error) < 2e-3
    assert written.size == written.path.stat().st_size
    assert list(written.path.parent.iterdir()) == [written.path]
    assert "against the exact solve over 40 frames" in str(written)


def test_landmarks_that_are_not_trusted_are_no_face(rig: BlendshapeRig, takes: list[Tensor]) -> None:
    """A filter carries them on after a face was lost; nor does a first frame of such landmarks hand on a state."""
    solver = VideoSolver(rig, None, K, ShapePrior.fit(takes, SEEN), settings=VideoSettings(motion=0.3, tolerance=1e-8))
    _, landmarks = synthetic_landmarks(solver, 8)
    sure = torch.ones(8, 68)
    sure[0], sure[4:6] = 0.0, torch.tensor([[0.0], [torch.nan]])
    found = played(VideoGraph(solver), landmarks, sure)
    states, _ = solver.states(landmarks[1:], confidence=sure[1:].nan_to_num(0.0))
    assert not found[0]["weights"].any()
    for frame, state in zip(found[1:], states, strict=True):
        torch.testing.assert_close(frame["weights"].double(), state.weights, atol=1e-4, rtol=0)


def test_an_infinite_landmark_is_one_that_is_not_seen(rig: BlendshapeRig) -> None:
    solver = VideoSolver(rig, None, K)
    _, landmarks = synthetic_landmarks(solver, 3)
    lost, infinite = landmarks.clone(), landmarks.clone()
    lost[1, 30], infinite[1, 30] = torch.nan, torch.tensor([torch.inf, 200.0])
    for one, other in zip(played(VideoGraph(solver), infinite), played(VideoGraph(solver), lost), strict=True):
        assert bool(one["weights"].isfinite().all())
        assert all(torch.equal(one[name], other[name]) for name in one)


def corrective_rig(rig: BlendshapeRig) -> BlendshapeRig:
    definitions = (Corrective("open_smile", ("jawOpen", "mouthSmileLeft")), Corrective("open_half", ("jawOpen",), 0.5))
    deltas = 0.4 * rig.deltas[rig.index(["mouthSmileLeft", "jawOpen"])].roll(1, 2)
    return BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(deltas, definitions))


def test_a_graph_with_correctives_is_the_solve(rig: BlendshapeRig) -> None:
    solver = VideoSolver(corrective_rig(rig), None, K, settings=VideoSettings(tolerance=1e-8))
    _, landmarks = synthetic_landmarks(solver, 4)
    states, _ = solver.states(landmarks)
    for frame, state in zip(played(VideoGraph(solver), landmarks), states, strict=True):
        torch.testing.assert_close(frame["weights"].double(), state.weights, atol=1e-4, rtol=0)


@pytest.mark.bench
def test_a_file_with_correctives_is_the_graph(rig: BlendshapeRig, tmp_path: Path) -> None:
    assert export_video_solver(corrective_rig(rig), CAMERA, tmp_path / "video_solver.onnx").parity < 1e-5


@pytest.mark.bench
def test_the_metadata_says_what_goes_in_and_out(written: VideoReport, rig: BlendshapeRig) -> None:
    session = onnxruntime.InferenceSession(written.path, providers=["CPUExecutionProvider"])
    count = len(SEEN)
    assert {i.name: i.shape for i in session.get_inputs()} == {
        "landmarks": [68, 2],
        "confidence": [68],
        "previous_rotation": [3, 3],
        "previous_translation": [3],
        "previous_window": [3, count],
        "previous_mean": [count + 6],
        "previous_covariance": [count + 6, count + 6],
    }
    assert [o.name for o in session.get_outputs()] == [
        *("weights", "rotation", "translation", "window", "mean", "covariance")
    ]
    metadata = session.get_modelmeta().custom_metadata_map
    assert metadata["task"] == "video_solver"
    assert tuple(json.loads(metadata["shape_names"])) == rig.names
    assert json.loads(metadata["intrinsics"]) == K.tolist()
    assert json.loads(metadata["width"]) == 640
    assert metadata["version"] == __version__
    assert metadata["licence"] == "MIT"
    assert {opset.domain for opset in onnx.load(written.path).opset_import} == {""}


@pytest.mark.bench
@pytest.mark.parametrize("kind", ["few", "zeros", "a place", "a line"])
def test_without_a_face_nothing_begins(written: VideoReport, rig: BlendshapeRig, kind: str) -> None:
    """Frames before the first face hand on no state; the file then begins as if they had not been."""
    session = onnxruntime.InferenceSession(written.path, providers=["CPUExecutionProvider"])
    names = [o.name for o in session.get_outputs()]
    none = {i.name: np.full(i.shape, np.nan, np.float32) for i in session.get_inputs() if i.name[:9] == "previous_"}
    trust = np.ones(68, np.float32)
    _, landmarks = synthetic_landmarks(VideoSolver(rig, None, K), 2, seed=3)
    empty = np.full((68, 2), np.nan, np.float32)
    empty[:5] = landmarks[0, :5].nan_to_num(100.0)
    if kind != "few":
        empty[:] = 0.0 if kind == "zeros" else 123.0
    if kind == "a line":
        empty[:, 0] += np.arange(68)
    first = dict(zip(names, session.run(names, {"landmarks": empty, "confidence": trust, **none}), strict=True))
    assert np.isnan(first["rotation"]).all()
    assert np.isnan(first["translation"]).all()
    assert (first["weights"] == 0).all()
    handed = {name: first[name[9:]] for name in none}
    marks = {"landmarks": landmarks[1].numpy(), "confidence": trust}
    for one, other in zip(session.run(names, {**marks, **none}), session.run(names, {**marks, **handed}), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.bench
def test_a_graph_that_differs_is_not_written(
    written: VideoReport,
    rig: BlendshapeRig,
    dynamics: DynamicsPrior,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The file of a solver with a prior is no solver without one."""
    monkeypatch.setattr(video_export, "exported_model", lambda *_, **__: onnx.load(written.path))
    monkeypatch.setattr(video_export, "FRAMES", 3)
    with pytest.raises(ValueRangeError, match="differ from PyTorch's"):
        export_video_solver(rig, CAMERA, tmp_path / "solver.onnx", dynamics=dynamics)
    assert not list(tmp_path.iterdir())


def test_what_has_no_graph_is_refused(rig: BlendshapeRig) -> None:
    bells = ShapePrior(SEEN, [range(len(SEEN))], [ParzenDensity.fit(torch.rand(30, len(SEEN)))])
    with pytest.raises(ValueRangeError, match="expected one of Student's distributions"):
        VideoGraph(VideoSolver(rig, None, K, bells))
    with pytest.raises(ValueRangeError, match="pose_trust"):
        VideoGraph(VideoSolver(rig, None, K, settings=VideoSettings(pose_trust=1.0)))
    with pytest.raises(ShapeError, match=r"expected \(68,2\)"):
        VideoGraph(VideoSolver(rig, None, K))(torch.zeros(67, 2), torch.ones(68))


@pytest.mark.bench
def test_the_command_writes_a_solver_of_rig_and_camera(
    rig: BlendshapeRig, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video_export, "FRAMES", 3)
    save_rig(rig.select(SEEN[:2]), tmp_path / "rig.glb")
    save_calibration(CAMERA, tmp_path / "camera.toml")
    given = ["--rig", f"{tmp_path}/rig.glb", "--camera", f"{tmp_path}/camera.toml", "--out", f"{tmp_path}/out.onnx"]
    with pytest.raises(SystemExit) as refused:
        main(["export", "video-solver", *given, "--prior", "head", "--quiet"])
    assert refused.value.code == 2
    assert "expected a ShapePrior" in capsys.readouterr().err
    assert not (tmp_path / "out.onnx").exists()
    main(["export", "video-solver", *given, "--quiet"])
    assert capsys.readouterr().out.splitlines()[-1] == f"{tmp_path}/out.onnx"
    session = onnxruntime.InferenceSession(tmp_path / "out.onnx", providers=["CPUExecutionProvider"])
    assert [o.name for o in session.get_outputs()] == ["weights", "rotation", "translation", "hidden"]
