"""The thin shell against a solve of its own in scipy, and what a spread motion must keep."""

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from torchface import Attachment, Mesh
from torchface.enhancement import thin_shell
from torchface.enhancement.coarse_level import coarse_level
from torchface.enhancement.thin_shell import ThinShell, rigid_motion
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.operators import border_vertices
from torchface.geometry.meshes.shell_energies import bending_energy, stretching_energy
from torchface.geometry.rotations import rotation_matrix


def sheet(bulge: float, count: int = 400, hole: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """An irregular sheet of 100 by 100 mm, bulging out, with a hole in it."""
    points = np.random.default_rng(3).uniform(-50, 50, (count, 2))
    faces = Delaunay(points).simplices
    middle = points[faces].mean(1)
    edge = np.abs(middle).max(1) < 44  # without the slivers of the hull
    faces = faces[edge & (np.linalg.norm(middle - [10, 5], axis=1) > (9 if hole else 0))]
    one, other = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    turned = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    faces[turned < 0] = faces[turned < 0][:, ::-1]
    used, faces = np.unique(faces, return_inverse=True)
    points = points[used]
    height = bulge * np.cos(points / 40).prod(1)
    vertices = np.concatenate([points, height[:, None]], 1)
    return torch.from_numpy(vertices).float(), torch.from_numpy(faces.reshape(-1, 3)).long()


def sites(faces: torch.Tensor, count: int) -> Attachment:
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(count, 3, generator=generator)
    return Attachment(torch.randperm(len(faces), generator=generator)[:count], weights / weights.sum(1, keepdim=True))


def own_solution(
    vertices: torch.Tensor, faces: torch.Tensor, points: Attachment, constants: tuple[float, float], wanted: np.ndarray
) -> np.ndarray:
    """The shell by its definition, edge by edge from slopes of linear functions, and one saddle-point system."""
    stretching, bending = constants
    place, triangles = vertices.double().numpy(), faces.numpy()
    slopes = np.zeros((len(triangles), 3, 3))  # of each corner's hat function
    areas = np.zeros(len(triangles))
    normals = np.zeros((len(triangles), 3))
    for t, corners in enumerate(triangles):
        a, b, c = place[corners]
        normals[t] = np.cross(b - a, c - a)
        areas[t] = np.linalg.norm(normals[t]) / 2
        normals[t] /= np.linalg.norm(normals[t])
        slopes[t] = np.linalg.pinv(np.stack([b - a, c - a])) @ np.array([[-1.0, 1, 0], [-1, 0, 1]])
    energy = sparse.lil_array((len(place), len(place)))
    beside: dict[tuple[int, int], list[int]] = {}
    for t, corners in enumerate(triangles):
        energy[np.ix_(corners, corners)] += stretching * areas[t] * slopes[t].T @ slopes[t]
        for i, j in ((0, 1), (1, 2), (2, 0)):
            beside.setdefault((min(corners[i], corners[j]), max(corners[i], corners[j])), []).append(t)
    for (i, j), both in beside.items():
        if len(both) != 2:
            continue
        along = place[j] - place[i]
        jump = np.zeros(len(place))
        for t in both:
            outward = np.cross(along, normals[t])  # as long as the edge
            third = next(corner for corner in triangles[t] if corner not in (i, j))
            outward *= -np.sign(outward @ (place[third] - place[i]))
            jump[triangles[t]] += slopes[t].T @ outward
        used = np.flatnonzero(jump)
        energy[np.ix_(used, used)] += bending * 3 / areas[both].sum() * np.outer(jump[used], jump[used])
    reads = sparse.lil_array((len(points.triangles), len(place)))
    for m, (t, weights) in enumerate(zip(points.triangles.tolist(), points.barycentric.double().numpy(), strict=True)):
        reads[m, triangles[t]] = weights
    saddle = sparse.block_array([[energy, reads.T], [reads, None]]).tocsc()
    return spsolve(saddle, np.concatenate([np.zeros((len(place), wanted.shape[1])), wanted]))[: len(place)]


@pytest.mark.parametrize("operator", [True, False])
def test_it_agrees_with_a_solve_of_its_own(operator: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thin_shell, "_OPERATOR_POINTS", 400 if operator else 0)
    vertices, faces = sheet(20.0, 130)
    points = sites(faces, 16)
    wanted = torch.randn(2, 16, 3, generator=torch.Generator().manual_seed(2))
    found = ThinShell(vertices, faces, points, 1.0, 50.0).spread(wanted)
    expected = own_solution(
        vertices, faces, points, (1.0, 50.0), wanted.permute(1, 0, 2).reshape(16, 6).double().numpy()
    )
    expected = torch.from_numpy(expected).float().reshape(-1, 2, 3).transpose(0, 1)
    assert expected.abs().max() > 2
    torch.testing.assert_close(found, expected, atol=1e-3 if operator else 1e-2, rtol=0)
    torch.testing.assert_close(points.on(faces, found), wanted, atol=1e-5 if operator else 1e-3, rtol=0)


@pytest.mark.parametrize("operator", [True, False])
def test_affine_motion_of_a_flat_sheet_is_kept_to_its_rims(operator: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thin_shell, "_OPERATOR_POINTS", 400 if operator else 0)
    vertices, faces = sheet(0.0)
    field = vertices @ torch.tensor([[0.3, -0.1, 0.2], [0.1, 0.2, -0.3], [0.0, 0.0, 0.0]]) + 2.0
    points = sites(faces, 20)
    found = ThinShell(vertices, faces, points, stretching=0.0).spread(points.on(faces, field)[None])[0]
    assert border_vertices(faces, len(vertices)).sum() > 40
    torch.testing.assert_close(found, field, atol=2e-3, rtol=0)


@pytest.mark.parametrize("level", [None, 120])
def test_a_translation_is_kept_exactly(level: int | None) -> None:
    vertices, faces = sheet(20.0)
    shift = torch.tensor([3.0, -2.0, 7.0])
    found = ThinShell(vertices, faces, sites(faces, 30), level=level).spread(shift.expand(1, 30, 3))
    torch.testing.assert_close(found, shift.expand_as(found), atol=1e-4, rtol=0)


@pytest.mark.parametrize("operator", [True, False])
def test_a_point_that_was_not_seen_holds_nothing(operator: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thin_shell, "_OPERATOR_POINTS", 400 if operator else 0)
    vertices, faces = sheet(20.0)
    points = sites(faces, 30)
    wanted = torch.randn(3, 30, 3, generator=torch.Generator().manual_seed(4))
    lost = wanted.clone()
    lost[1, 20:] = torch.nan
    lost[2, 5:] = torch.nan
    found = ThinShell(vertices, faces, points).spread(lost)
    fewer = ThinShell(vertices, faces, points.select(points.labels[:20])).spread(wanted[:, :20])
    torch.testing.assert_close(found[1], fewer[1], atol=1e-3, rtol=0)
    torch.testing.assert_close(points.on(faces, found[0]), wanted[0], atol=1e-3, rtol=0)
    assert found[2].isnan().all()  # five points are too few


def test_a_coarse_level_comes_near_the_whole_and_carries_affine_fields() -> None:
    flat, faces = sheet(0.0, 2000)
    level = coarse_level(flat, faces, 300)
    assert 150 < len(level.vertex_ids) <= 300
    field = flat @ torch.tensor([[0.3, -0.1, 0.2], [0.1, 0.2, -0.3], [0.0, 0.0, 0.0]]) + 2.0
    carried = torch.from_numpy(level.prolongation @ field[level.vertex_ids].double().numpy()).float()
    assert float((carried - field).norm(dim=1).quantile(0.98)) < 1e-4  # the others lie far outside of a rim triangle
    vertices, faces = sheet(20.0, 2000)
    wanted = torch.sin(vertices / 15)[None]
    points = sites(faces, 60)
    thin, whole = (
        ThinShell(vertices, faces, points, level=count).spread(points.on(faces, wanted)) for count in (300, 10_000)
    )
    assert float((thin - wanted).square().mean().sqrt()) < 1.2 * float((whole - wanted).square().mean().sqrt())


def test_a_loose_part_moves_as_one_with_what_it_lies_nearest_to() -> None:
    vertices, faces = sheet(20.0)
    ball = vertices[:4] * 0.01 + torch.tensor([-30.0, -30.0, 25.0])
    both = torch.cat([vertices, ball])
    loose = torch.tensor([[0, 1, 2], [0, 2, 3]]) + len(vertices)
    field = torch.where(vertices[:, :1] < 0, torch.tensor([[5.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, -5.0]]))
    points = Attachment.from_vertices(Mesh(vertices, faces), torch.arange(0, len(vertices), 2))
    found = ThinShell(both, torch.cat([faces, loose]), points).spread(points.on(faces, field)[None])[0, -4:]
    torch.testing.assert_close(found, torch.tensor([[5.0, 0.0, 0.0]]).expand(4, 3), atol=0.2, rtol=0)
    torch.testing.assert_close(found, found[:1].expand(4, 3), atol=1e-5, rtol=0)


def test_a_head_that_turns_takes_the_spread_motion_along() -> None:
    vertices, faces = sheet(20.0)
    points = sites(faces, 40)
    shell = ThinShell(vertices, faces, points)
    seen = shell.rest + torch.randn(1, 40, 3, generator=torch.Generator().manual_seed(5))
    seen[:, :8] += torch.tensor([0.0, -12.0, 0.0])  # an open jaw
    turn = rotation_matrix(torch.tensor([0.2, -0.5, 0.3]))
    moved = seen @ turn.T + torch.tensor([30.0, 400.0, -50.0])
    expected = shell.follow(seen) @ turn.T + torch.tensor([30.0, 400.0, -50.0])
    torch.testing.assert_close(shell.follow(moved), expected, atol=1e-3, rtol=0)


def test_an_open_jaw_does_not_turn_the_head() -> None:
    vertices, faces = sheet(20.0)
    shell = ThinShell(vertices, faces, sites(faces, 40))
    seen = shell.rest[None].clone()
    seen[0, shell.rest[:, 1] < -25] += torch.tensor([0.0, -15.0, -5.0])
    pose = rigid_motion(shell.rest, seen)
    assert float((pose.apply(shell.rest) - shell.rest).norm(dim=-1).max()) < 0.6


def test_stretching_and_bending_cost_nothing_where_nothing_stretches_or_bends() -> None:
    vertices, faces = sheet(20.0)
    for energy in (stretching_energy(vertices, faces), bending_energy(vertices, faces)):
        assert np.abs(energy.sum(1)).max() < 1e-9
        assert abs(energy - energy.T).max() < 1e-9


def test_what_cannot_be_spread_is_named() -> None:
    vertices, faces = sheet(20.0)
    with pytest.raises(ShapeError, match="found 11 points, expected at least 12"):
        ThinShell(vertices, faces, sites(faces, 11))
    with pytest.raises(TopologyError, match="expected 0 to"):
        ThinShell(vertices, faces, torch.arange(12) + len(vertices))
    with pytest.raises(ValueRangeError, match="stretching -1"):
        ThinShell(vertices, faces, sites(faces, 12), stretching=-1.0)
    shell = ThinShell(vertices, faces, sites(faces, 12))
    with pytest.raises(ShapeError, match=r"expected \(T,12,3\)"):
        shell.spread(torch.zeros(1, 13, 3))
    with pytest.raises(ValueRangeError, match="infinite"):
        shell.spread(torch.full((1, 12, 3), torch.inf))
