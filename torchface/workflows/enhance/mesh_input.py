"""Meshes of another topology as an animation of the model's dense mesh."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.enhancement.thin_shell import LEAST_POINTS, ThinShell
from torchface.errors import AlignmentError
from torchface.geometry.meshes.proximity import SurfaceIndex
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.workflows.animated_meshes import AnimatedMesh
from torchface.workflows.enhance.coarse_animation import CoarseAnimation, check_finite, known_rate, rate_notes
from torchface.workflows.enhance.head_correspondence import HeadCorrespondence, correspondence_notes

PLACE = "the result stands where the model stands, not where the input does"
"""What users are told whose input has a space of its own."""


def other_topology(
    animated: AnimatedMesh, model: Mesh, found: HeadCorrespondence, fps: float | None
) -> CoarseAnimation:
    """An animation of other vertices, spread over the model's by the thin shell.

    Args:
        animated: what moves.
        model: the model's neutral.
        found: how ``animated.neutral`` lies on it.
        fps: frames a second; as the file has them if absent.

    Raises:
        AlignmentError: fewer than 12 vertices have a place on the model.
    """
    ids, sites = found.on_model(SurfaceIndex(model.vertices, model.faces), animated.neutral.faces)
    if len(ids) < LEAST_POINTS:
        raise AlignmentError(
            f"{animated.path}: found {len(ids)} vertices with a place on the model, expected at least {LEAST_POINTS}; "
            "give pairs (--pairs), or bring the input's neutral nearer to the model's"
        )
    shell = ThinShell(model.vertices, model.faces, sites)
    rest = found.pose.apply(animated.neutral.vertices[ids].double())[0]

    def read(begin: int, end: int) -> Tensor:
        vertices = animated.read(begin, end)
        check_finite(vertices, animated.path, 1, begin)
        return shell.follow(placed(found.pose, vertices[:, ids]), rest)

    assumed = [] if animated.rig is not None else [f"{animated.path.name} is taken to be at rest in its first frame"]
    return CoarseAnimation(
        animated.path,
        "meshes of another topology",
        animated.count,
        read,
        known_rate(animated, fps),
        lambda begin, end: placed(found.pose, animated.read(begin, end)),
        animated.neutral.faces,
        found.residual,
        (*rate_notes(animated, fps), *assumed, *correspondence_notes(found, animated.path), PLACE),
    )


def placed(pose: Similarity, points: Tensor) -> Tensor:
    """Points (t,N,3) moved by one similarity, float32."""
    return (points.double() @ pose.rotation[0].T.double() * pose.scale[0] + pose.translation[0]).to(torch.float32)
