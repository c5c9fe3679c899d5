"""Eyes close where the input closes them; what a smoothed input cannot show stays as it was found."""

import pytest
import torch

from torchface.enhancement import CapturedPerformance, EnhancementModel
from torchface.enhancement.detail.low_pass import LowPass
from torchface.enhancement.prepared_database import InputLids
from torchface.geometry.meshes.operators import vertex_normals
from torchface.synthetic.head.performer import performer

UPPER, LOWER = {"right": (37, 38), "left": (43, 44)}, {"right": (41, 40), "left": (47, 46)}


@pytest.fixture(scope="module")
def model(database) -> EnhancementModel:
    """As that of all tests, with regions for the eyes."""
    given = database.frames, database.faces, database.sequences, database.neutral
    return EnhancementModel.fit(CapturedPerformance(*given, landmarks=database.landmarks), rank=36, patch_size=20)


@pytest.fixture(scope="module")
def blink(database) -> torch.Tensor:
    """From open to nearly closed, (5,V,3)."""
    rig = performer(texture=False)
    course = torch.linspace(0, 0.9, 5)[:, None, None]
    return database.neutral + course * rig.deltas[rig.names.index("eyeBlinkRight")]


def opening(database, frames: torch.Tensor, side: str) -> torch.Tensor:
    upper, lower = (frames[:, database.landmarks[list(ids[side])]] for ids in (UPPER, LOWER))
    return (upper - lower).norm(dim=-1).mean(1)


def test_an_eye_closes_as_the_input_does(model, database, blink, monkeypatch):
    """The database has blinks of this eye only together with a smile and a sneer."""
    given = opening(database, blink, "right")
    assert float(given[0] - given[-1]) > 6
    found = model(blink)
    assert float((opening(database, found, "right") - given).abs().max()) < 0.1
    assert torch.allclose(opening(database, found, "left"), opening(database, blink, "left"), atol=0.05)
    monkeypatch.setattr(InputLids, "__call__", lambda self, enhanced, low, own: enhanced)
    assert float((opening(database, model(blink), "right") - given).abs().max()) > 0.15


def test_lids_of_a_smoothed_input_are_those_found(model, database, blink, monkeypatch):
    smoothed = model.low(blink)
    found = model(smoothed)
    monkeypatch.setattr(InputLids, "__call__", lambda self, enhanced, low, own: enhanced)
    assert torch.equal(found, model(smoothed))


def test_wrinkles_of_the_lids_stay():
    x, y = torch.meshgrid(torch.arange(-20, 20.5, 0.5), torch.arange(-15, 15.5, 0.5), indexing="ij")
    sheet = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
    ids = torch.arange(x.numel()).view(x.shape)
    quads = torch.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], dim=-1).flatten(0, 1)
    faces, neutral = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), sheet.flatten(0, 1)
    inside = (neutral[faces].abs() < torch.tensor([16.0, 12.0, 1.0])).all(-1).all(-1)
    lid = (
        torch.tensor([0.0, 1.0, 0.0]) * (torch.pi * neutral[:, :1] / 32).cos() * (torch.pi * neutral[:, 1:2] / 24).cos()
    )
    waves = torch.tensor([0.0, 0.0, 0.1]) * (torch.pi * neutral[:, :1]).sin()
    lids, found = InputLids(neutral, faces, inside[None]), neutral + 3.0 * lid + waves
    closed = lids(found[None], neutral[None], (neutral + 3.4 * lid)[None])[0]
    middle = neutral.abs().amax(1) < 4
    assert torch.allclose(closed[middle, 1], (neutral + 3.4 * lid)[middle, 1], atol=0.06)
    kept = (closed - neutral)[middle, 2] @ waves[middle, 2] / waves[middle, 2].square().sum()
    assert float(kept) > 0.9
    assert torch.equal(lids(found[None], neutral[None], (neutral + 1.2 * lid)[None])[0], found)  # too far off
    smooth = LowPass(neutral, faces, 20.0)((found - neutral)[None])
    assert torch.equal(lids(found[None], neutral + smooth, neutral + 1.9 * smooth)[0], found)


def test_lids_that_hardly_move_stay_those_of_the_input(model, database, monkeypatch):
    """A sneer of one side alone, which the database does not show: there both come with a smile and a blink."""
    rig = performer(texture=False)
    sneer = rig.deltas[rig.names.index("noseSneerLeft")]
    moved_by = torch.tensor([0.3, 0.5, 0.8])[:, None, None] * sneer
    waves = 0.1 * (2.1 * database.neutral[:, 1]).sin() * moved_by.norm(dim=-1)  # of the captured performance
    shown = database.neutral + moved_by + waves[..., None] * vertex_normals(database.neutral, database.faces)
    lids = torch.cdist(database.neutral, database.neutral[database.landmarks[36:48]]).amin(1) < 4
    assert float(0.08 * sneer[lids].norm(dim=-1).max()) < 0.04  # of the wrinkles there

    def moved() -> float:
        return float((model(shown) - shown)[:, lids].norm(dim=-1).max())

    found, smoothed = moved(), model(model.low(shown))
    monkeypatch.setattr(InputLids, "_unsmoothed", lambda self, found, shown: found.new_zeros(len(found)))
    assert moved() > 0.3
    assert found < 0.4 * moved()
    assert torch.equal(model(model.low(shown)), smoothed)
