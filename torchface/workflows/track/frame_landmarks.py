"""Landmarks of a video's frames, kept piece by piece: a killed run goes on behind them."""

from __future__ import annotations

from itertools import chain, islice

from torchface.io.video import VideoFile
from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.boxes.face_box import find_faces
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.landmarks.images.tracking.video_landmarks import naming_the_frame
from torchface.progress import Progress
from torchface.workflows.track.track_state import TrackedFrames, TrackState

PIECE = 64
"""Frames whose landmarks are kept at a time: what a killed run loses at most."""


def track_frames(
    clip: VideoFile,
    finder: LandmarkFinder,
    appearance: AppearanceModel | None,
    face: int,
    state: TrackState,
    progress: Progress,
) -> int:
    """Landmarks of all frames into the state; how many faces the first frame shows."""
    tracker = LandmarkTracker(finder, appearance, face=face)
    kept, at, faces = state.done, 0, 0
    last = state.frames()
    if len(last):
        # A run that was killed goes on with all that it knew, and so gives the same landmarks.
        tracker.resume(last.landmarks[-1], last.confidence[-1], state.memory)
    frames = clip.color_frames()
    for first in frames:
        if at == 0:
            faces = len(find_faces(first))
        piece = chain([first], islice(frames, PIECE - 1))  # one by one: 64 frames in 4K take half a gigabyte
        if at < kept:
            at += sum(1 for _ in piece)
            progress("tracking landmarks", at, max(clip.count, at))
            continue
        found = []
        for frame in piece:  # a frame's box is the one before's
            with naming_the_frame(at):
                found.append(tracker.step(frame))
            at += 1
            progress("tracking landmarks", at, max(clip.count, at))
        state.append(TrackedFrames.of_faces(found), tracker.memory)
    return faces
