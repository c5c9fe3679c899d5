"""Patches are connected and even, their means are integrals."""

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from torchface.enhancement.matching.patches import grow_patches, neighbouring_triangles, patch_means
from torchface.geometry.meshes.operators import triangle_areas


def test_patches_are_connected_even_and_follow_their_seed(database):
    faces, count = database.faces, len(database.neutral)
    patches = grow_patches(faces, count, 100, seed=3)
    links = neighbouring_triangles(faces)
    inside = links[patches[links[:, 0]] == patches[links[:, 1]]].numpy()
    graph = coo_array((np.ones(len(inside)), inside.T), shape=(len(faces),) * 2)
    assert connected_components(graph, directed=False)[0] == int(patches.max()) + 1
    sizes = patches.bincount().float()
    assert 0.3 * sizes.mean() < sizes.median() < 2 * sizes.mean()
    assert float(sizes.max()) < 4 * float(sizes.mean())
    assert torch.equal(patches, grow_patches(faces, count, 100, seed=3))
    assert not torch.equal(patches, grow_patches(faces, count, 100, seed=4))


def test_patch_means_are_integrals_over_areas(database):
    patches = grow_patches(database.faces, len(database.neutral), 100)
    areas = triangle_areas(database.neutral, database.faces).double()
    values = torch.rand(2, len(patches), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    means = patch_means(values, patches, areas)
    total = torch.zeros(int(patches.max()) + 1, dtype=torch.float64).index_add(0, patches, areas)
    whole = (means * total[:, None]).sum(1)
    assert torch.allclose(whole, (values * areas[:, None]).sum(1), rtol=1e-9)
