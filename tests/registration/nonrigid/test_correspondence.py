"""Each test that refuses a correspondence, on surfaces made for it."""

import torch

from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Mesh
from torchface.registration.nonrigid.correspondence import correspondences, evenly_spread, exposed_vertices


def flat(columns: int, rows: int, height: float = 0.0, step: float = 10.0) -> Mesh:
    x, y = torch.meshgrid(torch.arange(columns) * step, torch.arange(rows) * step, indexing="ij")
    vertices = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3).double()
    ids = torch.arange(columns * rows).reshape(columns, rows)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    faces = torch.cat([torch.stack([a, b, c], -1).reshape(-1, 3), torch.stack([a, c, d], -1).reshape(-1, 3)])
    return Mesh(vertices, faces)


def found_between(template: Mesh, scan: Mesh, reach: float = 20.0):
    everyone = torch.arange(len(template.vertices))
    index = SurfaceIndex(scan.vertices, scan.faces)
    return correspondences(template.vertices, template.faces, everyone, index, reach, 60.0)


def test_what_lands_on_the_border_is_dropped() -> None:
    template, scan = flat(7, 3, 1.0), flat(4, 3)
    found = found_between(template, scan)
    beyond = template.vertices[:, 0] >= 30
    edge = (template.vertices[:, 1] == 0) | (template.vertices[:, 1] == 20) | (template.vertices[:, 0] == 0)
    assert torch.equal(found.weights == 0, beyond | edge)
    assert found.dropped == {"distance": 6, "border": 13, "normal": 0}


def test_what_is_too_far_is_dropped_and_what_is_nearer_weighs_more() -> None:
    scan = flat(5, 5)
    assert found_between(flat(5, 5, 21.0), scan).dropped["distance"] == 25
    weights = [float(found_between(flat(5, 5, height), scan).weights.max()) for height in (0.0, 5.0, 10.0, 19.0)]
    assert weights[0] == 1.0
    assert weights[2] == 0.25
    assert weights == sorted(weights, reverse=True)


def test_a_normal_that_differs_by_more_than_sixty_degrees_is_dropped() -> None:
    scan = flat(5, 5)
    turned = Mesh(scan.vertices + torch.tensor([0, 0, 1.0]), scan.faces.flip(1))
    assert found_between(turned, scan).dropped["normal"] == 9  # the other sixteen land on the border first
    for degrees, dropped in ((50.0, 0), (70.0, 25)):
        tilt = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
        shrunk = (scan.vertices - 20.0) * 0.4
        x, y = shrunk[:, 0], shrunk[:, 1]
        leaning = Mesh(torch.stack([x * tilt.cos() + 20, y + 20, x * tilt.sin()], -1), scan.faces)
        assert found_between(leaning, scan).dropped["normal"] == dropped


def test_points_and_normals_are_the_scans() -> None:
    found = found_between(flat(5, 5, 3.0), flat(5, 5))
    inner = found.weights > 0
    assert torch.allclose(found.points[inner][:, 2], torch.zeros(9, dtype=torch.float64))
    assert torch.allclose(found.distance, torch.full((25,), 3.0, dtype=torch.float64))
    assert torch.allclose(found.normals[:, 2], torch.ones(25, dtype=torch.float64))


def test_what_lies_behind_something_is_not_exposed() -> None:
    back, front = flat(9, 9), flat(3, 3, 5.0)
    vertices = torch.cat([back.vertices, front.vertices + torch.tensor([30.0, 30.0, 0.0])])
    faces = torch.cat([back.faces, front.faces + len(back.vertices)])
    x, y = vertices[:81, 0], vertices[:81, 1]
    under = (x > 30) & (x < 50) & (y > 30) & (y < 50)
    near = exposed_vertices(vertices, faces, 10.0)
    assert not near[:81][under].any()
    assert near[81:].all()
    assert near[:81][(x < 30) | (x > 50)].all()
    assert exposed_vertices(vertices, faces, 4.0).all()


def test_a_vertex_of_no_triangle_is_not_exposed() -> None:
    sheet = flat(3, 3)
    vertices = torch.cat([sheet.vertices, torch.tensor([[0.0, 0.0, 50.0]], dtype=torch.float64)])
    assert exposed_vertices(vertices, sheet.faces, 10.0).tolist() == [True] * 9 + [False]


def test_a_spread_choice_leaves_no_large_gap(mask) -> None:
    everyone = torch.arange(len(mask.vertices))
    chosen = evenly_spread(mask.vertices, everyone, 300)
    assert 200 <= len(chosen) <= 300
    assert len(chosen.unique()) == len(chosen)
    gap = torch.cdist(mask.vertices, mask.vertices[chosen]).min(1).values
    assert float(gap.max()) < 2.5 * float((160 * 220 / 300) ** 0.5)
    assert torch.equal(evenly_spread(mask.vertices, everyone, 5000), everyone)
