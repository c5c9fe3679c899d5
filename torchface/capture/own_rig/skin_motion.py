"""How skin moves beside a take's solution: the face of every frame, laid flat, beside that of all frames together.

Landmarks of a face are found by networks, which shrink what they have not learned; skin that was filmed is its own
reference. Where weights and pose are right, a rig's places show the same skin in all frames, so what the skin is off
by, from frame to frame, is what the weights are.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from tempfile import TemporaryFile, gettempdir
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import signed_difference, signed_quantities
from torchface.capture.own_rig.flat_face import FlatFace
from torchface.capture.own_rig.skin_flow import LEAST_ERROR, SkinFlow, brought_back, optical_flow
from torchface.errors import FileFormatError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.landmarks.images.networks.part_finder import PartFinder
from torchface.rig import BlendshapeRig

LEAST_FRAMES = 10
"""Frames that show the face from which their mean is a reference."""
LEAST_PLACES = 1000
"""Of skin: a tenth of a face."""
COVERS, COVERED = ("glasses", "hand", "cloth", "background"), 0.2
"""Parts that are no skin, and the share of them from which a place does not count."""

_FINEST, _COARSEST = 1.0, 1.5  # millimetres a pixel of it
_SAMPLES, _ROUNDS = 40, 2  # frames of the reference, and how often they are brought onto it
_LOOKED_AT = 10  # frames in which parts are found
_PILOT_ERROR = 0.5  # millimetres of a flow
# Deviation of a mean error; frames that err together; how far below 0 weights go, for skin goes beyond rigs' shapes.
_LIFT, _LASTS, _BEYOND = 0.2, 10.0, 0.1


@dataclass(frozen=True, eq=False)
class SkinMotion:
    """What the skin says of T frames' weights beside those that were given."""

    change: Tensor  # to be added, in the mean of the frames 0, (T,N)
    deviation: Tensor  # of it, (N,); infinite for shapes that skin does not show

    def applied(self, weights: Tensor, resting: Tensor | None = None) -> Tensor:
        r"""Weights (T,N) changed by it, in [0,1]; ``resting`` says how far the face rests in each frame, (T,) in [0,1].

        The skin does not say how far weights are off in all frames. That they are not below 0, and 0 at rest, does:

        .. math:: \min_c \; \frac{c^2}{2 \tau^2} + \frac{(\bar w + \bar x + c)^2}{2 \tau^2}
            + \sum_t \frac{\min(w_t + x_t + c, 0)^2}{2 \cdot 10 \, s^2}

        with :math:`\tau = 0.2`, the means over the frames at rest, and :math:`s^2` the deviation's square and 0.1's. A
        shape that changes by less than its deviation is not lifted: that is noise.
        """
        changed = weights + self.change.to(weights)
        moves = (self.change.std(0, correction=0) > self.deviation).to(weights.device)
        precision = (_LASTS * (_BEYOND**2 + self.deviation.square())).reciprocal().to(weights)
        rests = torch.zeros(len(weights)) if resting is None else resting
        known = float(rests.sum() > 0)
        at_rest = (rests.to(weights) / rests.sum().clamp(min=1e-9).to(weights)) @ changed
        lift = torch.zeros_like(weights[0])
        for _ in range(20):  # Newton's steps of a piecewise quadratic function
            below = (changed + lift).clamp(max=0)
            slope = (lift + known * (at_rest + lift)) / _LIFT**2 + precision * below.sum(0)
            lift = lift - slope / ((1 + known) / _LIFT**2 + precision * (below < 0).sum(0))
        return (changed + torch.where(moves, lift, 0.0)).clamp(0, 1)


def unless_shut(weights: Tensor, changed: Tensor, names: Sequence[str], unseen: Tensor) -> Tensor:
    """Weights (...,N) as the skin changed them, one of two antagonists at 0.

    Skin does not show a blink: where one is solved, it stays, and its lid does not rise. ``unseen`` says which shapes
    those are, (N,) bool.
    """
    signed = signed_quantities(names).to(weights)
    shut = ((weights * unseen) > 0).to(signed) @ signed.abs().T @ signed.abs() > 0
    return torch.where(shut, weights, signed_difference(changed, signed))


