"""Components of a video solver: the rig's points, the camera, priors and settings; and how they are kept."""

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from torchface.capture.antagonist_shapes import signed_quantities
from torchface.capture.own_rig.face_points import JAW, LANDMARKS, FacePoints, make_room_for_points
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets, shifted_points
from torchface.capture.own_rig.video_settings import VideoSettings
from torchface.capture.own_rig.weight_walk import relative_trust, twins_of
from torchface.capture.priors import AdaptedDynamicsPrior, DynamicsPrior, ReciprocalPrior, ShapePrior
from torchface.correctives.activation import CorrectiveActivation
from torchface.correctives.corrective_shapes import definitions_from_records
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.number_checks import as_real, as_tensor, checked_type
from torchface.rig import BlendshapeRig
from torchface.shape_names import read_as_arkit

CONTOUR_WEIGHT = 0.5
ROTATION_STEP, TRANSLATION_STEP = 0.02, 4.0
"""How far a head moves from frame to frame: standard deviations in radians and millimetres."""
_TURN, _SHIFT = 0.6, 180.0
"""How far it wanders in a second, where weights walk: landmarks that are left while others are hidden lead no further
astray."""
INITIAL_ROTATION, INITIAL_TRANSLATION = 0.5, 500.0
"""Standard deviations of a pose before any landmark is seen, radians and millimetres."""
INITIAL_WEIGHT, DEFAULT_WEIGHT_STEP = 1.0, 0.1
"""Standard deviations of a weight before anything is seen, and of its steps until the dynamics window is full."""

# Lids close in a tenth of a second; nothing else in a face is as quick.
_LIDS, _LID_MOTION = re.compile(r"eye_?(blink|wide|squint)", re.IGNORECASE), 2.0

_POINTS = ("rest", "basis", "rows", "valid", "side")
_PRIORS: dict[str, type[ShapePrior]] = {"shape_prior": ShapePrior, "reciprocal_prior": ReciprocalPrior}
_DYNAMICS: dict[str, type[DynamicsPrior] | type[AdaptedDynamicsPrior]] = {
    "dynamics_prior": DynamicsPrior,
    "adapted_dynamics_prior": AdaptedDynamicsPrior,
}
_LEAST_INFLUENCE = 1e-6  # mm²; less is nothing
_MAX_SHAPES, _MAX_POINTS = 2**12, 2**20


