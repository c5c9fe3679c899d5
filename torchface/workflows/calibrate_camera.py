"""From images of a checkerboard to the calibration of a camera on disk."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.color_space import grey_images
from torchface.errors import AlignmentError, FileFormatError, ShapeError, ValueRangeError
from torchface.files.files_beside import check_beside, write_beside
from torchface.files.whole_files import check_ending, check_writable, make_folder
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io.camera_files import save_calibration
from torchface.io.images.image_files import encode_png, load_image
from torchface.io.video import open_video
from torchface.progress import Progress, silent
from torchface.rendering.compositing import caption, sheet

_VIDEOS = (".avi", ".mkv", ".webm", ".mp4", ".mov")
MIN_VIEWS, _MAX_FRAMES = 5, 60
_DETECTED_AT = 1920  # pixels of the longer side; larger images are searched reduced and refined at full size
_MIN_MOVEMENT = 0.01  # of the width: views whose corners move less say nothing new
_MIN_TILT = 10.0  # degrees between the boards of some two views
_MAX_ERROR_RATIO = 3.0  # to the median error of the views
_MAX_FOCAL_DEVIATION = 0.02  # of the focal length, one standard deviation
_SHOWN, _CELL = 6, 420


@dataclass(frozen=True)
class Board:
    """A checkerboard."""

    # columns, rows: of inner corners, where four squares meet
    columns: int = 9
    rows: int = 6
    square: float = 25.0  # a square's side, millimetres

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100 and 0 < self.square < math.inf):
            raise ValueRangeError(
                f"checkerboard: found {self.columns} x {self.rows} corners and squares of {self.square} mm, expected "
                "3 to 100 inner corners a side and positive millimetres"
            )

    @property
    def points(self) -> Tensor:
        """The inner corners on the board, (N,3), millimetres."""
        y, x = torch.meshgrid(torch.arange(self.rows), torch.arange(self.columns), indexing="ij")
        return self.square * torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3).float()


@dataclass(frozen=True, eq=False)
class View:
    """An image in which the whole board was found."""

    name: str  # of the file, or the number of the video's frame
    image: Tensor  # uint8 (H,W)
    corners: Tensor  # (N,2), pixels


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """A camera, and what it rests on."""

    calibration: CameraCalibration
    used: tuple[str, ...]  # names of the images used
    errors: Tensor  # reprojection of each, root mean square, (M,), pixels
    left_out: tuple[tuple[str, str], ...]  # names of the others, and why
    focal_deviation: float  # standard deviation of the focal length, relative to it
    tilt: float  # the largest angle between the boards of two views, degrees
    overlay_path: Path | None = None

    def lines(self) -> list[str]:
        """For people to read."""
        camera = self.calibration
        K, distortion = camera.intrinsics.tolist(), camera.distortion.tolist()
        lines = [
            f"{len(self.used)} of {len(self.used) + len(self.left_out)} views used, {camera.width} x {camera.height} "
            f"pixels, boards tilted by up to {self.tilt:.0f} degrees to each other",
            f"reprojection error {camera.error:.3f} pixels root mean square (views: {float(self.errors.min()):.3f} to "
            f"{float(self.errors.max()):.3f})",
            f"focal length {K[0][0]:.1f}, {K[1][1]:.1f} pixels (+- {self.focal_deviation:.2%}), centre {K[0][2]:.1f}, "
            f"{K[1][2]:.1f}; {camera.field_of_view:.1f} degrees across",
            "distortion "
            + ", ".join(f"{n} {v:.4f}" for n, v in zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=True)),
        ]
        return lines + [f"  left out {name}: {reason}" for name, reason in self.left_out]


def calibrate(paths: Sequence[Path], board: Board, out: Path, progress: Progress | None = None) -> CalibrationReport:
    """Calibrates a camera from images of one size, or a video, of a checkerboard held at various angles, and writes it.

    Beside ``out`` goes an image of the corners found, and of views without distortion.

    Source: Zhang 2000; thesis 4.2.4.
    """
    progress = progress or silent
    check_ending(out, ".toml")
    check_writable(out)
    overlay_path = out.with_suffix(".png")
    check_beside(out, overlay_path)
    if not paths:
        raise FileFormatError("calibrate: found no image, expected some of a checkerboard, or a video")
    views, left_out = find_boards(board_images(paths), board, progress)
    progress(f"calibrating from {len(views)} views")
    report = calibrate_views(views, board, left_out)
    progress("writing the calibration and the overlay")
    make_folder(out.parent)
    corners = overlay([view for view in views if view.name in report.used], report.calibration, board)
    write_beside(out, {overlay_path.name: encode_png(corners)})
    save_calibration(report.calibration, out)
    return replace(report, overlay_path=overlay_path)


def find_boards(
    images: Iterator[tuple[str, Tensor]], board: Board, progress: Progress
) -> tuple[list[View], list[tuple[str, str]]]:
    """The views with the whole board, and of other images, uint8 (H,W) of one size, the names and the reasons why
    not."""
    views: list[View] = []
    left_out: list[tuple[str, str]] = []
    first: tuple[str, torch.Size] | None = None
    for name, image in images:  # OpenCV searches one image at a time
        progress("looking for the board", len(views) + len(left_out))
        first = first or (name, image.shape)
        if image.shape != first[1]:
            raise ShapeError(
                f"calibrate: found {name} with {image.shape[1]} x {image.shape[0]} pixels and {first[0]} with "
                f"{first[1][1]} x {first[1][0]}, expected images of one camera at one size"
            )
        corners = find_corners(image, board)
        if corners is None:
            left_out.append((name, f"no board of {board.columns} x {board.rows} inner corners"))
            continue
        near = _MIN_MOVEMENT * image.shape[1]
        earlier = next((view for view in views if float((view.corners - corners).norm(dim=1).mean()) < near), None)
        if earlier is None:
            views.append(View(name, image, corners))
        else:
            left_out.append((name, f"the board stands as in {earlier.name}"))
    return views, left_out


def find_corners(image: Tensor, board: Board) -> Tensor | None:
    """The inner corners (N,2) float32 of the board in an image uint8 (H,W), row by row; None if not all are seen."""
    grey = image.numpy()
    scale = min(1.0, _DETECTED_AT / max(grey.shape))
    small = grey if scale == 1.0 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    good, grid_corners = cv2.findChessboardCornersSB(small, (board.columns, board.rows), flags=flags)
    if not good or grid_corners is None or len(grid_corners) != board.columns * board.rows:
        return None
    corners = (grid_corners.reshape(-1, 1, 2) + 0.5) / scale - 0.5
    if scale < 1.0:
        grid = corners.reshape(board.rows, board.columns, 2)
        gap = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
        half = max(2, int(gap / 4))
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        corners = cv2.cornerSubPix(grey, corners.astype(np.float32), (half, half), (-1, -1), stop)
    return torch.from_numpy(np.ascontiguousarray(corners.reshape(-1, 2), dtype=np.float32))


def calibrate_views(views: Sequence[View], board: Board, left_out: Sequence[tuple[str, str]] = ()) -> CalibrationReport:
    """The camera that explains where the boards' corners are seen.

    Views whose residuals are far larger than those of the others are left out; k3 is estimated only where it differs
    significantly from 0.
    """
    left = list(left_out)
    _check_count(views, left)
    fit = _fit(views, board)
    outliers = [
        i for i, error in enumerate(fit.errors) if error > max(0.5, _MAX_ERROR_RATIO * float(np.median(fit.errors)))
    ]
    if outliers:
        left += [
            (views[i].name, f"its corners are {fit.errors[i]:.1f} pixels from where the camera predicts them")
            for i in outliers
        ]
        views = [view for i, view in enumerate(views) if i not in outliers]
        _check_count(views, left)
        fit = _fit(views, board)
    normals = np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in fit.rotations])
    tilt = math.degrees(math.acos(float(np.clip((normals @ normals.T).min(), -1, 1))))
    if tilt < _MIN_TILT:
        raise AlignmentError(
            f"calibrate: found {len(views)} views in which the board is tilted by at most {tilt:.1f} degrees from one "
            f"to another, expected {_MIN_TILT:.0f} at least: hold it at various angles to the camera"
        )
    focal_deviation = float(fit.deviations[:2].max() / fit.K[0, 0])
    if not focal_deviation < _MAX_FOCAL_DEVIATION:
        raise AlignmentError(
            f"calibrate: found views that leave the focal length open by {focal_deviation:.1%}, expected at most "
            f"{_MAX_FOCAL_DEVIATION:.0%}: add views with the board tilted more, and nearer to the image's corners"
        )
    height, width = views[0].image.shape
    camera = CameraCalibration(
        torch.from_numpy(fit.K), torch.from_numpy(fit.distortion), int(width), int(height), fit.error
    )
    names = tuple(view.name for view in views)
    return CalibrationReport(camera, names, torch.from_numpy(fit.errors), tuple(left), focal_deviation, tilt)


def overlay(views: Sequence[View], calibration: CameraCalibration, board: Board) -> Tensor:
    """Views with the corners found, and the same without distortion, as one image (3,H,W).

    The board's lines are drawn between corners: through the undistorted views they are straight.
    """
    K, distortion = calibration.intrinsics.numpy(), calibration.distortion.numpy()
    seen, straight = [], []
    for view in views[:: max(1, len(views) // _SHOWN)][:_SHOWN]:  # few views are drawn
        flat = cv2.undistort(view.image.numpy(), K, distortion)
        moved = cv2.undistortPoints(view.corners.numpy().reshape(-1, 1, 2), K, distortion, P=K).reshape(-1, 2)
        seen.append(caption(_drawn(view.image.numpy(), view.corners.numpy(), board), view.name))
        straight.append(caption(_drawn(flat, moved, board), "undistorted"))
    return sheet([*seen, *straight], columns=len(seen))


@dataclass(frozen=True, eq=False)
class _Fit:
    K: np.ndarray
    distortion: np.ndarray
    rotations: Sequence[np.ndarray]
    errors: np.ndarray
    deviations: np.ndarray
    error: float


def _fit(views: Sequence[View], board: Board) -> _Fit:
    height, width = views[0].image.shape
    corners = [view.corners.numpy().reshape(-1, 1, 2) for view in views]
    points = [board.points.numpy()] * len(views)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-10)
    best = None
    for flags in (cv2.CALIB_FIX_K3, 0):
        try:
            error, K, distortion, rotations, _, deviations, _, errors = cv2.calibrateCameraExtended(
                points, corners, (int(width), int(height)), np.eye(3), np.zeros(5), flags=flags, criteria=stop
            )
        except cv2.error as wrong:
            raise AlignmentError(
                f"calibrate: no camera explains the {len(views)} views ({' '.join(str(wrong).split())[:120]}); "
                "expected boards at various angles"
            ) from wrong
        distortion, deviations = distortion.ravel()[:5].astype(np.float64), deviations.ravel()
        # OpenCV's order: fx, fy, cx, cy, k1, k2, p1, p2, k3.
        if best is None or abs(distortion[4]) > 3 * deviations[8]:
            best = _Fit(K, distortion, rotations, errors.ravel(), deviations, float(error))
    assert best is not None
    return best


def _check_count(views: Sequence[View], left_out: Sequence[tuple[str, str]]) -> None:
    if len(views) >= MIN_VIEWS:
        return
    why = "; ".join(f"{name}: {reason}" for name, reason in left_out[:8])
    raise AlignmentError(
        f"calibrate: found the board in {len(views)} views, expected {MIN_VIEWS} at least that differ"
        + (f" ({why})" if why else "")
    )


def board_images(paths: Sequence[Path]) -> Iterator[tuple[str, Tensor]]:
    """Names and grey images uint8 (H,W) of files, or of a video's frames."""
    videos = [path for path in paths if path.suffix.lower() in _VIDEOS]
    if videos and len(paths) > 1:
        raise FileFormatError(f"{videos[0]}: found a video beside {len(paths) - 1} files, expected it alone, or images")
    if not videos:
        for path in paths:
            image = load_image(path)
            yield path.name, (255 * grey_images(image[None])[0, 0]).round().to(torch.uint8)
        return
    video = open_video(videos[0])
    step = max(1, -(-video.count // _MAX_FRAMES))
    for number, frame in enumerate(video.frames()):
        if number % step == 0:
            yield f"frame {number}", frame


def _drawn(image: np.ndarray, corners: np.ndarray, board: Board) -> Tensor:
    """A grey image, reduced, with the rows of corners drawn over it."""
    scale = _CELL / image.shape[1]
    small = cv2.resize(image, (_CELL, max(1, round(image.shape[0] * scale))), interpolation=cv2.INTER_AREA)
    canvas = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
    grid = ((corners.reshape(board.rows, board.columns, 2) + 0.5) * scale - 0.5) * 16
    lines = [np.ascontiguousarray(line.round(), np.int32) for line in (*grid, *grid.transpose(1, 0, 2))]
    cv2.polylines(canvas, lines, False, (40, 200, 90), 1, cv2.LINE_AA, shift=4)
    for x, y in grid.reshape(-1, 2).round().astype(np.int32):  # OpenCV draws one circle at a time
        cv2.circle(canvas, (int(x), int(y)), 40, (255, 60, 40), 1, cv2.LINE_AA, shift=4)
    return torch.from_numpy(canvas).permute(2, 0, 1).float().div(255)
