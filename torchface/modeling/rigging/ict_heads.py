"""ICT-FaceKit's heads with blinks that shut the eyes, lips that meet at rest and teeth that an open mouth shows."""

import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.contact import ContactFinder
from torchface.geometry.meshes.operators import vertex_areas
from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.io.rigs.ict_facekit import region
from torchface.mesh import Mesh
from torchface.modeling.rigging.eyelid_closure import SkinOfHead, eyes_seen, shut_blinks
from torchface.modeling.rigging.lid_and_lip_closing import REST_REACH
from torchface.optim.sparse import SparseCholesky
from torchface.rig import BlendshapeRig

_SKIN = ("face", "head_and_neck")
_SHAPES = ("eyeBlink_L", "eyeBlink_R", "jawOpen")
_AROUND, _REACH, _FIRM = 40.0, 4.0, 100.0  # millimetres about the lips; over which skin goes along; of meeting lips
_LONGER, _RAISED = 2.0, 4.0  # millimetres: upper teeth, and lower ones where the jaw opens


def mended_head(rig: BlendshapeRig, modes: Tensor | None = None) -> tuple[BlendshapeRig, Tensor]:
    """ICT-FaceKit's whole head and modes of heads (K,V,3) with lips that meet, blinks that shut and teeth in sight; a
    part of it, or a head without these shapes, as it is."""
    modes = rig.deltas[:0] if modes is None else modes
    whole = {*_SKIN, "teeth", "eyeball_left", "eyeball_right"} <= set(rig.neutral.regions)
    if not whole or not set(_SHAPES) <= set(rig.names):
        return rig, modes
    neutral, modes = with_meeting_lips(rig.neutral, modes)
    return with_teeth_in_sight(with_shut_lids(BlendshapeRig(neutral, rig.deltas, rig.names))), modes


def _skin(mesh: Mesh) -> Tensor:
    return torch.stack([region(mesh, name) for name in _SKIN]).any(0)


def with_shut_lids(rig: BlendshapeRig) -> BlendshapeRig:
    """A rig whose blinks shut the eyes: ICT-FaceKit's own leave the lids up to a millimetre apart over half an eye.

    Lashes and films on the eyes go along with the skin next to them.
    """
    mesh, vertices, skin = rig.neutral, rig.vertices.double(), _skin(rig.neutral)
    ball = region(mesh, "eyeball_right").long() + 2 * region(mesh, "eyeball_left").long()
    seen = skin | (ball > 0)
    head = SkinOfHead(vertices, mesh.faces[seen[mesh.faces].all(1)], ~skin, ball)
    own = rig.deltas.double()
    deltas = shut_blinks(head, own, rig.names, eyes_seen(head, vertices[mesh.landmarks]))[0]
    nearest = skin.nonzero()[:, 0][cKDTree(vertices[skin]).query(vertices[~seen])[1]]
    deltas[:, ~seen] += (deltas - own)[:, nearest]
    return BlendshapeRig(mesh, deltas.float(), rig.names)


def with_meeting_lips(mesh: Mesh, modes: Tensor) -> tuple[Mesh, Tensor]:
    r"""A mean head and modes (K,V,3) of heads whose lips meet at rest, which ICT-FaceKit's leave apart by 0.8 mm, and
    its people by more or less: how far lips are parted is expression, not identity.

    Of mean and modes x, each, the least change c of the skin around the lips under which pairs p, q of them meet,

    .. math:: \min_c \sum_k w \lVert (x + c)(p_k) - (x + c)(q_k) \rVert^2 + \int \lVert c \rVert^2 / \ell^2 + \lVert
        \nabla c \rVert^2.
    """
    vertices = mesh.vertices.double()
    marks = vertices[mesh.landmarks]
    near = _skin(mesh) & ((vertices - marks[48:].mean(0)).norm(dim=1) < _AROUND)
    rows = near.nonzero()[:, 0]
    faces = mesh.faces[near[mesh.faces].all(1)]
    place = torch.full((len(vertices),), -1)
    place[rows] = torch.arange(len(rows))
    faces, rest = place[faces], vertices[rows]
    pairs = ContactFinder(faces, len(rows)).find(rest, REST_REACH).pairs
    pairs = pairs[(rest[pairs, 2] > marks[[60, 64], 2].mean()).all(1)]  # behind the corners is the mouth's lining
    each = torch.arange(len(pairs)).repeat(2).numpy()
    signs = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat_interleave(len(pairs)).numpy()
    apart = sparse.csr_array((signs, (each, pairs.T.flatten().numpy())), shape=(len(pairs), len(rows)))
    held = sparse.diags_array((vertex_areas(rest, faces) / _REACH**2).numpy())
    system = SparseCholesky(stretching_energy(rest, faces) + held + _FIRM * (apart.T @ apart))
    whole = torch.cat([vertices[None], modes.double()])
    across = whole[:, rows, 1:].permute(1, 0, 2).flatten(1).numpy()  # along each other lips slide
    change = system.solve(torch.from_numpy(-_FIRM * (apart.T @ (apart @ across))))
    whole[:, rows, 1:] += change.unflatten(1, (-1, 2)).permute(1, 0, 2)
    return mesh.with_vertices(whole[0].float()), whole[1:].float()


def with_teeth_in_sight(rig: BlendshapeRig) -> BlendshapeRig:
    """A rig whose open mouth shows teeth: ICT-FaceKit's lips hide all of both rows however far the jaw opens."""
    jaw = rig.names.index("jawOpen")
    vertices, deltas, teeth = rig.vertices.clone(), rig.deltas.clone(), region(rig.neutral, "teeth")
    if not bool(teeth.any()):  # a part of the head, such as the face
        return rig
    lower = teeth & (deltas[jaw, :, 1] < 0.1 * deltas[jaw, teeth, 1].amin())
    vertices[teeth & ~lower, 1] -= _LONGER
    deltas[jaw, lower, 1] += _RAISED
    return BlendshapeRig(rig.neutral.with_vertices(vertices), deltas, rig.names)
