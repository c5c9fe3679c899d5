"""Regions are what moves together, named by place, with Gaussian borders."""

import numpy as np
import pytest
import torch

from torchface.enhancement.matching.face_regions import regions_of_motion, soft_weights, surface_distances
from torchface.enhancement.matching.patches import grow_patches, patch_means
from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import triangle_areas


def _sheet(count: int, edge: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A flat square of ``count`` by ``count`` vertices in the plane of x and y."""
    row = torch.arange(count) * edge
    y, x = torch.meshgrid(row, row, indexing="ij")
    number = torch.arange(count * count).view(count, count)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = torch.cat([torch.stack([a, b, d], -1).view(-1, 3), torch.stack([a, d, c], -1).view(-1, 3)])
    return torch.stack([x, y, torch.zeros_like(x)], -1).view(-1, 3), faces


def _motion_of_patches(displacements: torch.Tensor, database) -> tuple[torch.Tensor, torch.Tensor]:
    """The patch of each triangle (F,), and the mean displacements of each patch, (K,P,3)."""
    patches = grow_patches(database.faces, len(database.neutral), 4)
    areas = triangle_areas(database.neutral, database.faces)
    return patches, patch_means(displacements[:, database.faces].mean(2), patches, areas)


def test_borders_fall_off_as_a_gaussian_of_the_distance():
    vertices, faces = _sheet(41, 1.0)
    left = vertices[faces].mean(1)[:, 0] < 10
    weights = soft_weights((~left).long(), 2, vertices, faces, 5.0).float()
    assert bool((weights[0, left] == 1).all())
    middles = vertices[faces].mean(1)
    row = (middles[:, 1] - 20.5).abs() < 0.4
    far = row & ~left
    expected = torch.exp(-0.5 * ((middles[far, 0] - 10) / 5) ** 2)
    assert float((weights[0, far] - expected).abs().max()) < 0.03


def test_distances_along_a_flat_sheet_are_straight_along_its_edges():
    vertices, faces = _sheet(21, 2.0)
    distance = surface_distances(vertices, faces, torch.tensor([0]))
    assert torch.allclose(distance[:21], vertices[:21, 0])
    assert float(distance[-1]) == pytest.approx(20 * 2.0 * 2**0.5, rel=1e-6)  # the diagonals are edges


def test_regions_have_names_and_sides_and_are_a_partition(database):
    displacements = database.smooth - database.neutral
    moved = torch.cat([displacements, displacements.flip(0) * 0.5])
    patches, motion = _motion_of_patches(moved, database)
    regions = regions_of_motion(motion, patches, database.neutral, database.faces, 9, database.landmarks)
    assert {"eye_left", "eye_right"} < set(regions.names)
    assert len(set(regions.names)) == 9
    assert any(name.startswith("mouth") for name in regions.names)
    assert bool(regions.voluntary.any())
    inside = regions.weights.float() == 1
    assert bool(inside.any(0).all())
    assert float((inside.sum(0) == 1).float().mean()) > 0.9  # but for triangles within rounding of a border
    shares = regions.vertex_weights(database.faces, len(database.neutral))
    assert torch.allclose(shares.sum(0), torch.ones(len(database.neutral)))
    eyes = {name: regions.weights[regions.names.index(name)].float() == 1 for name in ("eye_left", "eye_right")}
    middles = database.neutral[database.faces].mean(1)[:, 0]
    # The actor's left eye lies to the viewer's right.
    assert float(middles[eyes["eye_left"]].min()) > 0 > float(middles[eyes["eye_right"]].max())


def test_a_face_that_does_not_move_has_no_regions(database):
    patches, motion = _motion_of_patches(database.smooth[:3], database)
    with pytest.raises(ValueRangeError, match=r"0 of \d+ patches that move"):
        regions_of_motion(torch.zeros_like(motion), patches, database.neutral, database.faces, 4)


def test_a_cluster_that_no_triangle_is_left_of_is_no_region(database, monkeypatch: pytest.MonkeyPatch) -> None:
    patches, motion = _motion_of_patches(database.smooth - database.neutral, database)
    one = np.zeros(int(patches.max()) + 1, np.int64)
    monkeypatch.setattr("torchface.enhancement.matching.face_regions.motion_clusters", lambda *_: one)
    regions = regions_of_motion(motion, patches, database.neutral, database.faces, 4, database.landmarks)
    assert regions.names == ("mouth", "eye_right", "eye_left")
    assert bool((regions.weights.float().amax(1) == 1).all())
