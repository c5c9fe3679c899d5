"""The thin shell on dense heads: what setting it up and a frame take, how near its coarse level comes to the whole."""

import time

import pytest
import torch

from torchface.attachment import Attachment
from torchface.enhancement.thin_shell import ThinShell
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.synthetic.stages.marker_stage import place_markers
from torchface.synthetic.stages.wrinkles import WrinkledPerformer

pytestmark = pytest.mark.bench
FRAMES = 8


def on_dense(performer: WrinkledPerformer, sites: Attachment) -> Attachment:
    """Sites of the coarse rig on the dense skin, without those that nearness alone takes to the other lip."""
    rig, dense = performer.rig, performer.neutral
    surface = SurfaceIndex(dense.vertices, dense.faces)
    found = surface.nearest(sites.on(rig.neutral.faces, rig.vertices))
    own = sites.on(rig.neutral.faces, vertex_normals(rig.vertices.double(), rig.neutral.faces))
    alike = (own * surface.normals_at(found)).sum(-1) > 0.5
    return Attachment(found.triangle[alike], found.barycentric[alike].float())


@pytest.mark.parametrize(("vertices", "limit"), [(100_000, 0.06), (500_000, 0.3)])
@pytest.mark.parametrize("points", [100, 2500])
def test_spreading_takes_a_part_of_a_frames_time(vertices: int, limit: float, points: int) -> None:
    performer = WrinkledPerformer(vertices=vertices)
    rig = performer.rig
    marked = place_markers(rig, 100) if points == 100 else Attachment.from_vertices(rig.neutral, torch.arange(points))
    sites = on_dense(performer, marked)
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(FRAMES, len(rig.names), generator=generator) ** 6
    smooth = performer.smooth(weights)
    started = time.process_time()
    shell = ThinShell(performer.neutral.vertices, performer.neutral.faces, sites)
    setting_up = time.process_time() - started
    seen = sites.on(performer.neutral.faces, smooth)
    started = time.process_time()
    found = shell.spread(seen - shell.rest)
    frame = (time.process_time() - started) / FRAMES
    moved = smooth - performer.neutral.vertices
    error = (found - moved).square().sum(-1).mean().sqrt() / moved.square().sum(-1).mean().sqrt()
    print(f"{vertices} vertices, {points} points: {setting_up:.1f} s, {frame:.3f} s a frame, error {float(error):.3f}")
    assert setting_up < 60
    assert frame < limit
    assert error < (0.25 if points == 100 else 0.04)


def test_the_coarse_level_is_near_the_whole() -> None:
    performer = WrinkledPerformer(vertices=100_000)
    rig = performer.rig
    sites = on_dense(performer, place_markers(rig, 100))
    weights = torch.rand(FRAMES, len(rig.names), generator=torch.Generator().manual_seed(0)) ** 6
    moved = performer.smooth(weights) - performer.neutral.vertices
    seen = sites.on(performer.neutral.faces, moved)
    thin, whole = (
        ThinShell(performer.neutral.vertices, performer.neutral.faces, sites, level=level).spread(seen)
        for level in (None, 10**7)
    )
    between = (thin - whole).square().sum(-1).mean().sqrt()
    assert float(between) < 0.2 * float((whole - moved).square().sum(-1).mean().sqrt())
