"""Frames for annotation span what a face does, whatever the head does meanwhile."""

import math
from pathlib import Path

import pytest
import torch

from planted.portrait_video import EXPRESSIONS, expression_weights
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.appearance.annotated_frames import (
    AnnotatedFrame,
    choose_frames,
    load_annotated_frames,
    save_annotated_frame,
)
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def performance() -> tuple[torch.Tensor, torch.Tensor]:
    """Landmarks (T,68,2) of a face that makes one expression after another, and which one each frame is nearest to."""
    rig = performer(texture=False)
    ids = rig.neutral.annotations.landmarks
    poses = expression_weights(rig.names, list(EXPRESSIONS.values()))
    rise = torch.cat([torch.linspace(0, 1, 6), torch.linspace(0.8, 0, 5)])
    weights = (rise[None, :, None] * poses[:, None]).flatten(0, 1)
    points = rig(weights)[:, ids].double()
    pixels = look_at(points[0].mean(0), 0.0, width=300, height=300).project(points)
    generator = torch.Generator().manual_seed(0)
    angle, size = torch.rand(2, len(pixels), generator=generator, dtype=torch.float64)
    angle, size = 0.6 * (angle - 0.5), 0.7 + 0.6 * size
    turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).view(-1, 2, 2) * size[:, None, None]
    moved = (pixels - 150) @ turn + 150 + 60 * torch.rand(len(pixels), 1, 2, generator=generator)
    return moved.float(), torch.arange(len(poses)).repeat_interleave(len(rise))


def test_every_expression_is_chosen_and_rest_comes_first(performance: tuple[torch.Tensor, torch.Tensor]) -> None:
    landmarks, expression = performance
    chosen = choose_frames(landmarks, 15)
    assert len(set(chosen.tolist())) == 15
    poses = len(EXPRESSIONS)
    first = int(chosen[0]) % 11
    assert first in (0, 1, 2, 8, 9, 10) or int(expression[chosen[0]]) == 0  # hardly any expression
    assert len(set(expression[chosen[1:]].tolist())) >= poses - 4  # lips to both sides, say, may speak for each other
    strength = torch.cat([torch.linspace(0, 1, 6), torch.linspace(0.8, 0, 5)]).repeat(poses)
    assert strength[chosen[1:]].mean() > 0.85  # extremes, not what lies on the way to them


def test_more_frames_hold_the_fewer_and_poses_do_not_matter(performance: tuple[torch.Tensor, torch.Tensor]) -> None:
    landmarks, _ = performance
    chosen = choose_frames(landmarks, 12)
    assert torch.equal(chosen[:5], choose_frames(landmarks, 5))
    angle = math.radians(17)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    again = choose_frames(3 * landmarks @ turn + 40, 12)
    # Several frames show the face at rest, any may be the first; beside an extreme lie frames as good.
    assert int((again[1:] - chosen[1:]).abs().max()) <= 6


def test_lost_and_astray_frames_are_left_out(performance: tuple[torch.Tensor, torch.Tensor]) -> None:
    landmarks, _ = performance
    spoilt = landmarks.clone()
    best = choose_frames(landmarks, 6)
    spoilt[best[1], 5] = torch.nan
    spoilt[best[2]] = 100 * torch.rand(68, 2, generator=torch.Generator().manual_seed(1))  # no face at all
    chosen = choose_frames(spoilt, 15).tolist()
    assert int(best[1]) not in chosen
    assert int(best[2]) not in chosen
    confidence = torch.ones(landmarks.shape[:2])
    confidence[best[3]] = 0.1
    assert int(best[3]) not in choose_frames(landmarks, 15, confidence).tolist()


def test_fewer_come_back_where_fewer_differ() -> None:
    one = torch.rand(1, 68, 2, generator=torch.Generator().manual_seed(2))
    assert choose_frames(one.expand(9, -1, -1), 4).tolist() == [0]


def test_bad_input_to_the_choice_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"expected \(T,68,2\)"):
        choose_frames(torch.zeros(5, 12, 2))
    with pytest.raises(ValueRangeError, match="count: found 0"):
        choose_frames(torch.rand(5, 68, 2), 0)
    with pytest.raises(ValueRangeError, match="found a face in none of 3 frames"):
        choose_frames(torch.full((3, 68, 2), torch.nan))


def test_annotated_frames_come_back_from_their_folder(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(3)
    frames = [
        AnnotatedFrame(name, torch.rand(3, 20, 30, generator=generator), 20 * torch.rand(68, 2, generator=generator))
        for name in ("b", "a")
    ]
    for frame in frames:
        save_annotated_frame(frame, tmp_path / "new")
    (tmp_path / "new" / "._hidden.pts").write_bytes(b"\0\5\x16\7Mac OS X")
    again = load_annotated_frames(tmp_path / "new")
    assert [frame.name for frame in again] == ["a", "b"]
    torch.testing.assert_close(again[1].landmarks, frames[0].landmarks, atol=1e-3, rtol=0)
    torch.testing.assert_close(again[1].image, frames[0].image, atol=0.51 / 255, rtol=0)
    (tmp_path / "new" / "c.png").write_bytes((tmp_path / "new" / "a.png").read_bytes())  # not annotated yet
    assert len(load_annotated_frames(tmp_path / "new")) == 2
    (tmp_path / "new" / "a.png").unlink()
    with pytest.raises(FileFormatError, match="found no image beside it"):
        load_annotated_frames(tmp_path / "new")


def test_folders_without_annotated_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="found no such folder"):
        load_annotated_frames(tmp_path / "none")
    with pytest.raises(FileFormatError, match=r"found no \.pts file"):
        load_annotated_frames(tmp_path)
    (tmp_path / "a.pts").write_text("n_points: 2\n{\n1 1\n2 2\n}\n")
    save_annotated_frame(AnnotatedFrame("b", torch.rand(3, 20, 20), torch.rand(68, 2)), tmp_path)
    (tmp_path / "a.png").write_bytes((tmp_path / "b.png").read_bytes())
    with pytest.raises(ShapeError, match="found 2, expected 68"):
        load_annotated_frames(tmp_path)
