"""What the camera's shake did to the picture is found again from a helmet point and two markers."""

from dataclasses import replace

import pytest
import torch

from torchface.capture.action_units import RegionVideo
from torchface.capture.action_units.stabilization import PointTracker, steady_transforms
from torchface.errors import AlignmentError, ShapeError
from train.filmed_performers.camera_stage import SIDE_MARKERS, RecordedSession
from train.filmed_performers.head_camera_images import MARKER_RADIUS
from train.filmed_performers.helmet_camera import HELMET_POINT, helmet_camera


def test_points_are_followed_through_the_shake(session: RecordedSession) -> None:
    frames = torch.cat(list(session.video.chunks()))
    labels = session.labels
    tracker = PointTracker(frames[labels.neutral], torch.tensor(labels.helmet), torch.tensor(labels.markers))
    found = tracker(frames)
    camera = helmet_camera(session.video.width, session.video.height)
    helmet = torch.tensor([HELMET_POINT], dtype=torch.float64)
    truth = torch.stack([
        replace(camera, rotation=r, translation=t).project(helmet)[0]
        for r, t in zip(session.rotation, session.translation, strict=True)
    ])  # fmt: skip
    assert (truth - truth[0]).norm(dim=1).max() > 0.6
    assert not found.isnan().any()
    error = found[:, 0] - truth
    error -= error.mean(0)  # where on the bolt the point was set, with the noise of one frame
    assert error.norm(dim=1).quantile(0.95) < 0.45
    # The markers themselves, where the true markers were.
    rows = [session.recording.take.markers.names.index(name) for name in SIDE_MARKERS]
    centres = session.recording.markers[:, rows].double()
    seen = torch.stack([
        replace(camera, rotation=r, translation=t).project(c)
        for r, t, c in zip(session.rotation, session.translation, centres, strict=True)
    ])  # fmt: skip
    assert MARKER_RADIUS > 0
    off = found[:, 1:] - seen
    assert (off - off.mean(0)).norm(dim=-1).quantile(0.95) < 0.5


def test_the_similarity_of_three_points_is_recovered() -> None:
    generator = torch.Generator().manual_seed(0)
    reference = torch.tensor([[60.0, 5.0], [110.0, 70.0], [12.0, 72.0]])
    angle = 0.1 * torch.randn(20, generator=generator)
    scale = 1 + 0.05 * torch.randn(20, generator=generator)
    shift = 3 * torch.randn(20, 2, generator=generator)
    turn = torch.stack([torch.stack([angle.cos(), -angle.sin()], 1), torch.stack([angle.sin(), angle.cos()], 1)], 1)
    matrix = scale[:, None, None] * turn
    tracked = reference @ matrix.transpose(1, 2) + shift[:, None]
    expected = torch.cat([matrix, shift[:, :, None]], dim=2)
    torch.testing.assert_close(steady_transforms(reference, tracked), expected, atol=1e-4, rtol=0)
    gap = tracked.clone()
    gap[7, 1] = torch.nan  # its neighbours stand in
    filled = steady_transforms(reference, gap)
    assert not filled.isnan().any()
    torch.testing.assert_close(filled[8], expected[8], atol=1e-4, rtol=0)
    gap[::3, 2] = torch.nan
    with pytest.raises(AlignmentError, match=r"the second of markers was lost in 3.%"):
        steady_transforms(reference, gap)


def test_a_steady_picture_changes_less_at_rest(session: RecordedSession, regions: RegionVideo) -> None:
    from torchface.capture.action_units.painted_pattern import pattern_levels
    from torchface.capture.action_units.painted_regions import region_grid, sample_regions

    video, labels = session.video, session.labels
    frames = torch.cat(list(video.chunks())).float() / 255
    grid = region_grid(labels.regions, regions.names, regions.patterns.shape[-1], video.width, video.height)
    still = torch.eye(2, 3).expand(len(frames), 2, 3)
    loose = sample_regions(frames, grid, still)
    loose = pattern_levels(loose[labels.neutral], regions.names).pattern(loose)
    rest = session.performance.intensities.sum(1) == 0
    wobble = [patterns[rest].std(0).mean() for patterns in (regions.patterns, loose)]
    assert wobble[0] < 0.75 * wobble[1]


def test_nothing_to_follow_is_said(session: RecordedSession) -> None:
    frame = session.video.frame(0)
    helmet, markers = torch.tensor(session.labels.helmet), torch.tensor(session.labels.markers)
    with pytest.raises(AlignmentError, match=r"helmet is at .* inside the image"):
        PointTracker(frame, torch.tensor([500.0, 3.0]), markers)
    with pytest.raises(AlignmentError, match="helmet: found nothing to follow at"):
        PointTracker(torch.full_like(frame, 90), helmet, markers)
    with pytest.raises(ShapeError, match="frames"):
        PointTracker(frame, helmet, markers)(frame[None, :50])


def test_a_marker_that_is_hidden_counts_as_lost_and_is_found_again() -> None:
    """A picture that shifts; a second blob comes near while the first is covered."""
    step = torch.arange(60.0)
    y, x = torch.meshgrid(step, step, indexing="ij")

    def blob(cx: float, cy: float) -> torch.Tensor:
        return torch.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 3)

    corner = 0.5 * ((x - 30).abs() < 5) * ((y - 8).abs() < 4)
    frames = []
    for t in range(30):
        shift = 2 * torch.sin(torch.tensor(t / 4.0)).item()
        picture = 0.1 + torch.roll(corner, round(shift), 1) + blob(50 + round(shift), 40)
        hidden = 10 <= t < 14
        picture = picture + (0 if hidden else blob(10 + round(shift), 40)) + blob(10 + round(shift), 50)
        frames.append((255 * picture.clamp(0, 1)).byte())
    tracker = PointTracker(frames[0], torch.tensor([30.0, 8.0]), torch.tensor([[10.0, 40.0], [50.0, 40.0]]))
    found = tracker(torch.stack(frames))
    assert found[10:14, 1].isnan().all()
    shift = torch.tensor([round(2 * torch.sin(torch.tensor(t / 4.0)).item()) for t in range(30)])
    seen = torch.ones(30, dtype=torch.bool)
    seen[10:14] = False
    assert (found[seen, 1, 0] - 10 - shift[seen]).abs().max() < 0.2
    assert (found[:, 2, 0] - 50 - shift).abs().max() < 0.2
    assert (found[:, 0, 0] - 30 - shift).abs().max() < 0.2
