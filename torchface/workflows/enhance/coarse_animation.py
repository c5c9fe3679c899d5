"""Coarse animation to be enhanced, in the vertices of the model's dense mesh, whatever it came from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ValueRangeError
from torchface.geometry.similarity import MAX_HEAD_SCALE, MIN_HEAD_SCALE, similarity_transform
from torchface.mesh import Mesh
from torchface.take import Take
from torchface.workflows.animated_meshes import AnimatedMesh, known_rate, rate_notes

SAME_TOPOLOGY = "meshes of the model's topology"
OTHER_ACTOR_MM, NO_HEAD_MM = 4.0, 20.0
OWN_HEAD_MM = 1.0
"""From how far on an input's face at rest is its own head: without it, at 1.3 mm, the model added 0.22 mm to another
person's smooth frames (root mean square), with it 0.13 as to the actor's."""
SAMPLED = 24  # frames of an animation, in which one at rest is looked for
_ASTRAY_MM = 20.0
_UNITS = ((1000.0, "metres"), (10.0, "centimetres"), (25.4, "inches"), (0.001, "micrometres"))


@dataclass(frozen=True, eq=False)
class CoarseAnimation:
    """An animation of the model's dense mesh, without its fine detail."""

    path: Path  # where it came from
    kind: str
    count: int
    # Vertices (t,V,3) of the frames from one number up to another, without it, millimetres.
    read: Callable[[int, int], Tensor]
    fps: float
    # What the file itself holds of these frames, in the same place: (t,N,3), NaN where a point was not seen.
    shown: Callable[[int, int], Tensor]
    shown_faces: Tensor | None  # triangles of that, (G,3); None where it is points
    # Root mean square distance of its face at rest from the model's, aligned with it, millimetres; None where it holds
    # no face at rest.
    residual: float | None = None
    notes: tuple[str, ...] = ()  # lines for people to read; warnings begin with warning:
    # Its own head at rest in the model's vertices, (V,3), where that is not the model's; unknown without a rig.
    head: Tensor | None = None
    moments: Tensor | None = None  # which of its frames each region shows in each frame, (R,T), where it was retimed


