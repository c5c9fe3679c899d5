"""Learned models as ONNX graphs: ONNX Runtime computes what the models do, at any batch size."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from torchface import BlendshapeRig, zoo
from torchface.cli import main
from torchface.errors import ValueRangeError
from torchface.landmarks import DetectorSettings, UVLandmarkDetector
from torchface.landmarks.scans.hog import HogLayout
from torchface.modeling import ExpressionRegression, ExpressionSettings, HeadModel, MorphableModel
from torchface.onnx import export_model
from torchface.onnx.checked_export import write_checked
from torchface.onnx.uv_landmark_graph import LandmarkBank, export_landmark_bank

FACTS = {"licence": "MIT", "data": "noise", "metrics": {"error": 1.5}, "recipe": "none"}
SIZE = 160
MODELS = Path(__file__).resolve().parents[2] / "models"


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def run(path: Path, inputs: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, str]]:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    found = session.run(names, {name: value.numpy() for name, value in inputs.items()})
    tensors = {name: torch.from_numpy(np.asarray(value)) for name, value in zip(names, found, strict=True)}
    return tensors, session.get_modelmeta().custom_metadata_map


@pytest.fixture(scope="module")
def head(dome_rig: BlendshapeRig) -> HeadModel:
    vertices = dome_rig.vertices
    colors = torch.rand(6, *vertices.shape, generator=torch.Generator().manual_seed(1))
    return HeadModel.on(
        dome_rig.neutral, MorphableModel.fit(vertices + noise(6, *vertices.shape)), MorphableModel.fit(colors)
    )


@pytest.fixture(scope="module")
def regression(dome_rig: BlendshapeRig) -> ExpressionRegression:
    neutrals = dome_rig.vertices + noise(8, *dome_rig.vertices.shape)
    moved = dome_rig.deltas * (1 + 0.3 * noise(8, 4, 1, 1, seed=2))
    return ExpressionRegression.fit(neutrals, neutrals[:, None] + moved, names=dome_rig.names)


def pictures(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Cloudy pictures (M,1,S,S) with a cross and a ring, and where these are, (M,2,2)."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 1, 10, 10, generator=generator)
    images = 0.6 + 0.1 * nn.functional.interpolate(coarse, size=(SIZE, SIZE), mode="bicubic")
    places = torch.tensor([[50.0, 60.0], [105.0, 90.0]]) + 4 * torch.randn(count, 2, 2, generator=generator)
    grid = torch.stack(torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="xy"), -1)
    across, down = (grid - places[:, 0, None, None]).unbind(-1)
    near = torch.exp(-(((across**2 + down**2) / 14**2) ** 4))
    images[:, 0] -= 0.4 * near * (torch.exp(-((across / 2) ** 2)) + torch.exp(-((down / 2) ** 2))).clamp(max=1)
    away = (grid - places[:, 1, None, None]).norm(dim=-1)
    images[:, 0] -= 0.4 * torch.exp(-(((away - 8) / 2) ** 2))
    return images, places


@pytest.fixture(scope="module")
def detector() -> UVLandmarkDetector:
    images, places = pictures(6, 0)
    settings = DetectorSettings(hog=HogLayout(stride=4), responses=50)
    return UVLandmarkDetector.fit(images, places, ("cross", "ring"), "curvature", settings)


def test_a_head_is_decoded(head: HeadModel, tmp_path: Path) -> None:
    report = export_model(head, tmp_path / "head.onnx", FACTS)
    assert "ONNX Runtime against PyTorch" in str(report)
    shape, color = noise(7, 5, seed=3), noise(7, 5, seed=4)
    found, metadata = run(tmp_path / "head.onnx", {"shape": shape, "color": color})
    heads = head(shape, color)
    torch.testing.assert_close(found["vertices"], heads.vertices, rtol=0, atol=1e-3)
    torch.testing.assert_close(found["colors"], heads.colors.clamp(0, 1), rtol=0, atol=1e-5)
    assert torch.equal(torch.tensor(json.loads(metadata["triangles"])), head.faces)
    assert (metadata["units"], metadata["licence"]) == ("millimetres", "MIT")


def exported_by_command(model: nn.Module, folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """The file that the command makes of a model's folder, and says where it lies."""
    card = zoo.ModelCard("MIT", "noise", {"error": 1.5}, "none")
    zoo.save_model(model, folder / "model", card)
    out = folder / "model.onnx"
    main(["export", str(folder / "model"), "--out", str(out), "--quiet"])
    assert str(out) in capsys.readouterr().out.replace("\n", "")
    metadata = onnxruntime.InferenceSession(out).get_modelmeta().custom_metadata_map
    assert metadata["sha256"] == zoo.describe(folder / "model").sha256
    assert (metadata["data"], metadata["licence"]) == ("noise", "MIT")
    return out


