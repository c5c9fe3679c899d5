"""A scan that has the template's triangles already: checked, and taken as it is."""

from dataclasses import replace

import torch

from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.meshes.vertex_order import check_vertex_order
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.registration.scan_preparation import check_same_hand
from torchface.registration.scan_registration import Registration

_LEAST_EXTENT, _MOST_EXTENT = 0.2, 5.0  # of the source's: characters differ by less, units by more


def as_it_is(template: Mesh, head: Mesh) -> Registration:
    """A head that has the template's triangles, as its registration; see ``check_own_topology``."""
    check_own_topology(template, head, "scan")
    known = torch.ones(len(head.vertices), dtype=torch.bool)
    pose = similarity_transform(template.vertices.double()[None], head.vertices.double()[None])
    painted = template if head.texture is None else head
    mesh = replace(template, vertices=head.vertices, colors=head.colors, texture=head.texture)
    mesh = replace(mesh, uvs=painted.uvs, uv_faces=painted.uv_faces)
    note = "taken as it is, for its triangles are the template's (no scan to register)"
    record = RegistrationRecord("its triangles", 0.0, (), (note,), 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, bent=False)
    return Registration(mesh, pose, torch.zeros(len(head.vertices)).double(), known, record)


def check_own_topology(source: Mesh, target: Mesh, name: str = "neutral", owner: str = "the template") -> None:
    """Refuses a target that has the source's triangles on other points."""
    used = source.faces.cpu().unique()
    rest, goal = (mesh.vertices.detach().cpu().double()[used] for mesh in (source, target))
    size, beside = extent(goal), extent(rest)
    if size == 0 or beside == 0:
        return  # the solve says it
    check_unit(name, goal, beside, owner, _LEAST_EXTENT, _MOST_EXTENT)
    check_same_hand(rest, goal, name, owner)
    own, found = (mesh.vertices.detach().cpu().double() for mesh in (source, target))
    check_vertex_order(
        name, own, similarity_transform(goal[None], rest[None]).apply(found)[0], source.faces.cpu(), owner
    )