def same_topology(animated: AnimatedMesh, model: Mesh, fps: float | None) -> CoarseAnimation:
    """An animation that has the model's vertices and triangles already."""
    step = max(1, animated.count // SAMPLED)
    some = torch.cat([animated.read(t, t + 1) for t in range(0, animated.count, step)])
    check_finite(some, animated.path, step)
    at_rest = animated.neutral.vertices[None] if animated.rig is not None else some
    residual = distance_at_rest(at_rest, model.vertices, animated.path)
    notes = residual_notes(residual, animated.path)

    def read(begin: int, end: int) -> Tensor:
        vertices = animated.read(begin, end).float()
        check_finite(vertices, animated.path, 1, begin)
        check_astray(vertices, model, animated.path, begin)
        return vertices

    another = animated.rig is not None and residual > OWN_HEAD_MM
    if another:
        notes = [*notes, f"the result keeps the input's own head, which is {residual:.1f} mm from the model's at rest"]
    return CoarseAnimation(
        animated.path,
        SAME_TOPOLOGY,
        animated.count,
        read,
        known_rate(animated.fps, fps),
        read,
        model.faces,
        residual,
        (*rate_notes(animated.path, animated.fps, fps), *notes),
        animated.neutral.vertices.float() if another else None,
    )


def distance_at_rest(frames: Tensor, rest: Tensor, path: Path) -> float:
    """Root mean square distance from a face at rest (V,3) of the frame (t,V,3) nearest to it, all aligned with it."""
    check_scale(float((_size(rest[None]) / _size(frames).clamp(min=1e-9)).median()), path)
    return float(distances_at_rest(frames, rest).min())


def distances_at_rest(frames: Tensor, rest: Tensor) -> Tensor:
    """Root mean square distance of each frame (t,V,3), aligned with it, from a face at rest (V,3); (t,)."""
    target = rest.expand_as(frames)
    aligned = similarity_transform(frames, target).apply(frames)
    return (aligned - target).square().sum(-1).mean(-1).sqrt()


def _size(vertices: Tensor) -> Tensor:
    """Root mean square distance from the middle, which no order of the vertices changes, (t,)."""
    return (vertices - vertices.mean(1, keepdim=True)).square().sum(-1).mean(-1).sqrt()


def resampling_note(path: Path, take: Take, even: Take) -> str:
    """Says that frames were brought to an even rate."""
    return (
        f"{path}: found {len(take)} frames {take.rate}; brought to {len(even)} at an even {even.fps:g} a second, "
        "linear in between"
    )


def check_finite(vertices: Tensor, path: Path, step: int, begin: int = 0) -> None:
    """Raises ``ValueRangeError`` for vertices (t,N,3) that hold NaN or infinity, or all lie in one place; every
    ``step``-th frame from one."""
    wrong = ~torch.isfinite(vertices).all(-1)
    if wrong.any():
        frame = int(wrong.any(-1).nonzero()[0, 0])
        raise ValueRangeError(
            f"{path}: found NaN or infinity in frame {begin + frame * step} ({int(wrong[frame].sum())} of "
            f"{wrong.shape[1]} vertices), expected numbers; leave such frames out, or repair them first"
        )
    empty = (vertices == vertices[:, :1]).flatten(1).all(1).nonzero()[:, 0]
    if len(empty):
        raise ValueRangeError(
            f"{path}: found all vertices of frame {begin + int(empty[0]) * step} in one place, expected a head; leave "
            "such frames out, or repair them first"
        )


def check_astray(vertices: Tensor, rest: Mesh, path: Path, begin: int) -> None:
    """Raises ``ValueRangeError`` where the distance of a vertex from its nearest neighbour in vertices (t,N,3), the
    frames from ``begin`` on, is another than at rest by more than 20 mm."""
    usual = _apart(rest.vertices, rest.faces)
    for frame, found in enumerate(vertices):
        more = (_apart(found, rest.faces) - usual).nan_to_num()
        far = more.abs() > _ASTRAY_MM
        if far.any():
            worst = int(more.abs().argmax())
            raise ValueRangeError(
                f"{path}: found vertex {worst} in frame {begin + frame} {abs(float(more[worst])):.0f} mm "
                f"{'farther from' if more[worst] > 0 else 'nearer to'} its neighbours than at rest "
                f"({int(far.sum())} of {len(found)} vertices are), expected at most {_ASTRAY_MM:g}; "
                "leave such frames out, or repair them first"
            )


def _apart(vertices: Tensor, faces: Tensor) -> Tensor:
    """How far each vertex (N,3) is from the nearest one that shares a triangle with it, (N,); infinite without any."""
    corners = vertices[faces]
    sides = (corners - corners.roll(1, 1)).norm(dim=-1)
    nearer = torch.minimum(sides, sides.roll(-1, 1))
    return vertices.new_full((len(vertices),), torch.inf).scatter_reduce(0, faces.flatten(), nearer.flatten(), "amin")


def check_scale(scale: float, path: Path) -> None:
    """Raises ``AlignmentError`` where an input had to be scaled by more than heads differ to lie on the model."""
    if MIN_HEAD_SCALE <= scale <= MAX_HEAD_SCALE:
        return
    unit = next((name for factor, name in _UNITS if 0.75 < scale / factor < 1.33), None)
    size = f"{scale:.3g} times too small" if scale > 1 else f"{1 / scale:.3g} times too large"
    why = f"it seems to be in {unit}" if unit else "its unit is another one, or it is no head of this model"
    raise AlignmentError(
        f"{path}: found a head {size} for the model, expected millimetres and a factor of {MIN_HEAD_SCALE} to "
        f"{MAX_HEAD_SCALE}; {why} (--unit of markers and meshes where the command has it, "
        "else scale the files to millimetres)"
    )


def residual_notes(residual: float, path: Path) -> list[str]:
    """What the distance of an input's face at rest from the model's says."""
    if residual > NO_HEAD_MM:
        raise AlignmentError(
            f"{path}: found vertices {residual:.1f} mm (root mean square) from the model's at rest, aligned "
            f"with it, expected at most {NO_HEAD_MM:g}; they stand in another order, or it is another head"
        )
    if residual > OTHER_ACTOR_MM:
        return [
            f"warning: at rest the vertices lie {residual:.1f} mm (root mean square) from the model's; it seems to be "
            "another person, who gets the wrinkles of the model's actor"
        ]
    return []
