"""Runs in the Python that has MediaPipe: crops of faces in through a pipe, points of the face mesh out.

It knows nothing of torchface, so that its Python need not have it. A message in is two little-endian numbers of 32
bits, height and width, and so many rows of pixels, red first. A message out is a count of points, 478 or 0 where no
face was found, and x and y of each in shares of width and height, as float32. The end of what comes in ends it.
"""

from __future__ import annotations

import os
import struct
import sys
from typing import BinaryIO

MAX_SIDE = 4096


def serve(incoming: BinaryIO, outgoing: BinaryIO) -> None:
    """Answers crops until there are no more."""
    import numpy as np
    from mediapipe import solutions

    mesh = solutions.face_mesh.FaceMesh(static_image_mode=True, max_num_faces=1, refine_landmarks=True)
    _send(outgoing, b"")  # ready
    while len(head := _read(incoming, 8)) == 8:
        height, width = struct.unpack("<II", head)
        if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
            raise ValueError(f"found a crop of {height} x {width}, expected at most {MAX_SIDE}")
        pixels = _read(incoming, 3 * height * width)
        if len(pixels) < 3 * height * width:
            return
        faces = mesh.process(np.frombuffer(pixels, np.uint8).reshape(height, width, 3)).multi_face_landmarks
        points = [(point.x, point.y) for point in faces[0].landmark] if faces else []
        _send(outgoing, np.asarray(points, dtype="<f4").tobytes())


def _send(outgoing: BinaryIO, points: bytes) -> None:
    outgoing.write(struct.pack("<I", len(points) // 8) + points)
    outgoing.flush()


def _read(incoming: BinaryIO, count: int) -> bytes:
    """So many bytes, or fewer where they end."""
    parts = []
    while count and (part := incoming.read(count)):
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the package prints may not come among the answers
    serve(sys.stdin.buffer, answers)
