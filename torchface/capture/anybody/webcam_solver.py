"""A character's weights from one webcam, for anybody who sits before it: the head becomes the person's meanwhile."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchface.capture.anybody.eye_signals import (
    CORNERS,
    LOOKS,
    EyesRead,
    eye_signals,
    look_weights,
    openness_rows,
    seen_gaze,
)
from torchface.capture.anybody.guided_gains import gain_factors, gain_groups, highest_weights, learned_gains
from torchface.capture.anybody.person_filter import frame_information, lasting_precision
from torchface.capture.anybody.person_prior import PersonPrior
from torchface.capture.anybody.rig_tables import CONTOUR_TRUST, arkit_names, closing, owners, tells
from torchface.capture.anybody.shown_state import (
    LOST_FIT,
    ShownOutputs,
    chosen_state,
    double_state,
    lost_state,
    shown_state,
)
from torchface.capture.anybody.webcam_settings import WebcamSettings
from torchface.capture.anybody.webcam_state import StateLayout, WebcamControls, WebcamState
from torchface.capture.own_rig.face_points import JAW, LANDMARKS, FacePoints, make_room_for_points
from torchface.capture.own_rig.reprojection import HeadState, Linearised, linearise
from torchface.capture.own_rig.weight_walk import faded, relative_trust, unseen_time, walk_information
from torchface.capture.priors import ShapePrior
from torchface.capture.priors.student_groups import StudentGroups
from torchface.errors import NameMismatchError, ShapeError
from torchface.geometry.cameras.affine_pose import affine_pose, orthonormal
from torchface.geometry.cameras.calibration import ASSUMED_FIELD_OF_VIEW
from torchface.landmarks.images.face_reading import READ_BY_NETWORKS, FaceReading, trust_of
from torchface.optim.exported_operators import split_box_program_quickly, symmetric_inverse
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping

_RHO, _SPLITTING_STEPS = 0.05, 30
_UPRIGHT = (1 / 600, -1 / 600)  # of a face some way off; the camera's y goes down
_BLINK_UNIT = 0.25  # what counts as a weight of 1 in the filter: of blinks, which it must not smooth away,
_MOTION_UNITS = [0.5] * 3 + [100.0] * 3  # and of the head's motion, radians and millimetres
_LOOK_EYES = (0, 0, 1, 1, 0, 0, 1, 1)  # whose each of ``LOOKS`` is
_DAMPING_ROTATION, _DAMPING_TRANSLATION = 0.5, 500.0  # radians and millimetres that a step of a pose may well be
_FREE = 1e9
_ENOUGH = 20.0  # landmarks
_LEAST_TRUST = 8.0  # of landmarks that nothing hides, together
_PRESENT = 0.5
_NEAR = 0.5  # of the eyes' distance
_SHORTEST, _LONGEST = 1e-3, 0.5  # seconds
_SETTLED = 0.15  # seconds after which a found face's pose has come to rest
_UNKNOWN, _FADE = 5.0, 0.4  # how much more sparse a face is that nothing is known of, and for how long, seconds
_EAGER, _EAGER_FOR = 3.0, 0.7  # how much more the first frames of a person tell, and for how long, seconds
_LIDS = ("eyeBlink", "eyeWide", "eyeSquint")
_LID_MOTION = 3.0
_LID_RIDGE = {"eyeWide": 16.0, "eyeSquint": 8.0}  # lids that stand a little otherwise are noise, more likely than not
_CONSTANTS = ("landmark_weights", "identity", "camera", "look_eyes", "upright", "damping", "filter_units")


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a frame shows of a face.

    Args:
        rays: to the landmarks, (68,2), at a depth of 1.
        trust: in each, (68,).
        spread: of each, standard deviation of a coordinate, (68,), at a depth of 1.
        iris: rays to the irises, (2,2).
        eyes: how open they are.
    """

    rays: Tensor
    trust: Tensor
    spread: Tensor
    iris: Tensor
    eyes: EyesRead


