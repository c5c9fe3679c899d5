"""A character's weights from one webcam, for anybody: the solver's head becomes the person's while frames come."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchface.capture.antagonist_shapes import one_side, weaker_sides
from torchface.capture.anybody.eye_signals import EyeSignals, EyesRead, eye_signals
from torchface.capture.anybody.guided_gains import gain_factors, highest_weights, learned_gains
from torchface.capture.anybody.webcam_components import WebcamSolverParts
from torchface.capture.anybody.webcam_outputs import LOST_FIT, OutputTables, calmed_state, lost_state
from torchface.capture.anybody.webcam_state import WebcamControls, WebcamState
from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.eye_geometry import CORNERS, look_weights, seen_gaze, undrifted
from torchface.capture.own_rig.face_points import EYE_CORNERS, JAW, LANDMARKS, FacePoints
from torchface.capture.own_rig.gauss_newton import HeadState, Linearised, energy_of_step, linearise, split_step
from torchface.capture.own_rig.weight_walk import (
    counted_share,
    expected_weights,
    relative_trust,
    unseen_time,
    walk_information,
)
from torchface.capture.weight_readings import doubted_blinks
from torchface.errors import ShapeError
from torchface.geometry.cameras.affine_pose import affine_pose, orthonormal, spreads
from torchface.geometry.cameras.calibration import ASSUMED_FIELD_OF_VIEW
from torchface.landmarks.images.face_reading import LEAST_VISIBLE, READ_FOR_SOLVER, FaceReading, trust_of
from torchface.number_checks import checked_type
from torchface.optim.exported_operators import symmetric_inverse
from torchface.optim.full_precision import full_precision

_SPLITTING_STEPS = 30
_LEAST_TRUST = 8.0  # of landmarks that nothing hides, together
_PRESENT = 0.5
_NEAR = 0.5  # of the eyes' distance
_SHORTEST, _LONGEST = 1e-3, 0.5  # seconds
_SETTLED = 0.15  # seconds after which the pose of a face that has just appeared has come to rest
_UNKNOWN, _FADE = 5.0, 0.4  # how much more sparse a face is that nothing is known of, and for how long, seconds
_EAGER, _EAGER_FOR = 3.0, 0.7  # how much more the first frames of a person count, and for how long, seconds


_INPUTS: dict[str, tuple[int, ...]] = {
    "landmarks": (68, 2), "deviation": (68,), "visibility": (68,), "presence": (), "iris": (2, 2), "openness": (2,),
    "closed": (2,), "eye_visibility": (2,), "expression": (52,), "expression_deviation": (52,), "size": (2,),
    "interval": (), "controls": (5,),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Frame:
    """What a frame shows of a face."""

    rays: Tensor  # to the landmarks, (68,2), at a depth of 1
    trust: Tensor  # in each, (68,)
    spread: Tensor  # of each, standard deviation of a coordinate, (68,), at a depth of 1
    # weights by ARKit's names as a network reads them, and their deviations, (52,) both; NaN for what is not seen
    read: tuple[Tensor, Tensor]
    iris: Tensor  # rays to the irises, (2,2)
    eyes: EyesRead  # how open they are
    interval: Tensor  # seconds since the frame before, ()
    pose: Tensor  # what the person has been asked to hold, () of `POSES`
    learns: Tensor  # 0 where nothing is to be learned of the person, ()


class WebcamSolver(WebcamSolverParts):
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
    by how far the person's landmarks go, which a guided calibration measures, and calmed.

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
        tensors = [getattr(reading, name).detach().float() for name in READ_FOR_SOLVER]
        pixels = torch.tensor([float(n) for n in size])
        with torch.inference_mode():
            asked = (controls or WebcamControls()).tensor()
            after = self(*tensors, pixels, torch.tensor(float(interval)), asked, state.pack())
            return self.layout.unpack(after.clone())

    @full_precision
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
        expression: Tensor,
        expression_deviation: Tensor,
        size: Tensor,
        interval: Tensor,
        controls: Tensor,
        state: Tensor,
    ) -> Tensor:
        """The next state's vector (S,), of a ``FaceReading``, ``step``'s other arguments and the state's vector.

        Raises:
            ArgumentTypeError, ShapeError: an input is no tensor, or of another shape than one face in one picture has.
        """
        given = [landmarks, deviation, visibility, presence, iris, openness, closed, eye_visibility, expression]
        given += [expression_deviation, size, interval, controls]
        for value, (name, shape) in zip(given, _INPUTS.items(), strict=True):
            if checked_type(name, value, Tensor).shape != shape:
                raise ShapeError(f"webcam solver: found {name} {tuple(value.shape)}, expected {shape}")
        landmarks, iris, openness, closed, expression = (
            torch.where(x.isinf(), torch.nan, x.double()) for x in (landmarks, iris, openness, closed, expression)
        )
        pose, gain, smoothing, reset, freeze = controls.double()
        before = self.layout.unpack(torch.where(reset > 0, 0.0, _known(state, 0.0))).double()
        interval = _known(interval.double(), _SHORTEST).clamp(_SHORTEST, _LONGEST)
        focal = size.double().max() / (2 * math.tan(math.radians(ASSUMED_FIELD_OF_VIEW) / 2))
        centre = 0.5 * (size.double() - 1)
        rays, iris_rays = (landmarks - centre) / focal, (iris - centre) / focal
        visible = ~torch.isnan(rays).any(1)
        present = _known(presence.double(), 0.0) * (visible.double().sum() >= LEAST_VISIBLE)
        trust = trust_of(self.landmark_weights * visible, _known(visibility.double(), 1.0).clamp(0, 1))
        shows_face = (present > _PRESENT) & (trust.sum() > _LEAST_TRUST) & spreads(landmarks, visible)
        # Without a face all counts alike and what comes of it is dropped, so that no number is a NaN.
        frame = _Frame(
            torch.where(visible[:, None] & shows_face, rays, self.person.rest[:LANDMARKS, :2] * self.upright),
            torch.where(shows_face, trust, 1.0),
            _known(deviation.double(), 0.0).clamp(0, 1e3) / focal,
            (expression, expression_deviation.double()),
            iris_rays,
            EyesRead(openness, closed, eye_visibility.double()),
            interval,
            pose,
            (freeze <= 0).double(),
        )
        after = self._solved(frame, before).where(shows_face, lost_state(before, interval))
        tables = OutputTables(self.gain_shapes, self.to_arkit, self.filter_units, self.arkit_signed, self.followers)
        return calmed_state(tables, after, before, shows_face, present, interval, gain, smoothing).pack()

    def _solved(self, frame: _Frame, before: WebcamState) -> WebcamState:
        """The state of a frame with a face, its outputs not yet calmed."""
        points = self.person.points(before.person)
        rotation, translation, near = self._start(points, frame, before)
        since_shown = torch.where(near, before.shown, 0.0) + frame.interval
        eyes = points.eyes_distance(rotation[None], translation[None], self.camera)[0]
        signals = self._eye_signals(points, frame, before, rotation, translation)

        evidence = relative_trust(torch.where(frame.trust > 0, frame.trust, 0.0)[None]) @ self.influence
        hidden = unseen_time(before.hidden[None], evidence, frame.interval)
        read = self._read_energy(frame, evidence)
        known = self._known_energy(signals, before, evidence, hidden, frame.interval) + read
        upper = highest_weights(gain_factors(before.gains, self.gain_shapes), self.gain_shapes, frame.pose)
        unit = eyes / (points.rest[EYE_CORNERS[0]] - points.rest[EYE_CORNERS[1]]).norm()
        variance = (self.settings.noise * eyes).square() + (0.5 * frame.spread).square()
        precision = frame.trust.sqrt() / (variance + self.person.person_remainder * unit**2).sqrt()
        head = HeadState(one_side(before.shapes.minimum(upper)[None], self.signed), rotation[None], translation[None])
        dual = pad(torch.zeros_like(before.shapes), (0, 6))
        damping = pad(self.damping, (len(self.names), 0))
        damped = Quadratic(damping.diag()[None], torch.zeros_like(damping)[None])
        for _ in range(self.settings.steps):  # each begins where the one before ends
            of_weights = known if self.prior is None else known + self.prior.energy(head.weights)
            energy = self._linearised(points, head, frame.rays, precision).energy() + damped
            energy = energy + energy_of_step(of_weights, head.weights)
            # A step with both sides free says which of two antagonists it is.
            tried, _ = split_step(energy, head, upper, dual, _SPLITTING_STEPS, quick=True)
            free = torch.where(weaker_sides(tried.weights, self.signed)[0], 0.0, upper)
            head, dual = split_step(energy, head, free, dual, _SPLITTING_STEPS, quick=True)
        weights = one_side(head.weights.clamp(min=0).minimum(upper), self.signed)[0]
        head = HeadState(weights[None], head.rotation, head.translation)

        at = self._linearised(points, head, frame.rays, precision)
        error = self._error(at, precision, eyes, frame.trust)
        learns = frame.learns * (before.learned < self.settings.learning)
        good = learns * (since_shown > _SETTLED) * (error < LOST_FIT)
        person, information, evidence = self._learned_person(at, head, read, frame, before, good)
        gains, gains_seen = learned_gains(weights, self.gain_shapes, before, frame.interval, frame.pose, frame.learns)
        learned = (before.learned + good * frame.interval).clamp(max=self.settings.learning)
        return replace(
            before,
            shapes=weights,
            pose=torch.cat([head.rotation[0].flatten(), head.translation[0]]),
            hidden=hidden[0],
            shown=since_shown,
            lost=torch.zeros_like(since_shown),
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
            gains=gains,
            gains_seen=gains_seen,
        )

    def _start(self, points: FacePoints, frame: _Frame, before: WebcamState) -> tuple[Tensor, Tensor, Tensor]:
        """Where a frame's steps begin: (3,3), (3,), and whether that is the pose of the frame before, ()."""
        rotation, translation = affine_pose(points.rest[:LANDMARKS], frame.rays, frame.trust)
        last_rotation, last_translation = before.pose[:9].reshape(3, 3), before.pose[9:]
        placed = points.rest[:LANDMARKS] @ last_rotation.T + last_translation
        apart = (points.rest[EYE_CORNERS[0]] - points.rest[EYE_CORNERS[1]]).norm() / placed[:, 2].clamp(min=1.0)
        off = (placed[:, :2] / placed[:, 2:].clamp(min=1.0) - frame.rays).square().sum(1).sqrt()
        # Where most landmarks are within half the eyes' distance of where that pose shows the head at rest.
        near = (frame.trust * (off < _NEAR * apart)).sum() > 0.5 * frame.trust.sum()
        near = near & (before.shown + before.lost > 0)
        turned = torch.where(near, orthonormal(torch.where(near, last_rotation, rotation)), rotation)
        return turned, torch.where(near, last_translation, translation), near

    def _eye_signals(
        self, points: FacePoints, frame: _Frame, before: WebcamState, rotation: Tensor, translation: Tensor
    ) -> EyeSignals:
        middles = torch.stack([0.5 * (points.rest[a] + points.rest[b]) for a, b in CORNERS])
        gaze = seen_gaze(
            frame.rays, undrifted(frame.rays, frame.iris), rotation, middles @ rotation[2] + translation[2]
        )
        looking = self.open_rows @ self.look_shapes
        return eye_signals(
            frame.eyes, gaze, self.usual_openness, looking, before, frame.interval, frame.pose, frame.learns
        )

    def _known_energy(
        self, signals: EyeSignals, before: WebcamState, evidence: Tensor, hidden: Tensor, interval: Tensor
    ) -> Quadratic:
        """Of the weights (1,N), whatever they are: the frame before, openness, gaze, sparsity and ridge."""
        walked = walk_information((self.settings.motion * self.walk).square(), evidence, interval + before.lost)[0]
        mean = expected_weights(before.shapes[None], evidence, hidden, interval, self.twins)[0]
        looking = self.look_shapes @ look_weights(signals.gaze)
        pull = self.look_shapes @ signals.gaze_trust[self.look_eyes] / self.settings.gaze_noise**2
        sure = signals.open_trust / self.settings.openness_noise**2
        unknown = torch.exp(-before.learned / _FADE)
        H = (walked + pull + 2 * self.settings.ridge).diag()
        f = self.settings.sparsity * (1 + _UNKNOWN * unknown) - walked * mean - pull * looking
        opened = (self.open_rows.T * sure) @ self.open_rows
        return Quadratic((H + opened)[None], (f + (sure * (1 - signals.open)) @ self.open_rows)[None])

    def _read_energy(self, frame: _Frame, evidence: Tensor) -> Quadratic:
        """Of the weights (1,N), by what a network read of them."""
        values, deviation = frame.read
        seen = ((self.to_arkit != 0) * counted_share(evidence)).amax(1)
        precision = seen * torch.where(torch.isnan(values), 0.0, doubted_blinks(deviation).square().reciprocal())
        pulled = precision * _known(values, 0.0)
        return Quadratic(((self.to_arkit.T * precision) @ self.to_arkit)[None], -(pulled @ self.to_arkit)[None])

    def _linearised(self, points: FacePoints, head: HeadState, rays: Tensor, precision: Tensor) -> Linearised:
        rows = points.chosen(head.weights, head.rotation, head.translation, self.camera)
        slide = self.settings.contour_slide
        return linearise(points, head, rows, self.camera, rays[None], precision[None], slide)

    def _error(self, at: Linearised, precision: Tensor, eyes: Tensor, trust: Tensor) -> Tensor:
        """Root mean square distance of the inner landmarks to the head's, as a share of the eyes' distance, ()."""
        inner = trust[JAW:]
        squared = at.residual[0, JAW:].square().sum(1) / precision[JAW:].clamp(min=1e-9).square()
        return ((inner * squared).sum() / inner.sum().clamp(min=1e-6)).sqrt() / eyes

    def _learned_person(
        self, at: Linearised, head: HeadState, read: Quadratic, frame: _Frame, before: WebcamState, good: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients, information and evidence with a frame's, where it is ``good``."""
        given = [at.residual, at.jacobian, head.weights, head.rotation, read.H, read.f, frame.interval, frame.pose]
        given += [before.person, before.information, before.evidence, before.learned]
        learns = good > 0
        if torch.compiler.is_compiling():  # a graph has both ways; here a call that is not exported takes one
            return torch.cond(learns, self._updated_person, self._same_person, tuple(given))
        return (self._updated_person if bool(learns) else self._same_person)(*given)

    def _updated_person(  # noqa: PLR0913  # torch.cond hands tensors on
        self,
        residual: Tensor,
        jacobian: Tensor,
        weights: Tensor,
        rotation: Tensor,
        read_curvature: Tensor,
        read_gradient: Tensor,
        interval: Tensor,
        pose: Tensor,
        person: Tensor,
        information: Tensor,
        evidence: Tensor,
        learned: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        head, at = HeadState(weights, rotation, rotation[:, 0]), Linearised(residual, jacobian)
        resting = (pose - 1).abs() < 0.5
        frame_information, frame_evidence = self.person.information(
            at, head, person, self.settings.rest_penalty, resting, Quadratic(read_curvature, read_gradient)
        )
        eager = 1 + _EAGER * torch.exp(-learned / _EAGER_FOR)
        share = (interval / self.settings.alike * eager).clamp(max=1.0)
        kept = torch.exp(-interval / self.settings.memory)
        information = kept * information + share * frame_information
        evidence = kept * evidence + share * frame_evidence
        prior = torch.ones_like(person).diag()
        return symmetric_inverse(information + prior) @ evidence, information, evidence

    def _same_person(self, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        person, information, evidence, _ = given[-4:]
        return person.clone(), information.clone(), evidence.clone()


def _known(values: Tensor, otherwise: float) -> Tensor:
    return torch.where(torch.isnan(values), otherwise, values)