def skin_motion(
    rig: BlendshapeRig,
    frames: Iterable[Tensor],
    weights: Tensor,
    poses: tuple[Tensor, Tensor],
    shown: Tensor,
    calibration: CameraCalibration,
    parts: PartFinder,
    done: Callable[[int], None] = lambda frame: None,
) -> SkinMotion | None:
    r"""How skin moves beside a take's solution.

    The places of a rig's face show some skin in each frame. Its mean over the frames, brought onto each other by
    optical flow, is the reference; from it to a frame leads a flow f, millimetres on the face from the front, that
    small changes of N weights and of the pose explain,

    .. math:: \min_{x, p} \; \sum_g \frac{\rho(f_g - B_g x - P_g p)}{s^2} + \sum_i \frac{x_i^2}{2 \sigma_i^2} + \dots

    with :math:`\sigma_i` what solutions are usually off by and s what the flows of this take are, of which those
    within 16 pixels err together.

    Args:
        rig: of N shapes, upright, in millimetres, with iBUG's 68 landmarks.
        frames: pictures, uint8 (3,h,w), of the camera as it is.
        weights: as solved, (T,N).
        poses: rig to camera, (T,3,3) and (T,3).
        shown: frames that show the face, (T,) bool.
        calibration: of the camera, at the frames' size.
        parts: finds what is no skin.
        done: called with each frame's number.

    Returns:
        What the weights are to be changed by; None where fewer than ten frames show a face, or next to no skin.

    Raises:
        FileFormatError: the folder for temporary files cannot hold the pictures, two bytes a place and frame.

    Source: Kroeger et al. 2016 for the flow.
    """
    if int(shown.sum()) < LEAST_FRAMES:
        return None
    weights, rotation, translation = weights.float(), poses[0].float(), poses[1].float()
    step = float((translation[shown, 2] / calibration.intrinsics[0, 0]).median().clamp(_FINEST, _COARSEST))
    face = FlatFace.of(rig, step)
    with TemporaryFile(buffering=0) as file:
        rows, size = shown.nonzero()[:, 0], face.counts.shape
        some = torch.linspace(0, len(rows) - 1, min(_SAMPLES, len(rows))).round().long().tolist()
        few, covered = some[:: max(1, len(some) // _LOOKED_AT)], torch.zeros(size)
        looked_at = rows[few].tolist()
        for t, frame in zip(range(len(weights)), frames, strict=False):
            if bool(shown[t]):
                picture, seen, at = face.seen_in(frame, weights[t], (rotation[t], translation[t]), calibration)
                _append(file, np.stack([face.even(picture), np.round(255 * seen).astype(np.uint8)]), len(rows))
            if t in looked_at:
                covered += parts(frame, face.landmarks_in(at)).around(at, *COVERS).nan_to_num(1.0) / len(few)
        pictures, squarely = np.memmap(file, np.uint8, "r", shape=(len(rows), 2, *size)).swapaxes(0, 1)
        face = replace(face, counts=face.counts & (covered < COVERED))
        if int(face.counts.sum()) < LEAST_PLACES:
            return None
        reference = _reference(pictures[some], squarely[some])
        fit = SkinFlow.of(face, rig.names, reference)
        samples = [fit.flow(pictures[t], squarely[t])[:2] for t in few]
        error = float(np.mean([fit.solved(*sample, _PILOT_ERROR)[2] for sample in samples]))
        change, deviation = torch.zeros(weights.shape), torch.full((len(rig.names),), torch.inf)
        spread = []
        for t, picture, seen in zip(rows.tolist(), pictures, squarely, strict=True):
            solved = fit.solved(*fit.flow(picture, seen)[:2], max(error, LEAST_ERROR))
            change[t, fit.shapes] = torch.from_numpy(solved[0]).float()
            spread.append(solved[1])
            done(t)
    change[rows] -= change[rows].mean(0)
    deviation[fit.shapes] = torch.from_numpy(np.mean(spread, axis=0)).float()
    return SkinMotion(change, deviation)


def _append(file: BinaryIO, pictures: np.ndarray, frames: int) -> None:
    """Writes a frame's pictures; a map that is written into ends the process where the disk is full."""
    left = memoryview(pictures.tobytes())
    try:
        while left:
            left = left[file.write(left) :]
    except OSError as error:
        raise FileFormatError(
            f"{gettempdir()}: found no space ({error.strerror}) for a temporary file of the skin in {frames} frames, "
            f"expected {frames * pictures.nbytes / 1e6:,.1f} MB; free some, or name a folder on another disk as TMPDIR"
        ) from error


def _reference(pictures: np.ndarray, squarely: np.ndarray) -> np.ndarray:
    """The mean of pictures (S,H,W) that are brought onto it, uint8 (H,W), each as far as it sees a place squarely."""
    share = squarely.astype(np.float32) + 0.25
    mean = np.average(pictures, 0, share).astype(np.uint8)
    for _ in range(_ROUNDS):
        flows = np.stack([optical_flow(mean, picture) for picture in pictures])
        flows -= np.average(flows, 0, np.broadcast_to(share[..., None], flows.shape))
        brought = [brought_back(picture, flow) for picture, flow in zip(pictures, flows, strict=True)]
        mean = np.average(np.stack(brought), 0, share).astype(np.uint8)
    return mean
