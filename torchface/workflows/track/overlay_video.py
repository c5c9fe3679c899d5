"""The video of what was solved: the rig as clay beside the camera's picture, or over it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import FacePoints
from torchface.geometry.cameras.distortion import undistort_image
from torchface.geometry.cameras.pinhole import Camera
from torchface.io.video import write_video
from torchface.landmarks.images.boxes.face_box import interleaved
from torchface.mesh import Mesh
from torchface.progress import Progress
from torchface.rendering.quick_clay import BACKGROUND, QuickClay
from torchface.viz.figures.landmark_dots import with_dots
from torchface.workflows.track.track_result import Tracked

_HEIGHT = 480  # pixels of the two pictures
_CRF = 22  # looks as 16 does, in a third of the bytes
_BORDER = 0.3  # of the face's height, round it
_SURE = 0.5  # landmarks of at least this confidence are not marked
_STRENGTH = 0.6  # of the mesh over the picture
_REACH = 12.0  # millimetres round a landmark that are marked with it
_FOUND, _SUSPECT, _WORDS = (60, 230, 60), (236, 92, 40), (225, 225, 225)


def write_overlay(tracked: Tracked, path: Path, progress: Progress) -> None:
    """Writes the overlay of a whole video, as its settings ask for; it appears when it is complete."""
    draw = mesh_drawer(tracked) if tracked.inputs.settings.overlay == "over" else side_by_side_drawer(tracked)

    def drawn() -> Iterator[Tensor]:
        for at, frame in zip(range(len(tracked)), tracked.video.color_frames(), strict=False):
            yield draw(at, frame)[None]
            progress("drawing the overlay (--overlay none skips it)", at + 1, len(tracked))

    write_video(drawn(), path, tracked.video.fps, tracked.times, tracked.video.path, _CRF)


def side_by_side_drawer(tracked: Tracked) -> Callable[[int, Tensor], Tensor]:
    """Draws frame number t of a video, uint8 (3,H,W), as uint8 (3,h,2w): the picture left, the rig right.

    Both are cut to where the head is in the whole take. Landmarks are green in the picture, orange where their
    confidence is low, left out where they are taken for hidden; what of the rig lies at the last two is tinted orange.
    A frame without a face shows no rig.
    """
    window = head_window(tracked)
    rig, weights = tracked.shown, tracked.solution.weights.detach()
    clay, near = QuickClay.of(rig.neutral, skin=True), _near_landmarks(rig.neutral)
    doubt = ((_SURE - tracked.reading.trust.nan_to_num()) / _SURE).clamp(0, 1)
    width = window.width
    view = (window.intrinsics @ torch.linalg.inv(tracked.calibration.intrinsics.double())).numpy()
    bend = tracked.calibration.distortion.double().numpy()
    maps = None
    if bend.any():
        maps = cv2.initUndistortRectifyMap(
            tracked.calibration.intrinsics.double().numpy(), bend, None, window.intrinsics.numpy(), (width, _HEIGHT),
            cv2.CV_16SC2,
        )  # fmt: skip

    def draw(t: int, frame: Tensor) -> Tensor:
        pixels = interleaved(frame)
        both = np.empty((_HEIGHT, 2 * width, 3), np.uint8)
        if maps is None:
            left = cv2.warpAffine(pixels, view[:2], (width, _HEIGHT), borderValue=BACKGROUND)
        else:
            left = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderValue=BACKGROUND)
        words = f"frame {t}" if tracked.seen[t] else f"frame {t}: no face"
        if tracked.seen[t]:
            places = tracked.landmarks[t].double() @ torch.from_numpy(view[:2, :2].T) + torch.from_numpy(view[:2, 2])
            _dots(left, places, doubt[t])
            at = camera_at(tracked, t)
            camera = replace(window, rotation=at.rotation, translation=at.translation)
            vertices = rig(weights[t : t + 1].to(rig.deltas))[0]
            tint = (near @ doubt[t].float()).clamp(0, 1) if bool((doubt[t] > 0).any()) else None
            both[:, width:] = clay.draw(vertices, camera, tint)
        else:
            both[:, width:] = BACKGROUND
        both[:, :width] = left
        cv2.putText(both, words, (width + 8, _HEIGHT - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _WORDS, 1, cv2.LINE_AA)
        return torch.from_numpy(both).permute(2, 0, 1)

    return draw


def mesh_drawer(tracked: Tracked) -> Callable[[int, Tensor], Tensor]:
    """Draws frame number t, uint8 (3,H,W): the mesh half through, found landmarks green, the solved rig's red."""
    rig, weights = tracked.rig, tracked.solution.weights.detach()
    clay = QuickClay.of(rig.neutral)
    points = FacePoints.of(rig, rig.neutral.landmarks)  # those of the contour slide, as the solver has them

    def draw(t: int, frame: Tensor) -> Tensor:
        if not tracked.seen[t]:
            return frame
        picture, camera = interleaved(undistort_image(frame, tracked.calibration)), camera_at(tracked, t)
        drawn = clay.draw(rig(weights[t : t + 1].to(rig.deltas))[0], camera)
        covered = (drawn != np.array(BACKGROUND, np.uint8)).any(2, keepdims=True)
        blue = np.ascontiguousarray(drawn[..., ::-1])  # clay that is not the colour of skin
        mixed = np.where(covered, cv2.addWeighted(blue, _STRENGTH, picture, 1 - _STRENGTH, 0), picture)
        here = weights[t : t + 1].double()
        rows = points.chosen(here, camera.rotation[None], camera.translation[None], camera.intrinsics)[0]
        places = camera.project(points.at(here)[0, rows])
        return with_dots(torch.from_numpy(mixed).permute(2, 0, 1), tracked.landmarks[t], places)

    return draw


