"""What the stiffness term and its subspaces keep unchanged."""

import numpy as np
import pytest
import torch
import trimesh

from torchface.registration.nonrigid.deformer import identity_maps, linked_edges, positions, stiffness_rows
from torchface.registration.nonrigid.subspace import graph


def affine_maps(vertices: torch.Tensor, linear: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """One affine motion of the whole, x -> x A + b, as the maps of all vertices."""
    maps = np.zeros((len(vertices), 4, 3))
    maps[:, :3] = linear
    maps[:, 3] = vertices.numpy() @ linear + offset
    return maps.reshape(-1, 3)


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    return np.eye(3) + 0.3 * generator.normal(size=(3, 3)), generator.normal(size=3) * 100


def test_an_affine_motion_of_the_whole_costs_nothing(mask, motion) -> None:
    rows = stiffness_rows(mask.vertices, mask.faces, 10.0)
    assert np.abs(rows @ affine_maps(mask.vertices, *motion)).max() < 1e-9
    bent = identity_maps(mask.vertices)
    bent[3] += 1.0
    assert np.square(rows @ bent).sum() > 0.5


def test_the_energy_does_not_depend_on_where_the_origin_lies(mask) -> None:
    noise = np.random.default_rng(1).normal(size=(4 * len(mask.vertices), 3))
    energies = []
    for shift in (0.0, 1000.0):
        vertices = mask.vertices + shift
        maps = identity_maps(vertices) + noise
        energies.append(np.square(stiffness_rows(vertices, mask.faces, 10.0) @ maps).sum())
    assert energies[0] == pytest.approx(energies[1], rel=1e-9)


def test_a_graph_of_few_nodes_spans_every_affine_motion(mask, motion) -> None:
    stiffness = stiffness_rows(mask.vertices, mask.faces, 10.0)
    space = graph(mask.vertices.numpy(), linked_edges(mask.vertices, mask.faces), stiffness, 40)
    assert space.basis.shape[1] == 160
    maps = affine_maps(mask.vertices, *motion)
    best = np.linalg.lstsq(space.basis.toarray(), maps, rcond=None)[0]
    assert np.allclose(space.basis @ best, maps, atol=1e-6)


def test_lips_that_touch_do_not_share_nodes() -> None:
    """Two sheets a millimetre apart, joined far away: a node of one has no say in the other."""
    x, y = np.meshgrid(np.arange(0, 60.0, 3), np.arange(0, 30.0, 3), indexing="ij")
    upper = np.stack([x, y, np.full_like(x, 1.0)], -1).reshape(-1, 3)
    lower = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    ids = np.arange(200).reshape(20, 10)
    quads = np.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], -1).reshape(-1, 4)
    sheet = np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    hinge = np.stack([ids[0, :-1], ids[0, 1:], ids[0, :-1] + 200], -1)
    points, faces = torch.tensor(np.vstack([upper, lower])), torch.tensor(np.vstack([sheet, sheet + 200, hinge]))
    space = graph(points.numpy(), linked_edges(points, faces), stiffness_rows(points, faces, 10.0), 60)
    weights = np.abs(space.positions.toarray())[:, 3::4] > 1e-6
    far_end = weights[points[:, 0].numpy() > 40]
    half = len(far_end) // 2
    assert not (far_end[:half].any(0) & far_end[half:].any(0)).any()


def test_loose_parts_are_linked_to_what_is_nearest(mask) -> None:
    ball = trimesh.creation.icosphere(1, 6.0)
    beside = torch.tensor(ball.vertices) + mask.vertices[mask.landmarks[0]]
    vertices = torch.cat([mask.vertices, beside, beside + torch.tensor([0.0, 60.0, 0.0])])
    count = len(mask.vertices)
    faces = torch.cat([mask.faces, torch.tensor(ball.faces) + count, torch.tensor(ball.faces) + count + len(beside)])
    pairs = linked_edges(vertices, faces)
    graph_of_all = trimesh.graph.connected_components(pairs, nodes=np.arange(len(vertices)))
    assert len(graph_of_all) == 1
    first = pairs[(pairs[:, 0] < count) & (pairs[:, 1] >= count) & (pairs[:, 1] < count + len(beside))]
    assert len(first) >= 3
    assert np.linalg.norm(vertices.numpy()[first[:, 0]] - vertices.numpy()[first[:, 1]], axis=1).max() < 4


def test_identity_maps_leave_every_vertex_in_place(mask) -> None:
    assert torch.equal(positions(identity_maps(mask.vertices)), mask.vertices)
