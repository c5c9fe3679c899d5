"""A rig whose head stands as the solvers expect it: upright, at a head's size, about where heads are."""

import torch

from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.rig import BlendshapeRig
from torchface.synthetic import neutral_head

_SIZE, _DEGREES, _AWAY = 1.5, 30.0, 100.0  # times a head's size, degrees and millimetres: what lies beyond is mended
_INNER = slice(17, 68)


def upright(rig: BlendshapeRig) -> tuple[BlendshapeRig, str]:
    """The rig, if it has iBUG's 68, brought to a head's place, and a line for people about its size and turn, empty
    where both are usual.

    A character in centimetres, on its back, or with its head 1.6 m above the ground is one; weights stay what they are.
    """
    notes = rig.neutral.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != LANDMARKS:
        return rig, ""
    head = neutral_head(texture=False)
    usual, found = (mesh.vertices[mesh.landmarks][_INNER].detach().double() for mesh in (head, rig.neutral))
    pose = similarity_transform(usual[None], found[None])
    size = float(pose.scale[0])
    turn = float(torch.rad2deg(torch.acos(((pose.rotation[0].trace() - 1) / 2).clamp(-1, 1))))
    odd = [
        *([f"{size:.3g} times a head's size"] if not 1 / _SIZE < size < _SIZE else []),
        *([f"turned by {turn:.0f} degrees"] if turn > _DEGREES else []),
    ]
    if not odd:
        away = (found - usual).mean(0)
        if float(away.norm()) < _AWAY:
            return rig, ""
        pose = Similarity(torch.ones_like(pose.scale), torch.eye(3).double()[None], away[None])
    line = f"the rig's head is {' and '.join(odd)}; it was solved upright and at a head's size" if odd else ""
    return _brought(rig, pose.inverse()), line


def _brought(rig: BlendshapeRig, back: Similarity) -> BlendshapeRig:
    placed = back.apply(rig.vertices.detach().double())[0].to(rig.vertices)
    deltas = back.apply_vectors(rig.deltas.detach().double()).to(rig.deltas)
    correctives = rig.correctives
    if correctives is not None:
        moved = back.apply_vectors(correctives.deltas.double()).to(correctives.deltas)
        correctives = correctives.with_deltas(moved)
    return BlendshapeRig(rig.neutral.with_vertices(placed), deltas, rig.names, correctives)
