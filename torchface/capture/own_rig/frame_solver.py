"""Frame solver: the energy of frames on their own, and the weights and poses where it is least."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchface.capture.antagonist_shapes import one_side, weaker_sides
from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.face_measurements import CameraView
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import (
    SLIDING_STEPS,
    HeadState,
    Linearised,
    box_step,
    energy_of_step,
    linearise,
    sliding,
)
from torchface.capture.own_rig.single_frame import SingleFrame
from torchface.capture.own_rig.solver_components import VideoSolverParts
from torchface.geometry.cameras.affine_pose import spreads
from torchface.optim.implicit import attach_gradients

_COARSEST, _FINEST = 1e-6, 1e-12  # residuals of a step's program


class FrameSolver(VideoSolverParts):
    """The solve of B frames, each for itself, by Gauss and Newton; ``VideoSolver`` says what it minimises."""

    def landmark_trust(self, landmarks: Tensor, confidence: Tensor | None, views: Sequence[CameraView] = ()) -> Tensor:
        """How much each of landmarks (B,68,2) counts beside one that is surely seen, by any camera, (B,68) float64."""
        seen = torch.isfinite(landmarks).all(-1).double()
        seen = seen if confidence is None else seen * confidence.detach().double().clamp(0, 1)
        seen = seen * spreads(landmarks.detach(), seen > 0)[..., None]
        for view in views:
            seen = torch.maximum(seen, view.seen.to(seen))
        return seen

    def noise(self, rotation: Tensor, translation: Tensor, intrinsics: Tensor | None = None) -> Tensor:
        """The standard deviation of landmarks of heads at poses (B,3,3), (B,3), (B,), pixels of one camera's."""
        K = self.intrinsics if intrinsics is None else intrinsics
        apart = self.points.eyes_distance(rotation, translation, K.double())
        return (self.settings.relative_noise * apart).clamp(min=self.settings.pixel_noise)

    def precision(self, seen: Tensor, confidence: Tensor | None, noise: Tensor) -> Tensor:
        """One over each landmark's standard deviation, (B,68), pixels, 0 where not seen; ``noise`` is that of one
        that counts 1."""
        weights = self.landmark_weights.double() * seen
        if confidence is not None:
            weights = weights * confidence
        # The root's slope is infinite at 0.
        return torch.where(weights > 0, weights, 1.0).sqrt() * (weights > 0) / noise

    def solve(self, terms: FrameTerms, start: HeadState) -> tuple[HeadState, Tensor]:
        """Weights (B,N) in [0,1] and poses of B frames on their own, from a start, float64.

        Returns:
            The states, and which of the rig's points each landmark is in them, (B,68), then in other views.
        """
        exactness = min(max(0.1 * self.settings.tolerance, _FINEST), _COARSEST)
        box = self.lower.double(), self.upper.double()
        if len(start.weights) == 1 and self._simple(terms):
            parts = self.l1_penalty.double(), self.ridge.double(), self.signed.double()
            one = SingleFrame(self.settings, terms, self.points, self.intrinsics.double(), *box, *parts)
            head, rows = one.solve(start.mapped(torch.detach), exactness)
        else:
            head, rows = self._stepped(terms, start, box, exactness)
        if torch.is_grad_enabled() and any(x.requires_grad for x in terms.tensors()):
            head = self._attached(terms, head, rows)
        return head, rows

    def _simple(self, terms: FrameTerms) -> bool:
        """Whether frames' energies are what ``SingleFrame`` knows."""
        more = self.prior is not None or self.activation is not None or self.settings.pose_trust > 0
        return not (more or terms.views) and self.rest.device.type == "cpu"

    def _stepped(
        self, terms: FrameTerms, start: HeadState, box: tuple[Tensor, Tensor], exactness: float
    ) -> tuple[HeadState, Tensor]:
        """The states (B,...) and rows after all steps."""
        # Steps are many and small; what tensors keep for derivatives is a fifth of their cost.
        with torch.inference_mode():
            head, rows = start, self.chosen(start, terms.views)
            for iteration in range(self.settings.steps):
                if 0 < iteration < SLIDING_STEPS:
                    rows = self.chosen(head, terms.views)
                # The first step says which of two antagonists it is: in the next the other is at rest.
                rest = weaker_sides(head.weights, self.signed) & (iteration > 0)
                before, head = head, box_step(self.energy(terms, head, rows), head, *box, exactness, rest)
                if iteration > 0:
                    head = HeadState(one_side(head.weights, self.signed), head.rotation, head.translation)
                if iteration > 0 and float((head.weights - before.weights).abs().max()) < self.settings.tolerance:
                    break
        # Copies, as autograd refuses tensors that were made without it.
        return head.mapped(torch.clone), rows.clone()

    def chosen(self, head: HeadState, views: Sequence[CameraView] = ()) -> Tensor:
        """Which of the rig's points each landmark is in B states, (B,68), then in views; see ``FacePoints.chosen``."""
        cameras = [(head.rotation, head.translation, self.intrinsics.double())]
        cameras += [(*view.pose(head.rotation, head.translation), view.intrinsics.double()) for view in views]
        rows = [self.points.chosen(head.weights, *camera) for camera in cameras]
        return torch.cat(rows, dim=1) if views else rows[0]

    def energy(self, terms: FrameTerms, head: HeadState, rows: Tensor) -> Quadratic:
        """All terms linearised at a state, of a step from there, (B,N+6)."""
        ridge = self.ridge.double()
        penalty = Quadratic(ridge.diag(), self.l1_penalty.double() + ridge * pad(head.weights, (0, 6)))
        total = self.seen(terms, head, rows) + terms.expected.energy(head) + penalty
        return total if self.prior is None else total + energy_of_step(self.prior.energy(head.weights), head.weights)

    def seen(self, terms: FrameTerms, head: HeadState, rows: Tensor) -> Quadratic:
        """Landmarks and tracked poses linearised at a state, of a step from there, (B,N+6)."""
        K, slide = self.intrinsics.double(), self.settings.contour_slide
        own = rows[:, :LANDMARKS] if terms.views else rows
        at = linearise(self.points, head, own, K, terms.landmarks, terms.precision, slide)
        data = at.energy()
        for number, view in enumerate(terms.views, 1):
            data = data + self._seen_by(view, head, rows[:, LANDMARKS * number : LANDMARKS * (number + 1)])
        if terms.read is not None:
            data = data + energy_of_step(terms.read, head.weights)
        if self.settings.pose_trust == 0:
            return data
        by_motion = at.jacobian[..., -6:].flatten(1, 2)
        precision = self.settings.pose_trust * (by_motion.transpose(1, 2) @ by_motion)
        off = head.step_from(HeadState(head.weights, terms.rotation, terms.translation))[:, -6:]
        shapes = len(self.names)
        H = pad(precision, (shapes, 0, shapes, 0))
        return data + Quadratic(H, pad((precision @ off[..., None])[..., 0], (shapes, 0)))

    def _seen_by(self, view: CameraView, head: HeadState, rows: Tensor) -> Quadratic:
        """Another view's landmarks linearised at a state, of a step from there before the first camera, (B,N+6)."""
        K, precision = view.intrinsics.double(), self.landmark_weights.double().sqrt() / view.deviation
        there = HeadState(head.weights, *view.pose(head.rotation, head.translation))
        at = linearise(self.points, there, rows, K, view.landmarks, precision, self.settings.contour_slide)
        # Turns and moves before the first camera are those before this one, turned.
        turned = (at.jacobian[..., -6:].unflatten(-1, (2, 3)) @ view.rotation.to(K)).flatten(-2)
        return Linearised(at.residual, torch.cat([at.jacobian[..., :-6], turned], dim=-1)).energy()

    def _attached(self, terms: FrameTerms, head: HeadState, rows: Tensor) -> HeadState:
        """The converged state as a differentiable function of the terms."""

        def gradient(x: Tensor) -> Tensor:
            return self.energy(terms, head.moved(x[:, :-6], x[:, -6:]), rows).f

        x = pad(head.weights, (0, 6))
        x = attach_gradients(gradient, x, (x > self.lower) & (x < self.upper))
        return head.moved(x[:, :-6], x[:, -6:])

    def reprojection_errors(
        self,
        landmarks: Tensor,
        weights: Tensor,
        rotation: Tensor,
        translation: Tensor,
        confidence: Tensor | None = None,
    ) -> Tensor:
        """Root mean square distance of seen landmarks (T,68,2) to the rig's, (T,), pixels; NaN where none is seen.

        Each counts as much as its confidence (T,68), so one behind a hand does not. Landmarks of the contour count
        along it as they do in the solve, see ``sliding``: where between ear and chin an annotator sets them says
        nothing of a face.
        """
        weights, rotation, translation = (x.detach().double() for x in (weights, rotation, translation))
        points, K = self.points, self.intrinsics.double()
        rows = points.chosen(weights, rotation, translation, K)
        placed = points.at(weights)[torch.arange(len(rows), device=rows.device)[:, None], rows]
        image = (placed @ rotation.transpose(-1, -2) + translation[:, None]) @ K.T
        pixels = image[..., :2] / image[..., 2:]
        off = sliding((pixels - landmarks.detach().double())[..., None], pixels, self.settings.contour_slide)
        trust = self.landmark_trust(landmarks, confidence)
        squared = (trust * off.square().sum((-2, -1)).nan_to_num(0.0)).sum(1)
        return (squared / trust.sum(1)).sqrt().to(landmarks.dtype)
