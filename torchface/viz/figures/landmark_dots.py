"""Landmarks found and landmarks solved, drawn on the picture that they were found in."""

import cv2
import numpy as np
import torch
from torch import Tensor

_FOUND, _SOLVED = (60, 230, 60), (250, 70, 60)
_SUBPIXEL = 4  # binary digits of OpenCV's drawing coordinates


def with_dots(frame: Tensor, landmarks: Tensor, solved: Tensor) -> Tensor:
    """Landmarks on a frame, uint8 (3,H,W): those given (L,2) green, the solved rig's (L,2) red."""
    canvas = np.array(frame.permute(1, 2, 0).numpy(), order="C")  # a copy: the frame stays as it is
    radius = max(1.0, 0.004 * max(frame.shape[1:]))
    scale = 2**_SUBPIXEL
    for points, color, size in ((solved, _SOLVED, 0.7 * radius), (landmarks, _FOUND, radius)):
        for x, y in (points[torch.isfinite(points).all(1)].double() * scale).round().long().tolist():
            if abs(x) < 2**30 and abs(y) < 2**30:
                cv2.circle(canvas, (x, y), round(size * scale), color, -1, cv2.LINE_AA, _SUBPIXEL)
    return torch.from_numpy(canvas).permute(2, 0, 1)
