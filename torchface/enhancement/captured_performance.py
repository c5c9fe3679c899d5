"""An actor's captured frames, from which an enhancement learns."""

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.io.meshes.mesh_sequence import MeshSequence
from torchface.number_checks import as_tensor


@dataclass(frozen=True, eq=False)
class CapturedPerformance:
    """Frames of one mesh in several sequences, each from the neutral to an extreme expression and back.

    Args:
        frames: (K,V,3), millimetres, each in any rigid place; or on disk.
        faces: (F,3) int64.
        sequences: the number of each frame's sequence, (K,) int64.
        neutral: (V,3), millimetres.
        coarse: what the coarse animation shows of the same frames in the same places, (K,V,3), where it is known:
            the actor's rig fitted to them, or the thin shell through their markers. Then the detail is what such an
            animation lacks, and what it has itself beyond the smooth part stays. Absent, the smooth part's detail
            takes the place of the input's own.
        colors: of the frames' vertices, in [0,1], (K,V,3); or on disk.
        landmarks: vertex ids of the 68 iBUG landmarks, which name the regions and set the eyes apart.

    Raises:
        TopologyError: frames are of another mesh.
        ShapeError: not one coarse frame a frame, or not one colour a vertex.
        ValueRangeError: fewer than two frames, a neutral that is not finite, or sequences in pieces.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False).select(["jawOpen"])
        >>> frames = rig(rig.vertices.new_tensor([[0.0], [1.0], [0.0], [0.5]]))
        >>> performance = CapturedPerformance(frames, rig.neutral.faces, torch.tensor([0, 0, 1, 1]), rig.vertices)
        >>> len(performance.frames), performance.coarse is None
        (4, True)
    """

    frames: Tensor | MeshSequence
    faces: Tensor
    sequences: Tensor
    neutral: Tensor
    coarse: Tensor | MeshSequence | None = None
    colors: Tensor | MeshSequence | None = None
    landmarks: Tensor | None = None

    def __post_init__(self) -> None:
        for name, expected in (("faces", "(F,3)"), ("neutral", "(V,3)"), ("sequences", "(K,)")):
            object.__setattr__(self, name, as_tensor(name, getattr(self, name), expected))
        if not isinstance(self.frames, MeshSequence):
            object.__setattr__(self, "frames", as_tensor("frames", self.frames, "(K,V,3)"))
        count = len(self.frames)
        _check_topology(self.frames, self.faces, self.neutral)
        if self.coarse is not None:
            _check_topology(self.coarse, self.faces, self.neutral)
            if len(self.coarse) != count:
                raise ShapeError(f"coarse: found {len(self.coarse)} frames, expected {count}, one for each")
        _check_sequences(self.sequences, count)
        if self.colors is not None and tuple(self.colors.shape) != (count, len(self.neutral), 3):
            raise ShapeError(f"colors: found {tuple(self.colors.shape)}, expected {(count, len(self.neutral), 3)}")


def _check_sequences(sequences: Tensor, count: int) -> None:
    """Raises or warns where the sequences (K,) do not fit a database."""
    if sequences.shape != (count,) or sequences.is_floating_point():
        raise ValueRangeError(
            f"sequences: found {sequences.dtype} {tuple(sequences.shape)}, expected ({count},) int64: the number of "
            "each frame's sequence"
        )
    pieces = 1 + int((sequences[1:] != sequences[:-1]).sum())
    numbers = len(sequences.unique())
    if pieces != numbers:
        raise ValueRangeError(f"sequences: found {numbers} sequences in {pieces} pieces, expected each in one piece")
    if numbers < 2:
        warnings.warn(
            f"sequences: found 1 of {count} frames, expected several, from the neutral to an extreme and back each: "
            "detail and timing of what it does not show are missing",
            stacklevel=3,
        )


def _check_topology(frames: Tensor | MeshSequence, faces: Tensor, neutral: Tensor) -> None:
    """Raises where frames, triangles and neutral are not of one topology."""
    shape = tuple(frames.shape)
    if neutral.ndim != 2 or neutral.shape[1] != 3 or not bool(torch.isfinite(neutral).all()):
        raise ValueRangeError(f"neutral: found {tuple(neutral.shape)}, expected (V,3), finite")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or int(faces.max()) >= len(neutral):
        raise TopologyError(f"faces: found {tuple(faces.shape)}, expected (F,3) between {len(neutral)} vertices")
    if len(shape) != 3 or shape[1:] != (len(neutral), 3):
        raise TopologyError(f"frames: found {shape}, expected (K,{len(neutral)},3) as the neutral's vertices")
    if isinstance(frames, MeshSequence) and not torch.equal(frames.faces, faces.cpu()):
        raise TopologyError(f"{frames.path}: found other triangles than the neutral's, expected the same")
    if shape[0] < 2:
        raise ValueRangeError(f"frames: found {shape[0]}, expected sequences of frames, 2 at the very least")
