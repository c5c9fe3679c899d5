"""Another actor's detail: his model on a head of the same mesh, beside that head's own model and none at all."""

from pathlib import Path

import pytest
import torch
from enhancement_comparison import fitted
from enhancement_measures import Ruler
from enhancement_peers import Method
from enhancement_scenes import Scene, scene_of
from torch import Tensor

from torchface.enhancement.detail.low_pass import LowPass
from torchface.synthetic import IDENTITY, performer
from torchface.synthetic.stages.wrinkles import WrinkledPerformer
from torchface.synthetic.stages.wrinkles.wrinkled_performer import captured_skin

pytestmark = [pytest.mark.real, pytest.mark.usefixtures("one_thread")]
VERTICES, FRAMES = 10_548, 200  # whole rounds of subdivision: the same mesh whatever the head
WEAKER = 0.6


def actors(data: Path, seed: int) -> tuple[Scene, Scene]:
    """The mean performer, and a head of another shape whose wrinkles run as the seed says."""
    mean = performer(texture=False)
    identity = torch.randn(len(IDENTITY), generator=torch.Generator().manual_seed(1))
    one, two = (head.part(captured_skin(mean)) for head in (mean, performer(identity, texture=False)))
    giver, taker = (WrinkledPerformer(vertices=VERTICES, rig=rig, seed=k) for rig, k in ((one, 0), (two, seed)))
    assert torch.equal(giver.neutral.faces, taker.neutral.faces)
    return scene_of("giver", giver, data, FRAMES), scene_of("taker", taker, data, FRAMES)


@pytest.mark.parametrize(("seed", "places"), [(0, "in the same places"), (1, "elsewhere")])
def test_another_actors_detail(data: Path, seed: int, places: str) -> None:
    """Where wrinkles run alike his are nearer to the own ones than none; elsewhere they are as many, not the same."""
    giver, taker = actors(data, seed)
    ruler = Ruler(taker.neutral, taker.faces, LowPass(taker.neutral, taker.faces))
    apart = float((giver.neutral - taker.neutral).norm(dim=1)[ruler.skin].mean())
    print(f"\n{len(taker.neutral):,} vertices, heads {apart:.1f} mm apart, {len(giver.frames)} database frames; own "
          f"wrinkles {places}: fine part and normals as shares of the smooth input's, and how much is added as a share "
          "of what the truth adds to the coarse animation")  # fmt: skip
    print(" " * 40 + "".join(f"{f'wrinkles x {s:g}':>30s}" for s in (1.0, WEAKER)))
    models = {
        kind: tuple(fitted(scene, scene.rigged if kind else None) for scene in (giver, taker))
        for kind in ("", ", from pairs")
    }
    found: dict[str, list[float]] = {}
    for scale in (1.0, WEAKER):
        ways: dict[str, Method] = {"coarse animation itself": lambda coarse: coarse}
        for kind, (his, own) in models.items():
            ways["another actor's model" + kind] = his.on_actor(taker.neutral, scale)
            ways["own model" + kind] = own.on_actor(taker.neutral, scale)
        rows: dict[str, list[Tensor]] = {}
        for coarse, truth in zip(taker.coarse, taker.truth, strict=True):
            known = ruler.known(coarse + scale * (truth - coarse))
            smooth = ruler.errors(taker.neutral + ruler.smooth(coarse - taker.neutral), known)
            lacks = ruler.fine(known.truth - coarse)[:, ruler.skin].norm()
            for name, way in ways.items():
                enhanced = way(coarse)
                row = ruler.shares(ruler.errors(enhanced, known), smooth, known.flicker)
                added = float(ruler.fine(enhanced - coarse)[:, ruler.skin].norm() / lacks)
                rows.setdefault(name, []).append(torch.tensor([row.fine, row.angle, added]))
        for name, some in rows.items():
            found.setdefault(name, []).extend(torch.stack(some).mean(0).tolist())
    for name, figures in found.items():
        print(f"{name:40s}" + "".join(f"{value:10.3f}" for value in figures))
    none, his, own = (
        found[name]
        for name in ("coarse animation itself", "another actor's model, from pairs", "own model, from pairs")
    )
    assert own[0] < his[0]
    if seed == 0:
        assert his[0] < none[0]
    assert 0.5 < his[2] < 1.5
    assert abs(his[5] - his[2]) < 0.01
