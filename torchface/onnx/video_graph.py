"""The video solve of one frame as it goes into an ONNX graph: its steps are a loop that ends where they settle."""

import copy

import torch
from torch import Tensor, nn
from torch.func import functional_call

from torchface.capture.antagonist_shapes import one_side, weaker_sides
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import SLIDING_STEPS, HeadState, split_step
from torchface.capture.own_rig.solver_components import (
    DEFAULT_WEIGHT_STEP,
    INITIAL_ROTATION,
    INITIAL_TRANSLATION,
    INITIAL_WEIGHT,
    ROTATION_STEP,
    TRANSLATION_STEP,
)
from torchface.capture.own_rig.state_estimate import Expectation
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.capture.own_rig.weight_walk import relative_trust, unseen_time
from torchface.capture.priors import AdaptedDynamicsPrior, DynamicsPrior
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.affine_pose import affine_pose, orthonormal, spreads
from torchface.optim.exported_operators import symmetric_inverse

_MIN_LANDMARKS = 6
_SPLITTING_STEPS = 40


class VideoGraph(nn.Module):
    r"""``VideoSolver.step`` as products, clamps and choices alone, one frame with what it hands on to the next.

    The energy is that of ``VideoSolver``, in float64 inside and float32 outside. A step is one of Gauss and Newton, see
    ``GaussNewtonStep``; the steps end once none moves a weight further than the settings' tolerance, or at their limit.
    The first frame's pose is that of an affine camera, so that nothing else need be known.

    Without a dynamics prior the state is ``weights``, ``rotation`` and ``translation``, and where the settings say how
    weights wander ``hidden``: for how long each shape has not been seen, (N,), seconds. With one it is ``rotation``,
    ``translation``, and

    - ``window``: the latest frames' weights, (J,N), the newest last, NaN for those that have not been;
    - ``mean``: of weights and motion from the pose, by landmarks and dynamics alone, (N+6,);
    - ``covariance``: of that, (N+6,N+6).

    Inputs are ``landmarks``, ``confidence`` and the state with ``previous_`` before its names; outputs ``weights``,
    ``rotation``, ``translation`` and the rest of the state. A state with a NaN in ``previous_rotation`` is none: the
    frame is a first one. A first frame with fewer than six landmarks hands on no state either.

    Args:
        solver: the exact solve, with its settings; its tracked poses count for nothing.

    Raises:
        ValueRangeError: the solver uses tracked poses, or its prior is none of Student's distributions.

    Source: thesis 4.2.6, 4.2.9, 4.2.10.

    Example:
        >>> from torchface.capture import VideoSolver
        >>> from torchface.synthetic import performer
        >>> camera = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
        >>> VideoGraph(VideoSolver(performer(texture=False), None, camera)).state
        ('weights', 'rotation', 'translation')
    """

    landmark_weights: Tensor
    to_rays: Tensor
    initial_information: Tensor
    initial_covariance: Tensor
    motion_variance: Tensor
    influence: Tensor

    def __init__(self, solver: VideoSolver) -> None:
        super().__init__()
        self.settings = solver.settings
        if self.settings.pose_trust > 0:
            raise ValueRangeError(f"video graph: found a pose_trust of {self.settings.pose_trust}, expected 0")
        self.names, count = solver.names, len(solver.names)
        self.dynamics: DynamicsPrior | AdaptedDynamicsPrior | None = copy.deepcopy(solver.dynamics)
        self.walks = solver.walks
        self.window = 1 if self.dynamics is None else self.dynamics.window
        self.step = GaussNewtonStep(solver)
        deviations = [INITIAL_WEIGHT] * count + [INITIAL_ROTATION] * 3 + [INITIAL_TRANSLATION] * 3
        for name, value in {
            "landmark_weights": solver.landmark_weights.double(),
            "to_rays": torch.linalg.inv(solver.intrinsics.double()).T.contiguous(),
            "initial_information": solver.initial_information.double().diag(),
            # Share of each landmark in the evidence of each shape, (68,N).
            "influence": solver.shape_confidence(torch.eye(LANDMARKS, dtype=torch.float64, device=solver.rest.device)),
            "initial_covariance": torch.tensor(deviations, dtype=torch.float64).square().diag(),
            "motion_variance": torch.tensor([ROTATION_STEP**2] * 3 + [TRANSLATION_STEP**2] * 3, dtype=torch.float64),
        }.items():
            self.register_buffer(name, value.to(solver.rest.device))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what ``forward`` returns."""
        names = ("weights", "rotation", "translation")
        if self.dynamics is None:
            return (*names, "hidden") if self.walks else names
        return (*names, "window", "mean", "covariance")

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the outputs that the next frame takes, in the order of its arguments."""
        return self.outputs if self.dynamics is None else self.outputs[1:]

    def start(self) -> tuple[Tensor, ...]:
        """The state before the first frame: NaN."""
        count = len(self.names)
        shapes = {"weights": (count,), "rotation": (3, 3), "translation": (3,), "window": (self.window, count)}
        shapes |= {"hidden": (count,), "mean": (count + 6,), "covariance": (count + 6, count + 6)}
        return tuple(torch.full(shapes[name], torch.nan) for name in self.state)

    def forward(self, landmarks: Tensor, confidence: Tensor, *previous: Tensor) -> tuple[Tensor, ...]:
        """The frame's ``outputs``.

        Args:
            landmarks: (68,2), pixels; NaN or infinity for not seen.
            confidence: how far each is trusted, (68,) in [0,1].
            previous: the ``state`` of the frame before, or ``start()``.

        Raises:
            ShapeError: an argument is not as above.
        """
        if landmarks.shape != (LANDMARKS, 2) or confidence.shape != (LANDMARKS,) or len(previous) != len(self.state):
            raise ShapeError(
                f"video graph: found landmarks {tuple(landmarks.shape)}, confidence {tuple(confidence.shape)} and "
                f"{len(previous)} parts of a state, expected ({LANDMARKS},2), ({LANDMARKS},) and {len(self.state)}"
            )
        state = {name: value.double() for name, value in zip(self.state, previous, strict=True)}
        unseen = ~torch.isfinite(landmarks).all(1) | ~(confidence > 0)
        pixels = torch.where(unseen[:, None], 0.0, landmarks.double())
        trust = torch.where(unseen, 0.0, self.landmark_weights * confidence.double())
        enough = ((~unseen).double().sum() > _MIN_LANDMARKS - 0.5) & spreads(pixels, ~unseen)
        first = torch.isnan(state["rotation"]).any()
        rotation, translation = self._affine_pose(pixels, trust)
        rotation = torch.where(first, rotation, orthonormal(state["rotation"]))
        translation = torch.where(first, translation, state["translation"])
        window = state["weights"][None] if self.dynamics is None else state["window"]
        weights = one_side(torch.where(first, 0.0, window[-1]).clamp(0, 1)[None], self.step.solver.signed)
        head = HeadState(weights, rotation[None], translation[None])
        counts = torch.where(enough & ~unseen, confidence.double(), 0.0)[None]
        evidence = relative_trust(counts) @ self.influence
        interval = self.settings.interval
        before = torch.where(first, 0.0, state["hidden"])[None] if self.walks else torch.zeros_like(evidence)
        hidden = unseen_time(before, evidence, interval)
        if self.walks:
            mean, information = self._walked(head, evidence, hidden, before.amin(1), first)
        else:
            mean, information = self._expected(head, window, first, state)
        noise = self.step.solver.noise(head.rotation, head.translation)
        precision = torch.where(enough, trust.sqrt() / noise, 0.0)[None]
        given = (pixels[None], precision, mean.weights, mean.rotation, mean.translation, information[None])
        solved, rows = self._solved(head, given, ~enough)
        # A face that is not seen stays as it was, or goes to rest.
        head = _where(enough, solved, HeadState(mean.weights, head.rotation, head.translation) if self.walks else head)
        started = ~first | enough
        out = [
            torch.where(started, head.weights[0], 0.0),
            torch.where(started, head.rotation[0], torch.nan),
            torch.where(started, head.translation[0], torch.nan),
        ]
        if self.walks:
            out.append(torch.where(started, hidden[0], torch.nan))
        if self.dynamics is not None:
            terms = frame_terms(*given)
            energy = self.step.solver.seen(terms, head, rows) + terms.expected.energy(head)
            covariance = symmetric_inverse(energy.H[0])
            estimate = nn.functional.pad(head.weights[0], (0, 6)) - covariance @ energy.f[0]
            kept = torch.where(first, torch.full_like(window, torch.nan), window)
            window = torch.cat([kept, head.weights])[-self.window :]
            out += [window, estimate, 0.5 * (covariance + covariance.T)]
        return tuple(value.float() for value in out)

    def _solved(self, head: HeadState, given: tuple[Tensor, ...], settled: Tensor) -> tuple[HeadState, Tensor]:
        """Where the steps from a state end, and which points the landmarks are there."""
        buffers = dict(self.step.named_buffers())

        def advanced(*values: Tensor) -> tuple[Tensor, ...]:
            return functional_call(
                self.step, dict(zip(buffers, values[7 + len(given) :], strict=True)), values[: 7 + len(given)]
            )

        def unfinished(iteration: Tensor, settled: Tensor, *_: Tensor) -> Tensor:
            return (iteration < self.settings.steps) & ~settled

        rows = self.step.solver.chosen(head)
        dual = torch.zeros_like(self.initial_information[0])
        state = (head.weights, head.rotation, head.translation, dual, rows)
        # A loop takes no tensor twice, nor two that share memory.
        begin = torch.zeros((), dtype=torch.int64, device=settled.device)
        carried = (begin, settled, *(value.clone() for value in state))
        given = tuple(value.clone() for value in given)
        _, _, weights, rotation, translation, _, rows = torch.ops.higher_order.while_loop(
            unfinished, advanced, carried, (*given, *buffers.values())
        )
        return HeadState(weights, rotation, translation), rows

    def _affine_pose(self, pixels: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
        """The pose (3,3), (3,) in which an affine camera sees the rig at rest as landmarks (68,2) are."""
        rays = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ self.to_rays
        return affine_pose(self.step.solver.rest[:LANDMARKS], rays[:, :2] / rays[:, 2:], trust)

    def _walked(
        self, head: HeadState, evidence: Tensor, hidden: Tensor, lost: Tensor, first: Tensor
    ) -> tuple[HeadState, Tensor]:
        """The prediction for this frame from the last one's weights and pose: the mean and its information (N+6,N+6).

        A face that was ``lost`` for so many seconds, (1,), may be further away.
        """
        interval = self.settings.interval
        walked = self.step.solver.walked(head, evidence, hidden, interval, interval + lost)
        weights = torch.where(first, 0.0, walked.mean.weights)
        return (
            HeadState(weights, head.rotation, head.translation),
            torch.where(first, self.initial_information, walked.information[0]),
        )

    def _expected(
        self, head: HeadState, window: Tensor, first: Tensor, state: dict[str, Tensor]
    ) -> tuple[HeadState, Tensor]:
        """The prediction for this frame from those before: the mean and its information (N+6,N+6)."""
        if self.dynamics is None:
            return HeadState(torch.zeros_like(head.weights), head.rotation, head.translation), self.initial_information
        gaps = torch.isnan(window)
        full = ~gaps.any()
        filled = torch.where(gaps, 0.0, window)
        ahead, variance = self.dynamics(filled.to(self.dynamics.center.dtype)[None])
        steps = torch.where(full, ahead[0].double() - filled[-1], 0.0)
        variance = torch.where(full, variance[0].double() / self.settings.dynamics_strength, DEFAULT_WEIGHT_STEP**2)
        mean = torch.where(first, 0.0, state["mean"] + nn.functional.pad(steps, (0, 6)))[None]
        noise = torch.cat([variance, self.motion_variance]).diag()
        covariance = torch.where(first, self.initial_covariance, state["covariance"] + noise)
        shapes = len(self.names)
        return head.moved(mean[:, :shapes], mean[:, shapes:]), symmetric_inverse(covariance)


def _where(condition: Tensor, one: HeadState, other: HeadState) -> HeadState:
    return HeadState(
        torch.where(condition, one.weights, other.weights),
        torch.where(condition, one.rotation, other.rotation),
        torch.where(condition, one.translation, other.translation),
    )


class GaussNewtonStep(nn.Module):
    r"""Moves weights and pose to the least of ``VideoSolver.energy`` linearised where they are, weights in [0,1]."""

    upper: Tensor

    def __init__(self, solver: VideoSolver) -> None:
        super().__init__()
        groups = None if solver.prior is None else solver.prior.prepared()
        self.solver = copy.deepcopy(solver).double()
        self.solver.prior, self.solver.dynamics = groups, None  # type: ignore[assignment]
        self.register_buffer("upper", self.solver.rest.new_ones(len(solver.names)))

    def forward(
        self,
        iteration: Tensor,
        settled: Tensor,
        weights: Tensor,
        rotation: Tensor,
        translation: Tensor,
        dual: Tensor,
        rows: Tensor,
        *given: Tensor,
    ) -> tuple[Tensor, ...]:
        """The next values of the first seven arguments: () twice, (1,N), (1,3,3), (1,3), the program's dual (N+6,), the
        points (1,68).

        ``given`` are tensors of :func:`frame_terms`; ``settled`` says that no weight has moved beyond the tolerance.
        """
        head = HeadState(weights, rotation, translation)
        rows = torch.where((iteration > 0) & (iteration < SLIDING_STEPS), self.solver.chosen(head), rows)
        energy = self.solver.energy(frame_terms(*given), head, rows)
        signed = self.solver.signed
        upper = torch.where(weaker_sides(weights, signed)[0], 0.0, self.upper)
        after, dual = split_step(energy, head, upper, dual, _SPLITTING_STEPS)
        after = HeadState(one_side(after.weights, signed), after.rotation, after.translation)
        settled = (after.weights - weights).abs().max() < self.solver.settings.tolerance
        return iteration + 1, settled, after.weights, after.rotation, after.translation, dual, rows


def frame_terms(landmarks: Tensor, precision: Tensor, *expected: Tensor) -> FrameTerms:
    """The terms of one frame's energy, of landmarks (1,68,2) and their precision; poses are not tracked.

    ``expected`` are mean weights (1,N), rotation (1,3,3), translation (1,3), and information (1,N+6,N+6).
    """
    mean = HeadState(*expected[:3])
    return FrameTerms(landmarks, precision, mean.rotation, mean.translation, Expectation(mean, expected[3]))
