"""The recipe end to end on a handful of coarse scans, and what the detector then gives to registration."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from planted.scan_files import write_scans
from torchface import zoo
from torchface.errors import FileFormatError, TopologyError, TorchfaceError, ValueRangeError
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import Similarity
from torchface.io import load_mesh
from torchface.landmarks import (
    AutomaticLandmarks,
    DetectorSettings,
    UVLandmarkDetector,
    load_annotations,
    scan_landmarks,
)
from torchface.landmarks.scans.hog import HogLayout
from torchface.landmarks.scans.landmark_pairs import scan_pairs, template_features
from torchface.landmarks.scans.uv_landmark_names import LINES
from torchface.synthetic import draw_identities, neutral_head, performer
from torchface.synthetic.stages.scanner import Photography, ScannerSettings, eyes_closed
from train.scan_landmark_errors import landmark_errors
from train.uv_landmarks import Settings, Trained, train

pytest.importorskip("safetensors")
pytest.importorskip("tomli_w")

SIZE = 512
QUICK = DetectorSettings(hog=HogLayout(stride=4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scans")
    identities = draw_identities(4, torch.Generator().manual_seed(2), scale=0.7)
    settings = ScannerSettings(voxel=4.0, detail=4.0, photography=Photography(height=450))
    write_scans((eyes_closed(performer(identity)) for identity in identities), path, settings)
    return path


def settings(folder: Path, out: Path) -> Settings:
    return Settings(
        scans=folder, annotations=folder / "annotations.json", out=out, held_out=1, size=SIZE, detector=QUICK
    )


@pytest.fixture(scope="module")
def trained(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Trained, Path]:
    out = tmp_path_factory.mktemp("models") / "uv"
    return train(settings(folder, out)), out


@pytest.mark.bench
def test_landmarks_of_the_scan_held_out_are_found(trained: tuple[Trained, Path]) -> None:
    (errors,) = trained[0].errors
    assert errors.mean_pixels < 8 * SIZE / 512
    assert max(errors.lines.values()) < 4


@pytest.mark.bench
def test_the_model_on_disk_finds_the_same(trained: tuple[Trained, Path], folder: Path) -> None:
    result, out = trained
    assert {p.name for p in out.iterdir()} == {"model.toml", "state.safetensors", "CARD.md", "held_out.png"}
    again = zoo.get_model(out, UVLandmarkDetector)
    assert zoo.get_model(out).config == again.config
    described = zoo.describe(out)
    assert described.size < 2 * 2**20
    assert described.metrics["mean error, pixels"] == pytest.approx(result.errors[0].mean_pixels)
    assert described.recipe.startswith("torchface train uv_landmarks --scans")
    scan = load_mesh(folder / "scan_003.obj")
    found = scan_landmarks(again, scan)
    truth = load_annotations(folder / "annotations.json")["scan_003.obj"]
    assert torch.allclose(landmark_errors(found, scan, truth).pixels, result.errors[0].pixels, atol=1e-3)


@pytest.mark.bench
def test_pairs_lie_on_the_scan_near_the_truth(trained: tuple[Trained, Path], folder: Path) -> None:
    scan = load_mesh(folder / "scan_003.obj")
    truth = load_annotations(folder / "annotations.json")["scan_003.obj"]
    template = neutral_head(texture=False)
    pairs = scan_pairs(
        template_features(template, trained[0].detector), scan_landmarks(trained[0].detector, scan), scan
    )
    assert set(LINES) <= set(pairs.names)
    assert SurfaceIndex(scan.vertices, scan.faces).nearest(pairs.points).distance.max() < 3.0
    for name in LINES:
        rows = [i for i, label in enumerate(pairs.names) if label == name]
        assert len(rows) > 10
        away = torch.cdist(pairs.points[rows].double(), truth.lines[name]).amin(1)
        assert away.median() < 3.0
        # Template vertices and scan points run the same way along the line.
        across = template.vertices[pairs.vertices[rows], 0]
        along = (pairs.points[rows].double() - truth.lines[name][0]) @ (truth.lines[name][-1] - truth.lines[name][0])
        assert torch.corrcoef(torch.stack([across.double(), along]))[0, 1] > 0.97


@pytest.mark.bench
def test_registration_is_given_landmarks(trained: tuple[Trained, Path], folder: Path) -> None:
    template = neutral_head(texture=False)
    scan = load_mesh(folder / "scan_003.obj")
    closed = replace(template, annotations=replace(template.annotations, contacts=None))
    with pytest.raises(ValueRangeError, match="contact pairs"):
        template_features(closed)
    # The template has no texture: what is not annotated could not be detected on it, what is needs no texture.
    finder = AutomaticLandmarks(trained[0].detector, template)
    inverse = trained[0].detector.frame.locate(scan).inverse()
    own = trained[0].detector.frame.locate(template)
    rotation = inverse.rotation @ own.rotation
    translation = inverse.apply(own.translation[:, None])[:, 0]
    found = finder(template, scan, Similarity(inverse.scale * own.scale, rotation, translation))
    vertices, points = found
    assert vertices.dtype == torch.int64
    assert len(vertices) == len(points) > 60
    with pytest.raises(TopologyError, match="vertices"):
        finder(scan, scan, inverse)


@pytest.mark.bench
def test_a_detector_of_textures_refuses_a_scan_without(trained: tuple[Trained, Path], folder: Path) -> None:
    scan = replace(load_mesh(folder / "scan_000.obj"), texture=None, uvs=None, uv_faces=None)
    with pytest.raises(ValueRangeError, match="no texture"):
        scan_landmarks(trained[0].detector, scan)
    with pytest.raises(ValueRangeError, match="FaceFrame"):
        scan_landmarks(UVLandmarkDetector(2), scan)


def test_annotations_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    people = draw_identities(2, torch.Generator().manual_seed(2))
    coarse = ScannerSettings(voxel=8.0, detail=8.0, photography=Photography(height=120))
    write_scans((neutral_head(identity) for identity in people), folder, coarse)
    document = json.loads((folder / "annotations.json").read_text())
    one = dict(document, scans={"scan_000.obj": document["scans"]["scan_000.obj"]})
    (tmp_path / "one.json").write_text(json.dumps(one))
    with pytest.raises(TorchfaceError, match="at least two"):
        train(replace(settings(folder, tmp_path), annotations=tmp_path / "one.json"))
    with pytest.raises(TorchfaceError, match="number of performers"):
        train(replace(settings(folder, tmp_path), annotations=None))
    with pytest.raises(TorchfaceError, match="number of performers"):
        train(replace(settings(folder, tmp_path), performers=3))
    document["scans"]["scan_000.obj"]["points"]["nose"] = [1, "two", 3]
    (tmp_path / "text.json").write_text(json.dumps(document))
    with pytest.raises(FileFormatError, match=r"scan_000.obj.points.nose = .*expected three finite numbers"):
        load_annotations(tmp_path / "text.json")
    (tmp_path / "else.json").write_text('{"format": "something"}')
    with pytest.raises(FileFormatError, match="scan-annotations"):
        load_annotations(tmp_path / "else.json")
