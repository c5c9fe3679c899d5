"""The hair's colour of washed-out pictures."""

import torch

from torchface.modeling.photographs.hair_cap import without_veil


def test_hair_is_as_dark_beside_skin_as_without_the_veil() -> None:
    skin, hair = torch.tensor([0.7, 0.5, 0.4]), torch.tensor([0.2, 0.15, 0.1])
    picture = skin[:, None, None].expand(3, 60, 60).clone()
    picture[:, :20], picture[:, 30:38, 10:18] = hair[:, None, None], 0.07  # hair, and a nostril
    head = torch.tensor([[2.0, 2.0], [58.0, 58.0]])
    assert torch.equal(without_veil(hair, skin, [picture], [head]), hair)  # black is there
    veil = 0.3
    veiled, veiled_skin, veiled_hair = (veil + (1 - veil) * one for one in (picture, skin, hair))
    found = without_veil(veiled_hair, veiled_skin, [veiled], [head])
    shares = [
        float(one.mean() / of.mean()) for one, of in ((hair, skin), (veiled_hair, veiled_skin), (found, veiled_skin))
    ]
    assert abs(shares[2] - shares[0]) < 0.15 * (shares[1] - shares[0])
    assert torch.equal(without_veil(veiled_skin + 0.1, veiled_skin, [veiled], [head]), veiled_skin + 0.1)  # fair hair
    outside = head + 500.0  # a head beside the picture has nothing that is dark
    assert bool(without_veil(veiled_hair, veiled_skin, [veiled], [outside]).isfinite().all())
