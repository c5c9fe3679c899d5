"""Claim: weights of one performance play on other rigs: another topology and names, and 140 shapes with combinations.

Pictures of the same frames on all three rigs go to out/retarget.
"""

from itertools import combinations
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, load_rig, load_take
from torchface.capture.retargeting import shape_map
from torchface.rendering.compositing import caption, save_rendered_image, sheet
from torchface.synthetic import performer
from torchface.viz.figures.face_views import face_views

PICTURES = Path("out/retarget")
SIZE = {"width": 260, "height": 325}


def combination_rig(rig: BlendshapeRig, count: int = 140) -> BlendshapeRig:
    """A rig with more shapes: where two base shapes are active together a combination shape takes a tenth of both back,
    as correctives do that keep sums from overshooting."""
    base = {name: rig.deltas[i] for i, name in enumerate(rig.names)}
    strength = rig.deltas.norm(dim=-1)
    overlap = (strength @ strength.T).fill_diagonal_(0)
    pairs = sorted(combinations(range(len(rig.names)), 2), key=lambda pair: -float(overlap[pair]))
    for first, second in pairs[: count - len(base)]:
        name = f"{rig.names[first]}+{rig.names[second]}"
        base[name] = -0.1 * (rig.deltas[first] + rig.deltas[second])
    return BlendshapeRig(rig.neutral, torch.stack(list(base.values())), list(base))


def lower_face_motion(rig: BlendshapeRig, weights: Tensor) -> Tensor:
    """How far each frame's vertices are from rest, root mean square over the face, over that of the whole take."""
    moved = (rig(weights) - rig.vertices).square().sum(-1).mean(1).sqrt()
    return moved / moved.square().mean().sqrt()


@pytest.mark.real
def test_one_performance_on_three_rigs(ict_folder: Path, performances: list[Path]) -> None:
    ict, own = load_rig(ict_folder, part="face"), performer()
    many = combination_rig(own)
    assert len(many.names) == 140
    track = load_take(performances[2]).weights
    assert track is not None
    weights = ict.weights_from(track).clamp(0, 1)
    to_own, to_many = shape_map(ict.names, own.names), shape_map(ict.names, many.names)
    rigs = {"ICT, 53 shapes": (ict, weights), "performer, 51": (own, to_own(weights)), "140": (many, to_many(weights))}
    print(f"\n{'rig':16}{'driven':>8}{'moves as the source does':>28}")
    reference = lower_face_motion(ict, weights[::10])
    for name, (rig, found) in rigs.items():
        driven = int((found > 1e-3).any(0).sum())
        moves = lower_face_motion(rig, found[::10])
        agreement = float(torch.corrcoef(torch.stack([reference, moves]))[0, 1])
        print(f"{name:16}{driven:8}{agreement:28.3f}")
        assert agreement > 0.9
    # A combination is the product of what it combines; where one of the two rests it rests.
    first, second = many.names[51].split("+")
    product = weights @ shape_map(ict.names, [first, second]).matrix.T
    assert torch.allclose(to_many(weights)[:, 51], product.prod(1).clamp(0, 1), atol=1e-6)
    energy = lower_face_motion(ict, weights)
    frames = [int(energy.argmax()), int(weights[:, ict.names.index("jawOpen")].argmax()), len(weights) // 2]
    cells = []
    for name, (rig, found) in rigs.items():
        posed = [rig.neutral.with_vertices(rig(found[frame : frame + 1])[0]) for frame in frames]
        cells += [
            caption(face_views(mesh, (20.0,), framed_by=rig.neutral, **SIZE), f"{name}, frame {frame}")
            for mesh, frame in zip(posed, frames, strict=True)
        ]
    PICTURES.mkdir(parents=True, exist_ok=True)
    save_rendered_image(sheet(cells, 3), PICTURES / "rigs.png")
