"""The camera's picture as the live page shows it: smaller, as in a mirror where asked, with what was found drawn in."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from torchface.viz.browser.live_view import LiveView

_WIDTH = 480
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel
_POINT, _IRIS, _EDGE = (120, 225, 255), (255, 190, 60), (20, 40, 60)
_BAND, _LATE = (46, 92, 138), 0.75


def camera_drawing(view: LiveView, mirrored: bool) -> np.ndarray:
    """The picture (h,480,3) with landmarks, irises and, while a calibration runs, how long each face is still held."""
    height, width = view.picture.shape[:2]
    scale = _WIDTH / width
    size = (_WIDTH, max(1, round(height * scale)))
    drawn = cv2.resize(view.picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    if mirrored:
        drawn = np.ascontiguousarray(drawn[:, ::-1])
        view = replace(view, landmarks=_flipped(view.landmarks, width), iris=_flipped(view.iris, width))
    for points, radius, color in ((view.landmarks, 1.6, _POINT), (view.iris, 3.2, _IRIS)):
        found = points[torch.isfinite(points).all(1)]
        places = (((found.double() + 0.5) * scale - 0.5).clamp(-1e3, 1e4) * 2**_SHIFT).round().int().tolist()
        for x, y in places:
            at = (x, y)
            cv2.circle(drawn, at, round((radius + 0.8) * 2**_SHIFT), _EDGE, -1, cv2.LINE_AA, _SHIFT)
            cv2.circle(drawn, at, round(radius * 2**_SHIFT), color, -1, cv2.LINE_AA, _SHIFT)
    if not view.seen:
        drawn = (drawn * _LATE).astype(np.uint8)
    if view.prompt:
        cv2.rectangle(drawn, (0, 0), (_WIDTH - 1, size[1] - 1), _BAND, 8)
    return drawn


def _flipped(points: torch.Tensor, width: int) -> torch.Tensor:
    return torch.stack([width - 1 - points[:, 0], points[:, 1]], 1)
