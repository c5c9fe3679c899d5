"""From films of a checkerboard to cameras that are fixed to each other, on disk."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.files.whole_files import check_ending, check_writable, make_folder
from torchface.geometry.cameras.calibration import CameraCalibration, PlacedCamera
from torchface.io.camera_files import save_cameras
from torchface.io.video import open_video
from torchface.io.video.timecodes import start_of
from torchface.progress import Progress, silent
from torchface.workflows.calibrate_camera import (
    MIN_VIEWS,
    Board,
    CalibrationReport,
    View,
    board_images,
    calibrate_views,
    find_boards,
    find_corners,
)

_MAX_ERROR = 0.005  # of the width: cameras that stand still and films at one time are off by a tenth of that


def calibrate_beside(
    films: Sequence[Path], board: Board, out: Path, progress: Progress | None = None
) -> tuple[list[CalibrationReport], list[PlacedCamera], list[str]]:
    """Calibrates cameras that are fixed to each other, from their films of one checkerboard, and writes them.

    Returns:
        A report of each camera, the cameras, and lines about how they lie.

    Raises:
        AlignmentError: the films show the board at once too seldom, or no place of a camera explains where it is seen.
    """
    progress = progress or silent
    check_ending(out, ".toml")
    check_writable(out)
    reports, views = [], []
    for film in films:
        found, left_out = find_boards(board_images([film]), board, progress)
        reports.append(calibrate_views(found, board, left_out))
        views.append({int(view.name.split()[-1]): view for view in found if view.name in reports[-1].used})
    nowhere = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    cameras = [PlacedCamera(reports[0].calibration, *nowhere, films[0].stem)]
    lines = []
    for film, report in zip(films[1:], reports[1:], strict=True):
        progress(f"looking for the board in {film.name} and {films[0].name} at once")
        first, then = _seen_at_once(films[0], film, views[0], board)
        if len(first) < MIN_VIEWS:
            raise AlignmentError(
                f"calibrate: found the board in {films[0].name} and {film.name} at once at {len(first)} moments, "
                f"expected {MIN_VIEWS} at least: hold it where both cameras see all of it"
            )
        R, t, error = relative_place(board, reports[0].calibration, report.calibration, first, then)
        if error > _MAX_ERROR * report.calibration.width:
            raise AlignmentError(
                f"calibrate: found no place of {film.name} beside {films[0].name} by which the board is where both "
                f"show it ({error:.1f} pixels off root mean square); expected cameras that do not move, and films that "
                "begin at one time or have timecodes"
            )
        cameras.append(PlacedCamera(report.calibration, R, t, film.stem))
        lines.append(
            f"{film.stem}: {float((R.T @ t).norm()):.1f} mm from {films[0].stem}, "
            f"from {len(first)} moments, {error:.3f} pixels off root mean square"
        )
    make_folder(out.parent)
    save_cameras(cameras, out)
    return reports, cameras, lines


def _seen_at_once(one: Path, other: Path, views: dict[int, View], board: Board) -> tuple[list[Tensor], list[Tensor]]:
    """Corners (N,2) of the board in views of one film by their frames, and in another film at these moments."""
    (rate, start), (other_rate, other_start) = ((open_video(film).fps, start_of(film)) for film in (one, other))
    begin = 0.0 if start is None or other_start is None else (other_start - start + 43200) % 86400 - 43200
    wanted = {round((number / rate - begin) * other_rate): view for number, view in views.items()}
    first, then = [], []
    for number, frame in enumerate(open_video(other).frames()):
        if number in wanted and (corners := find_corners(frame, board)) is not None:
            first.append(wanted[number].corners)
            then.append(corners)
    return first, then


def relative_place(
    board: Board, one: CameraCalibration, other: CameraCalibration, first: Sequence[Tensor], then: Sequence[Tensor]
) -> tuple[Tensor, Tensor, float]:
    """Rotation and translation from one camera to another, and their error in pixels, from corners (N,2) in both."""
    (K1, d1), (K2, d2) = ((x.intrinsics.numpy(), x.distortion.numpy()) for x in (one, other))
    points, size = board.points.numpy(), (one.width, one.height)
    seen = [corners.numpy().reshape(-1, 1, 2) for corners in first]
    # A turned camera's corners may be found from another end on, those of a square board also by its columns.
    grid, quarters = (board.rows, board.columns, 2), (0, 1, 2, 3) if board.rows == board.columns else (0, 2)
    ways = [np.stack([np.rot90(c.numpy().reshape(grid), q).reshape(-1, 2) for q in quarters]) for c in then]
    boards = [_rigid(cv2.solvePnP(points, corners, K1, d1)[1:]) for corners in seen]
    before = np.concatenate([points @ R.T + t for R, t in boards])

    def off(R: np.ndarray, t: np.ndarray) -> np.ndarray:
        """How far each moment's corners (M,), taken each way (M,W), are from where a place of the camera has them."""
        shown = cv2.projectPoints(before @ R.T + t, np.zeros(3), np.zeros(3), K2, d2)[0].reshape(len(ways), 1, -1, 2)
        return np.linalg.norm(shown - np.stack(ways), axis=-1).mean(-1)

    best = None
    for (R1, t1), both in zip(boards, ways, strict=True):
        for corners in both:
            R2, t2 = _rigid(cv2.solvePnP(points, np.ascontiguousarray(corners), K2, d2)[1:])
            R = R2 @ R1.T
            found = off(R, t2 - R @ t1)
            if best is None or np.median(found.min(1)) < np.median(best.min(1)):
                best = found
    assert best is not None
    right = [np.ascontiguousarray(both[way]).reshape(-1, 1, 2) for both, way in zip(ways, best.argmin(1), strict=True)]
    held = cv2.CALIB_FIX_INTRINSIC
    error, *_, R, t, _, _ = cv2.stereoCalibrate([points] * len(seen), seen, right, K1, d1, K2, d2, size, flags=held)
    return torch.from_numpy(np.asarray(R)), torch.from_numpy(np.asarray(t).ravel()), float(error)


def _rigid(pose: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    rotation, translation = pose
    return cv2.Rodrigues(rotation)[0], translation.ravel()
