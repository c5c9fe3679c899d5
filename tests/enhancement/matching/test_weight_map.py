"""Detail planted by a rig's weights is found better with them; weights of another rig do little harm."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from torchface.enhancement import CapturedPerformance, EnhancementModel
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.performer import performer
from torchface.take import Track
from torchface.zoo import ModelCard, get_model, save_model

SEQUENCES, EACH, LEARNED = 48, 5, 36
MOVED = ("browInnerUp", "mouthSmileLeft", "noseSneerRight")
NAMES = (*MOVED, *(f"{name}Tense" for name in MOVED))


@dataclass(frozen=True, eq=False)
class Scene:
    """Coarse and wrinkled frames (T,V,3) of random expressions, and weights (T,N); the last sequences are the test."""

    rig: BlendshapeRig
    coarse: Tensor
    frames: Tensor
    weights: Tensor

    def performance(self, weights: bool = True, pairs: bool = True) -> CapturedPerformance:
        some = slice(0, LEARNED * EACH)
        return CapturedPerformance(
            self.frames[some],
            self.rig.neutral.faces,
            torch.arange(LEARNED).repeat_interleave(EACH),
            self.rig.vertices,
            coarse=self.coarse[some] if pairs else None,
            weights=Track(self.rig.names, self.weights[some, :, None]) if weights else None,
        )

    def share(self, found: Tensor) -> float:
        """The error in the test's frames as a share of their detail."""
        truth, coarse = self.frames[-len(found) :], self.coarse[-len(found) :]
        return float((found - truth).norm() / (coarse - truth).norm())


@pytest.fixture(scope="module")
def scene() -> Scene:
    whole = performer(texture=False)
    face = whole.part(whole.neutral.annotations.regions["face"]).select(list(MOVED))
    # Two muscles each that move the skin nearly alike, and wrinkle it in different ways.
    rig = BlendshapeRig(face.neutral, torch.cat([face.deltas, 0.8 * face.deltas]), NAMES)
    extremes = torch.rand(SEQUENCES, len(NAMES), generator=torch.Generator().manual_seed(1)) ** 2
    course = torch.linspace(0, torch.pi, EACH).sin()
    weights = (course[None, :, None] * extremes[:, None]).flatten(0, 1)
    coarse = rig(weights)
    # A wrinkle of each shape, across where it moves the skin, which begins to show at 0.2 of its weight.
    phase = torch.arange(len(NAMES))[:, None]
    waves = (2.1 * rig.vertices[:, 1] + phase).sin() * rig.deltas.norm(dim=-1) * 0.1
    heights = (weights - 0.2).clamp(min=0) @ waves
    frames = coarse + heights[..., None] * vertex_normals(coarse, rig.neutral.faces)
    return Scene(rig, coarse, frames, weights)


@pytest.fixture(scope="module")
def model(scene: Scene) -> EnhancementModel:
    return EnhancementModel.fit(scene.performance(), region_count=4)


def ridge(scene: Scene, least: float = 1e-4) -> Tensor:
    """Frames of the test by linear regression of the detail on the weights."""
    learned = LEARNED * EACH
    rows = torch.cat([scene.weights, torch.ones(len(scene.weights), 1)], 1).double()
    detail = (scene.frames - scene.coarse).flatten(1).double()
    known = rows[:learned]
    gram = known.T @ known + least * torch.eye(known.shape[1]).double()
    found = rows[learned:] @ torch.linalg.solve(gram, known.T @ detail[:learned])
    return scene.coarse[learned:] + found.view(-1, *scene.coarse.shape[1:]).float()


