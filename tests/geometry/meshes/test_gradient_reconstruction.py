"""Vertices from gradients, against a dense least squares solution of equation 25 with every fourth vertex unknown."""

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.deformation import deformation_gradients, triangle_frames
from torchface.geometry.meshes.gradient_reconstruction import GradientReconstruction, offset_constraints


def sheet(seed: int, count: int = 30) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-10, 10, (count, 2))
    vertices = np.concatenate([flat, rng.normal(0, 1, (count, 1))], 1)
    return torch.from_numpy(vertices), torch.from_numpy(Delaunay(flat).simplices).long()


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def dense_equation_25(
    rest: np.ndarray, faces: np.ndarray, asked: np.ndarray, held: dict[int, np.ndarray]
) -> np.ndarray:
    """min |c - A x| with all vertices and one fourth vertex a triangle as unknowns, as Sumner writes it."""
    count, triangles = len(rest), len(faces)
    matrix, wanted = np.zeros((3 * triangles, count + triangles)), np.zeros((3 * triangles, 3))
    for t, (a, b, c) in enumerate(faces):
        normal = np.cross(rest[b] - rest[a], rest[c] - rest[a])
        frame = np.stack([rest[b] - rest[a], rest[c] - rest[a], normal / np.sqrt(np.linalg.norm(normal))], axis=1)
        differences = np.zeros((count + triangles, 3))
        for column, end in enumerate((b, c, count + t)):
            differences[end, column] += 1
            differences[a, column] -= 1
        matrix[3 * t : 3 * t + 3] = (differences @ np.linalg.inv(frame)).T
        wanted[3 * t : 3 * t + 3] = asked[t].T
    known = np.array(list(held))
    unknown = np.setdiff1d(np.arange(count + triangles), known)
    values = np.stack([held[v] for v in known])
    solved, *_ = np.linalg.lstsq(matrix[:, unknown], wanted - matrix[:, known] @ values, rcond=None)
    result = np.zeros((count + triangles, 3))
    result[unknown], result[known] = solved, values
    return result[:count]


def test_it_agrees_with_dense_least_squares_over_all_fourth_vertices() -> None:
    rest, faces = sheet(0)
    other, _ = sheet(1)
    asked = deformation_gradients(other, other + noise(30, 3), faces)
    pinned = torch.zeros(30, dtype=torch.bool)
    pinned[[3, 7, 11]] = True
    positions = rest + noise(30, 3, seed=1)
    held = {v: positions[v].numpy() for v in (3, 7, 11)}
    expected = dense_equation_25(rest.numpy(), faces.numpy(), asked.numpy(), held)
    solved = GradientReconstruction(rest, faces).solve(asked[None], positions[None], pinned)[0]
    np.testing.assert_allclose(solved.numpy(), expected, atol=1e-5)
    np.testing.assert_array_equal(solved[pinned].numpy(), positions[pinned].numpy())


def test_gradients_of_a_pose_give_the_pose_back() -> None:
    rest, faces = sheet(2)
    poses = rest + noise(3, 30, 3)
    pinned = torch.zeros(30, dtype=torch.bool)
    pinned[0] = True
    start = rest.expand(3, -1, -1).clone()
    start[:, 0] = poses[:, 0]
    solved = GradientReconstruction(rest, faces).solve(deformation_gradients(rest, poses, faces), start, pinned)
    torch.testing.assert_close(solved, poses, atol=1e-4, rtol=0)


def test_solving_together_is_solving_one_by_one() -> None:
    rest, faces = sheet(3)
    asked = deformation_gradients(rest, rest + noise(4, 30, 3), faces)
    positions = rest + noise(4, 30, 3, seed=3)
    pinned = torch.zeros(30, dtype=torch.bool)
    pinned[[1, 2]] = True
    system = GradientReconstruction(rest, faces)
    pair = offset_constraints(torch.tensor([[5, 9]]), torch.zeros(1, 3), torch.ones(1), 30)
    together = system.solve(asked, positions, pinned, [pair])
    alone = torch.cat([system.solve(asked[i : i + 1], positions[i : i + 1], pinned, [pair]) for i in range(4)])
    torch.testing.assert_close(together, alone, atol=1e-10, rtol=0)


def test_a_heavy_offset_holds_and_a_light_one_hardly_pulls() -> None:
    rest, faces = sheet(4)
    identity = torch.eye(3, dtype=torch.float64).expand(1, len(faces), 3, 3)
    pinned = torch.zeros(30, dtype=torch.bool)
    pinned[0] = True
    wish = torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64)
    distance = []
    for weight in (1e6, 1e-6):
        pair = offset_constraints(torch.tensor([[4, 20]]), wish, torch.tensor([weight]), 30)
        solved = GradientReconstruction(rest, faces).solve(identity, rest[None], pinned, [pair])[0]
        distance.append(float((solved[4] - solved[20] - wish[0]).norm()))
    assert distance[0] < 1e-3
    assert abs(distance[1] - float((rest[4] - rest[20] - wish[0]).norm())) < 1e-3


def test_a_part_without_pins_and_a_loose_vertex_stay_where_they_are_put() -> None:
    rest, faces = sheet(5)
    rest = torch.cat([rest, rest + 50, torch.tensor([[1.0, 2.0, 3.0]])])
    faces = torch.cat([faces, faces + 30])
    pinned = torch.zeros(61, dtype=torch.bool)
    pinned[:30] = True
    positions = rest.clone()
    positions[30:] += 4.0
    identity = torch.eye(3, dtype=torch.float64).expand(1, len(faces), 3, 3)
    solved = GradientReconstruction(rest, faces).solve(identity, positions[None], pinned)[0]
    torch.testing.assert_close(solved, positions, atol=1e-6, rtol=0)


def test_the_answer_turns_with_rest_and_target() -> None:
    rest, faces = sheet(6)
    turn, _ = torch.linalg.qr(noise(3, 3, seed=9))
    turn = turn * torch.det(turn).sign()
    asked = deformation_gradients(rest, rest + noise(30, 3), faces)
    assert triangle_frames(rest, faces).shape == asked.shape
    pinned = torch.zeros(30, dtype=torch.bool)
    pinned[0] = True
    straight = GradientReconstruction(rest, faces).solve(asked[None], rest[None], pinned)[0]
    turned = rest @ turn.T
    result = GradientReconstruction(turned, faces).solve((turn @ asked @ turn.T)[None], turned[None], pinned)[0]
    torch.testing.assert_close(result, straight @ turn.T, atol=1e-5, rtol=0)


def test_wrong_shapes_and_nan_are_named() -> None:
    rest, faces = sheet(7)
    system = GradientReconstruction(rest, faces)
    identity = torch.eye(3, dtype=torch.float64).repeat(1, len(faces), 1, 1)
    pinned = torch.ones(30, dtype=torch.bool)
    with pytest.raises(ShapeError, match="pinned"):
        system.solve(identity, rest[None], pinned[:-1])
    with pytest.raises(ValueRangeError, match="gradients"):
        system.solve(identity * torch.nan, rest[None], pinned)
