"""Frames in which a face rests, of a take that laughs most of the time."""

import torch

from torchface.capture.own_rig.resting_frames import activity_of_readings, activity_of_weights, resting_share


def test_rest_is_found_among_laughs() -> None:
    generator = torch.Generator().manual_seed(0)
    activity = torch.cat([torch.rand(10, generator=generator) * 0.2, 2 + torch.rand(90, generator=generator)])
    share = resting_share(activity)
    assert float(share[:10].min()) > 0.8
    assert float(share[10:].max()) < 0.05
    assert float(resting_share(torch.full((30,), 0.7)).min()) == 1.0  # who never rests is taken as at rest
    assert resting_share(torch.full((3,), torch.nan)).tolist() == [0.0] * 3


def test_blinks_and_looks_are_rest() -> None:
    names = ["eyeBlinkLeft", "eyeLookUp_L", "jawOpen"]
    assert activity_of_weights(torch.tensor([[1.0, 1, 0], [0, 0, 1]]), names).tolist() == [0.0, 1.0]
    read = torch.tensor([[0.9, 0.4], [0.3, 0.4]]).repeat_interleave(10, 0)  # the second reads 0.4 too much always
    known = activity_of_readings(read, torch.full_like(read, 0.1), ["jawOpen", "mouthFunnel"])
    assert torch.allclose(known, torch.tensor([0.6, 0.0]).repeat_interleave(10), atol=1e-6)
    assert bool(
        torch.isnan(activity_of_readings(read, torch.full_like(read, torch.inf), ["jawOpen", "cheekPuff"])).all()
    )


def test_a_laugh_that_is_read_less_surely_is_no_rest() -> None:
    read = torch.zeros(60, 2)
    read[20:] = 0.9
    deviation = 0.1 + 0.4 * read  # as networks state them
    share = resting_share(activity_of_readings(read, deviation, ["mouthSmileLeft", "mouthSmileRight"]))
    assert float(share[:20].min()) > 0.9
    assert float(share[20:].max()) < 0.1
