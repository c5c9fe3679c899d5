"""Normals, areas, borders and parts, against trimesh."""

import numpy as np
import torch
import trimesh

from torchface.geometry.meshes import operators


def as_tensors(mesh: trimesh.Trimesh) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces))


def test_areas_and_normals_agree_with_trimesh() -> None:
    mesh = trimesh.creation.icosphere(2, radius=80)
    vertices, faces = as_tensors(mesh)
    torch.testing.assert_close(operators.triangle_areas(vertices, faces), torch.from_numpy(mesh.area_faces.copy()))
    torch.testing.assert_close(operators.triangle_normals(vertices, faces), torch.from_numpy(mesh.face_normals.copy()))
    outward = vertices / vertices.norm(dim=1, keepdim=True)
    assert (operators.vertex_normals(vertices, faces) * outward).sum(1).min() > 0.999


def test_batched_normals_equal_single_ones() -> None:
    vertices, faces = as_tensors(trimesh.creation.torus(50, 20))
    batch = torch.stack([vertices, vertices * 2, vertices.flip(1)])
    single = torch.stack([operators.vertex_normals(v, faces) for v in batch])
    torch.testing.assert_close(operators.vertex_normals(batch, faces), single)


def test_edges_and_components_of_two_spheres() -> None:
    first, second = trimesh.creation.icosphere(1), trimesh.creation.icosphere(2)
    vertices, faces = as_tensors(trimesh.util.concatenate([first, second]))
    assert len(operators.edges(faces)) == len(first.edges_unique) + len(second.edges_unique)
    labels = operators.components(faces, len(vertices))
    expected = torch.cat([torch.zeros(len(first.vertices)), torch.ones(len(second.vertices))]).long()
    assert torch.equal(labels, expected)


def test_border_is_the_rim_where_the_lid_was_taken_off() -> None:
    mesh = trimesh.creation.annulus(5, 10, 30)
    vertices, faces = as_tensors(mesh)
    assert not operators.border_vertices(faces, len(vertices)).any()
    kept = faces[vertices[faces].mean(1)[:, 2] < 14.9]
    rim = operators.border_vertices(kept, len(vertices))
    used = torch.zeros(len(vertices), dtype=torch.bool)
    used[kept.flatten()] = True
    assert torch.equal(rim, used & (vertices[:, 2] > 14.9))
