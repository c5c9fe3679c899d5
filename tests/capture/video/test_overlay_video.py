"""From a film on disk to a painted film on disk, a chunk at a time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.capture.video.painted_video import overlay_video
from torchface.errors import ShapeError
from torchface.io.video import open_video
from torchface.rendering.point_light import PointLight
from torchface.synthetic import performer
from torchface.synthetic.stages.light_stage import LightStageSettings, LitVideo, render_lit_video

LIGHT = PointLight(torch.full((3,), 0.3), torch.full((3,), 0.6), torch.tensor([-500.0, -200, 0]))
BLUE = torch.tensor([0.0, 0.0, 1.0, 1.0])[:, None, None].expand(4, 16, 16)


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> LitVideo:
    rig = performer(texture=True)
    folder = tmp_path_factory.mktemp("light")
    settings = LightStageSettings(width=96, height=80, samples=1)
    weights = 0.5 * torch.rand(5, len(rig.names), generator=torch.Generator().manual_seed(0))
    return render_lit_video(folder / "film.avi", rig, weights, LIGHT, 5.0, torch.Generator().manual_seed(1), settings)


def test_every_frame_with_a_face_is_painted(tmp_path: Path, film: LitVideo) -> None:
    told: list[tuple[int, int]] = []
    meshes = film.vertices.clone()
    meshes[3] = math.nan  # no face was found there
    painted = overlay_video(
        open_video(film.video.path).color_chunks(2),
        meshes,
        film.rig.neutral,
        BLUE,
        LIGHT,
        film.cameras,
        tmp_path / "painted.avi",
        film.video.fps,
        progress=lambda _, done, of: told.append((done, of)),
    )
    before = torch.cat(list(open_video(film.video.path).color_chunks(8)))
    after = torch.cat(list(open_video(painted.path).color_chunks(8)))
    assert after.shape == before.shape
    assert painted.fps == film.video.fps
    blue = (after[:, 2] > after[:, 0] + 60).float().mean((1, 2))
    assert bool((blue[[0, 1, 2, 4]] > 0.08).all())
    assert torch.equal(after[3], before[3])
    assert torch.equal(after[:, :, :4, :4], before[:, :, :4, :4])
    assert told == [(i + 1, 5) for i in range(5)]


def test_a_video_of_another_length_leaves_no_file(tmp_path: Path, film: LitVideo) -> None:
    mesh, chunks = film.rig.neutral, open_video(film.video.path).color_chunks
    six, cameras = torch.cat([film.vertices, film.vertices[:1]]), [*film.cameras, film.cameras[0]]
    with pytest.raises(ShapeError, match="found 5 frames for 6 meshes"):
        overlay_video(chunks(2), six, mesh, BLUE, LIGHT, cameras, tmp_path / "long.avi", 5.0)
    with pytest.raises(ShapeError, match="more frames than the 4 meshes"):
        overlay_video(chunks(2), film.vertices[:4], mesh, BLUE, LIGHT, film.cameras[:4], tmp_path / "short.avi", 5.0)
    with pytest.raises(ShapeError, match="expected"):
        overlay_video(chunks(2), film.vertices, mesh, BLUE, LIGHT, film.cameras[:4], tmp_path / "odd.avi", 5.0)
    assert list(tmp_path.iterdir()) == []


def test_frames_are_taken_as_they_come(tmp_path: Path, film: LitVideo) -> None:
    """Nothing is read ahead: a long video never lies in memory."""
    ahead, done = [0], [0]

    def frames() -> Iterator[Tensor]:
        for frame in open_video(film.video.path).color_frames():
            ahead[0] += 1
            assert ahead[0] <= done[0] + 2
            yield frame

    def progress(step: str, count: int = 0, total: int = 0) -> None:
        done[0] = count

    path = tmp_path / "painted.avi"
    overlay_video(frames(), film.vertices, film.rig.neutral, BLUE, LIGHT, film.cameras, path, 5.0, progress=progress)
    assert done == [5]
