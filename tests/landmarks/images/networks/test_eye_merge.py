"""Two networks' lids as one: by their deviations, and only where the eye is seen."""

import torch

from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS
from torchface.landmarks.images.networks.eye_merge import merged_lids


def test_lids_lie_between_by_inverse_variance_and_stay_where_the_eye_is_hidden() -> None:
    generator = torch.Generator().manual_seed(0)
    landmarks = 100 * torch.rand(3, 68, 2, generator=generator)
    offset = torch.tensor([4.0, -2.0])
    lids = torch.stack([landmarks[:, list(rows)] + offset for rows in EYE_LANDMARKS], 1)
    visibility = torch.tensor([[1.0, 0.1], [0.9, 0.9], [0.55, 0.0]])
    found, deviation = merged_lids(landmarks, torch.full((3, 68), 3.0), lids, torch.full((3, 2, 6), 1.0), visibility)
    # A ninth of the variance moves a landmark nine tenths of the way; half a share of it 4.5 / 5.5.
    share = torch.tensor([[0.9, 0.0], [0.9, 0.9], [4.5 / 5.5, 0.0]]).repeat_interleave(6, 1)
    torch.testing.assert_close(found[:, 36:48], landmarks[:, 36:48] + share[..., None] * offset)
    torch.testing.assert_close(deviation[:, 36:48], 3 * (1 - share).sqrt())
    outside = [*range(36), *range(48, 68)]
    assert torch.equal(found[:, outside], landmarks[:, outside])
    assert bool((deviation[:, outside] == 3).all())
