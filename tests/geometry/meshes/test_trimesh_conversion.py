import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from torchface.errors import ShapeError, ValueRangeError
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def head() -> Mesh:
    """The embedded performer, whose texture coordinates have seams."""
    mesh = performer().neutral
    return replace(mesh, colors=torch.rand(mesh.vertices.shape, generator=torch.Generator().manual_seed(0)))


def test_area_volume_and_ray_hits_are_those_of_trimesh(head: Mesh) -> None:
    other = head.to_trimesh()
    a, b, c = head.vertices.double()[head.faces].unbind(1)
    assert other.area == pytest.approx(float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2), rel=1e-9)
    assert Mesh.from_trimesh(trimesh.creation.box(extents=(10, 20, 30))).to_trimesh().volume == pytest.approx(6000)
    origins = torch.tensor([[x, y, 500.0] for x in (-30.3, 0.2, 30.1) for y in (-40.7, 10.3)], dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(len(origins), 3)
    ours = RayCaster(head.vertices, head.faces).cast(origins, down)
    triangles = other.ray.intersects_first(origins.numpy(), down.numpy())
    assert np.array_equal(ours.triangle.numpy(), triangles)


def test_a_head_with_seams_comes_back_from_trimesh(head: Mesh) -> None:
    textured = replace(head, texture=torch.rand(3, 8, 6, generator=torch.Generator().manual_seed(1)))
    other = textured.to_trimesh()
    assert len(other.vertices) > len(head.vertices)  # split at seams
    assert np.allclose(other.visual.uv[other.faces], head.uvs[head.uv_faces].numpy(), atol=1e-7)
    found = Mesh.from_trimesh(other)
    assert torch.equal(found.vertices, head.vertices)
    assert torch.equal(found.faces, head.faces)
    assert torch.equal(found.uvs[found.uv_faces], head.uvs[head.uv_faces])
    assert float((found.colors - head.colors).abs().max()) <= 0.5 / 255 + 1e-6
    assert float((found.texture - textured.texture).abs().max()) <= 0.5 / 255 + 1e-6
    again = Mesh.from_trimesh(Mesh(head.vertices, head.faces, colors=head.colors).to_trimesh())
    assert torch.equal(again.colors, found.colors)


def test_without_seams_the_vertices_keep_their_order() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    uvs = torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    mesh = Mesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), uvs, torch.tensor([[3, 2, 1], [3, 1, 0]]))
    other = mesh.to_trimesh()
    assert np.array_equal(other.vertices, vertices.numpy())
    assert np.array_equal(other.faces, mesh.faces.numpy())
    assert np.array_equal(other.visual.uv, uvs.numpy()[::-1])


def test_what_trimesh_has_changed_is_not_joined(head: Mesh) -> None:
    other = head.to_trimesh()
    ids = other.vertex_attributes["vertex_id"]
    twice = int(np.flatnonzero(np.bincount(ids) > 1)[0])
    other.vertices[np.flatnonzero(ids == twice)[0]] += 1.0
    assert len(Mesh.from_trimesh(other).vertices) == len(other.vertices)


def test_colours_and_images_of_trimesh_arrive() -> None:
    box = trimesh.creation.box(extents=(10, 20, 30))
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    found = Mesh.from_trimesh(box)
    assert found.vertices.dtype == torch.float32
    assert np.array_equal((found.colors * 255).round().numpy(), np.arange(32).reshape(8, 4)[:, :3])
    assert Mesh.from_trimesh(trimesh.creation.box()).colors is None


def test_what_is_no_mesh_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"found a Scene, expected a trimesh\.Trimesh; of a scene take"):
        Mesh.from_trimesh(trimesh.Scene([trimesh.creation.box()]))
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(ValueRangeError, match="1 of 3 vertices are NaN"):
        Mesh.from_trimesh(broken)


def test_the_package_is_imported_without_trimesh() -> None:
    code = "import sys, torchface; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
