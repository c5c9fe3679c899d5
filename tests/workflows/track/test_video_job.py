"""A video of a batch: its picture on the contact sheet."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.workflows.track.conftest import Done
from torchface import BlendshapeRig
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.track import video_job
from torchface.workflows.track.video_job import VideoJob


def test_a_batchs_picture_shows_the_head_with_the_films_skin(
    done: Done, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = done.tracked.rig
    green = torch.tensor([0.0, 1, 0]).expand(len(rig.vertices), 3)
    neutral = replace(rig.neutral, texture=None, colors=green)
    head = SimpleNamespace(shown=BlendshapeRig(neutral, rig.deltas, rig.names), lines=list)
    tracked = replace(done.tracked, head=head)
    monkeypatch.setattr(video_job, "track_video", lambda *_: tracked)
    monkeypatch.setattr(video_job, "write_track_page", lambda *_: tmp_path / "index.html")
    picture = VideoJob(None).run(BatchItem("film", tmp_path / "film.mp4"), tmp_path).picture
    red, light, blue = picture[:, 200, 160]
    assert light > 0.3
    assert max(red, blue) < 0.5 * light
