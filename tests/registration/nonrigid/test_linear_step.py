"""The quadratic of non-rigid ICP, against scipy."""

import numpy as np
import pytest
import torch
from scipy import sparse

from torchface.mesh import Mesh
from torchface.registration.nonrigid.deformer import identity_maps, linked_edges, stiffness_rows
from torchface.registration.nonrigid.linear_step import Contacts, Data, LinearStep
from torchface.registration.nonrigid.subspace import Subspace, all_maps, graph, translations

ALPHA, BETA, LENGTH = 1.7, 2.5, 10.0


@pytest.fixture(scope="module")
def patch(make_mask) -> Mesh:
    return make_mask(7, 9)


@pytest.fixture(scope="module")
def data(patch: Mesh) -> Data:
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(40, 3))
    return Data(
        patch.vertices[:40].numpy() + generator.normal(size=(40, 3)),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        generator.uniform(0, 2, 40) * (generator.uniform(size=40) > 0.2),
        patch.vertices[patch.landmarks].numpy() + generator.normal(size=(8, 3)),
    )


def step(space: Subspace, patch: Mesh, sliding: float) -> LinearStep:
    return LinearStep(space, np.arange(40), patch.landmarks.numpy(), ALPHA, BETA, sliding)


def stacked(patch: Mesh, data: Data, sliding: float) -> tuple[sparse.csr_array, np.ndarray]:
    """A and B of equation 7 with the three coordinates one after the other, row by row as they are written."""
    stiffness = ALPHA * stiffness_rows(patch.vertices, patch.faces, LENGTH)
    count = stiffness.shape[1]
    place = sparse.eye_array(count, format="csr")[3::4]
    rows = [sparse.block_diag([stiffness] * 3)]
    values = [np.zeros(3 * stiffness.shape[0])]
    for weight, normal, target, vertex in zip(data.weights, data.normals, data.targets, range(40), strict=True):
        across = np.outer(normal, normal)
        block = np.sqrt(weight) * (across + np.sqrt(sliding) * (np.eye(3) - across))
        one = place[[vertex]]
        rows.append(sparse.block_array([[block[i, k] * one for k in range(3)] for i in range(3)]))
        values.append(block @ target)
    landmarks = place[patch.landmarks.numpy()]
    rows.append(BETA * sparse.block_diag([landmarks] * 3))
    values.append(BETA * data.landmarks.T.ravel())
    return sparse.vstack(rows).tocsr(), np.concatenate(values)


@pytest.mark.parametrize("sliding", [1.0, 0.05])
def test_optimum_agrees_with_scipy_least_squares(patch: Mesh, data: Data, sliding: float) -> None:
    matrix, target = stacked(patch, data, sliding)
    expected = np.linalg.lstsq(matrix.toarray(), target, rcond=None)[0].reshape(3, -1).T
    space = all_maps(stiffness_rows(patch.vertices, patch.faces, LENGTH))
    found = step(space, patch, sliding).minimise(identity_maps(patch.vertices), data, tolerance=1e-9)
    assert np.allclose(found, expected, atol=1e-5)


def test_energy_is_the_stacked_systems_residual(patch: Mesh, data: Data) -> None:
    matrix, target = stacked(patch, data, 0.3)
    maps = identity_maps(patch.vertices) + np.random.default_rng(1).normal(size=(4 * 63, 3)) * 0.1
    space = all_maps(stiffness_rows(patch.vertices, patch.faces, LENGTH))
    residual = matrix @ maps.T.ravel() - target
    assert step(space, patch, 0.3).energy(maps, data) == pytest.approx(float(residual @ residual), rel=1e-10)


