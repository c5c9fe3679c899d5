"""Blendshape weights from landmarks in the images of one camera."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import one_side
from torchface.capture.own_rig.face_measurements import CameraView, FaceMeasurements
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.frame_solver import FrameSolver
from torchface.capture.own_rig.frame_states import FrameTerms, VideoSolution, VideoState
from torchface.capture.own_rig.gauss_newton import HeadState
from torchface.capture.own_rig.solver_components import DEFAULT_WEIGHT_STEP, check_not_negative
from torchface.capture.own_rig.state_estimate import Expectation, StateEstimate
from torchface.capture.own_rig.weight_walk import (
    expected_weights,
    frame_intervals,
    read_evidence,
    unseen_time,
    walk_information,
)
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pnp import solve_pnp
from torchface.number_checks import as_real
from torchface.optim.blas_threads import one_blas_thread
from torchface.optim.data_dependent import data_dependent
from torchface.progress import Progress, silent

_MIN_LANDMARKS = 6
_NEAR = 0.5  # of the eyes' distance


class VideoSolver(FrameSolver):
    r"""Solves 68 landmarks in one camera's frames for blendshape weights, and the head's pose with them.

    .. math::
        \min_{0 \le w \le 1,\, R,\, t} \; \tfrac12 \sum_l \frac{c_l}{\sigma^2}
        \lVert \pi(K (R (b_l + B_l w) + t)) - q_l \rVert^2
        - \lambda \log p(w) + \beta \sum_i w_i + \varepsilon \lVert w \rVert^2
        + \tfrac12 (x - m)^\top (V + P)^{-1} (x - m) + \kappa \, D(R, t; \hat R, \hat t)

    Every term is a negative log likelihood, so each is in units of its own variance. It is solved by Gauss-Newton's
    steps, quadratic programs in a box, each frame from the one before, in float64. Contour landmarks slide to where the
    face is seen to end; their errors along the contour count less.

    The term before the last is the dynamics prior's: x are weights and pose, m where the last frames lead to and V the
    variance of that. The thesis divides by V alone, as if the last frames' weights were true. They have a
    covariance P, which a Kalman filter of the landmarks carries on; it is large in directions in which the landmarks
    show little, such as depth, so these are averaged over more frames. Without a dynamics prior m is the last frame's
    weights and V the variance of a random walk, where ``settings.motion`` says how far weights wander; otherwise each
    frame is solved on its own.

    A pose tracked from stable landmarks is noisy, and biased by what the face does, so it is where the search starts,
    no more, unless ``pose_trust`` is positive: D is the distance from it in units of what the frame's landmarks say of
    a pose.

    Args:
        rig: N shapes, of the person in the image.
        landmark_vertices: the 68 in iBUG's order, vertex ids; the rig's annotated ones if absent.
        intrinsics: K, (3,3), pixels; of images without distortion.
        prior: which weights faces have; its ``strength`` is :math:`\lambda`.
        dynamics: how weights go on.
        settings: what the terms weigh, and when steps end; :math:`\sigma` grows with the face where they say so.
        landmark_weights: :math:`c`, (68,); 1 for inner landmarks, half for those of the contour if absent.

    Raises:
        NameMismatchError: a prior was learned for other shapes than the rig has.
        ShapeError, ValueRangeError: an argument is not as above.

    Source: thesis 4.2.6, 4.2.9, 4.2.10; equations 40, 44, 65.

    Example:
        >>> from torchface import zoo
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> camera = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
        >>> head = rig.vertices[rig.neutral.landmarks] * torch.tensor([1.0, -1, -1]) + torch.tensor([0.0, 0, 700])
        >>> pixels = 900 * head[:, :2] / head[:, 2:] + torch.tensor([320.0, 240.0])
        >>> solution = VideoSolver(rig, None, camera, zoo.get_model("shape_prior"))(pixels[None])
        >>> bool(solution.weights.max() < 0.1), bool((solution.translation[0, 2] - 700).abs() < 10)
        (True, True)
    """

    @data_dependent("torchface.onnx.VideoGraph, which `torchface export video-solver` writes")
    def forward(
        self,
        landmarks: Tensor,
        rotation: Tensor | None = None,
        translation: Tensor | None = None,
        confidence: Tensor | None = None,
        seconds: Tensor | None = None,
        progress: Progress | None = None,
        measured: FaceMeasurements | None = None,
    ) -> VideoSolution:
        """Weights and poses of consecutive frames, each from what was seen until then.

        Args:
            landmarks: (T,68,2), pixels; NaN for not seen.
            rotation, translation: tracked poses, rig to camera, (T,3,3) and (T,3), NaN for lost; found here if absent.
            confidence: how far each landmark is trusted, (T,68) in [0,1].
            seconds: when each frame is shown, (T,), rising; ``settings.interval`` apart if absent.
            progress: called with how many frames are solved.
            measured: what else is known of the T frames.

        Returns:
            What the face did, in the dtype of the landmarks; differentiable in all arguments, through all frames. A
            pose that is found here counts as given.

        Raises:
            ShapeError: the shapes do not fit each other.
            ValueRangeError: infinite landmarks, confidences below 0, or no frame with six trusted landmarks.
        """
        landmarks = as_real(landmarks, "landmarks")
        states, _ = self.states(landmarks, rotation, translation, confidence, seconds, progress, measured)
        weights, rotations, translations = (
            torch.stack([getattr(state, name) for state in states]).to(landmarks.dtype)
            for name in ("weights", "rotation", "translation")
        )
        return self.solution(landmarks, confidence, weights, rotations, translations, measured)

    def solution(
        self,
        landmarks: Tensor,
        confidence: Tensor | None,
        weights: Tensor,
        rotation: Tensor,
        translation: Tensor,
        measured: FaceMeasurements | None = None,
    ) -> VideoSolution:
        """Weights (T,N) and poses (T,3,3), (T,3) of T frames, with what the frames' landmarks say of them.

        Args:
            landmarks, confidence, measured: as of ``forward``.
            weights, rotation, translation: as solved.
        """
        errors = self.reprojection_errors(landmarks, weights, rotation, translation, confidence)
        views = () if measured is None else measured.views
        seen = self.shape_confidence(self.landmark_trust(landmarks, confidence, views)).to(landmarks.dtype)
        solved = self.shows_face(landmarks, confidence, views)
        return VideoSolution(weights, rotation, translation, errors, solved, seen)

    def shows_face(self, landmarks: Tensor, confidence: Tensor | None, views: Sequence[CameraView] = ()) -> Tensor:
        """Which of frames (T,68,2) show at least six landmarks that are trusted, by any camera, (T,) bool."""
        return (self.landmark_trust(landmarks, confidence, views) > 0).sum(1) >= _MIN_LANDMARKS

    def states(
        self,
        landmarks: Tensor,
        rotation: Tensor | None = None,
        translation: Tensor | None = None,
        confidence: Tensor | None = None,
        seconds: Tensor | None = None,
        progress: Progress | None = None,
        measured: FaceMeasurements | None = None,
    ) -> tuple[list[VideoState], Tensor]:
        """The states after each of T frames, and which frames showed a face, (T,) bool; arguments as ``forward``.

        Frames before the first face have its state.
        """
        count = self._check(landmarks, rotation, translation, confidence)
        views = () if measured is None else measured.views
        enough = self.shows_face(landmarks, confidence, views)
        if not bool(enough.any()):
            trusted = (self.landmark_trust(landmarks, confidence, views) > 0).sum(1)
            raise ValueRangeError(
                f"landmarks: found at most {max(trusted.tolist(), default=0)} that are trusted in any of {count} "
                f"frames, expected at least {_MIN_LANDMARKS} in some frame"
            )
        progress = progress or silent
        states, state = [], self.start()
        first = int(enough.nonzero()[0, 0])
        intervals = frame_intervals(seconds, count, self.settings.interval)
        # A frame is solved from the one before.
        with one_blas_thread():
            for t in range(first, count):
                turn, place, sure = (None if x is None else x[t] for x in (rotation, translation, confidence))
                more = None if measured is None else measured.of_frames(torch.tensor([t], device=landmarks.device))
                state = self.step(state, landmarks[t], turn, place, sure, intervals[t], more)
                states.append(state)
                progress("solving for weights", t + 1, count)
        return [states[0]] * first + states, enough

    def start(self) -> VideoState:
        """The state before the first frame."""
        return VideoState(None, None, self.rest.new_zeros(1, 0, len(self.names), dtype=torch.float64))

    @data_dependent("torchface.onnx.VideoGraph, which `torchface export video-solver` writes")
    def step(
        self,
        state: VideoState,
        landmarks: Tensor,
        rotation: Tensor | None = None,
        translation: Tensor | None = None,
        confidence: Tensor | None = None,
        interval: float | None = None,
        measured: FaceMeasurements | None = None,
    ) -> VideoState:
        """The next frame's state; its ``weights``, ``rotation`` and ``translation`` are the frame's.

        A frame with fewer than six landmarks keeps the weights of the frame before: rest is likeliest of all faces, but
        not of one that smiled a moment ago. So do shapes whose landmarks are hidden, where ``settings.motion`` says how
        weights wander; after a third of a second those go to rest, and all of a face that is lost. Hidden shapes of one
        side follow the other one while that is seen.

        Args:
            state: of the frame before; ``start()`` for the first.
            landmarks: (68,2), pixels; NaN for not seen.
            rotation, translation: the tracked pose, (3,3) and (3,); the last one's if absent or NaN.
            confidence: (68,) in [0,1].
            interval: seconds since the frame before; ``settings.interval`` if absent.
            measured: what else is known of the frame, with a row for it.

        Raises:
            ShapeError: an argument is not as above.
            ValueRangeError: the first frame shows fewer than six landmarks, or a landmark is infinite.
        """
        given = [None if x is None else x[None] for x in (rotation, translation, confidence)]
        self._check(landmarks[None], *given)
        measured = measured or FaceMeasurements()
        self._check_measured(measured)
        pixels = landmarks[None].double()
        rotation, translation, confidence = (None if x is None else x.double() for x in given)
        # Filtered landmarks go on for some frames after a face was lost, with a confidence of 0.
        trust = self.landmark_trust(pixels, confidence, measured.views)
        trusted = int((trust > 0).sum())
        enough = trusted >= _MIN_LANDMARKS
        if state.head is None and not enough:
            raise ValueRangeError(
                f"landmarks: found {trusted} in the first frame, expected at least {_MIN_LANDMARKS} to start"
            )
        if rotation is None or translation is None or not _finite(rotation, translation):
            rotation, translation = self._pose_of(state, pixels, confidence, enough, measured.views)
        interval = self.settings.interval if interval is None else interval
        evidence = self.shape_confidence(trust * enough)
        read = measured.weights.energy() if enough and measured.weights is not None else None
        if read is not None:
            before = torch.zeros_like(evidence) if state.head is None else state.head.weights.detach()
            evidence = evidence.maximum(read_evidence(read, before))
        hidden = unseen_time(state.hidden, evidence, interval)
        expected = self._expected(state, rotation, translation, evidence, hidden, interval)
        tracked = HeadState(expected.mean.weights, rotation, translation)
        last = state.head or tracked
        noise = self.noise(last.rotation, last.translation)[:, None]
        if measured.deviation is not None:
            noise = (noise.square() + measured.deviation.double().square()).sqrt()
        precision = self.precision(torch.isfinite(pixels).all(-1) & enough, confidence, noise)
        sighted = [view for view in measured.views if enough and bool(view.seen.any())]
        views = tuple(self._whitened(view, last) for view in sighted)
        terms = FrameTerms(pixels.nan_to_num(0.0), precision, rotation, translation, expected, read, views)
        if enough:
            # After a gap the tracked pose is nearer than where the head was left.
            near = expected.mean if state.solved and state.estimate is not None else tracked
            start = HeadState(one_side(last.weights.clamp(0, 1), self.signed), near.rotation, near.translation)
            head, rows = self.solve(terms, start.mapped(torch.detach))
        else:
            head = tracked if self.walks else HeadState(last.weights, rotation, translation)
            rows = self.chosen(head)
        if self.dynamics is None:
            return VideoState(head, None, state.window, enough, hidden)
        estimate = expected.updated(head, self.seen(terms, head, rows))
        window = torch.cat([state.window, head.weights[:, None]], dim=1)[:, -self.dynamics.window :]
        return VideoState(head, estimate, window, enough, hidden)

    def _whitened(self, view: CameraView, head: HeadState) -> CameraView:
        """A view of one frame with finite landmarks, and deviations with the solver's own noise for a head there."""
        noise = self.noise(*view.pose(head.rotation, head.translation), view.intrinsics)[:, None]
        deviation = (noise.square() + view.deviation.double().square()).sqrt().masked_fill(~view.seen, torch.inf)
        return replace(view, landmarks=view.landmarks.double().nan_to_num(0.0), deviation=deviation)

    def _expected(
        self,
        state: VideoState,
        rotation: Tensor,
        translation: Tensor,
        evidence: Tensor,
        hidden: Tensor,
        interval: float,
    ) -> Expectation:
        """The prediction for the next frame from those before."""
        if state.estimate is not None and self.dynamics is not None:
            return self.predicted(state, state.estimate).expectation()
        if state.head is None or not self.walks:
            mean = HeadState(rotation.new_zeros(1, len(self.names)), rotation, translation)
            return Expectation(mean, self.initial_information.double().diag()[None])
        head = HeadState(state.head.weights, rotation, translation)
        # A pose that was tracked, or found in a frame by itself, is where the search starts and no more.
        return self.walked(head, evidence, hidden, interval, interval if rotation is state.head.rotation else None)

    def walked(
        self, head: HeadState, evidence: Tensor, hidden: Tensor, interval: float, since: float | Tensor | None
    ) -> Expectation:
        """The prediction of a random walk of the weights (B,N) of the frame before, and of its pose.

        Args:
            head: weights of the frame before, and the pose.
            evidence, hidden: as of ``weight_walk``, (B,N).
            interval: seconds since the frame before.
            since: seconds since the head was seen in the pose; None where it was not.
        """
        weights = walk_information(self.walk_variance.double(), evidence, interval)
        motion = self.initial_information.double()[-6:]
        motion = (motion if since is None else 1 / (self.motion_variance.double() * since)).expand(len(weights), 6)
        mean = expected_weights(head.weights, evidence, hidden, interval, self.twins)
        expected = HeadState(mean, head.rotation, head.translation)
        return Expectation(expected, torch.diag_embed(torch.cat([weights, motion], dim=1)))

    def predicted(self, state: VideoState, estimate: StateEstimate) -> StateEstimate:
        """The prediction for the next frame from a frame's estimate."""
        if self.dynamics is None or state.window.shape[1] < self.dynamics.window:
            steps = torch.zeros_like(estimate.mean.weights)
            variance = torch.full_like(steps, DEFAULT_WEIGHT_STEP**2)
        else:
            mean, variance = self.dynamics(state.window.to(self.dynamics.center.dtype))
            steps, variance = mean.double() - state.window[:, -1], variance.double() / self.settings.dynamics_strength
        return estimate.predicted(steps, variance, self.motion_variance.double())

    def _near(self, head: HeadState, landmarks: Tensor) -> bool:
        """Whether most landmarks (1,68,2) are within half the eyes' distance of where a pose shows the rig at rest."""
        K = self.intrinsics.double()
        rest = self.rest[:LANDMARKS].double() @ head.rotation[0].detach().T + head.translation[0].detach()
        image = rest @ K.T
        off = (image[:, :2] / image[:, 2:] - landmarks[0].detach()).norm(dim=1).nanmedian()
        return float(off) < _NEAR * float(self.points.eyes_distance(head.rotation, head.translation, K).detach())

    def _pose_of(
        self,
        state: VideoState,
        landmarks: Tensor,
        confidence: Tensor | None,
        enough: bool,
        views: Sequence[CameraView] = (),
    ) -> tuple[Tensor, Tensor]:
        """Of the frame before, or by the camera that saw most, where that showed no face, or one far from here."""
        if state.head is not None and (not enough or (state.solved and self._near(state.head, landmarks))):
            return state.head.rotation, state.head.translation
        trust = self.landmark_weights.double() * self.landmark_trust(landmarks, confidence)
        best = max(views, key=lambda view: int(view.seen.sum()), default=None)
        if best is not None and int(best.seen.sum()) > int((trust > 0).sum()):
            trust = self.landmark_weights.double() * best.seen
            pose = solve_pnp(self.rest[:LANDMARKS], best.landmarks.detach().double(), best.intrinsics, trust)
            return best.pose_before_first(pose.rotation, pose.translation)
        pose = solve_pnp(self.rest[:LANDMARKS], landmarks.detach(), self.intrinsics, trust)
        if state.head is not None and not _finite(pose.rotation, pose.translation):
            return state.head.rotation, state.head.translation
        return pose.rotation, pose.translation

    def _check_measured(self, measured: FaceMeasurements) -> None:
        found = {
            "deviation": (measured.deviation, (1, LANDMARKS)),
            "weights": (None if measured.weights is None else measured.weights.rows[:1], (1, len(self.names))),
        }
        for name, (value, expected) in found.items():
            if value is not None and value.shape != expected:
                raise ShapeError(f"measured {name}: found {tuple(value.shape)}, expected {expected}")

    def _check(
        self, landmarks: Tensor, rotation: Tensor | None, translation: Tensor | None, confidence: Tensor | None
    ) -> int:
        if landmarks.ndim != 3:
            raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,{LANDMARKS},2), a row a frame")
        count = len(landmarks)
        expected = {"landmarks": (count, LANDMARKS, 2), "rotation": (count, 3, 3), "translation": (count, 3)}
        expected["confidence"] = (count, LANDMARKS)
        given = {"landmarks": landmarks, "rotation": rotation, "translation": translation, "confidence": confidence}
        for name, value in given.items():
            if value is not None and value.shape != expected[name]:
                raise ShapeError(f"{name}: found {tuple(value.shape)}, expected {expected[name]}")
        if torch.isinf(landmarks).any():
            raise ValueRangeError("landmarks: found infinite ones, expected pixels, or NaN for not seen")
        if confidence is not None:
            check_not_negative("confidence", confidence)
        return count


def _finite(*tensors: Tensor) -> bool:
    return all(bool(torch.isfinite(x).all()) for x in tensors)
