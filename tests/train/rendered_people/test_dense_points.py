"""Points of the face's surface: mirrored twins, apart as they should be, and on lids and lips where these meet."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.io import load_ict_facekit, load_identity_modes
from torchface.shape_names import ARKIT
from train.rendered_people.dense_points import COUNT, dense_places
from train.rendered_people.face_picture import draw_pictures
from train.rendered_people.head_kind import HeadKind, people_kind, performer_kind
from train.rendered_people.people import closed_lids


@pytest.fixture(scope="module")
def performers() -> HeadKind:
    return performer_kind()


def test_each_point_has_its_mirrored_twin() -> None:
    places, mirror = dense_places()
    assert places.shape == (COUNT, 3)
    assert torch.equal(mirror[mirror], torch.arange(COUNT))
    off = (places[mirror] - places * torch.tensor([-1.0, 1, 1])).norm(dim=1)
    assert float(off.max()) < 1e-3  # millimetres
    apart = torch.cdist(places, places).fill_diagonal_(1e9).amin(1)
    assert float(apart.min()) > 0.5  # millimetres
    assert float(apart.max()) < 17  # under the jaw


def test_points_of_lids_meet_when_they_close_and_those_of_lips_part_when_the_jaw_opens(performers: HeadKind) -> None:
    rest, shut, opened = (_points(performers, weights) for weights in ({}, _SHUT, {"jawOpen": 1.0}))
    moved = (shut - rest).norm(dim=1)
    assert int((moved > 3).sum()) >= 8  # lids
    lower = (opened - rest)[:, 1] < -10
    assert 30 < int(lower.sum()) < 250  # of the lower lip, jaw and chin


_SHUT = {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}


def _points(kind: HeadKind, weights: dict[str, float]) -> Tensor:
    row = torch.tensor([weights.get(name, 0.0) for name in ARKIT])
    head = kind.draw(torch.Generator().manual_seed(0))
    return closed_lids(kind, head, row)[kind.dense]


def test_pictures_have_the_weights_that_they_show(performers: HeadKind) -> None:
    for picture in draw_pictures((performers,), (1.0,), 0, 2, seed=3):
        assert picture.points.shape == (COUNT, 2)
        assert picture.weights.shape == (52,)
        assert float(picture.weights.min()) >= 0
        assert float(picture.weights.max()) <= 1
        spots = picture.points[picture.point_visible].round().long()
        shown = (picture.rgba[3] == 255).float()
        near = torch.nn.functional.max_pool2d(shown[None], 3, 1, 1)[0]  # points on an outline round to beside it
        assert bool(near[spots[:, 1], spots[:, 0]].all())


@pytest.mark.bench
@pytest.mark.real
def test_points_of_peoples_heads_lie_where_the_performers_do(performers: HeadKind, ict_folder: Path) -> None:
    people = people_kind(load_ict_facekit(ict_folder), load_identity_modes(ict_folder))
    places, mirror = dense_places()
    apart = (people.canonical[people.dense] - places).norm(dim=1)
    assert float(apart.median()) < 3  # millimetres
    assert float(apart.quantile(0.95)) < 7
    lower = places[:, 1] < -60
    opened = (_points(people, {"jawOpen": 1.0}) - _points(people, {}))[:, 1]
    assert float(opened[lower].mean()) < -5
    assert float(opened[~lower].abs().max()) < 12
    # Twins of symmetric heads move alike.
    shut = (_points(people, _SHUT) - _points(people, {}))[:, 1]
    torch.testing.assert_close(shut[mirror], shut, atol=4.0, rtol=0)