@pytest.mark.parametrize("pairs", [True, False])
def test_detail_that_weights_plant_is_found_by_them(scene: Scene, model: EnhancementModel, pairs: bool) -> None:
    learned = LEARNED * EACH
    own = model if pairs else EnhancementModel.fit(scene.performance(pairs=False), region_count=4)
    coarse, weights = scene.coarse[learned:], scene.weights[learned:]
    without, found = own(coarse), own.enhance(coarse, rig_weights=weights).vertices
    other = own.enhance(coarse, rig_weights=weights.flip(0)).vertices
    print(f"without {scene.share(without):.3f}, with {scene.share(found):.3f}, ridge {scene.share(ridge(scene)):.3f}, "
          f"other frames' {scene.share(other):.3f}")  # fmt: skip
    assert scene.share(found) < (0.2 if pairs else 0.8) * scene.share(without)
    assert not pairs or scene.share(found) < 0.7 * scene.share(ridge(scene))
    assert scene.share(other) < 1.05 * scene.share(without)  # those of another rig are not believed


def test_frames_of_the_database_come_back(scene: Scene, model: EnhancementModel) -> None:
    some = slice(0, LEARNED * EACH)
    found = model.enhance(scene.coarse[some], rig_weights=scene.weights[some]).vertices
    left = (found - scene.frames[some]).norm() / (scene.frames - scene.coarse)[some].norm()
    assert float(left) < 0.06
    rest = model.enhance(scene.rig.vertices[None], rig_weights=torch.zeros(1, len(NAMES))).vertices
    assert torch.allclose(rest[0], scene.rig.vertices, atol=2e-3)


def test_a_model_without_weights_is_saved_as_before_and_one_with_them_comes_back(scene, model, tmp_path) -> None:
    plain = EnhancementModel.fit(scene.performance(weights=False), region_count=4)
    assert "weight_names" not in plain.config
    assert not any("weight_terms" in name or "database_weights" in name for name in plain.state_dict())
    asked = scene.coarse[-2:], None, scene.weights[-2:]
    for name, one in (("plain", plain), ("known", model)):
        save_model(one, tmp_path / name, ModelCard("MIT", "made", {}, "none"))
        loaded = get_model(tmp_path / name)
        assert loaded.weight_names == one.weight_names
        assert torch.equal(loaded(asked[0]), one(asked[0]))
    assert torch.equal(loaded.enhance(*asked).vertices, model.enhance(*asked).vertices)
    assert torch.equal(plain(asked[0]), model(asked[0]))
    with pytest.raises(ShapeError, match="fitted without weights knows none"):
        plain.enhance(*asked)
    for wrong in ("jaw", [1]):
        with pytest.raises(ValueRangeError, match="weight_names: found other than texts"):
            EnhancementModel.from_config({**model.config, "weight_names": wrong})


def test_weights_that_do_not_fit_are_refused(scene: Scene, model: EnhancementModel) -> None:
    coarse = scene.coarse[-2:]
    with pytest.raises(ShapeError, match=r"found \(1, 6\), expected \(2,6\)"):
        model.enhance(coarse, rig_weights=scene.weights[:1])
    with pytest.raises(ValueRangeError, match="NaN"):
        model.enhance(coarse, rig_weights=scene.weights[-2:] * torch.nan)
    given = scene.performance()
    few = scene.weights[: LEARNED * EACH, :, None]
    for wrong, error in ((few[:3], ShapeError), (few * torch.nan, ValueRangeError)):
        with pytest.raises(error, match="weights: found"):
            CapturedPerformance(
                given.frames, given.faces, given.sequences, given.neutral, weights=Track(scene.rig.names, wrong)
            )


def test_derivatives_by_weights_are_those_of_finite_differences(scene: Scene, model: EnhancementModel) -> None:
    coarse, weights = scene.coarse[-3:-2].double(), scene.weights[-3:-2].double().requires_grad_(True)
    looked_at = torch.randn(coarse.shape, generator=torch.Generator().manual_seed(0)).double()
    step = 1e-3 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(1)).double()
    (model.enhance(coarse, rig_weights=weights).vertices * looked_at).sum().backward()
    with torch.no_grad():
        ahead, behind = (
            (model.enhance(coarse, rig_weights=weights + sign * step).vertices * looked_at).sum() for sign in (1, -1)
        )
    assert float((weights.grad * step).sum()) == pytest.approx(float(ahead - behind) / 2, rel=0.01)
