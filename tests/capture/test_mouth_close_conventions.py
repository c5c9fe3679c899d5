"""ARKit's mouthClose and Audio2Face's: distinguished, and weights converted between them."""

from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, Track, load_rig, load_take
from torchface.capture.mouth_close_conventions import jaw_into_mouth_close, jaw_out_of_mouth_close, mouth_close_of
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.synthetic import performer


def jaw_opened(rig: BlendshapeRig) -> BlendshapeRig:
    """ARKit's rig in Audio2Face's convention."""
    jaw, close = rig.names.index("jawOpen"), rig.names.index("mouthClose")
    deltas = rig.deltas.clone()
    deltas[close] += deltas[jaw]
    return BlendshapeRig(rig.neutral, deltas, rig.names)


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(["jawOpen", "mouthClose", "mouthSmileLeft", "mouthPucker"])


def test_conventions_are_told_apart_by_the_chin(rig: BlendshapeRig) -> None:
    arkit, other = mouth_close_of(rig), mouth_close_of(jaw_opened(rig))
    assert (arkit.opens_jaw, other.opens_jaw) == (False, True)
    assert abs(arkit.share) < 0.1
    assert abs(other.share - 1) < 0.1
    assert mouth_close_of(rig.select(["jawOpen"])) is None
    between = BlendshapeRig(
        rig.neutral, torch.stack([rig.deltas[0], rig.deltas[1] + 0.5 * rig.deltas[0]]), rig.names[:2]
    )
    with pytest.raises(ValueRangeError, match="moves the chin 50% of the way"):
        mouth_close_of(between)
    with pytest.raises(ValueRangeError, match="jawOpen moves nothing"):
        mouth_close_of(BlendshapeRig(rig.neutral, 0 * rig.deltas, rig.names))


def test_both_rigs_show_the_same_faces(rig: BlendshapeRig) -> None:
    weights = torch.rand(9, 4, generator=torch.Generator().manual_seed(0))
    weights[:, 1] *= weights[:, 0]  # lips close over an open jaw
    track = Track(rig.names, weights[..., None])
    other = jaw_opened(rig)
    into = jaw_into_mouth_close(track)
    torch.testing.assert_close(other(other.weights_from(into)), rig(weights), atol=1e-4, rtol=0)
    assert (other(weights) - rig(weights)).norm(dim=-1).max() > 1
    torch.testing.assert_close(jaw_out_of_mouth_close(into).values, track.values)


def test_closed_lips_over_a_closed_jaw_are_warned_of() -> None:
    track = Track(("jaw_open", "JawOpen", "MouthClose"), torch.tensor([[0.9, 0.1, 0.5], [0.0, 0.6, 0.5]])[..., None])
    with pytest.warns(UserWarning, match=r"as far as 0.4 outside 0 to 1 in 1 of 2 frames"):
        into = jaw_into_mouth_close(track)
    assert into.values[..., 0].tolist() == [pytest.approx([0.9, 0.0, 0.5]), pytest.approx([0.0, 0.1, 0.5])]
    with pytest.raises(NameMismatchError, match="found no jawOpen and mouthClose"):
        jaw_into_mouth_close(Track(("jawOpen",), torch.zeros(1, 1, 1)))


@pytest.mark.real
def test_a_real_rig_is_arkits_and_plays_alike_in_the_other(ict_folder: Path, performances: list[Path]) -> None:
    rig = load_rig(ict_folder, shapes=["jawOpen", "mouthClose"])
    found = mouth_close_of(rig)
    assert not found.opens_jaw
    take = load_take(performances[0]).weights
    track = take.select(["JawOpen", "MouthClose"] if "JawOpen" in take.names else ["jawOpen", "mouthClose"])
    other = jaw_opened(rig)
    kept = (track.values[:, 0] >= track.values[:, 1])[:, 0].nonzero()[::50, 0]
    assert len(kept) > 5
    few = Track(track.names, track.values[kept])
    faces = rig(rig.weights_from(few))
    assert (other(other.weights_from(jaw_into_mouth_close(few))) - faces).norm(dim=-1).max() < 1e-3
