"""Stabilisation of a loose camera: a point of the helmet and two markers are tracked through the video."""

import numpy as np
import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError
from torchface.temporal import interpolated

_WINDOW = 15
_LEVELS = 3
_REACH = 4  # pixels about a marker's expected place in which its centroid is taken
_MAX_RESIDUAL = 0.2  # of a grey value of 1, mean over the window
_MAX_STEP = 20.0  # pixels from one frame to the next
_FIELDS = ("helmet", "the first of markers", "the second of markers")  # of the labels, in which the points stand


class PointTracker:
    """Follows a point of the helmet and bright markers through a video.

    The helmet's point is found by pyramidal Lucas-Kanade optical flow, every frame against the reference, so that
    nothing drifts. Most image motion is the helmet's: a marker is searched at its last place, moved with the
    helmet, and is the intensity centroid of its blob.

    Args:
        helmet: a point of the helmet, (2,), pixels.

    Source: Lucas and Kanade 1981, Bouguet 2001; thesis 4.1.10.
    """

    def __init__(self, reference: Tensor, helmet: Tensor, markers: Tensor) -> None:
        height, width = reference.shape
        for i, (x, y) in enumerate(torch.cat([helmet[None], markers]).tolist()):
            if not (2 <= x < width - 2 and 2 <= y < height - 2):
                raise AlignmentError(
                    f"{_FIELDS[i]} is at ({x:.1f}, {y:.1f}), expected inside the image of {width} x {height} pixels"
                )
            top, left = max(int(y) - 5, 0), max(int(x) - 5, 0)
            around = reference[top : int(y) + 7, left : int(x) + 7].float()
            if float(around.max() - around.min()) < 20:
                raise AlignmentError(
                    f"{_FIELDS[i]}: found nothing to follow at ({x:.1f}, {y:.1f}) in the neutral frame, expected "
                    + ("a bright marker" if i else "a corner or an edge of the helmet")
                )
        self._reference = np.ascontiguousarray(reference.numpy())
        blobs, brightness = _blobs(reference, markers.float())
        self._min_brightness = 0.6 * brightness
        self.points = torch.cat([helmet[None].float(), blobs])
        self._last = self.points.clone()

    def __call__(self, frames: Tensor) -> Tensor:
        """Where helmet and markers are in the next frames (t,H,W) uint8: (t,1+M,2), NaN where one was lost."""
        if frames.ndim != 3 or frames.shape[1:] != self._reference.shape:
            raise ShapeError(f"frames: found {tuple(frames.shape)}, expected (t, {self._reference.shape})")
        tracked = torch.full((len(frames), len(self.points), 2), torch.nan)
        for i, frame in enumerate(frames):  # where a point was last is where the next search begins
            helmet = self._flow(frame)
            if helmet is not None:
                tracked[i, 0] = helmet
                self._last[1:] += helmet - self._last[0]
                self._last[0] = helmet
            blobs, brightness = _blobs(frame, self._last[1:])
            seen = (brightness > self._min_brightness) & ((blobs - self._last[1:]).norm(dim=1) < _REACH)
            tracked[i, 1:][seen] = blobs[seen]
            self._last[1:][seen] = blobs[seen]
        return tracked

    def _flow(self, frame: Tensor) -> Tensor | None:
        """Where the helmet's point is, (2,), or nothing where it cannot be found."""
        import cv2

        place, status, residual = cv2.calcOpticalFlowPyrLK(
            self._reference,
            np.ascontiguousarray(frame.numpy()),
            self.points[:1].numpy()[:, None].copy(),
            self._last[:1].numpy()[:, None].copy(),
            winSize=(_WINDOW, _WINDOW),
            maxLevel=_LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
        )
        moved = torch.from_numpy(place[0, 0].copy())
        step = float((moved - self._last[0]).norm())
        good = status[0, 0] > 0 and residual[0, 0] < 255 * _MAX_RESIDUAL and step < _MAX_STEP
        return moved if good else None


def _blobs(frame: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """The intensity centroids (P,2) about points (P,2), and the brightest grey there, (P,)."""
    height, width = frame.shape
    offsets = torch.arange(-_REACH, _REACH + 1)
    for _ in range(2):  # a blob that was cut off at first is whole the second time
        place = points.round().long()
        rows = (place[:, 1, None, None] + offsets[:, None]).clamp(0, height - 1)
        columns = (place[:, 0, None, None] + offsets[None, :]).clamp(0, width - 1)
        grey = frame[rows, columns].float()
        brightest = grey.flatten(1).amax(1)
        weight = (grey - 0.6 * brightest[:, None, None]).clamp(min=0)
        total = weight.sum((1, 2)).clamp(min=1e-6)
        points = torch.stack([(weight * columns).sum((1, 2)) / total, (weight * rows).sum((1, 2)) / total], dim=1)
    return points, brightest


def steady_transforms(reference: Tensor, tracked: Tensor) -> Tensor:
    r"""The similarity of the image plane that moves the reference's points to each frame's.

    .. math:: \min_{a,b \in \mathbb{C}} \sum_p \lvert a z_p + b - z'_{tp} \rvert^2

    with points as complex numbers. A frame in which a point was lost takes the frames' around it.

    Returns:
        (T,2,3): a pixel (x,y,1) of the reference is at ``transform @ (x,y,1)`` in frame t.
    """
    if reference.ndim != 2 or len(reference) < 2 or tracked.shape[1:] != reference.shape:
        raise ShapeError(f"points: found {tuple(reference.shape)} and {tuple(tracked.shape)}, expected (P,2), (T,P,2)")
    lost = tracked.isnan().any(-1)
    worst = int(lost.float().mean(0).argmax())
    share = float(lost[:, worst].float().mean())
    if share > 0.2:
        raise AlignmentError(f"{_FIELDS[worst]} was lost in {share:.0%} of {len(tracked)} frames, expected in view")
    z = torch.view_as_complex(reference.double().contiguous())
    moved = torch.view_as_complex(_filled(tracked.double()).contiguous())
    centred, target = z - z.mean(), moved - moved.mean(1, keepdim=True)
    a = (centred.conj() * target).sum(1) / centred.abs().square().sum()
    b = moved.mean(1) - a * z.mean()
    rows = torch.stack([a.real, -a.imag, b.real, a.imag, a.real, b.imag], dim=1)
    return rows.view(-1, 2, 3).float()


def _filled(tracked: Tensor) -> Tensor:
    """Lost places (T,P,2) on the straight line between the frames before and after."""
    filled = tracked.clone()
    for p in range(tracked.shape[1]):  # three points
        rows = (~tracked[:, p].isnan().any(1)).nonzero()[:, 0]
        filled[:, p] = interpolated(tracked[rows, p], rows, len(tracked))
    return filled
