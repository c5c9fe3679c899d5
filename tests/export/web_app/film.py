"""Films that Chromium takes for its camera."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from planted_graph import BESIDE, BLOCK, COLUMNS, PRESENCE, YAW


def write_y4m(path: Path, frames: NDArray[np.uint8], fps: int = 30) -> None:
    """Grey frames (T,H,W) or RGB ones (T,H,W,3) as YUV4MPEG2, which Chromium plays in a loop as its camera."""
    if frames.ndim == 3:
        frames = np.repeat(frames[..., None], 3, axis=3)
    height, width = frames.shape[1:3]
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{width} H{height} F{fps}:1 Ip A1:1 C420jpeg\n".encode())
        for frame in frames:  # one at a time, for memory
            red, green, blue = np.moveaxis(frame.astype(np.float32), 2, 0)
            luma = 0.299 * red + 0.587 * green + 0.114 * blue
            chroma = ((blue - luma) / 1.772 + 128, (red - luma) / 1.402 + 128)
            small = [part.reshape(height // 2, 2, width // 2, 2).mean((1, 3)) for part in chroma]
            planes = [luma, *small]
            file.write(
                b"FRAME\n" + b"".join(np.clip(plane.round(), 0, 255).astype(np.uint8).tobytes() for plane in planes)
            )


def planted_film(frames: int = 60, unseen: range = range(0)) -> NDArray[np.uint8]:
    """Small grey frames (T,128,160) whose blocks rise and fall, each at its own speed; without a face in ``unseen``."""
    time, block = np.arange(frames)[:, None] / frames, np.arange(COLUMNS * COLUMNS)
    values = 0.5 + 0.4 * np.sin(2 * np.pi * (time * (1 + block % 5) + block / 9))
    values[:, PRESENCE], values[:, BESIDE] = 0.95, 0.05
    values[:, YAW] = 0.5 + 0.3 * np.sin(2 * np.pi * 4 * time[:, 0])
    values[list(unseen), PRESENCE] = 0.05
    film = np.full((frames, BLOCK * COLUMNS, 160), 128, np.uint8)
    blocks = np.kron(values.reshape(-1, COLUMNS, COLUMNS), np.ones((1, BLOCK, BLOCK)))
    film[:, :, : BLOCK * COLUMNS] = (255 * blocks).round().astype(np.uint8)
    return film
