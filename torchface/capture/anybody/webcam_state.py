"""State of a webcam's solve between frames, as named tensors and as one vector, and the user's controls."""

from dataclasses import dataclass, fields
from math import prod

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import checked_number
from torchface.shape_names import ARKIT

POSES = ("none", "rest", "mouth open", "smile", "brows up", "eyes shut")
"""What a guided calibration asks the person to hold, by its number."""
GROUPS = 3
"""How many groups of shapes have a gain of their own: see ``guided_gains``."""
CONTROLS = ("pose", "gain", "smoothing", "reset", "freeze")


@dataclass(frozen=True)
class WebcamControls:
    """What the user asks for, a frame at a time.

    Args:
        pose: row of ``POSES`` that the person has been asked to hold now, 0 for none.
        gain: on all weights, 1 is usual.
        smoothing: 0 none, 0.5 usual, 1 most.
        reset: forget this person, as at the start.
        freeze: learn no more of this person.

    Raises:
        ValueRangeError: an argument is not as above.

    Example:
        >>> WebcamControls(gain=1.5, freeze=True).tensor().tolist()
        [0.0, 1.5, 0.5, 0.0, 1.0]
    """

    pose: int = 0
    gain: float = 1.0
    smoothing: float = 0.5
    reset: bool = False
    freeze: bool = False

    def __post_init__(self) -> None:
        if self.pose not in range(len(POSES)):
            raise ValueRangeError(f"pose: found {self.pose}, expected 0 to {len(POSES) - 1}: {', '.join(POSES)}")
        checked_number("gain", self.gain, 0.0, 10.0)
        checked_number("smoothing", self.smoothing, 0.0, 1.0)

    def tensor(self) -> Tensor:
        """In the order of ``CONTROLS``, (5,)."""
        return torch.tensor([float(getattr(self, name)) for name in CONTROLS])


@dataclass(frozen=True, eq=False)
class WebcamState:
    """A frame's answer, and what the next frame needs of it; all zero at the start, float32.

    Args:
        weights: by ``ARKIT``'s names, (52,) in [0,1].
        rotation, translation: head to camera, (3,3) and (3,) millimetres; zero before the first face.
        gaze: of the right eye and the left, (2,2) radians: to the person's left, up; beside the head.
        tracked: how far the frame's answer is to be believed, () in [0,1]: 0 without a face, low where it does not fit.
        calibrated: how much of the time that learning a person takes has passed, () in [0,1].
        error: root mean square distance of the landmarks to the head's, () as a share of that of the eyes' corners.
        shapes: weights of the rig's N shapes before gains and filter, (N,).
        pose: rotation and translation before the filter, (12,).
        hidden: for how long shapes have not been seen, (N,), seconds.
        shown, lost: for how long there has been a face, and none, (), seconds.
        speeds: of the filtered weights and of the head, (58,), a second.
        information, evidence: what has been learned of the person's D coefficients, (D,D) and (D,), beside the prior.
        person: the coefficients, (D,).
        learned: for how long the person has been learned, (), seconds.
        lids: by how much the person's open and shut eyes are beside what is usual, (2,2): the right eye's, the left's.
        lids_seen: for how long that has been learned, (2,2), seconds.
        straight: where the eyes seem to look as they look straight ahead, (2,2) radians, and for how long that has been
            learned, seconds.
        straight_seen: for how long that has been learned, (), seconds.
        gains: logarithms of how far the person's landmarks go beside the rig's, of groups of shapes, (3,).
        gains_seen: for how long that has been learned, (3,), seconds.

    Example:
        >>> from torchface.capture.anybody import WebcamSolver
        >>> from torchface.synthetic import performer
        >>> state = WebcamSolver(performer(texture=False)).start()
        >>> len(state.weights), state.tracked.item()
        (52, 0.0)
    """

    weights: Tensor
    rotation: Tensor
    translation: Tensor
    gaze: Tensor
    tracked: Tensor
    calibrated: Tensor
    error: Tensor
    shapes: Tensor
    pose: Tensor
    hidden: Tensor
    shown: Tensor
    lost: Tensor
    speeds: Tensor
    information: Tensor
    evidence: Tensor
    person: Tensor
    learned: Tensor
    lids: Tensor
    lids_seen: Tensor
    straight: Tensor
    straight_seen: Tensor
    gains: Tensor
    gains_seen: Tensor

    def pack(self) -> Tensor:
        """All of it in one vector, (S,) float32; see :class:`StateLayout` for the way back."""
        return torch.cat([getattr(self, name).reshape(-1).float() for name in PARTS])

    def double(self) -> "WebcamState":
        """In float64, as it is computed with."""
        return WebcamState(*(getattr(self, name).double() for name in PARTS))

    def where(self, condition: Tensor, other: "WebcamState") -> "WebcamState":
        """This where a condition () holds, else another."""
        return WebcamState(*(torch.where(condition, getattr(self, name), getattr(other, name)) for name in PARTS))


PARTS = tuple(part.name for part in fields(WebcamState))
"""Of a state, in order."""


@dataclass(frozen=True)
class StateLayout:
    """Where a state's parts lie in its vector."""

    shapes: int  # N, of the rig
    coefficients: int  # D, of the person

    @property
    def sizes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each part, in order."""
        n, d, all_names = self.shapes, self.coefficients, len(ARKIT)
        return {
            "weights": (all_names,),
            "rotation": (3, 3),
            "translation": (3,),
            "gaze": (2, 2),
            "tracked": (),
            "calibrated": (),
            "error": (),
            "shapes": (n,),
            "pose": (12,),
            "hidden": (n,),
            "shown": (),
            "lost": (),
            "speeds": (all_names + 6,),
            "information": (d, d),
            "evidence": (d,),
            "person": (d,),
            "learned": (),
            "lids": (2, 2),
            "lids_seen": (2, 2),
            "straight": (2, 2),
            "straight_seen": (),
            "gains": (GROUPS,),
            "gains_seen": (GROUPS,),
        }

    @property
    def length(self) -> int:
        """S."""
        return sum(prod(size) for size in self.sizes.values())

    def start(self) -> WebcamState:
        """The state before the first frame."""
        return self.unpack(torch.zeros(self.length))

    def unpack(self, vector: Tensor) -> WebcamState:
        """A state of its vector (S,)."""
        if vector.shape != (self.length,):
            raise ShapeError(f"webcam state: found {tuple(vector.shape)}, expected ({self.length},)")
        parts = vector.split([prod(size) for size in self.sizes.values()])
        return WebcamState(*(part.reshape(size) for part, size in zip(parts, self.sizes.values(), strict=True)))
