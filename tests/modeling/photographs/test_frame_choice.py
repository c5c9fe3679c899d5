"""Frames that differ are chosen, and none whose landmarks are wrong or blurred."""

import pytest
import torch

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.modeling.photographs.frame_choice import choose_frames
from torchface.synthetic import performer


def test_frames_of_all_angles_and_expressions_are_chosen() -> None:
    rig = performer(texture=False)
    marks, weights = rig.neutral.landmarks, torch.zeros(40, len(rig.names))
    weights[20:, rig.names.index("jawOpen")] = 0.7
    yaws = torch.tensor([0.0] * 10 + [35.0] * 10 + [0.0] * 10 + [-35.0] * 10)
    faces = rig(weights)[:, marks].double()
    pixels = torch.stack([look_at(f.mean(0), float(a)).project(f) for f, a in zip(faces, yaws, strict=True)])
    pixels += 0.3 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0)).double()
    rest, trust = rig.vertices[marks], torch.ones(40, 68)
    chosen = choose_frames(rest, pixels, trust, 4)
    assert sorted((chosen // 10).tolist()) == [0, 1, 2, 3]
    trust[:10] = 0.2  # the first group is hardly seen
    assert bool((choose_frames(rest, pixels, trust, 4) >= 10).all())
    sharpness = torch.arange(40.0) % 10
    assert bool((choose_frames(rest, pixels, torch.ones(40, 68), 4, sharpness) % 10 >= 4).all())


def test_without_a_face_there_is_no_frame() -> None:
    rest = performer(texture=False).vertices[:68]
    with pytest.raises(ValueRangeError, match="found no frame that shows a face"):
        choose_frames(rest, torch.full((3, 68, 2), torch.nan), torch.zeros(3, 68), 2)
    with pytest.raises(ShapeError, match=r"landmarks \(3, 60, 2\)"):
        choose_frames(rest, torch.zeros(3, 60, 2), torch.zeros(3, 68), 2)