@pytest.mark.bench  # tests/modules exports the module to a graph of PyTorch's
def test_offsets_come_with_any_pose(
    regression: ExpressionRegression, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = exported_by_command(regression, tmp_path, capsys)
    turn = torch.linalg.qr(noise(5, 3, 3, seed=7))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None]
    neutrals = (regression.neutral_mean + noise(5, *regression.neutral_mean.shape, seed=5)) @ turn + 80.0
    found, metadata = run(path, {"neutrals": neutrals})
    torch.testing.assert_close(found["offsets"], regression.offsets(neutrals.double()).float(), rtol=0, atol=1e-3)
    still = regression.offsets(neutrals).abs().amax((0, 1, 3)) == 0
    assert still.any()
    assert (found["offsets"][:, :, still] == 0).all()
    assert metadata["task"] == "expression_regression"
    assert tuple(json.loads(metadata["shape_names"])) == regression.names
    assert json.loads(metadata["metrics"]) == {"error": 1.5}


@pytest.mark.bench  # torch.export takes seven seconds
def test_the_bank_finds_what_the_detector_finds(detector: UVLandmarkDetector, tmp_path: Path) -> None:
    images, places = pictures(5, 9)
    export_landmark_bank(detector, tmp_path / "uv.onnx", FACTS, images[:2])
    found, metadata = run(tmp_path / "uv.onnx", {"images": images})
    pixels, confidence = LandmarkBank(detector)(images)
    torch.testing.assert_close(found["pixels"], pixels, rtol=0, atol=0.1)
    torch.testing.assert_close(found["confidence"], confidence, rtol=0, atol=0.01)
    exact = detector(images)
    assert (pixels - exact.pixels).norm(dim=-1).max() < 2.0
    assert (found["pixels"] - places).norm(dim=-1).mean() < 3.0
    assert (detector.prior_mean - places).norm(dim=-1).mean() > 4.0
    assert metadata["task"] == "uv_landmarks"
    assert json.loads(metadata["landmark_names"]) == ["cross", "ring"]
    nothing, _ = run(tmp_path / "uv.onnx", {"images": torch.full((1, 1, SIZE, SIZE), 0.5)})
    torch.testing.assert_close(nothing["pixels"][0], detector.prior_mean, rtol=0, atol=12)


def test_the_command_exports_models_of_a_folder(
    head: HeadModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, metadata = run(exported_by_command(head, tmp_path, capsys), {"shape": noise(1, 5), "color": noise(1, 5)})
    assert metadata["task"] == "head_decoder"
    with pytest.raises(SystemExit):
        main(["export", "nobody", "--out", str(tmp_path / "x.onnx"), "--quiet"])
    assert not (tmp_path / "x.onnx").exists()


def test_what_has_no_graph_is_named(regression: ExpressionRegression, dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    with pytest.raises(ValueRangeError, match=r"found no graph for Linear.*export enhancement"):
        export_model(nn.Linear(2, 2), tmp_path / "x.onnx")
    neutrals = dome_rig.vertices + noise(4, *dome_rig.vertices.shape)
    whole = ExpressionRegression.fit(
        neutrals, neutrals[:, None] + dome_rig.deltas, ExpressionSettings(form="expressions")
    )
    with pytest.raises(ValueRangeError, match="form 'expressions'"):
        export_model(whole, tmp_path / "x.onnx")
    assert not (tmp_path / "x.onnx").exists()


def test_infinite_deviations_agree_and_others_are_a_gap(tmp_path: Path) -> None:
    tensor = onnx.helper.make_tensor_value_info
    values = [tensor(name, onnx.TensorProto.FLOAT, (2,)) for name in ("x", "y")]
    node = onnx.helper.make_node("Identity", ["x"], ["y"])
    graph = onnx.helper.make_graph([node], "same", values[:1], values[1:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=9)
    x, units = {"x": torch.tensor([torch.inf, 2.0])}, {"y": "pixels"}
    report = write_checked(model, tmp_path / "same.onnx", [(x, {"y": x["x"]})], {"y": 1e-3}, units)
    assert report.parity == {"y": 0.0}
    with pytest.raises(ValueRangeError, match="differ from PyTorch's by"):
        write_checked(model, tmp_path / "x.onnx", [(x, {"y": torch.tensor([9.0, 2.0])})], {"y": 1e-3}, units)
    assert not (tmp_path / "x.onnx").exists()


@pytest.mark.bench
@pytest.mark.parametrize("name", [path.parent.name for path in sorted(MODELS.glob("*/model.toml"))])
def test_every_shipped_model_is_exported(name: str, tmp_path: Path) -> None:
    assert export_model(zoo.get_model(MODELS / name), tmp_path / "it.onnx").path.stat().st_size > 1000
