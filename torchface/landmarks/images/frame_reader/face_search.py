"""Choice among the faces that the box network finds in a picture."""

import torch
from torch import Tensor

from torchface.landmarks.images.boxes.box_network import BoxNetwork
from torchface.landmarks.images.frame_reader.face_place import overlap
from torchface.landmarks.images.frame_reader.picture_pieces import whole_picture
from torchface.landmarks.images.person_identity import CANDIDATES

_NEAR, _SMALLER, _LARGER = 0.75, 0.6, 1.6
_OVERLAP = 0.25  # at least, of a face that is followed and what confirms it
_FIRST = 1e6  # more than any side: a face that is near goes before all others
# Where what the network says shows no face, one is looked for upright, then 50 degrees either way.
_TRIES, _LEANING = 4, (0.643, 0.766)
FOUND = 7 + 4 * CANDIDATES  # numbers that a search gives


def search(
    image: Tensor, network: BoxNetwork, scores: tuple[float, float], place: Tensor, asked: tuple[Tensor, ...]
) -> Tensor:
    """The face that is meant.

    Args:
        image: uint8 (H,W,C).
        scores: that a face has at least, and that one has which confirms a face that is followed.
        place: where the face was last (5,); side 0 where there was none.
        asked: whether another face than one near there is refused where several are about, () bool; how many were
            refused since the last was lost, (); and pixels of the longer side of what the network is shown, ().

    Returns:
        Its place; whether there is one; whether a face is seen at the last place; and of the likeliest faces, one after
        the other, x and y of the middle, side, and score: (FOUND,). Of several faces that are refused another is tried
        with each frame.
    """
    waiting, attempt, longest = asked
    picture, ratio = whole_picture(image, longest)
    faces = network(picture)[0]
    middles, sides, said = (faces[:, :2] + 0.5) * ratio - 0.5, faces[:, 2] * ratio.mean(), faces[:, 3]
    last = place[2].clamp(min=1)
    distance, growth = ((middles - place[:2]) / last).square().sum(1).sqrt(), sides / last
    near = (distance < _NEAR) & (growth > _SMALLER) & (growth < _LARGER) & (place[2] > 0)
    likely = said >= scores[0]
    meant = likely & (near | (place[2] <= 0) | ~waiting | (likely.sum() <= 1))
    preference = torch.where(near, (2 - distance) * _FIRST, sides * said) * meant
    order, rows = preference.topk(CANDIDATES)
    count = (order > 0).sum()
    rounds = (attempt / count.clamp(min=1)).floor()
    row = rows[(attempt - rounds * count.clamp(min=1)).long()[None]]
    middle, side, angle = middles[row][0], sides[row], faces[row, 4:][0]
    # The network may take a leaning face for one that is upside down: refused ones are looked at in other ways.
    other = rounds % _TRIES
    leaning = (other >= 2).float()
    turned = torch.stack([1 - leaning * (1 - _LEANING[0]), leaning * _LEANING[1] * (5 - 2 * other)])
    angle = torch.where(other > 0, turned, angle)
    there = (overlap(middles, sides, place) > _OVERLAP) & (said >= scores[1])
    likeliest = torch.cat([middles, sides[:, None], said[:, None]], 1)[:CANDIDATES]
    return torch.cat([middle, side, angle, torch.stack([count > 0, there.any()]).float(), likeliest.flatten()])
