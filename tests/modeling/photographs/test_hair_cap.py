"""Hair as a cap: where it ends, and its colour."""

import torch

from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.modeling.photographs.hair_cap import HairCap, _hair_color
from torchface.modeling.photographs.skin_mask import FacePlaces
from torchface.synthetic import neutral_head


def test_long_hair_goes_on_behind_the_ears_and_leaves_them_bare() -> None:
    places = FacePlaces.of(neutral_head(texture=False))
    at = torch.tensor([[0.0, -1.1, places.ears - 0.9], [0.9, -0.2, places.ears - 0.35], [0.0, 1.0, places.ears - 0.9]])
    line = torch.full((17,), 0.6, dtype=torch.float64)
    short, long = (HairCap(torch.zeros(3), line, places, one).share(at.double()) for one in (False, True))
    assert float(short[0]) < 0.1  # the neck
    assert float(long[0]) > 0.9
    assert float(torch.stack([short, long])[:, 1].max()) < 0.1  # an ear
    assert float(torch.stack([short, long])[:, 2].min()) > 0.9


def test_hair_grows_thin_toward_an_uneven_edge() -> None:
    places = FacePlaces.of(neutral_head(texture=False))
    across, up = torch.linspace(-0.4, 0.4, 161, dtype=torch.float64), torch.linspace(0.3, 0.9, 601, dtype=torch.float64)
    x, y = torch.meshgrid(across, up, indexing="ij")
    at = torch.stack([x, y, torch.full_like(x, float(places.ears) + 1.0)], dim=-1)
    cap = HairCap(torch.full((3,), 0.3), torch.full((17,), 0.6, dtype=torch.float64), places)
    share = cap.share(at.flatten(0, 1)).view_as(x)
    assert float(share[:, up < 0.4].max()) == 0
    assert float(share[:, up > 0.8].min()) > 0.95
    step = up[1] - up[0]
    begins, ends = (((share < limit) * step).sum(1) for limit in (0.1, 0.9))
    assert float((ends - begins).mean()) > 0.05  # 5 mm from the last strands to whole hair
    assert float(begins.std()) > 0.015


def test_hair_over_and_behind_the_ears_is_whole_where_its_line_falls_steeply() -> None:
    places = FacePlaces.of(neutral_head(texture=False))
    behind, up = torch.meshgrid(torch.linspace(0.25, 0.9, 60), torch.linspace(0.45, 0.6, 40), indexing="ij")
    at = torch.stack([torch.full_like(up, 0.8), up, places.ears - behind], dim=-1).double().flatten(0, 1)
    share = HairCap(torch.zeros(3), torch.full((17,), 0.6, dtype=torch.float64), places).share(at)
    assert float(share.min()) > 0.9


def test_a_fringe_hangs_low_over_the_foreheads_middle_and_not_at_one_temple() -> None:
    places, across = FacePlaces.of(neutral_head(texture=False)), torch.linspace(-1, 1, 17, dtype=torch.float64)
    usual = 0.76 - 0.28 * across.square()
    aside = torch.where(across > 0.4, usual - 0.4, usual)
    whole = torch.full((17,), 0.4, dtype=torch.float64)
    fringes = [HairCap(torch.zeros(3), line, places).fringe for line in (usual, usual - 0.1, aside, whole)]
    assert fringes == [False, False, False, True]


def test_bluish_hair_is_grey_unless_it_is_dyed() -> None:
    for hair, found in (((0.15, 0.23, 0.25), (0.21, 0.21, 0.21)), ((0.1, 0.2, 0.6),) * 2, ((0.3, 0.2, 0.1),) * 2):
        image = torch.tensor(hair)[:, None, None].expand(3, 60, 60)
        shares = torch.zeros(len(PARTS), 60, 60)
        shares[PARTS.index("hair"), :30] = 1.0
        points = torch.full((68, 2), 40.0, dtype=torch.float64)
        points[:, 0] = torch.linspace(15, 45, 68).double()
        color = _hair_color([image], [FaceParts(shares, torch.eye(2, 3, dtype=torch.float64))], [points], True)
        assert (color - torch.tensor(found)).abs().max() < 0.01
