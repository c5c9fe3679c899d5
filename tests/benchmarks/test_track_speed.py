"""How many frames of 1280 x 720 pixels a second ``torchface track`` solves and draws, beside MediaPipe's landmarker."""

import time
from pathlib import Path

import pytest
import torch
from expression_methods import frames, mean_head, mediapipe

from torchface import save_rig
from torchface.io.video import open_video, write_video
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_page import write_track_page
from torchface.workflows.track.track_video import track_video
from train.expression_films import Settings, render
from train.rendered_people.webcam_film import Film

pytestmark = [pytest.mark.real, pytest.mark.bench]

TIMES = 8  # that four seconds are played, forward and backward


def seconds_of(work: object, *given: object) -> float:
    """Processor time."""
    start = time.process_time()
    work(*given)
    return time.process_time() - start


def test_the_whole_way(data: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    pytest.importorskip("ai_edge_litert")
    ict = data / "ict_facekit" / "FaceXModel"
    film: Film = render(Settings(out=tmp_path, ict=ict, films=("laugh_hd",)))["laugh_hd"]
    once = list(frames(film))
    played = [frame[None] for number in range(TIMES) for frame in (once if number % 2 == 0 else reversed(once))]
    video = write_video(played, tmp_path / "long.mp4", 30.0)
    count = open_video(video.path).count
    save_rig(mean_head(film), tmp_path / "rig.glb")
    out, done = tmp_path / "out", []

    def track(overlay: str, path: Path = video.path) -> None:
        done.append(track_video(path, tmp_path / "rig.glb", out, TrackSettings(overlay=overlay)))

    track("none", film.path)  # graphs are made once
    whole = seconds_of(track, "none")
    reread = seconds_of(track, "none")  # what a second run takes that has all but the overlay
    overlay = seconds_of(track, "side") - reread
    report = seconds_of(write_track_page, done[1], out)
    peer = seconds_of(mediapipe(data / "peers" / "face_landmarker.task"), video)
    print(f"\n{count} frames of {video.width} x {video.height}, processor time")
    print(f"track, from decoding to files {count / whole:6.1f} frames a second")
    print(f"its overlay                   {count / overlay:6.1f}")
    print(f"MediaPipe's 52 blendshapes    {count / peer:6.1f}")
    print(f"its report                    {report:6.2f} seconds")
    assert whole < 3 * peer
