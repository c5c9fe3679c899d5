"""A video with paint on its face, frame by frame from file to file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.io.video import VideoFile, write_video
from torchface.mesh import Mesh
from torchface.progress import Progress, silent
from torchface.rendering.point_light import PointLight
from torchface.rendering.texture_overlay import FacePaint, overlay


def overlay_video(
    frames: Iterable[Tensor],
    meshes: Tensor,
    mesh: Mesh,
    texture: Tensor,
    light: PointLight,
    cameras: Sequence[Camera],
    path: str | Path,
    fps: float,
    calibration: CameraCalibration | None = None,
    progress: Progress | None = None,
) -> VideoFile:
    """Writes a video in which the face wears a texture, in the light that was found; a chunk at a time.

    Args:
        frames: the video's, in chunks (t,3,H,W) or one by one (3,H,W), uint8 or in [0,1], such as
            ``VideoFile.color_chunks`` gives.
        meshes: the face in each frame, (T,V,3), millimetres; a frame whose mesh holds NaN (no face found) stays as it
            is.
        mesh: the rig's neutral: faces, texture coordinates, regions.
        texture: red, green, blue and alpha, (4,h,w); see :meth:`FacePaint.of`.
        light: as ``estimate_light`` finds it.
        cameras: one a frame.
        path: of the video; ``.avi`` and ``.mkv`` are lossless.
        fps: frames a second.
        calibration: of a lens that bends the frames.
        progress: called with each step and how far it is.

    Raises:
        ShapeError: meshes, cameras and frames differ in number or size.
        FileFormatError: the file cannot be written.

    Source: thesis 4.2.11.
    """
    progress = progress or silent
    if meshes.ndim != 3 or meshes.shape[1:] != mesh.vertices.shape or len(meshes) != len(cameras):
        raise ShapeError(
            f"overlay_video: found meshes {tuple(meshes.shape)} and {len(cameras)} cameras, expected "
            f"(T,{len(mesh.vertices)},3) and as many"
        )
    paint = FacePaint.of(mesh, texture)

    def painted() -> Iterator[Tensor]:
        done = 0
        for chunk in frames:  # a frame at a time: each has a mesh of its own, and a video does not fit in memory
            for frame in chunk if chunk.ndim == 4 else chunk[None]:
                if done == len(meshes):
                    raise ShapeError(f"overlay_video: found more frames than the {done} meshes, expected as many")
                found = bool(torch.isfinite(meshes[done]).all())
                yield (overlay(frame, meshes[done], paint, light, cameras[done], calibration) if found else frame)[None]
                done += 1
                progress("drawing the overlay", done, len(meshes))
        if done < len(meshes):
            raise ShapeError(f"overlay_video: found {done} frames for {len(meshes)} meshes, expected as many")

    return write_video(painted(), path, fps)
