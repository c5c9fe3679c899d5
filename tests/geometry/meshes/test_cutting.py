"""Cuts keep the surface: its area, its vertices and no cracks."""

import torch

from torchface.geometry.meshes.cutting import CutMesh, strip
from torchface.geometry.meshes.operators import border_edges, edges, triangle_areas


def sheet(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A square of count x count quads, the z of a saddle."""
    line = torch.linspace(-1, 1, count + 1, dtype=torch.float64)
    x, y = torch.meshgrid(line, line, indexing="ij")
    ids = torch.arange((count + 1) ** 2).view(count + 1, count + 1)
    quads = torch.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], -1).reshape(-1, 4)
    return torch.stack([x, y, 0 * x], -1).reshape(-1, 3), torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def test_splits_of_random_edges_keep_area_orientation_and_the_border() -> None:
    places, faces = sheet(5)
    cut = CutMesh.of(len(places), faces)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        ends = edges(cut.faces)
        ends = ends[torch.rand(len(ends), generator=generator) < 0.4]
        cut = cut.split(ends, 0.2 + 0.6 * torch.rand(len(ends), generator=generator, dtype=torch.float64))
    now = cut.at(places)
    assert torch.equal(now[: len(places)], places)
    corners = now[cut.faces]
    signed = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert float(signed.sum().abs()) == float(torch.tensor(4.0)) or abs(float(signed.sum().abs()) - 4) < 1e-9
    assert bool((signed * signed.sum().sign() > 0).all())
    border = now[cut.faces[:, [1, 2]][border_edges(cut.faces)[:, 0]]]
    assert bool((border.abs().amax(-1) > 1 - 1e-9).all())  # no crack inside
    area = torch.zeros(len(faces), dtype=torch.float64).index_add_(0, cut.source, triangle_areas(now, cut.faces))
    assert torch.allclose(area, triangle_areas(places, faces))


def test_a_torn_line_opens_between_its_ends() -> None:
    places, faces = sheet(4)
    level = places[:, 1] + 0.1 + 0 * places[:, 0]
    ends = edges(faces)
    share = level[ends[:, 0]] / (level[ends[:, 0]] - level[ends[:, 1]])
    point = places[ends[:, 0]] + share[:, None] * (places[ends[:, 1]] - places[ends[:, 0]])
    kept = (level[ends].prod(1) < 0) & (point[:, 0].abs() < 0.7)
    cut = CutMesh.of(len(places), faces).split(ends[kept], share[kept])
    new = torch.arange(len(places), len(places) + int(kept.sum()))
    inner = new[cut.at(places)[new, 0].argsort()][1:-1]
    far = torch.cat([level, torch.zeros(len(new), dtype=level.dtype)])
    torn = cut.torn(inner, far[cut.faces].sum(1) < 0)
    now = torn.at(places)
    assert int(border_edges(torn.faces).sum()) - int(border_edges(cut.faces).sum()) == 2 * (len(inner) + 1)
    middle = now[torn.faces].mean(1)[:, 1]
    for row in inner.tolist():
        assert bool((middle[(torn.faces == row).any(1)] > -0.1).all())


def test_a_strip_joins_two_loops_of_other_counts() -> None:
    outer, inner = torch.arange(7), torch.arange(7, 12)
    faces = strip(outer, inner, torch.arange(7) / 7, torch.arange(5) / 5)
    assert len(faces) == 12
    assert int(border_edges(faces).sum()) == 12
    assert set(faces.unique().tolist()) == set(range(12))