def test_optimum_of_a_subspace_agrees_with_scipy_least_squares(patch: Mesh, data: Data) -> None:
    matrix, target = stacked(patch, data, 0.2)
    stiffness = stiffness_rows(patch.vertices, patch.faces, LENGTH)
    pairs = linked_edges(patch.vertices, patch.faces)
    start = identity_maps(patch.vertices)
    for space in (graph(patch.vertices.numpy(), pairs, stiffness, 12), translations(stiffness)):
        basis = sparse.block_diag([space.basis] * 3)
        left = target - matrix @ start.T.ravel()
        best = np.linalg.lstsq((matrix @ basis).toarray(), left, rcond=None)[0]
        expected = start + (basis @ best).reshape(3, -1).T
        found = step(space, patch, 0.2).minimise(start, data, tolerance=1e-9)
        assert np.allclose(found, expected, atol=1e-5)


def test_gradient_vanishes_at_the_optimum(patch: Mesh, data: Data) -> None:
    space = all_maps(stiffness_rows(patch.vertices, patch.faces, LENGTH))
    solver = step(space, patch, 0.1)
    best = solver.minimise(identity_maps(patch.vertices), data, tolerance=1e-9)
    lowest, generator = solver.energy(best, data), np.random.default_rng(2)
    for size in (1e-3, 1e-1):  # a quadratic grows with the square of the distance from where it is least
        way = generator.normal(size=best.shape)
        there, back = solver.energy(best + size * way, data), solver.energy(best - size * way, data)
        assert there - lowest == pytest.approx(back - lowest, rel=1e-4)
        assert there > lowest


def test_without_any_correspondence_the_maps_stay(patch: Mesh, data: Data) -> None:
    empty = Data(data.targets, data.normals, np.zeros(40), np.zeros((0, 3)))
    space = all_maps(stiffness_rows(patch.vertices, patch.faces, LENGTH))
    start = identity_maps(patch.vertices)
    alone = LinearStep(space, np.arange(40), np.zeros(0, dtype=np.int64), ALPHA, BETA, 0.1)
    assert np.allclose(alone.minimise(start, empty), start, atol=1e-6)


def test_the_kept_factorisation_serves_other_weights(patch: Mesh, data: Data) -> None:
    space = all_maps(stiffness_rows(patch.vertices, patch.faces, LENGTH))
    start, kept = identity_maps(patch.vertices), step(space, patch, 0.1)
    kept.minimise(start, data)
    other = Data(data.targets, data.normals, data.weights[::-1].copy(), data.landmarks)
    again = kept.minimise(start, other, tolerance=1e-9)
    fresh = step(space, patch, 0.1).minimise(start, other, tolerance=1e-9)
    assert torch.allclose(torch.from_numpy(again), torch.from_numpy(fresh), atol=1e-6)


def test_contacts_keep_their_offset_and_the_optimum_agrees_with_scipy(patch: Mesh, data: Data) -> None:
    generator = np.random.default_rng(3)
    pairs = np.array([[3, 40], [10, 55], [20, 21]])
    contacts = Contacts(pairs, generator.normal(size=(3, 3)), np.array([1.0, 30.0, 0.0]))
    matrix, target = stacked(patch, data, 0.3)
    place = sparse.eye_array(4 * len(patch.vertices), format="csr")[3::4]
    rows = sparse.diags_array(np.sqrt(contacts.weights)) @ (place[pairs[:, 1]] - place[pairs[:, 0]])
    matrix = sparse.vstack([matrix, sparse.block_diag([rows] * 3)])
    target = np.concatenate([target, (np.sqrt(contacts.weights)[:, None] * contacts.offsets).T.ravel()])
    expected = np.linalg.lstsq(matrix.toarray(), target, rcond=None)[0].reshape(3, -1).T
    space = all_maps(stiffness_rows(patch.vertices, patch.faces, LENGTH))
    solver = LinearStep(space, np.arange(40), patch.landmarks.numpy(), ALPHA, BETA, 0.3, contacts)
    found = solver.minimise(identity_maps(patch.vertices), data, tolerance=1e-9)
    assert np.allclose(found, expected, atol=1e-5)
    residual = matrix @ found.T.ravel() - target
    assert solver.energy(found, data) == pytest.approx(float(residual @ residual), rel=1e-8)
