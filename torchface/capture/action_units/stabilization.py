"""A camera that hangs loose is held still: a point of the helmet and two markers are followed through the video."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError

_WINDOW = 15
_LEVELS = 3
_REACH = 4  # pixels round a marker in which its blob is weighed
_LARGEST_RESIDUAL = 0.2  # of a grey value of 1, mean over the window
_LARGEST_STEP = 0.35  # of the distance to the other points: further than that nothing has moved between two frames


class PointTracker:
    """Follows points from a reference picture by pyramidal Lucas-Kanade optical flow.

    Every frame is compared with the reference, not with the frame before, so that nothing drifts; the last place found
    is where the search begins. A marker's place is then its blob's centre of brightness.

    Args:
        reference: grey picture, (H,W) uint8.
        points: (P,2), pixels.
        blobs: which of them are bright markers, (P,) bool.

    Raises:
        AlignmentError: a point lies outside the picture, or there is nothing to follow there.

    Source: Lucas and Kanade 1981, Bouguet 2001; thesis 4.1.10.
    """

    def __init__(self, reference: Tensor, points: Tensor, blobs: Tensor) -> None:
        height, width = reference.shape
        for i, (x, y) in enumerate(points.tolist()):
            if not (2 <= x < width - 2 and 2 <= y < height - 2):
                raise AlignmentError(
                    f"stabilisation: point {i} is at ({x:.1f}, {y:.1f}), expected it inside the picture of "
                    f"{width} x {height} pixels"
                )
            around = reference[int(y) - 2 : int(y) + 4, int(x) - 2 : int(x) + 4].float()
            if float(around.max() - around.min()) < 20:
                raise AlignmentError(
                    f"stabilisation: nothing to follow at point {i}, ({x:.1f}, {y:.1f}); expected a corner or a marker"
                )
        self.reference = np.ascontiguousarray(reference.numpy())
        self.blobs = blobs
        self.points = points.float().clone()
        self.points[blobs] = _weighed(reference, self.points[blobs])
        self._last = self.points.clone()

    def __call__(self, frames: Tensor) -> Tensor:
        """Where the points are in the next frames (t,H,W) uint8: (t,P,2), NaN where one was lost."""
        import cv2

        if frames.ndim != 3 or frames.shape[1:] != self.reference.shape:
            raise ShapeError(f"frames: found {tuple(frames.shape)}, expected (t,{self.reference.shape})")
        found = torch.full((len(frames), len(self.points), 2), torch.nan)
        start = self.points.numpy()[:, None]
        for i, frame in enumerate(frames):  # where a point was last is where the next search begins
            places, status, residual = cv2.calcOpticalFlowPyrLK(
                self.reference,
                np.ascontiguousarray(frame.numpy()),
                start,
                self._last.numpy()[:, None].copy(),
                winSize=(_WINDOW, _WINDOW),
                maxLevel=_LEVELS,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
                criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
            )
            now = torch.from_numpy(places[:, 0].copy())
            good = torch.from_numpy((status[:, 0] > 0) & (residual[:, 0] < 255 * _LARGEST_RESIDUAL))
            good &= (now - self._last).norm(dim=1) < _LARGEST_STEP * torch.pdist(self.points).min()
            seen = good & self.blobs
            now[seen] = _weighed(frame, now[seen])
            found[i, good] = now[good]
            self._last[good] = now[good]
        return found


def _weighed(frame: Tensor, points: Tensor) -> Tensor:
    """The centre of brightness round points (P,2)."""
    height, width = frame.shape
    offsets = torch.arange(-_REACH, _REACH + 1)
    place = points.round().long()
    rows = (place[:, 1, None, None] + offsets[:, None]).clamp(0, height - 1)
    columns = (place[:, 0, None, None] + offsets[None, :]).clamp(0, width - 1)
    grey = frame[rows, columns].float()
    brightest = grey.flatten(1).amax(1)[:, None, None]
    weight = (grey - 0.6 * brightest).clamp(min=0)
    total = weight.sum((1, 2)).clamp(min=1e-6)
    across = (weight * columns).sum((1, 2)) / total
    down = (weight * rows).sum((1, 2)) / total
    return torch.stack([across, down], dim=1)


def steady_transforms(reference: Tensor, tracked: Tensor) -> Tensor:
    r"""The similarity of the picture plane that moves the reference's points to each frame's.

    .. math:: \min_{a,b \in \mathbb{C}} \sum_p \lvert a z_p + b - z'_{tp} \rvert^2

    with points as complex numbers. A frame in which a point was lost takes the frames' around it.

    Args:
        reference: z, (P,2), pixels.
        tracked: z', (T,P,2); NaN where lost.

    Returns:
        (T,2,3): a pixel (x,y,1) of the reference is at ``transform @ (x,y,1)`` in frame t.

    Raises:
        ShapeError: the shapes do not fit, or fewer than two points.
        AlignmentError: a point was lost in more than a fifth of the frames.
    """
    if reference.ndim != 2 or len(reference) < 2 or tracked.shape[1:] != reference.shape:
        raise ShapeError(f"points: found {tuple(reference.shape)} and {tuple(tracked.shape)}, expected (P,2), (T,P,2)")
    lost = tracked.isnan().any(-1)
    worst = int(lost.float().mean(0).argmax())
    share = float(lost[:, worst].float().mean())
    if share > 0.2:
        raise AlignmentError(
            f"stabilisation: point {worst} was lost in {share:.0%} of {len(tracked)} frames, expected it in view"
        )
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
    frames = np.arange(len(tracked))
    for p in range(tracked.shape[1]):  # three points
        known = ~tracked[:, p].isnan().any(1).numpy()
        if not known.all():
            for axis in (0, 1):
                curve = np.interp(frames, frames[known], tracked[known, p, axis].numpy())
                filled[:, p, axis] = torch.from_numpy(curve)
    return filled
