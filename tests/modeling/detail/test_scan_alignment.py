"""Wrinkles 0.3 mm deep and 2 mm wide, planted on the performer's raised brow, come back."""

import math
from dataclasses import dataclass

import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.rasterization import interpolate, rasterise_uvs
from torchface.geometry.meshes.tangent_space import from_tangent_space, tangent_space
from torchface.mesh import Mesh, fan_triangulation, submesh
from torchface.modeling.detail.normal_map_baking import NormalMap, bake_normal_map
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages.subdivision import catmull_clark, finely_coloured

DEPTH, WIDTH, SIZE = 0.3, 2.0, 768
SHAPE = "browInnerUp"


@dataclass(frozen=True, eq=False)
class Planted:
    """A performer, its brow raised, a scan of that with wrinkles somewhere in space, and points picked on both.

    The skin is the smooth surface through the performer's vertices; ``skin`` and ``outward`` are points on it, close
    to each other, and its normals there.
    """

    rig: BlendshapeRig
    raised: Mesh
    scan: Mesh
    picks: tuple[Tensor, Tensor]
    brow: Tensor
    skin: Tensor
    outward: Tensor

    def errors(self, baked: NormalMap) -> tuple[Tensor, Tensor]:
        """Where wrinkles turn the skin by more than 8 degrees: how far the map's normals are from the true ones, and
        how far the smooth skin's are, degrees."""
        mesh = self.raised
        texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, *baked.hit.shape)
        hit = baked.hit.flatten()[texels.texels].nonzero()[::3, 0]
        triangles, barycentric = texels.triangles[hit], texels.barycentric[hit]
        smooth = vertex_normals(mesh.vertices, mesh.faces)
        space = tangent_space(mesh.vertices, mesh.faces, mesh.uvs.double(), mesh.uv_faces, smooth)
        shown = space.frames(triangles, barycentric)
        shown = from_tangent_space(shown, baked.normals.flatten(1)[:, texels.texels[hit]].T.double())
        at = interpolate(mesh.vertices, mesh.faces[triangles], barycentric)
        nearest = torch.from_numpy(cKDTree(self.skin.numpy()).query(at.numpy())[1])
        way = self.outward[nearest]
        # The triangles are chords of the skin; the ray that fills a texel goes on to the skin itself.
        at = at + ((self.skin[nearest] - at) * way).sum(-1, keepdim=True) * way
        at.requires_grad_()
        (slope,) = torch.autograd.grad(relief(at, self.brow).sum(), at)
        truth = torch.nn.functional.normalize(way - slope + way * (slope * way).sum(-1, keepdim=True), dim=-1)
        turn = torch.rad2deg(torch.acos((truth * way).sum(-1).clamp(-1, 1)))
        error = torch.rad2deg(torch.acos((truth * shown).sum(-1).clamp(-1, 1)))
        return error[turn > 8], turn[turn > 8]


def relief(points: Tensor, brow: Tensor) -> Tensor:
    """How far the skin lies outside the smooth one, (N,)."""
    x, y, _ = (points - brow).unbind(-1)
    folds = torch.stack([y - level - 3 * torch.sin(x / 14) for level in (16.0, 23, 30)]) / (WIDTH / 2)
    depth = torch.where(folds.abs() < 1, torch.cos(math.pi / 2 * folds.clamp(-1, 1)) ** 2, 0.0).sum(0)
    return -DEPTH * depth * torch.exp(-((x / 36) ** 4))


def smooth_skin(mesh: Mesh, brow: Tensor) -> tuple[Tensor, Tensor]:
    """The smooth surface of the upper face, a vertex every 3 mm and less; on the forehead three to a millimetre."""
    fine = finely_coloured(mesh, 2.0)
    x, y, z = (fine.vertices - brow).unbind(-1)
    seen = (y > -55) & (y < 55) & (z > -45)
    wrinkled = (x.abs() < 44) & (y > 8) & (y < 40) & (z > -45)
    forehead = submesh(fine, wrinkled).mesh
    skin, quads = forehead.vertices.double(), forehead.polygons
    for _ in range(3):
        skin, quads, _ = catmull_clark(skin, quads)
    rest = submesh(fine, seen & ~wrinkled).mesh
    return torch.cat([skin, rest.vertices.double()]), torch.cat([fan_triangulation(quads), rest.faces + len(skin)])


@pytest.fixture(scope="module")
def planted() -> Planted:
    rig = performer(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)
    pose = rig(torch.tensor([[float(name == SHAPE) for name in rig.names]]))[0].double()
    raised = rig.neutral.with_vertices(pose)
    brow = pose[raised.landmarks[17:27]].mean(0)
    skin, faces = smooth_skin(raised, brow)
    outward = vertex_normals(skin, faces)
    wrinkled = skin + relief(skin, brow)[:, None] * outward
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, 1.7, -0.6]).as_matrix())
    shift = torch.tensor([300.0, -40, 900]).double()
    ids = raised.landmarks[[17, 21, 22, 26, 27, 36, 39, 42, 45]]
    hand = torch.randn(len(ids), 3, generator=torch.Generator().manual_seed(1)).double()
    picks = (ids, pose[ids] @ turn.T + shift + hand)
    return Planted(rig, raised, Mesh(wrinkled @ turn.T + shift, faces), picks, brow, skin, outward)


@pytest.fixture(scope="module")
def by_picks(planted: Planted) -> NormalMap:
    return bake_normal_map(planted.raised, planted.scan, SIZE, planted.picks)


def test_they_come_back_by_picked_points(planted: Planted, by_picks: NormalMap) -> None:
    error, turn = planted.errors(by_picks)
    assert len(error) > 500
    assert float(turn.median()) > 12
    assert float(error.median()) <= 5


@pytest.mark.bench  # test_normal_map_baking.py lays a scan without picks
def test_they_come_back_with_no_point_picked(planted: Planted) -> None:
    error, _ = planted.errors(bake_normal_map(planted.raised, planted.scan, SIZE))
    assert len(error) > 500
    assert float(error.median()) <= 5
