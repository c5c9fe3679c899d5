"""Mixing normal maps: what adding the heights they belong to would give."""

import math

import pytest
import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.meshes.normal_maps import (
    DetailMaps,
    blend_normal_maps,
    decode_normals,
    encode_normals,
    flat_normal_map,
)


def heights(seed: int) -> Tensor:
    """A periodic relief of some waves, 64 x 64."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(*[torch.arange(64.0).double() / 64 * 2 * math.pi] * 2, indexing="ij")
    waves = torch.randint(1, 4, (4, 2), generator=generator).double()
    phase = 6 * torch.rand(4, generator=generator).double()
    return sum(3 * torch.sin(a * x + b * y + p) for (a, b), p in zip(waves, phase, strict=True))


def normals_of(height: Tensor) -> Tensor:
    """By central differences; rows run down, so y is up against them."""
    across = (height.roll(-1, 1) - height.roll(1, 1)) / 2
    up = (height.roll(1, 0) - height.roll(-1, 0)) / 2
    return torch.nn.functional.normalize(torch.stack([-across, -up, torch.ones_like(across)]), dim=0)


MAPS = torch.stack([normals_of(heights(seed)) for seed in range(3)])
NEUTRAL = normals_of(heights(9))


def test_mixed_normals_are_the_normals_of_mixed_heights() -> None:
    weights = torch.tensor([0.3, 0.9, -0.2]).double()
    expected = normals_of(sum(float(w) * heights(seed) for seed, w in enumerate(weights)))
    torch.testing.assert_close(blend_normal_maps(MAPS, weights), expected)


def test_at_rest_the_neutral_shows_and_at_one_the_shape_alone() -> None:
    flat = flat_normal_map(64, 64).double()
    assert torch.equal(blend_normal_maps(MAPS, torch.zeros(3)), flat)
    torch.testing.assert_close(blend_normal_maps(MAPS, torch.zeros(3), NEUTRAL), NEUTRAL)
    for row in range(3):
        one = torch.eye(3)[row]
        torch.testing.assert_close(blend_normal_maps(MAPS, one), MAPS[row])
        torch.testing.assert_close(blend_normal_maps(MAPS, one, NEUTRAL), MAPS[row])


def test_order_does_not_matter_and_results_are_unit() -> None:
    weights = torch.tensor([0.7, 0.5, 0.9]).double()
    first = blend_normal_maps(MAPS, weights, NEUTRAL)
    torch.testing.assert_close(first, blend_normal_maps(MAPS.flip(0), weights.flip(0), NEUTRAL))
    torch.testing.assert_close(first.norm(dim=0), torch.ones(64, 64).double())


def test_weights_follow_names_not_order() -> None:
    maps = DetailMaps(("smile", "frown"), MAPS[:2], NEUTRAL)
    blended = maps.blend(["blink", "frown", "smile"], torch.tensor([1.0, 0.25, 0.5]).double())
    torch.testing.assert_close(blended, blend_normal_maps(MAPS[:2], torch.tensor([0.5, 0.25]).double(), NEUTRAL))
    with pytest.raises(NameMismatchError, match="'frown'"):
        maps.blend(["smile", "blink"], torch.zeros(2))
    with pytest.raises(ShapeError, match=r"\(3,\), expected \(2,\)"):
        maps.blend(["smile", "frown"], torch.zeros(3))


def test_maps_of_merged_shapes_show_what_their_halves_show_together() -> None:
    maps = DetailMaps(("smileLeft", "frown", "smileRight"), MAPS[:3], NEUTRAL)
    merged = maps.merged({"smile": ["smileLeft", "smileRight"], "blink": ["blink"], "sneer": ["frown"]})
    assert merged.names == ("smile", "sneer")
    torch.testing.assert_close(merged.maps[1], MAPS[1])
    both = maps.blend(["smileLeft", "smileRight", "frown"], torch.tensor([0.4, 0.4, 0.0]).double())
    torch.testing.assert_close(merged.blend(["smile", "sneer"], torch.tensor([0.4, 0.0]).double()), both)
    assert DetailMaps((), MAPS[:0], NEUTRAL).merged({"smile": ["smile"]}).names == ()


def test_gradients_reach_the_weights() -> None:
    small, rest = MAPS[:, :, ::16, ::16], NEUTRAL[:, ::16, ::16]
    weights = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: blend_normal_maps(small, w, rest), weights)


def test_pictures_of_normals_and_back() -> None:
    image = encode_normals(NEUTRAL)
    assert float(image.min()) >= 0
    assert float(image.max()) <= 1
    torch.testing.assert_close(decode_normals(image), NEUTRAL)
    nothing = torch.full((3, 2, 2), 0.5)
    assert torch.equal(decode_normals(nothing), flat_normal_map(2, 2))


def test_bad_maps_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"expected \(N,3,H,W\)"):
        DetailMaps(("a",), MAPS[0])
    with pytest.raises(ShapeError, match="neutral"):
        DetailMaps(("a",), MAPS[:1], NEUTRAL[:, ::2])
    with pytest.raises(NameMismatchError, match="2 names for 1 maps"):
        DetailMaps(("a", "b"), MAPS[:1])
    with pytest.raises(NameMismatchError, match="more than once: a"):
        DetailMaps(("a", "a"), MAPS[:2])
    with pytest.raises(ValueRangeError, match="NaN"):
        DetailMaps(("a",), MAPS[:1] * torch.nan)
    with pytest.raises(ValueRangeError, match="weights"):
        blend_normal_maps(MAPS, torch.tensor([0, 0, torch.nan]))
    with pytest.raises(ShapeError, match="no map"):
        blend_normal_maps(MAPS[:0], torch.zeros(0))
