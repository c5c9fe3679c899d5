"""Claim: in no shape and no frame of real takes do teeth, gums or eyeballs stand out of the skin; shells hardly do.

Of the shells of the eye a few vertices do, by less than a millimetre, in frames that mix blinks with other shapes.
Twenty random heads and the scan of a real one are rigged with ICT-FaceKit's whole head; the scans of three embedded
performers with the performer's own. All shapes at weight 1 and 100 frames of six takes, the template's own beside.
"""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.io import load_ict_facekit, load_identity_modes, load_mesh, load_take
from torchface.modeling import InnerParts, inner_parts, place_parts, shape_depths, transfer_with_report
from torchface.modeling.rigging.penetration import TOLERANCE
from torchface.registration import in_place_of, register
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.synthetic import IDENTITY, performer

HEADS, FRAMES = 20, 100
SHELLS = 1.2


@pytest.fixture(scope="module")
def template(ict_folder: Path) -> BlendshapeRig:
    return load_ict_facekit(ict_folder)


@pytest.fixture(scope="module")
def parts(template: BlendshapeRig) -> InnerParts:
    return inner_parts(template)


def frames(rig: BlendshapeRig, performances: list[Path]) -> Tensor:
    """Evenly spread frames of the takes as the rig's weights, (FRAMES,N)."""
    found = []
    for path in performances:
        track = load_take(path).weights
        found.append((track.values[..., 0] @ mapping(track.names, rig.names).T).clamp(0, 1))
    weights = torch.cat(found)
    return weights[torch.linspace(0, len(weights) - 1, FRAMES).long()]


def told(label: str, rig: BlendshapeRig, parts: InnerParts, weights: Tensor) -> tuple[float, float]:
    """The deepest vertex of teeth, gums and eyeballs, and of shells, millimetres; prints shapes and frames."""
    shapes = shape_depths(rig, parts)
    posed = torch.stack([parts.depth(rig(row[None].to(rig.deltas))[0]) for row in weights])
    for kind, rows in (("bone", parts.hard), ("shells", ~parts.hard)):
        if not rows.any():
            continue
        cells = []
        for depths in (shapes[:, rows], posed[:, rows]):
            out = (depths > TOLERANCE).sum(1)
            cells.append(f"{float(depths.max()):6.2f} mm {int(out.max()):4d} vertices {int((out > 0).sum()):3d} poses")
        print(f"{label:14s}{kind:8s}shapes{cells[0]}   frames{cells[1]}")
    both = torch.cat([shapes, posed])
    shells = both[:, ~parts.hard]
    return float(both[:, parts.hard].max()), float(shells.max()) if shells.numel() else 0.0


@pytest.mark.real
def test_random_heads(template: BlendshapeRig, parts: InnerParts, ict_folder: Path, performances: list[Path]) -> None:
    weights, modes = frames(template, performances), load_identity_modes(ict_folder)
    print()
    told("template", template, parts, weights)
    found = []
    for seed in range(HEADS):
        rig = transfer_with_report(template, modes.random_head(seed)).rig
        found.append(told(f"head {seed}", rig, parts, weights))
    bone, shells = torch.tensor(found).amax(0).tolist()
    assert bone <= 1.25 * TOLERANCE  # frames mix shapes as no pose that was cleared did
    assert shells <= SHELLS


@pytest.mark.real
def test_a_scan_of_a_real_head(
    template: BlendshapeRig, parts: InnerParts, data: Path, performances: list[Path]
) -> None:
    scan = register(template.neutral, load_mesh(data / "scans" / "james" / "james.obj"), texture_size=0)
    neutral = in_place_of(scan.mesh, template.neutral, scan.matched.double())
    print()
    placed = place_parts(template, neutral, parts)
    rig = transfer_with_report(template, placed).rig
    bone, shells = told("scan", rig, parts, frames(template, performances))
    assert float(parts.depth(neutral.vertices).max()) > TOLERANCE
    assert bone <= TOLERANCE
    assert shells <= SHELLS


@pytest.mark.real
def test_performers(performances: list[Path]) -> None:
    own = performer(texture=False)
    parts = inner_parts(own)
    weights = frames(own, performances)
    generator = torch.Generator().manual_seed(1)
    print()
    told("template", own, parts, weights)
    for number in range(3):
        person = performer(torch.randn(len(IDENTITY), generator=generator), texture=False).neutral
        rig = transfer_with_report(own, place_parts(own, person, parts)).rig
        assert max(told(f"performer {number}", rig, parts, weights)) <= TOLERANCE