def camera_at(tracked: Tracked, t: int) -> Camera:
    """The camera of frame t, from the rig's space, without distortion."""
    solution, clip = tracked.solution, tracked.video
    return Camera(
        tracked.calibration.intrinsics.double(),
        solution.rotation[t].detach().double(),
        solution.translation[t].detach().double(),
        clip.width,
        clip.height,
    )


def head_window(tracked: Tracked) -> Camera:
    """The camera of the part of the image where the head is in a take, ``_HEIGHT`` pixels high; its pose is none's."""
    visible = tracked.seen.nonzero()[:, 0]
    marks = tracked.rig.vertices[tracked.rig.neutral.landmarks].double()
    rotation, translation = (getattr(tracked.solution, name).detach().double() for name in ("rotation", "translation"))
    rays = torch.einsum("tij,lj->tli", rotation[visible], marks) + translation[visible, None]
    projected = rays @ tracked.calibration.intrinsics.double().T
    pixels = projected[..., :2] / projected[..., 2:].clamp(min=1.0)
    low, high = pixels.amin(1), pixels.amax(1)
    border = _BORDER * (high - low).amax(1).median()
    # A frame or two in which the pose went astray do not shrink all others.
    first, last = low.quantile(0.02, 0) - border, high.quantile(0.98, 0) + border
    first[1] -= border  # the landmarks end at the brows
    size = (last - first).clamp(min=16.0)
    size[0] = size[0].clamp(min=float(0.75 * size[1]))
    size[1] = size[1].clamp(min=float(0.6 * size[0]))
    middle = (first + last) / 2
    scale = _HEIGHT / size[1]
    # Both sides together divisible by 32: of other widths x264 reads what lies behind rows, and files differ each time.
    width = 16 * max(1, round(float(size[0] * scale) / 16))
    intrinsics = tracked.calibration.intrinsics.double().clone()
    intrinsics[:2] *= scale
    intrinsics[:2, 2] += torch.tensor([width, _HEIGHT]).double() / 2 - scale * middle
    return Camera(intrinsics, torch.eye(3).double(), torch.zeros(3).double(), width, _HEIGHT)


def _near_landmarks(mesh: Mesh) -> Tensor:
    """How much each landmark's doubt is each vertex's, (V,68): a mean of those near, less where none is."""
    distance = torch.cdist(mesh.vertices, mesh.vertices[mesh.landmarks])
    weight = torch.exp(-distance.square() / (2 * _REACH**2))
    return weight / weight.sum(1, keepdim=True).clamp(min=0.5)


def _dots(picture: np.ndarray, places: Tensor, doubt: Tensor) -> None:
    """Landmarks (68,2) on a picture, drawn into it."""
    for (x, y), suspect in zip((places * 16).tolist(), (doubt > 0).tolist(), strict=True):
        if abs(x) < 2**20 and abs(y) < 2**20:  # NaN is neither
            color = _SUSPECT if suspect else _FOUND
            cv2.circle(picture, (round(x), round(y)), 20, color, -1, cv2.LINE_AA, 4)
