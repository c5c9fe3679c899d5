"""Inputs, states and results of the solve of a video's frames."""

from dataclasses import dataclass

from torch import Tensor

from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.face_measurements import CameraView
from torchface.capture.own_rig.gauss_newton import HeadState
from torchface.capture.own_rig.state_estimate import Expectation, StateEstimate
from torchface.errors import ValueRangeError


@dataclass(frozen=True, eq=False)
class VideoSolution:
    """What a face did in T frames.

    Args:
        weights: in [0,1], (T,N).
        rotation: rig to camera, refined with the weights, (T,3,3).
        translation: rig to camera, (T,3), millimetres.
        errors: root mean square distance of the landmarks to the rig's, each counted as much as it is trusted, (T,),
            pixels; NaN where none is seen.
        solved: frames with at least six landmarks, (T,) bool; the others keep the weights of the frame before,
            or in a whole take lie between those before and after.
        confidence: share of what shows each weight that was seen, (T,N) in [0,1].
    """

    weights: Tensor
    rotation: Tensor
    translation: Tensor
    errors: Tensor
    solved: Tensor
    confidence: Tensor


@dataclass(frozen=True, eq=False)
class VideoState:
    """What one frame hands on to the next, in float64.

    Args:
        head: weights (1,N) and pose of the frame; None before the first.
        estimate: from landmarks and dynamics until now; None before the first, and without a dynamics prior.
        window: weights of the latest frames, the newest last, (1,J,N) with J growing up to the dynamics prior's window.
        solved: whether the frame showed at least six landmarks.
        hidden: for how long each shape has not been seen, (1,N), seconds; None before the first.

    Example:
        >>> from torchface.capture import VideoSolver
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> camera = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
        >>> head = rig.vertices[rig.neutral.landmarks] * torch.tensor([1.0, -1, -1]) + torch.tensor([0.0, 0, 700])
        >>> solver = VideoSolver(rig, None, camera)
        >>> first = solver.step(solver.start(), 900 * head[:, :2] / head[:, 2:] + torch.tensor([320.0, 240.0]))
        >>> hidden = solver.step(first, torch.full((68, 2), torch.nan))
        >>> first.solved, hidden.solved, torch.equal(first.weights, hidden.weights)
        (True, False, True)
    """

    head: HeadState | None
    estimate: StateEstimate | None
    window: Tensor
    solved: bool = False
    hidden: Tensor | None = None

    @property
    def weights(self) -> Tensor:
        """(N,)."""
        return self._known().weights[0]

    @property
    def rotation(self) -> Tensor:
        """Rig to camera, (3,3)."""
        return self._known().rotation[0]

    @property
    def translation(self) -> Tensor:
        """Rig to camera, (3,), millimetres."""
        return self._known().translation[0]

    def _known(self) -> HeadState:
        if self.head is None:
            raise ValueRangeError("video state: found no frame yet; expected one solved by step")
        return self.head


@dataclass(frozen=True, eq=False)
class FrameTerms:
    """What the energies of B frames are made of."""

    landmarks: Tensor  # finite, (B,68,2)
    precision: Tensor  # of each, one over its standard deviation, 0 where not seen, (B,68)
    # rotation, translation: the tracked pose, (B,3,3) and (B,3)
    rotation: Tensor
    translation: Tensor
    expected: Expectation  # what is known before the frames are seen
    read: Quadratic | None = None  # what readings say of the weights (B,N) themselves; nothing if absent
    # of other cameras, with finite landmarks; their deviations count all noise, infinite where not seen
    views: tuple[CameraView, ...] = ()

    def tensors(self) -> tuple[Tensor, ...]:
        mean = self.expected.mean
        terms = (self.landmarks, self.precision, self.rotation, self.translation, self.expected.information)
        read = () if self.read is None else (self.read.H, self.read.f)
        return (*terms, mean.weights, mean.rotation, mean.translation, *read, *(view.landmarks for view in self.views))