class WebcamSolver(nn.Module):
    r"""Weights by ARKit's names, pose and gaze from what networks read of a face, for people it has never seen.

    Every frame it minimises ``VideoSolver``'s energy by a fixed number of Gauss and Newton's steps,

    .. math::
        \min_{0 \le w \le 1,\, R,\, t} \; \tfrac12 \sum_l \frac{c_l}{\sigma^2}
        \lVert \pi(R (b_l + U_l z + B_l w) + t) - q_l \rVert^2 - \lambda \log p(w) + \beta \sum_i w_i
        + \tfrac12 \sum_i \frac{(w_i - w^-_i)^2}{v_i} + \tfrac12 \sum_e \frac{(1 + c_e^\top w - o_e)^2}{\sigma_o^2}

    on a head that becomes the person's own: z are D coefficients of how the person's landmarks lie beside the rig's,
    identity and the finder's habits in one, :math:`z \sim N(0, I)`. They are learned beside it by an information filter
    that leaves out what expressions and pose explain; after some seconds they are held. Openness o of the eyes counts
    beside the person's own open and shut eyes, gaze beside where the person looks straight ahead. Weights are divided
    by how far the person's landmarks go, which a guided calibration tells, and calmed.

    The same module is what ``torchface.onnx.webcam`` exports: no step depends on values but by clamps and choices.

    Args:
        rig: N shapes with the 68 landmarks annotated; of any person, by ARKit's names.
        identity_modes: what a standard deviation of each of K ways of being another person adds to the landmarks,
            (K,68,3), millimetres; see ``HeadModel``.
        prior: which weights faces have, one of Student's distributions.
        settings: what terms weigh.

    Raises:
        ShapeError: the rig has no landmarks, or the modes are others.
        NameMismatchError: the prior is for other shapes, or the rig has none of ARKit's.
        ValueRangeError: the prior is none of Student's distributions.

    Source: thesis 4.2.6; Li, Yu, Ye and Bregler 2013 and Bouaziz, Wang and Pauly 2013 for learning while solving.

    Example:
        >>> from torchface.landmarks.images.face_reading import FaceReading
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> head = rig.vertices[rig.neutral.landmarks] * torch.tensor([1.0, -1, -1]) + torch.tensor([0.0, 0, 500])
        >>> pixels = 600 * head[:, :2] / head[:, 2:] + torch.tensor([320.0, 240.0])
        >>> sure, both = torch.ones(68), torch.ones(2)
        >>> seen = FaceReading(pixels, sure, sure, both[0], pixels[[36, 42]], 0.3 * both, 0 * both, both)
        >>> solver = WebcamSolver(rig)
        >>> state = solver.step(solver.start(), seen, interval=1 / 30)
        >>> state.tracked.item() > 0
        True
    """

    rest: Tensor
    basis: Tensor
    rows: Tensor
    valid: Tensor
    side: Tensor
    owner: Tensor
    person_basis: Tensor
    person_remainder: Tensor
    closing_basis: Tensor
    closing_shapes: Tensor
    lid_ridge: Tensor
    precisions: Tensor
    freedoms: Tensor
    sizes: Tensor
    to_arkit: Tensor
    tells: Tensor
    open_rows: Tensor
    usual_openness: Tensor
    look_shapes: Tensor
    look_eyes: Tensor
    gain_shapes: Tensor
    walk: Tensor
    landmark_weights: Tensor
    identity: Tensor
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
        self.settings = settings or WebcamSettings()
        self.names: tuple[str, ...] = tuple(rig.names)
        if rig.neutral.landmarks is None:
            raise ShapeError("rig: found no landmarks, expected the 68 of iBUG's order; see torchface annotate")
        if prior is not None:
            prior.require(rig.names)
        to_arkit = mapping(rig.names, ARKIT).double()
        if not bool(to_arkit.any()):
            raise NameMismatchError(
                f"rig: found none of ARKit's shapes among {', '.join(rig.names[:5])}, expected some"
            )
        points = FacePoints.of(rig.linear("WebcamSolver"), rig.neutral.landmarks)
        person = PersonPrior.of(identity_modes, self.settings.coefficients)
        self.layout = StateLayout(len(rig.names), self.settings.coefficients)
        self.strength = self.settings.prior_strength
        groups = StudentGroups.of(prior, len(rig.names), points.rest)
        called = arkit_names(rig.names)
        rows, usual = openness_rows(points.rest[:LANDMARKS], points.basis[:LANDMARKS], called)
        for name, value in {
            "rest": points.rest,
            "basis": points.basis,
            "rows": points.rows,
            "valid": points.valid,
            "side": points.side,
            "owner": owners(points),
            "person_basis": person.basis,
            "person_remainder": person.remainder,
            "closing_basis": closing(person.basis, rig.names)[0],
            "closing_shapes": closing(person.basis, rig.names)[1],
            "lid_ridge": torch.tensor(
                [_LID_RIDGE.get(n.removesuffix("Left").removesuffix("Right"), 0.0) for n in called]
            ),
            "precisions": groups.precisions,
            "freedoms": groups.freedoms,
            "sizes": groups.sizes,
            "to_arkit": to_arkit,
            "tells": tells(points),
            "open_rows": rows,
            "usual_openness": usual,
            "look_shapes": mapping(LOOKS, rig.names).double(),
            "gain_shapes": gain_groups(rig.names),
            "walk": torch.tensor([(_LID_MOTION if n.startswith(_LIDS) else 1.0) for n in called]),
            "landmark_weights": torch.tensor([CONTOUR_TRUST] * JAW + [1.0] * (LANDMARKS - JAW)),
            "identity": torch.eye(max(len(rig.names) + 6, self.settings.coefficients)),
            "camera": torch.eye(3),
            "look_eyes": torch.tensor(_LOOK_EYES),
            "upright": torch.tensor(_UPRIGHT),
            "damping": torch.tensor([_DAMPING_ROTATION] * 3 + [_DAMPING_TRANSLATION] * 3).double() ** -2,
            "filter_units": torch.tensor(
                [_BLINK_UNIT if n.startswith("eyeBlink") else 1.0 for n in ARKIT] + _MOTION_UNITS
            ),
        }.items():
            # What no rig, person or prior brings is in no state.
            kept = name not in _CONSTANTS
            self.register_buffer(name, value.double() if value.is_floating_point() else value, persistent=kept)

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        """As modules do; but another rig's contour may have more or fewer points than this one's."""
        make_room_for_points(self, state_dict, prefix, ("owner",))
        super()._load_from_state_dict(state_dict, prefix, *rest)  # type: ignore[arg-type]

    def start(self) -> WebcamState:
        """The state before the first frame, all zeros."""
        return self.layout.start()

    def step(
        self,
        state: WebcamState,
        reading: FaceReading,
        interval: float,
        controls: WebcamControls | None = None,
        size: tuple[int, int] = (640, 480),
    ) -> WebcamState:
        """The next frame's state; its ``weights``, ``rotation``, ``translation`` and ``gaze`` are the frame's.

        Args:
            state: of the frame before; ``start()`` for the first.
            reading: of the frame; landmarks and irises of NaN where there is no face.
            interval: seconds since the frame before.
            controls: what the user asks for.
            size: width and height of the picture, pixels; the camera is assumed from it.
        """
        tensors = [getattr(reading, name).detach().float() for name in READ_BY_NETWORKS]
        pixels = torch.tensor([float(n) for n in size])
        with torch.inference_mode():
            given = (
                *tensors,
                pixels,
                torch.tensor(float(interval)),
                (controls or WebcamControls()).tensor(),
                state.pack(),
            )
            return self.layout.unpack(self(*given).clone())

    def forward(  # noqa: PLR0913  # the inputs of a graph are tensors by their names
        self,
        landmarks: Tensor,
        deviation: Tensor,
        visibility: Tensor,
        presence: Tensor,
        iris: Tensor,
        openness: Tensor,
        closed: Tensor,
        eye_visibility: Tensor,
        size: Tensor,
        interval: Tensor,
        controls: Tensor,
        state: Tensor,
    ) -> Tensor:
        """The next state's vector (S,), of a ``FaceReading``, ``step``'s other arguments and the state's vector."""
        pose, gain, smoothing, reset, freeze = controls.double()
        before = double_state(self.layout.unpack(torch.where(reset > 0, 0.0, _known(state, 0.0))))
        interval = _known(interval.double(), _SHORTEST).clamp(_SHORTEST, _LONGEST)
        focal = size.double().max() / (2 * math.tan(math.radians(ASSUMED_FIELD_OF_VIEW) / 2))
        centre = 0.5 * (size.double() - 1)
        rays, iris_rays = (landmarks.double() - centre) / focal, (iris.double() - centre) / focal
        seen = ~torch.isnan(rays).any(1)
        present = _known(presence.double(), 0.0) * (seen.double().sum() >= _ENOUGH)
        found = present > _PRESENT
        visible = _known(visibility.double(), 1.0).clamp(0, 1)
        trust = trust_of(self.landmark_weights * seen, visible)
        found = found & (trust.sum() > _LEAST_TRUST)
        # Without a face all counts alike and what comes of it is dropped, so that no number is a NaN.
        trust = torch.where(found, trust, 1.0)
        rays = torch.where(seen[:, None] & found, rays, self.rest[:LANDMARKS, :2] * self.upright)
        spread = _known(deviation.double(), 0.0).clamp(0, 1e3) / focal
        eyes = EyesRead(openness.double(), closed.double(), eye_visibility.double())
        solved = self._solved(_Seen(rays, trust, spread, iris_rays, eyes), before, interval, pose, freeze)
        lost = lost_state(before, interval)
        after = chosen_state(found, solved, lost)
        outputs = ShownOutputs(self.gain_shapes, self.to_arkit, self.filter_units)
        return shown_state(outputs, after, before, found, present, interval, gain, smoothing).pack()

    def _solved(self, seen: _Seen, before: WebcamState, interval: Tensor, pose: Tensor, freeze: Tensor) -> WebcamState:
        """The state of a frame with a face, its outputs not yet calmed."""
        rays, trust, spread = seen.rays, seen.trust, seen.spread
        points = self.personal_points(before.person)
        K = self.camera
        start_rotation, start_translation = affine_pose(points.rest[:LANDMARKS], rays, trust)
        kept = before.pose[:9].reshape(3, 3), before.pose[9:]
        near = (before.shown + before.lost > 0) & self._near(points, kept, rays, trust)
        rotation = torch.where(near, orthonormal(torch.where(near, kept[0], start_rotation)), start_rotation)
        translation = torch.where(near, kept[1], start_translation)
        shown = torch.where(near, before.shown, 0.0) + interval
        eyes = points.eyes_distance(rotation[None], translation[None], K)[0]
        depth = (
            torch.stack([0.5 * (points.rest[a] + points.rest[b]) for a, b in CORNERS]) @ rotation[2] + translation[2]
        )
        learns = (freeze <= 0) * (before.learned < self.settings.learning)
        gaze = seen_gaze(rays, seen.iris, rotation, depth)
        signals = eye_signals(
            seen.eyes,
            gaze,
            self.usual_openness,
            self.open_rows @ self.look_shapes,
            before,
            interval,
            pose,
            (freeze <= 0).double(),
        )

        counts = torch.where(trust > 0, trust, 0.0)[None]
        told = relative_trust(counts) @ self.tells
        hidden = unseen_time(before.hidden[None], told, interval)
        since = interval + before.lost
        walked = walk_information((self.settings.motion * self.walk).square(), told, since)[0]
        mean = before.shapes * faded(hidden, interval)[0]
        unknown = torch.exp(-before.learned / _FADE)
        unit = eyes / (points.rest[36] - points.rest[45]).norm()
        noise = (
            (self.settings.noise * eyes).square() + (0.5 * spread).square() + self.person_remainder * unit**2
        ).sqrt()
        precision = trust.sqrt() / noise
        gains = gain_factors(before.gains, self.gain_shapes)
        upper = highest_weights(gains, self.gain_shapes, pose)
        looking, look_trust = (
            self.look_shapes @ look_weights(signals.gaze),
            self.look_shapes @ signals.gaze_trust[self.look_eyes],
        )
        head = HeadState(before.shapes.minimum(upper)[None], rotation[None], translation[None])
        dual = torch.zeros_like(self.identity[0, : len(self.names) + 6])
        identity = self.identity[: len(self.names) + 6, : len(self.names) + 6]
        for _ in range(self.settings.steps):  # each begins where the one before ends
            at = self._linearised(points, head, rays, precision)
            J, r = at.jacobian[0].flatten(0, 1), at.residual[0].flatten()
            weights = head.weights[0]
            sure = signals.open_trust / self.settings.openness_noise**2
            gap = 1 + self.open_rows @ weights - signals.open
            pull = look_trust / self.settings.gaze_noise**2
            H = walked.diag() + pull.diag() + (self.open_rows.T * sure) @ self.open_rows
            prior = self._prior(weights)
            H = H + prior
            f = walked * (weights - mean) + pull * (weights - looking) + (sure * gap) @ self.open_rows
            f = f + prior @ weights + self.settings.sparsity * (1 + _UNKNOWN * unknown)
            damping = torch.cat([torch.zeros_like(weights), self.damping])
            motion, dual = split_box_program_quickly(
                J.T @ J + pad(H, (0, 6, 0, 6)) + damping.diag(),
                r @ J + pad(f, (0, 6)),
                pad(-weights, (0, 6), value=-_FREE),
                pad(upper - weights, (0, 6), value=_FREE),
                dual,
                identity,
                _RHO,
                _SPLITTING_STEPS,
            )
            dual = pad(dual[: len(self.names)], (0, 6))
            head = head.moved(head.weights + motion[:, : len(self.names)], motion[:, len(self.names) :])
        weights = head.weights[0].clamp(min=0).minimum(upper)
        head = HeadState(weights[None], head.rotation, head.translation)

        at = self._linearised(points, head, rays, precision)
        error = self._error(at, precision, eyes, trust)
        good = learns * (shown > _SETTLED) * (error < LOST_FIT)
        person, information, evidence = self._learned_person(at, head, before, interval, pose, good)
        gains_after, gains_seen = learned_gains(
            weights, self.gain_shapes, before, interval, pose, (freeze <= 0).double()
        )
        learned = (before.learned + good * interval).clamp(max=self.settings.learning)
        return replace(
            before,
            shapes=weights,
            pose=torch.cat([head.rotation[0].flatten(), head.translation[0]]),
            hidden=hidden[0],
            shown=shown,
            lost=torch.zeros_like(shown),
            error=error,
            gaze=signals.gaze,
            person=person,
            information=information,
            evidence=evidence,
            learned=learned,
            calibrated=learned / self.settings.learning,
            lids=signals.lids,
            lids_seen=signals.lids_seen,
            straight=signals.straight,
            straight_seen=signals.straight_seen,
            gains=gains_after,
            gains_seen=gains_seen,
        )

    def personal_points(self, person: Tensor) -> FacePoints:
        """The rig's points where this person's landmarks lie, of coefficients (D,); all lids shut alike."""
        moved = self.person_basis @ person
        closing = self.closing_basis @ person
        basis = torch.cat(
            [
                self.basis[:LANDMARKS] - (closing[..., None] * self.closing_shapes[:, None, None]).sum(0),
                self.basis[LANDMARKS:],
            ]
        )
        return FacePoints(self.rest + moved[self.owner], basis, self.rows, self.valid, self.side)

    def _linearised(self, points: FacePoints, head: HeadState, rays: Tensor, precision: Tensor) -> Linearised:
        rows = points.chosen(head.weights, head.rotation, head.translation, self.camera)
        slide = self.settings.contour_slide
        return linearise(points, head, rows, self.camera, rays[None], precision[None], slide)

    def _near(self, points: FacePoints, pose: tuple[Tensor, Tensor], rays: Tensor, trust: Tensor) -> Tensor:
        """Whether landmarks are mostly within half the eyes' distance of where a pose shows the head at rest, ()."""
        rotation, translation = pose
        placed = points.rest[:LANDMARKS] @ rotation.T + translation
        apart = (points.rest[36] - points.rest[45]).norm() / placed[:, 2].clamp(min=1.0)
        off = (placed[:, :2] / placed[:, 2:].clamp(min=1.0) - rays).square().sum(1).sqrt()
        return (trust * (off < _NEAR * apart)).sum() > 0.5 * trust.sum()

    def _prior(self, weights: Tensor) -> Tensor:
        """H (N,N) of the shape prior and the ridge."""
        ridge = (2 * self.settings.ridge + self.lid_ridge).diag()
        if not len(self.precisions):
            return ridge
        return ridge + self.strength * StudentGroups(self.precisions, self.freedoms, self.sizes).bound(weights)

    def _error(self, at: Linearised, precision: Tensor, eyes: Tensor, trust: Tensor) -> Tensor:
        """Root mean square distance of the inner landmarks to the head's, as a share of the eyes' distance, ()."""
        inner = trust[JAW:]
        squared = at.residual[0, JAW:].square().sum(1) / precision[JAW:].clamp(min=1e-9).square()
        return ((inner * squared).sum() / inner.sum().clamp(min=1e-6)).sqrt() / eyes

    def _learned_person(
        self, at: Linearised, head: HeadState, before: WebcamState, interval: Tensor, pose: Tensor, good: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients, information and evidence with a frame's, where it is ``good``."""
        resting = ((pose - 1).abs() < 0.5).to(pose)
        frame = at.residual[0], at.jacobian[0], head.weights[0], head.rotation[0], interval, resting
        known = before.person, before.information, before.evidence, before.learned
        learns = good > 0
        if torch.compiler.is_compiling():  # a graph has both ways; here a call that is not exported takes one
            return torch.cond(learns, self._updated_person, self._same_person, (*frame, *known))
        return (self._updated_person if bool(learns) else self._same_person)(*frame, *known)

    def _updated_person(  # noqa: PLR0913  # torch.cond hands tensors on
        self,
        residual: Tensor,
        jacobian: Tensor,
        weights: Tensor,
        rotation: Tensor,
        interval: Tensor,
        resting: Tensor,
        person: Tensor,
        information: Tensor,
        evidence: Tensor,
        learned: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        closed = self.closing_shapes @ weights
        basis = self.person_basis - (closed[:, None, None, None] * self.closing_basis).sum(0)
        by_person = (jacobian[..., -3:] @ rotation @ basis).flatten(0, 1)
        lasting = lasting_precision(weights, self.settings.rest_penalty, resting > 0)
        frame, gradient = frame_information(residual.flatten(), jacobian.flatten(0, 1), by_person, weights, lasting)
        eager = 1 + _EAGER * torch.exp(-learned / _EAGER_FOR)
        share = (interval / self.settings.alike * eager).clamp(max=1.0)
        kept = torch.exp(-interval / self.settings.memory)
        information = kept * information + share * frame
        evidence = kept * evidence + share * (frame @ person - gradient)
        count = len(person)
        return symmetric_inverse(information + self.identity[:count, :count]) @ evidence, information, evidence

    def _same_person(self, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        person, information, evidence, _ = given[-4:]
        return person.clone(), information.clone(), evidence.clone()


def _known(values: Tensor, otherwise: float) -> Tensor:
    return torch.where(torch.isnan(values), otherwise, values)
