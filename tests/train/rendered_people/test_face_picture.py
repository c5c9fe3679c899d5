"""Pictures of synthetic people: drawn by number, with lids that meet and landmarks where annotators put them."""

import torch

from torchface.landmarks.images.ibug_68 import as_annotated
from torchface.shape_names import ARKIT
from train.rendered_people.face_picture import SIZE, draw_pictures
from train.rendered_people.head_kind import performer_kind
from train.rendered_people.people import closed_lids


def test_a_picture_depends_on_its_number_and_the_seed_alone() -> None:
    kinds = (performer_kind(),)
    both = draw_pictures(kinds, (1.0,), 4, 2, seed=3)
    again = draw_pictures(kinds, (1.0,), 5, 1, seed=3)[0]
    assert torch.equal(both[1].rgba, again.rgba)
    assert torch.equal(both[1].landmarks, again.landmarks)
    assert not torch.equal(both[0].landmarks, again.landmarks)
    # Landmarks that are visible lie on the person, whose pixels are opaque.
    for picture in both:
        spots = picture.landmarks[17:][picture.visible[17:]].round().long()
        assert bool(((spots >= 0) & (spots < SIZE)).all())
        assert float((picture.rgba[3, spots[:, 1], spots[:, 0]] == 255).float().mean()) > 0.97


def test_lids_of_a_blink_meet_on_every_head() -> None:
    kind = performer_kind()
    weights = torch.zeros(52)
    weights[[ARKIT.index("eyeBlinkLeft"), ARKIT.index("eyeBlinkRight")]] = 1.0
    for seed in range(3):
        head = kind.draw(torch.Generator().manual_seed(seed))
        marks = closed_lids(kind, head, weights)[kind.landmarks]
        opened = torch.stack([marks[a, 1] - marks[b, 1] for a, b in ((37, 41), (38, 40), (43, 47), (44, 46))])
        assert float(opened.mean().abs()) < 0.6  # millimetres


def test_lid_landmarks_lie_at_thirds_as_annotators_put_them() -> None:
    kind = performer_kind()
    marks = as_annotated(kind.draw(torch.Generator().manual_seed(1)).rest[kind.landmarks][:, :2])
    along = marks[39] - marks[36]
    share = ((marks[[37, 38]] - marks[36]) @ along) / (along @ along)
    torch.testing.assert_close(share, torch.tensor([0.32, 0.68]), atol=0.08, rtol=0)
