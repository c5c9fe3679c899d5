"""Frames of a video to be annotated: tracked, chosen so that they span what the face does, kept for a resumed run."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.content_keys import content_key, file_digest
from torchface.files.documents import read_json, write_json
from torchface.files.whole_files import make_folder
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.io.video import VideoFile, open_video
from torchface.landmarks.images.appearance.annotated_frames import AnnotatedFrame, choose_frames, save_annotated_frame

PROPOSALS = "proposals.json"
_FORMAT = "torchface proposals 2"
_METHOD = "annotation proposals/2"
_MAX_BYTES = 16 * 2**20
_MAX_FRAMES = 1000
_MAX_PIXEL_BYTES = 2**31
Tracker = Callable[[VideoFile], tuple[Tensor, Tensor | None]]
"""Landmarks (T,68,2) of a video, NaN where lost, and the confidence of each, (T,68) in [0,1]."""


@dataclass(frozen=True, eq=False)
class Annotation:
    """Frames to be annotated."""

    frames: list[AnnotatedFrame]  # images, with the user's landmarks where there are some already, else those proposed
    saved: list[str]  # names of those with the user's own
    folder: Path  # where files go


def prepare_annotation(video: Path, folder: Path, track: Tracker, count: int = 15, key: str = "") -> Annotation:
    """Tracks a video, unless that is done already, and gives the frames to annotate.

    Proposals are kept in the folder's ``proposals.json``; with the same video, count and key nothing is tracked anew.
    More frames asked for later hold the earlier ones.
    """
    if not 1 <= count <= _MAX_FRAMES:
        raise ValueRangeError(f"count: found {count}, expected 1 to {_MAX_FRAMES}")
    opened = open_video(video)
    made_from = content_key(_METHOD, video=opened.path, tracker=key)
    proposed = _read(folder / PROPOSALS, opened)
    if proposed is None or proposed.asked < count or proposed.key != made_from:
        landmarks, confidence = track(opened)
        chosen = choose_frames(landmarks, count, confidence)
        proposed = _Proposals(count, {int(i): landmarks[i].double() for i in chosen}, made_from)
        for number, points in _annotated(folder, opened).items():  # another tracker may choose other frames
            proposed.landmarks.setdefault(number, points)
        _write(folder, opened, proposed)
    wanted = list(proposed.landmarks)[:count]
    wanted += [i for i in proposed.landmarks if i not in wanted and _points(folder, opened, i).is_file()]
    if len(proposed.landmarks) < count:
        warnings.warn(
            f"{video.name}: found {len(proposed.landmarks)} of {opened.count} frames, {count} were asked for: "
            "frames without a sure face, or like another one, are left out",
            stacklevel=2,
        )
    images = _images(opened, wanted)
    frames, saved = [], []
    for number in wanted:
        name, points = _name(opened, number), proposed.landmarks[number]
        if _points(folder, opened, number).is_file():
            points = load_landmark_points(_points(folder, opened, number)).ibug()[:, :2]
            saved.append(name)
        frames.append(AnnotatedFrame(name, images[number], points))
    return Annotation(frames, saved, folder)


def write_proposals(annotation: Annotation) -> list[Path]:
    """Writes every frame with its proposed landmarks, to be edited elsewhere, but for the user's own; all these
    files."""
    paths = []
    for frame in annotation.frames:
        path = annotation.folder / f"{frame.name}.pts"
        paths.append(path if frame.name in annotation.saved else save_annotated_frame(frame, annotation.folder))
    return paths


@dataclass(frozen=True, eq=False)
class _Proposals:
    """How many frames were asked for, landmarks (68,2) by frame number in the order of choice, and what they were made
    from."""

    asked: int
    landmarks: dict[int, Tensor]
    key: str


def _name(video: VideoFile, number: int) -> str:
    return f"{video.path.stem}_{number:06d}"


def _points(folder: Path, video: VideoFile, number: int) -> Path:
    return folder / f"{_name(video, number)}.pts"


def _annotated(folder: Path, video: VideoFile) -> dict[int, Tensor]:
    """The landmarks (68,2) that lie in the folder for frames of the video, by frame number."""
    names = {_name(video, number): number for number in range(video.count)}
    paths = {names[path.stem]: path for path in sorted(folder.glob("*.pts")) if path.stem in names}
    return {number: load_landmark_points(path).ibug()[:, :2] for number, path in paths.items()}


def _images(video: VideoFile, numbers: list[int]) -> dict[int, Tensor]:
    """Frames (3,H,W), uint8, by number, in one pass: codecs seek wrongly too often."""
    wanted, images = set(numbers), {}
    most = _MAX_PIXEL_BYTES // (3 * video.width * video.height)
    if len(wanted) > most:
        raise ValueRangeError(
            f"count: found {len(wanted)} frames of {video.width} x {video.height} pixels, expected at most {most}, "
            f"which take {_MAX_PIXEL_BYTES >> 20} MiB"
        )
    for number, frame in enumerate(video.color_frames()):
        if number in wanted:
            images[number] = frame.clone()  # not the chunk that it came in
            if len(images) == len(wanted):
                break
    missing = wanted - set(images)
    if missing:
        raise FileFormatError(f"{video.path}: found no frame {min(missing)}, expected the video that was tracked")
    return images


def _identity(video: VideoFile) -> dict[str, Any]:
    return {
        "video": video.path.name,
        "frames": video.count,
        "width": video.width,
        "height": video.height,
        "sha256": file_digest(video.path),
    }


def _write(folder: Path, video: VideoFile, proposals: _Proposals) -> None:
    document = {
        "format": _FORMAT,
        **_identity(video),
        "asked": proposals.asked,
        "key": proposals.key,
        "proposals": [
            {"frame": number, "landmarks": [[round(x, 3) for x in row] for row in points.tolist()]}
            for number, points in proposals.landmarks.items()
        ],
    }
    write_json(make_folder(folder) / PROPOSALS, document, indent=None)


def _read(path: Path, video: VideoFile) -> _Proposals | None:
    if not path.exists():
        return None
    document = read_json(path, _FORMAT, _MAX_BYTES)
    expected = _identity(video)
    found = {key: document[key].found for key in expected}
    if found != expected:
        content = " of other content" if found["sha256"] != expected["sha256"] else ""
        raise FileFormatError(
            f"{path}: found proposals for {found['video']!r} ({found['frames']} frames of {found['width']} x "
            f"{found['height']}{content}), expected {video.path.name!r} ({video.count} of {video.width} x "
            f"{video.height}): name another folder, or remove this file"
        )
    landmarks = {
        row["frame"].whole(0, video.count - 1): row["landmarks"].tensor(68, 2, expected="68 finite points")
        for row in document["proposals"].rows(1, _MAX_FRAMES)
    }
    return _Proposals(document["asked"].whole(), landmarks, document["key"].text())