class VideoSolverParts(nn.Module):
    """All that a video solve computes with, as buffers and submodules; see ``VideoSolver`` for the arguments."""

    rest: Tensor
    basis: Tensor
    rows: Tensor
    valid: Tensor
    side: Tensor
    corrective_basis: Tensor | None
    signed: Tensor
    twins: Tensor
    intrinsics: Tensor
    lower: Tensor
    upper: Tensor
    landmark_weights: Tensor
    motion_variance: Tensor
    initial_information: Tensor
    l1_penalty: Tensor
    ridge: Tensor
    walk_variance: Tensor

    def __init__(
        self,
        rig: BlendshapeRig,
        landmark_vertices: Tensor | None,
        intrinsics: Tensor,
        prior: ShapePrior | None = None,
        dynamics: DynamicsPrior | AdaptedDynamicsPrior | None = None,
        settings: VideoSettings | None = None,
        landmark_weights: Tensor | None = None,
    ) -> None:
        super().__init__()
        settings = settings or VideoSettings()
        checked_type("rig", rig, BlendshapeRig)
        intrinsics = as_tensor("intrinsics", intrinsics, "(3,3)", torch.get_default_dtype())
        marks = rig.neutral.landmarks if landmark_vertices is None else landmark_vertices
        if intrinsics.shape != (3, 3):
            raise ShapeError(f"intrinsics: found {tuple(intrinsics.shape)}, expected (3,3)")
        weights = _default_weights() if landmark_weights is None else as_real(landmark_weights, "landmark_weights")
        weights = weights.detach()
        if weights.shape != (LANDMARKS,):
            raise ShapeError(f"landmark_weights: found {tuple(weights.shape)}, expected ({LANDMARKS},)")
        check_not_negative("landmark_weights", weights)
        for learned in (prior, dynamics):
            if learned is not None:
                learned.require(rig.names)
        points = FacePoints.of(rig, marks, slides=settings.contour_slide < 1)
        self._hold(rig.names, points, intrinsics.detach(), weights, prior, dynamics, settings)

    def _hold(
        self,
        names: Sequence[str],
        points: FacePoints,
        intrinsics: Tensor,
        landmark_weights: Tensor,
        prior: ShapePrior | None,
        dynamics: DynamicsPrior | AdaptedDynamicsPrior | None,
        settings: VideoSettings,
    ) -> None:
        self.names: tuple[str, ...] = tuple(names)
        self.prior, self.dynamics = prior, dynamics
        self._settings = settings
        like = points.rest
        for name in _POINTS:
            self.register_buffer(name, getattr(points, name).detach())
        self.activation = points.activation
        self.register_buffer("corrective_basis", points.corrective_basis)
        self.register_buffer("intrinsics", intrinsics.to(like, copy=True))
        self.register_buffer("landmark_weights", landmark_weights.to(like, copy=True))
        # What follows from settings alone is on the CPU also where a solver is being rebuilt without memory.
        device = torch.device("cpu") if like.is_meta else like.device
        count = len(names)
        # Nothing is expected of weights that no dynamics prior leads to, next to nothing of a first frame's.
        weight = 0.0 if dynamics is None else INITIAL_WEIGHT**-2
        # From frame to frame with a dynamics prior, in a second without.
        turn, shift = (_TURN, _SHIFT) if dynamics is None else (ROTATION_STEP, TRANSLATION_STEP)
        lids = [_LIDS.match(name) for name in read_as_arkit(names)]
        constants = {
            "lower": [0.0] * count + [-torch.inf] * 6,
            "upper": [1.0] * count + [torch.inf] * 6,
            "motion_variance": [turn**2] * 3 + [shift**2] * 3,
            "initial_information": [weight] * count + [INITIAL_ROTATION**-2] * 3 + [INITIAL_TRANSLATION**-2] * 3,
            "l1_penalty": [settings.sparsity] * count + [0.0] * 6,
            "ridge": [2 * settings.ridge] * count + [0.0] * 6,
            "walk_variance": [(settings.motion * (_LID_MOTION if lid else 1.0)) ** 2 for lid in lids],
        }
        for name, numbers in constants.items():
            made = torch.tensor(numbers, dtype=torch.float64, device=device)
            self.register_buffer(name, made, persistent=False)
        with torch.device("cpu"):
            signed = signed_quantities(names)
            twins = twins_of(names)
        self.register_buffer("signed", signed.to(device), persistent=False)
        self.register_buffer("twins", twins.to(device), persistent=False)

    @property
    def settings(self) -> VideoSettings:
        """What the terms weigh; fixed."""
        return self._settings

    @property
    def points(self) -> FacePoints:
        """Of the rig, float64."""
        more = None if self.corrective_basis is None else self.corrective_basis.double()
        parts = self.rest.double(), self.basis.double(), self.rows, self.valid, self.side.double()
        return FacePoints(*parts, self.activation, more)

    @property
    def walks(self) -> bool:
        """Whether weights are expected near those of the frame before, without a dynamics prior."""
        return self.dynamics is None and self.settings.motion > 0

    def shifted(self, offsets: LandmarkOffsets) -> Self:
        """The same solver for landmarks that lie off the rig's by these offsets, with their noise."""
        made = copy.copy(self)
        made._buffers = dict(self._buffers)
        points = shifted_points(self.points, self.names, offsets.millimetres)
        made.rest, made.basis = points.rest, points.basis
        made._settings = replace(self.settings, relative_noise=offsets.noise)
        return made

    def with_settings(self, settings: VideoSettings) -> Self:
        """The same solver with other weights of terms; those of sparsity, ridge and motion stay."""
        made = copy.copy(self)
        made._settings = settings
        return made

    def shape_confidence(self, trust: Tensor) -> Tensor:
        """Share of each shape's evidence that is seen, (B,N) in [0,1], where landmarks count as (B,68) beside their
        frame's surest.

        A landmark's evidence of a shape is how far the shape moves it, squared.
        """
        influence = self.basis[:LANDMARKS].square().sum(1).to(trust) * self.landmark_weights.to(trust)[:, None]
        return (relative_trust(trust) @ influence) / influence.sum(0).clamp(min=_LEAST_INFLUENCE)

    @property
    def config(self) -> dict[str, Any]:
        """What :meth:`from_config` needs beside the state: plain values only."""
        return {
            "names": list(self.names),
            "points": len(self.rest),
            "curve": self.rows.shape[1],
            "settings": asdict(self.settings),
            "prior": _described(self.prior, _PRIORS),
            "dynamics": _described(self.dynamics, _DYNAMICS),
            **({} if self.activation is None else {"correctives": self.activation.records()}),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "VideoSolverParts":
        """A solver of zeros for the state to be loaded into, without the rig it came from."""
        names = config["names"]
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names) or len(set(names)) < len(names):
            raise NameMismatchError(f"names: found {names!r:.80}, expected a list of distinct names")
        values = Value("video solver", "", config)
        count, curve = values["points"].whole(1), values["curve"].whole(1)
        if not 0 < len(names) <= _MAX_SHAPES or not LANDMARKS <= count <= _MAX_POINTS or curve > count:
            raise FileFormatError(
                f"video solver: found {len(names)} shapes, {count} points and curves of {curve}, expected 1 to "
                f"{_MAX_SHAPES} shapes, {LANDMARKS} to {_MAX_POINTS} points and no longer curves"
            )
        settings = values["settings"].plain_table()
        prior, dynamics = _made(config.get("prior"), _PRIORS), _made(config.get("dynamics"), _DYNAMICS)
        for learned in (prior, dynamics):
            if learned is not None:
                learned.require(names)
        self = cls.__new__(cls)
        nn.Module.__init__(self)
        definitions = definitions_from_records(config.get("correctives", []))
        points = FacePoints(
            torch.zeros(count, 3, dtype=torch.float64),
            torch.zeros(count, 3, len(names), dtype=torch.float64),
            torch.zeros(JAW, curve, dtype=torch.int64),
            torch.zeros(JAW, curve, dtype=torch.bool),
            torch.zeros(JAW, dtype=torch.float64),
            CorrectiveActivation(definitions, names) if definitions else None,
            torch.zeros(count, 3, len(definitions), dtype=torch.float64) if definitions else None,
        )
        K, weights = torch.zeros(3, 3), torch.zeros(LANDMARKS)
        self._hold(names, points, K, weights, prior, dynamics, VideoSettings(**settings))
        return self

    def check_state(self) -> None:
        """Refuses a state that no rig and camera give."""
        if bool(((self.rows < 0) | (self.rows >= len(self.rest))).any()):
            raise ValueRangeError(f"video solver: found rows beyond its {len(self.rest)} points, expected rows of them")
        K = self.intrinsics
        if not bool((K.diagonal() > 0).all()) or K[2].tolist() != [0.0, 0.0, 1.0]:
            raise ValueRangeError(f"video solver: found intrinsics {K.tolist()}, expected those of a camera")
        check_not_negative("landmark_weights", self.landmark_weights)
        for learned in (self.prior, self.dynamics):
            if check := getattr(learned, "check_state", None):
                check()

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        """As modules do; but another rig's contour may have more or fewer points than this one's."""
        make_room_for_points(self, state_dict, prefix, () if self.corrective_basis is None else ("corrective_basis",))
        super()._load_from_state_dict(state_dict, prefix, *rest)  # type: ignore[arg-type]

    def extra_repr(self) -> str:
        return f"{len(self.names)} shapes, {self.settings}"


