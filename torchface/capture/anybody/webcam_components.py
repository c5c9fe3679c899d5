"""Settings of the webcam's solver, and its components: what follows from the rig, people, the prior and names."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor, nn

from torchface.capture.antagonist_shapes import signed_quantities
from torchface.capture.anybody.guided_gains import gain_groups
from torchface.capture.anybody.person_landmarks import PersonLandmarks
from torchface.capture.anybody.webcam_state import StateLayout, WebcamState
from torchface.capture.own_rig.eye_geometry import LOOKS, arkit_names, lid_followers, openness_rows
from torchface.capture.own_rig.face_points import JAW, LANDMARKS
from torchface.capture.own_rig.weight_walk import twins_of
from torchface.capture.priors import ShapePrior
from torchface.errors import NameMismatchError
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number, checked_type
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping


@dataclass(frozen=True)
class WebcamSettings:
    """How a webcam's frames are solved.

    Args:
        noise: of landmarks in one frame, as a share of the distance of the eyes' outer corners.
        prior_strength: of the shape prior; 1 is Bayes' rule, were landmarks' errors independent of each other.
        sparsity: the L1 penalty, for a weight of 1.
        ridge: for a squared weight of 1.
        motion: how far a weight wanders in a second, standard deviation.
        contour_slide: how much an error along the contour counts beside one across it, 0 to 1.
        steps: of Gauss and Newton, a frame.
        coefficients: of a person's landmarks.
        alike: for how long landmarks' errors stay alike, seconds: frames nearer to each other count as one.
        learning: for how long a person is learned, seconds of good frames.
        memory: after how long what was learned counts for 1/e while learning goes on, seconds.
        rest_penalty: for how unlikely a lasting expression is held beside a person's own shape.
        openness_noise, gaze_noise: standard deviations, of openness as a share of the open eye's, of eyeLook's weights.

    Raises:
        ValueRangeError: an argument is not as above.

    Example:
        >>> from torchface.capture.anybody import WebcamSolver
        >>> from torchface.synthetic import performer
        >>> few = WebcamSolver(performer(texture=False), settings=WebcamSettings(coefficients=8))
        >>> len(few.start().person)  # what is learned of a person
        8
    """

    noise: float = 0.015
    prior_strength: float = 0.3
    sparsity: float = 0.5
    ridge: float = 1e-2
    motion: float = 1.0
    contour_slide: float = 0.3
    steps: int = 1
    coefficients: int = 64
    alike: float = 0.3
    learning: float = 10.0
    memory: float = 20.0
    rest_penalty: float = 6.0
    openness_noise: float = 0.1
    gaze_noise: float = 0.1

    def __post_init__(self) -> None:
        for name in ("prior_strength", "sparsity", "ridge", "rest_penalty"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT)
        for name in ("noise", "motion", "alike", "learning", "memory", "openness_noise", "gaze_noise"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT, above=True)
        checked_number("contour_slide", self.contour_slide, 0.0, 1.0)
        checked_count("steps", self.steps, 1)
        checked_count("coefficients", self.coefficients, 1)


_UPRIGHT = (1 / 600, -1 / 600)  # of a face some way off; the camera's y goes down
# What counts as a weight of 1 in the filter, of what it must not smooth away, and of the head's motion.
_FILTER_UNITS = {"eyeBlink": 0.25, "eyeLook": 0.5}
_MOTION_UNITS = [0.5] * 3 + [100.0] * 3  # radians and millimetres
_LOOK_EYES = (0, 0, 1, 1, 0, 0, 1, 1)  # whose each of ``LOOKS`` is
_DAMPING_ROTATION, _DAMPING_TRANSLATION = 0.5, 500.0  # radians and millimetres that a step of a pose may well be
_CONTOUR_TRUST = 0.5  # how much a landmark of the contour counts beside an inner one
_LIDS = ("eyeBlink", "eyeWide", "eyeSquint")
_LID_MOTION = 3.0
_CONSTANTS = (
    "signed",
    "twins",
    "arkit_signed",
    "followers",
    "landmark_weights",
    "camera",
    "look_eyes",
    "upright",
    "damping",
    "filter_units",
)


class WebcamSolverParts(nn.Module):
    """All that a webcam's solve computes with, as buffers and submodules; see ``WebcamSolver`` for the arguments."""

    to_arkit: Tensor
    influence: Tensor
    open_rows: Tensor
    usual_openness: Tensor
    look_shapes: Tensor
    look_eyes: Tensor
    gain_shapes: Tensor
    signed: Tensor
    twins: Tensor
    arkit_signed: Tensor
    followers: Tensor
    walk: Tensor
    landmark_weights: Tensor
    camera: Tensor
    upright: Tensor
    damping: Tensor
    filter_units: Tensor

    def __init__(
        self,
        rig: BlendshapeRig,
        identity_modes: Tensor | None = None,
        prior: ShapePrior | None = None,
        settings: WebcamSettings | None = None,
    ) -> None:
        super().__init__()
        checked_type("rig", rig, BlendshapeRig)
        self.settings = settings or WebcamSettings()
        self.names: tuple[str, ...] = tuple(rig.names)
        self.person = PersonLandmarks(rig, identity_modes, self.settings.coefficients)
        if prior is not None:
            prior.require(rig.names)
        to_arkit = mapping(rig.names, ARKIT).double()
        if not bool(to_arkit.any()):
            raise NameMismatchError(
                f"rig: found none of ARKit's shapes among {', '.join(rig.names[:5])}, expected some"
            )
        self.prior = None if prior is None else prior.prepared(self.settings.prior_strength)
        self.layout = StateLayout(len(rig.names), self.settings.coefficients)
        called = arkit_names(rig.names)
        rest, basis = self.person.rest[:LANDMARKS], self.person.basis[:LANDMARKS]
        rows, usual = openness_rows(rest, basis, called)
        landmark_weights = torch.tensor([_CONTOUR_TRUST] * JAW + [1.0] * (LANDMARKS - JAW))
        moved = basis.square().sum(1) * landmark_weights[:, None]
        for name, value in {
            "to_arkit": to_arkit,
            # Share of each landmark in the evidence of each shape, (68,N).
            "influence": moved / moved.sum(0).clamp(min=1e-6),
            "open_rows": rows,
            "usual_openness": usual,
            "look_shapes": mapping(LOOKS, rig.names).double(),
            "gain_shapes": gain_groups(rig.names),
            "signed": signed_quantities(rig.names),
            "twins": twins_of(rig.names),
            "arkit_signed": signed_quantities(ARKIT),
            # A prior has what goes together.
            "followers": float(prior is None) * (lid_followers(rig.names).double() @ to_arkit.T),
            "walk": torch.tensor([(_LID_MOTION if n.startswith(_LIDS) else 1.0) for n in called]),
            "landmark_weights": landmark_weights,
            "camera": torch.eye(3),
            "look_eyes": torch.tensor(_LOOK_EYES),
            "upright": torch.tensor(_UPRIGHT),
            "damping": torch.tensor([_DAMPING_ROTATION] * 3 + [_DAMPING_TRANSLATION] * 3).double() ** -2,
            "filter_units": torch.tensor(
                [min([u for k, u in _FILTER_UNITS.items() if n.startswith(k)], default=1.0) for n in ARKIT]
                + _MOTION_UNITS
            ),
        }.items():
            # What no rig, person or prior brings is in no state.
            kept = name not in _CONSTANTS
            self.register_buffer(name, value.double() if value.is_floating_point() else value, persistent=kept)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Moves to a device; numbers stay double, as they are computed with, where the rest of a network does not."""

        def moved(x: Tensor) -> Tensor:
            made = fn(x)
            return made if made.dtype == x.dtype else x.to(made.device)

        return super()._apply(moved, recurse)  # type: ignore[no-untyped-call, no-any-return]

    def start(self) -> WebcamState:
        """The state before the first frame, all zeros."""
        return self.layout.start()
