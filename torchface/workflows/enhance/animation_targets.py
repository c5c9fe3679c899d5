"""Meshes over time as morph targets with weights: what a ``.glb`` can hold of them."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io import MeshSequence, save_animation
from torchface.mesh import Mesh
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.progress import Progress
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track

MEGABYTES = 200.0
_BYTES_A_VERTEX = 24  # of a target: position and normal
_EXACT_MM = 0.005
_SAMPLE_BYTES = 5 * 2**28
_MOST_SAMPLED = 200
_CHUNK = 8


@dataclass(frozen=True, eq=False)
class AnimationTargets:
    """An animation as morph targets."""

    kind: str  # frames, a target a frame, or components, the principal components of all frames
    deltas: Tensor  # of the targets, (N,V,3), millimetres
    weights: Tensor  # of every frame, (T,N); components are weighed below 0 too
    # rms, largest: how far the frames that these give are from those they were made of: root mean square over all
    # vertices and frames, and the worst frame's root mean square, millimetres
    rms: float
    largest: float


def animation_targets(
    sequence: MeshSequence, neutral: Tensor, megabytes: float, progress: Progress
) -> AnimationTargets:
    r"""Every frame (T,V,3) as a target where these are small enough, else as few principal components as show it.

    Components are those of frames spread over the animation, as many as leave 0.005 mm, root mean square, or as fit.
    Their weights in all frames are projections: no frame is left out.

    Args:
        megabytes: that the targets may take, not counting what glTF leaves out of them because it is still.
    """
    frames, vertices = sequence.shape[:2]
    most = int(megabytes * 1e6 // (_BYTES_A_VERTEX * vertices))
    if most < 1:
        raise ValueRangeError(
            f"--glb-megabytes: found {megabytes:g}, expected at least {_BYTES_A_VERTEX * vertices / 1e6:.0f} for one "
            f"morph target of {vertices} vertices"
        )
    if frames <= most:
        return AnimationTargets("frames", sequence.read(0, frames) - neutral, torch.eye(frames), 0.0, 0.0)
    sampled = min(frames, _MOST_SAMPLED, max(2 * most, _SAMPLE_BYTES // (12 * vertices)))
    rows = torch.linspace(0, frames - 1, sampled).round().long().unique().tolist()
    offsets = torch.empty(len(rows), 3 * vertices)
    for number, row in enumerate(rows):  # a frame at a time: they lie far apart on disk
        offsets[number] = (sequence.read(row, row + 1)[0] - neutral).reshape(-1)
        progress("finding morph targets", number + 1, len(rows))
    values, vectors = largest_eigenpairs(offsets @ offsets.T)
    values = values.clamp(min=0)
    left = values.sum() - values.cumsum(0)
    enough = (left / (len(rows) * vertices)).sqrt() <= _EXACT_MM
    wanted = int(enough.nonzero()[0, 0]) + 1 if enough.any() else len(values)
    count = max(1, min(most, wanted, int((values > 1e-12 * values[0]).sum())))
    basis = (vectors[:, :count] / values[:count].sqrt()).T.float() @ offsets
    del offsets
    weights, error = torch.empty(frames, count), torch.empty(frames, dtype=torch.float64)
    for begin in range(0, frames, _CHUNK):
        some = (sequence.read(begin, begin + _CHUNK) - neutral).flatten(1)
        own = some @ basis.T
        weights[begin : begin + len(some)] = own
        error[begin : begin + len(some)] = (some - own @ basis).double().square().sum(1) / vertices
        progress("weighing morph targets", begin + len(some), frames)
    size = weights.abs().amax(0).clamp(min=1e-12)
    deltas = (basis * size[:, None]).reshape(count, vertices, 3)
    return AnimationTargets("components", deltas, weights / size, float(error.mean().sqrt()), float(error.max().sqrt()))


def write_targets(targets: AnimationTargets, neutral: Mesh, fps: float, path: Path) -> None:
    """Writes them as an animated ``.glb``."""
    names = tuple(f"{targets.kind.removesuffix('s')}_{i + 1:03d}" for i in range(len(targets.deltas)))
    rig = BlendshapeRig(neutral, targets.deltas, names)
    save_animation(rig, Take(fps, weights=Track(names, targets.weights[..., None])), path)
