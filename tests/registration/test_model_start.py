"""A model fitted to scans: planted coefficients come back, and what the model knows does not slide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from torchface.errors import ShapeError, TopologyError
from torchface.geometry.alignment import similarity_transform
from torchface.io import load_identity_modes
from torchface.mesh import Mesh
from torchface.registration import register


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


@pytest.mark.parametrize("given", [True, False])
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
    without = register(mask, scan, landmarks)
    assert without.coefficients is None
    error, before = ((r.mesh.vertices - face).norm(dim=1).mean() for r in (found, without))
    assert error < 0.6 * before
    # The coefficients and a similarity make the face: a scale may stand in for some of them.
    shape = waves(found.coefficients)
    fit = similarity_transform(shape[None], face[None]).apply(shape)[0]
    assert (fit - face).norm(dim=1).mean() < 0.3


def test_the_same_input_gives_the_same_fit(mask: Mesh, waves: Waves, rescanned: Callable) -> None:
    face = waves(torch.ones(5, dtype=torch.float64))
    scan = rescanned(mask.with_vertices(face))
    landmarks = (mask.landmarks, face[mask.landmarks])
    runs = [register(mask, scan, landmarks, model=waves) for _ in range(2)]
    assert torch.equal(runs[0].mesh.vertices, runs[1].mesh.vertices)
    assert torch.equal(runs[0].coefficients, runs[1].coefficients)


@pytest.mark.real
def test_real_shapes_known_to_the_model_do_not_slide(ict_folder: Path, rescanned: Callable) -> None:
    modes = load_identity_modes(ict_folder, part="face")
    template, half = modes.neutral, Waves(modes.neutral.vertices, modes.deltas[:12])
    head = modes.random_head(1)
    scan = rescanned(Mesh(head.vertices.double(), head.faces))
    landmarks = (template.landmarks, head.vertices[template.landmarks].double())
    whole = Waves(template.vertices, modes.deltas)
    found = [register(template, scan, landmarks, model=model).mesh.vertices for model in (None, whole, half)]
    without, known, partly = (float((v - head.vertices).norm(dim=1).mean()) for v in found)
    assert known < 0.3 * without
    assert partly < 0.9 * without


def test_models_of_something_else_are_refused(mask: Mesh, waves: Waves, make_mask: Callable) -> None:
    with pytest.raises(TopologyError, match=r"found a model of \(1485, 3\).*80 vertices"):
        register(make_mask(8, 10), mask, model=waves)
    with pytest.raises(ShapeError, match="found str, expected a model"):
        register(mask, mask, model="heads")  # type: ignore[arg-type]
