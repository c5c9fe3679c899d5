"""Which parts of a template are bone and which are skin: teeth and eyeballs move rigidly, shells of the eye do not."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.similarity import similarity_transform
from torchface.rig import BlendshapeRig

_RIGID = 0.1
_MOSTLY = 0.75
_FOLLOWS, _FOLLOWS_SHARE = 1.0, 0.3


def is_rigid(template: BlendshapeRig, vertices: Tensor, group: Tensor, label: Tensor) -> Tensor:
    """Whether each vertex of the parts is hard, (P,) bool: of a part that moves rigidly, or goes along with such parts.

    A part goes along, as gums do with teeth, where its vertices move nearly as the nearest rigid ones, to a millimetre
    on average or three tenths of their own motion.

    Args:
        template: N shapes, V vertices.
        vertices: ids of the parts' vertices, (P,) int64.
        group: which pocket of the head each lies in, (P,) int64.
        label: the connected part of each, (P,) int64.
    """
    rest, deltas = template.vertices.detach().cpu().double(), template.deltas.detach().cpu().double()
    rigid = torch.zeros(len(vertices), dtype=torch.bool)
    for one in label.unique().tolist():  # a head has tens of parts of all sizes
        rows = label == one
        ids = vertices[rows]
        moving = deltas[:, ids]
        moving = moving[moving.abs().amax((1, 2)) > _RIGID]
        if len(moving) == 0:
            rigid[rows] = True
        elif len(ids) >= 3:
            bent = (rest[ids] + moving - rigidly_moved(rest[ids], rest[ids] + moving)).abs().amax((1, 2))
            rigid[rows] = float((bent < _RIGID).double().mean()) >= _MOSTLY
    hard = rigid.clone()
    for pocket in group.unique().tolist():  # one mouth, two eyes
        bones = vertices[rigid & (group == pocket)]
        if len(bones) == 0:
            continue
        tree = cKDTree(rest[bones].numpy())
        for one in label[~rigid & (group == pocket)].unique().tolist():
            rows = label == one
            ids = vertices[rows]
            beside = bones[torch.from_numpy(tree.query(rest[ids].numpy())[1])]
            apart = (deltas[:, ids] - deltas[:, beside]).norm(dim=-1).amax(0).mean()
            moved = deltas[:, ids].norm(dim=-1).amax(0).mean()
            hard[rows] = float(apart) < max(_FOLLOWS, _FOLLOWS_SHARE * float(moved))
    return hard


def rigidly_moved(rest: Tensor, poses: Tensor) -> Tensor:
    """The rigid motions of a part (n,3) that come nearest to its poses (N,n,3), as places (N,n,3)."""
    start = rest.expand_as(poses)
    return similarity_transform(start, poses, scale=False).apply(start)
