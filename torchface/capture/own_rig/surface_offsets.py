"""Offsets of the surface's points on a person who is not the rig's: what a take shows where the face rests."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.own_rig.face_measurements import FaceMeasurements
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import HeadState
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.own_rig.state_estimate import Expectation
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.errors import AlignmentError

_FRAMES, _LEAST = 40, 10
_DEVIATION = 4.0  # millimetres that people's points lie off a rig's
_ERROR = 1.0  # millimetres that a point is off in all frames alike
_CALM = 1.0  # sum of weights at which a frame counts half


def surface_offsets(
    solver: VideoSolver, landmarks: Tensor, confidence: Tensor, measured: FaceMeasurements
) -> Tensor | None:
    r"""How far a take's points lie from the rig's, (P,3) millimetres; None where fewer than ten frames show a face.

    Forty frames are solved from their landmarks alone, and each point's offset is the likeliest for what is left over,

    .. math:: \min_o \; \frac{1}{2 \mu^2} \sum_t c_t \lVert r_t + G_t o \rVert^2 + \frac{\lVert o \rVert^2}{2 s^2}

    with :math:`c_t`, which sum to 1, small in frames of a strong expression: their offset would be the expression.

    Args:
        solver: with the landmarks' own offsets, and a surface.
        landmarks, confidence: of a take, (T,68,2) and (T,68).
        measured: its points.
    """
    trust = solver.landmark_trust(landmarks, confidence)
    shown = ((trust > 0).sum(1) >= LANDMARKS // 2).nonzero()[:, 0]
    surface, points, deviation = solver.surface, measured.points, measured.point_deviation
    if len(shown) < _LEAST or surface is None or points is None or deviation is None:
        return None
    chosen = shown[torch.linspace(0, len(shown) - 1, min(_FRAMES, len(shown))).round().long()]
    K = solver.intrinsics.double()
    with torch.no_grad():
        seen, trust = landmarks[chosen].double(), trust[chosen].double()
        try:
            poses = measure_poses(solver.points.rest[:LANDMARKS].double(), seen, K, trust)
        except AlignmentError:
            return None
        chosen, seen, trust = chosen[poses.found], seen[poses.found], trust[poses.found]
        if len(chosen) < _LEAST:
            return None
        rotation, translation = poses.rotation[poses.found], poses.translation[poses.found]
        start = HeadState(seen.new_zeros(len(seen), len(solver.names)), rotation, translation)
        noise = solver.noise(rotation, translation)
        precision = (solver.landmark_weights.double() * trust).sqrt() / noise[:, None]
        information = solver.initial_information.double().diag().expand(len(seen), -1, -1)
        terms = FrameTerms(seen.nan_to_num(0.0), precision, rotation, translation, Expectation(start, information))
        head, _ = solver.solve(terms, start)
        found, off = points[chosen].double(), deviation[chosen].double()
        known = torch.isfinite(found).all(-1) & torch.isfinite(off)
        calm = 1 / (1 + (head.weights.sum(1) / _CALM).square())
        share = surface.facing(head.rotation, head.translation).double() * known * calm[:, None]
        at = surface.linearised(head, K, torch.where(known[..., None], found, 0.0), torch.ones_like(share))
        unit = head.translation[:, 2:, None, None] / K[0, 0]  # from pixels to millimetres
        by_offset = unit * (at.jacobian[..., -3:].double() @ head.rotation[:, None].double())
        residual = unit[..., 0] * at.residual.double()
        share = share / share.sum(0).clamp(min=1e-6) / _ERROR**2
        H = torch.einsum("tp,tpci,tpcj->pij", share, by_offset, by_offset)
        f = torch.einsum("tp,tpci,tpc->pi", share, by_offset, residual)
        identity = torch.eye(3, dtype=H.dtype, device=H.device) / _DEVIATION**2
        return -torch.linalg.solve(H + identity, f)
