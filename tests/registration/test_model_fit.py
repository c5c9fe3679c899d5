"""A model fitted to scans: planted coefficients come back, and what the model knows does not slide."""

import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from torchface.errors import ShapeError, TopologyError
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_identity_modes, load_mesh, save_mesh
from torchface.mesh import Mesh
from torchface.modeling import HeadModel, MorphableModel
from torchface.registration import Level, Schedule, Stage, load_scan_landmarks, register
from torchface.registration.model_fit import LinearShape, shape_model
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.register.register_scans import ScanSettings, register_scans
from torchface.workflows.register.scan_job import ScanJob


@dataclass(frozen=True, eq=False)
class Waves:
    """A mean and smooth modes: about 2 mm at one standard deviation."""

    mean: torch.Tensor
    modes: torch.Tensor

    def __call__(self, coefficients: torch.Tensor) -> torch.Tensor:
        return self.mean + torch.tensordot(coefficients, self.modes, 1)


@pytest.fixture(scope="module")
def waves(mask: Mesh) -> Waves:
    x, y = mask.vertices[:, 0] / 80, mask.vertices[:, 1] / 110
    zero = torch.zeros_like(x)
    fields = [
        (2 * x, zero, 2 * y),
        (zero, 3 * torch.sin(2 * x), 2 * torch.cos(3 * y)),
        (2 * torch.sin(3 * y), zero, 2 * torch.cos(3 * x)),
        (zero, 2 * torch.cos(2 * y), 3 * torch.exp(-20 * (x**2 + (y - 0.1) ** 2))),
        (2 * torch.sin(3 * x), 2 * torch.sin(2 * y), zero),
    ]
    return Waves(mask.vertices, torch.stack([torch.stack(f, dim=1) for f in fields]))


@pytest.mark.parametrize("given", [True, pytest.param(False, marks=pytest.mark.bench)])
def test_planted_coefficients_come_back(
    mask: Mesh, waves: Waves, moved: Callable, rescanned: Callable, given: bool
) -> None:
    planted = torch.tensor([1.5, -1.0, 0.8, -2.0, 1.2], dtype=torch.float64)
    face = moved(waves(planted))
    scan = rescanned(mask.with_vertices(face))
    landmarks = (mask.landmarks, face[mask.landmarks]) if given else None
    found = register(mask, scan, landmarks, model=waves)
    assert found.coefficients is not None
    assert any("the model comes to" in note for note in found.record.notes)
    assert (found.mesh.vertices - face).norm(dim=1).mean() < 0.3
    # The coefficients and a similarity make the face: a scale may stand in for some of them.
    shape = waves(found.coefficients)
    fit = similarity_transform(shape[None], face[None]).apply(shape)[0]
    assert (fit - face).norm(dim=1).mean() < 0.3


@pytest.mark.bench
@pytest.mark.real
def test_real_shapes_known_to_the_model_do_not_slide(ict_folder: Path, rescanned: Callable) -> None:
    modes = load_identity_modes(ict_folder, part="face")
    template = modes.neutral
    head = modes.random_head(1)
    scan = rescanned(Mesh(head.vertices.double(), head.faces))
    landmarks = (template.landmarks, head.vertices[template.landmarks].double())
    whole = Waves(template.vertices, modes.deltas)
    found = [register(template, scan, landmarks, model=model) for model in (None, whole)]
    assert [result.coefficients is None for result in found] == [True, False]
    without, known = (float((r.mesh.vertices - head.vertices).norm(dim=1).mean()) for r in found)
    assert known < 0.3 * without


def test_models_of_something_else_are_refused(mask: Mesh, waves: Waves, make_mask: Callable) -> None:
    with pytest.raises(TopologyError, match=r"found a model of \(1485, 3\).*80 vertices"):
        register(make_mask(8, 10), mask, model=waves)
    heads = HeadModel(MorphableModel(waves.mean, waves.modes, torch.ones(5)), None, mask.faces)
    assert shape_model(heads, mask) is heads.shape
    turned = Mesh(mask.vertices, mask.faces.flip(1))
    with pytest.raises(TopologyError, match="expected the template's topology"):
        register(turned, mask, model=heads)
    with pytest.raises(ShapeError, match="found str, expected a model"):
        register(mask, mask, model="heads")


@pytest.mark.usefixtures("coarse_figures")
def test_another_model_makes_results_anew_and_goes_to_other_processes(mask: Mesh, waves: Waves, tmp_path: Path) -> None:
    item = BatchItem("scan", tmp_path / "scan.ply")
    save_mesh(mask, item.path)
    job, other = (
        ScanJob(mask, Schedule((Stage(Level.GRAPH, 8.0, 8.0, 20.0),)), 0, model=LinearShape.of(one))
        for one in (waves, Waves(waves.mean, 1.1 * waves.modes))
    )
    assert job.key(item) != other.key(item)
    sent = pickle.loads(pickle.dumps(job))
    assert torch.equal(sent.model.modes, waves.modes.float())
    assert sent.key(item) == job.key(item)


@pytest.mark.bench  # the command starts from a model in tests/cli/test_register.py
def test_a_corpus_starts_from_the_model_too(mask: Mesh, waves: Waves, rescanned: Callable, tmp_path: Path) -> None:
    short = Schedule((Stage(Level.GRAPH, 8.0, 8.0, 20.0, samples=300), Stage(Level.GRAPH, 0.5, 1.0, 8.0)), nodes=30)
    (tmp_path / "scans").mkdir()
    for number in range(2):
        face = waves(torch.tensor([1.0, -1, 0.5, 1, -1], dtype=torch.float64) * (1 - 2 * number))
        save_mesh(rescanned(mask.with_vertices(face), number), tmp_path / "scans" / f"{number}.ply")
        points = {"points": face[mask.landmarks].tolist()}
        (tmp_path / "scans" / f"{number}.ljson").write_text(json.dumps({"version": 2, "landmarks": points}))
    settings = {"landmarks": tmp_path / "scans", "schedule": short, "texture_size": 0}
    done = register_scans(mask, [tmp_path / "scans"], tmp_path / "out", ScanSettings(model=waves, **settings))
    assert len(done.done) == 2
    for entry in done.done:
        marks = load_scan_landmarks(tmp_path / "scans" / f"{entry.name}.ljson", mask, entry.item.path)
        alone = register(mask, load_mesh(entry.item.path), marks, model=LinearShape.of(waves), schedule=short)
        assert (load_mesh(entry.results[0]).vertices - alone.mesh.vertices).abs().max() < 1e-3
    again = register_scans(mask, [tmp_path / "scans"], tmp_path / "out", ScanSettings(model=waves, **settings))
    assert all(entry.reused for entry in again.outcomes)
    other = Waves(waves.mean, 1.1 * waves.modes)
    changed = register_scans(mask, [tmp_path / "scans"], tmp_path / "out", ScanSettings(model=other, **settings))
    assert not any(entry.reused for entry in changed.outcomes)