def check_not_negative(name: str, value: Tensor) -> None:
    """Raises ``ValueRangeError`` for a negative or infinite number, or NaN."""
    if not bool((torch.isfinite(value) & (value >= 0)).all()):
        raise ValueRangeError(f"{name}: found {value.flatten()[:5].tolist()}, expected finite ones of at least 0")


def _default_weights() -> Tensor:
    weights = torch.ones(LANDMARKS)
    weights[:JAW] = CONTOUR_WEIGHT
    return weights


def _described(learned: Any, kinds: Mapping[str, type]) -> dict[str, Any] | None:
    if learned is None:
        return None
    kind = next((kind for kind, known in kinds.items() if type(learned) is known), None)
    if kind is None:
        known = " or ".join(one.__name__ for one in kinds.values())
        raise NameMismatchError(f"video solver: found a prior of class {type(learned).__name__}, expected {known}")
    return {"kind": kind, **learned.config}


def _made(config: Any, kinds: Mapping[str, type]) -> Any:
    """A prior that has learned nothing; a kind is looked up in the table and nowhere else."""
    if config is None:
        return None
    kind = config.get("kind") if isinstance(config, Mapping) else None
    if not isinstance(kind, str) or kind not in kinds:
        raise FileFormatError(f"video solver: found a prior of kind {kind!r:.80}, expected {' or '.join(kinds)}")
    return kinds[kind].from_config(config)  # type: ignore[attr-defined]
