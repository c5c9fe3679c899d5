"""Cameras at this machine by number, and what is said where one is missing; torch is not needed for it."""

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from torchface.errors import FileFormatError

BY_FILE = "A video file does as well: torchface live film.mp4"
"""What to do without a camera."""

_MAX_PROBED = 6


def list_cameras() -> dict[int, str]:
    """Cameras by number, with their names where the system gives them."""
    if sys.platform == "linux":
        cameras = {}
        for folder in Path("/sys/class/video4linux").glob("video*"):
            try:
                number, first = int(folder.name.removeprefix("video")), (folder / "index").read_text().strip() == "0"
                if first:  # the others are a camera's metadata
                    cameras[number] = (folder / "name").read_text(errors="replace").strip()[:80]
            except (OSError, ValueError):
                continue
        return dict(sorted(cameras.items()))
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    found = {}
    for number in range(_MAX_PROBED):
        capture = cv2.VideoCapture(number)
        if capture.isOpened():
            found[number] = ""
        capture.release()
    return found


def check_source(camera: str) -> None:
    """Looks whether a camera or a film is there, before libraries and models are read.

    Args:
        camera: a device's number, a path, or an address, which is not looked at.
    """
    if re.fullmatch("[0-9]{1,3}", camera):
        if sys.platform == "linux" and not Path(f"/dev/video{int(camera)}").exists():
            raise no_camera(int(camera), list_cameras())
    elif "://" not in camera and not Path(camera).exists():
        raise FileFormatError(f"{camera}: found no such file, expected a video")


def no_camera(number: int, cameras: Mapping[int, str]) -> FileFormatError:
    """The error of a camera that cannot be opened; ``cameras`` are those that are there."""
    others = {other: name for other, name in cameras.items() if other != number}
    named = ", ".join(f"{other} ({name})" if name else str(other) for other, name in others.items())
    expected = f"expected a camera that no other program holds, or another one's number: {named}"
    if not others:
        expected = "found no camera at this machine, expected one that is plugged in and that this user may open"
    return FileFormatError(f"camera {number}: cannot be opened; {expected}. {BY_FILE}")
