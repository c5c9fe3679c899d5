"""Which of two people a face belongs to: the one who is followed, or another who passes before them.

Tensor operations alone: they go into graphs. A place is (5,), see
:mod:`~torchface.landmarks.images.frame_reader.face_place`. What is known of two people is (IDENTITY,), zeros for
nothing: the motion of the one who is followed, that of the other who was nearest, how many others stand to the left and
to the right, and how the first looks. A motion is x and y of the face's middle, its side, pixels; its speed along x and
y, pixels a second; and the seconds since it was seen; side 0 for nobody.
"""

import torch
from torch import Tensor

_MOTION = 6
LOOK_SIZE, LOOK_MARGIN = 8, 1.1  # pixels a side of a look, and its side in sides of the face
IDENTITY = 2 * _MOTION + 2 + 3 * LOOK_SIZE * LOOK_SIZE
"""Numbers that are known of two people."""
CANDIDATES = 4
"""Faces of a picture that are distinguished."""

_FORGOTTEN = 1.0  # seconds after which anybody is taken for one who is not seen
# Sides within which somebody stands where the followed one is hidden; how slowly that one is forgotten meanwhile, and
# after how many seconds that begins: eight in all, and some are left to find the followed one once the other has gone.
_BEFORE, _SLOWLY, _SOON = 1.2, 0.1, 0.2
_LIKELY, _PERSON = 0.4, 0.5  # score of a box that may show somebody else, and of one that is counted
_COAST = {0: 0.1, 1: 0.5}  # seconds for which the followed one, and the other, are expected to move on unseen
_SPEED, _GROWTH, _LEARNING = 0.1, 0.3, 0.5  # seconds in which speed, side and look are learned
_BESIDE = 0.5  # sides: what is nearer is the same face
_REACH, _QUICK = 0.5, 6.0  # sides, and sides a second: farther the other cannot have moved from where it is expected
_NEAR = 3.0  # sides within which the other may be in the way in the next moment
_COUNTING = 0.2  # of a new count of people that is taken up at once
_LASTING = 0.6  # seconds for which it is known where the other is
_ALIKE, _UNLIKE = 0.8, 1.5  # correlation of looks from which a face counts as the same, and what lacks counts in sides
_STRANGE = 0.4  # correlation under which a face is not that of one who is hidden
SAME = 0.9  # from which it is
_ELSEWHERE = 0.5  # of a smoothed count of others
_AROUND = 1.0  # sides: what is half hidden by the other, and so looks like nobody, lies within
_RESEMBLING = 0.5  # what the logarithm of two sides counts in sides
_SURE, _CLEARLY = 0.12, 2.0  # sides: nearer is the followed one; how much nearer than the other one that was hidden is


def face_look(colors: Tensor) -> Tensor:
    """A face's colours (...,3,S,S), upright, about their mean, flat, of unit length: they distinguish people.

    The product of two is their correlation.
    """
    # The mean of all colours goes, not that of each: how red a face is beside how blue differs between people.
    flat = (colors - colors.mean()).flatten()
    return flat / flat.square().sum().sqrt().clamp(min=1e-6)


def known_look(identity: Tensor) -> Tensor:
    """How the followed face looks, (192,) of unit length; zeros where that is not known."""
    return identity[2 * _MOTION + 2 :]


def look_alone(identity: Tensor) -> Tensor:
    """What is known after a cut: how the followed one looks, and not where anybody is."""
    return torch.cat([torch.zeros_like(identity[: 2 * _MOTION + 2]), known_look(identity)])


def is_beside(identity: Tensor) -> Tensor:
    """Whether somebody else is so near that they may be in the way in the next moment; () bool."""
    own, other = _motions(identity)
    return _is_known(identity) & (_apart(own, _expected(other, 1)) < _NEAR + _QUICK * other[5])


def is_awaited(identity: Tensor) -> Tensor:
    """Whether nobody else is taken for the followed one yet; () bool."""
    own, _ = _motions(identity)
    return (own[2] > 0) & (own[5] < _FORGOTTEN)


def after_boxes(identity: Tensor, faces: Tensor, searched: Tensor, interval: Tensor) -> Tensor:
    """What is known after the box network, where it has ``searched``, has looked at the next picture, before a face is
    read.

    ``faces`` have x and y of the middle, side, pixels, and score, the likeliest first, (CANDIDATES,4).
    """
    own, other = _motions(identity)
    hidden = _is_known(identity) & (_apart(own, _expected(other, 1)) < _BEFORE) & (own[5] >= _SOON)
    aged = interval * torch.tensor([0.0] * (_MOTION - 1) + [1.0])
    own, other = own + aged * torch.where(hidden, _SLOWLY, 1.0), other + aged
    known = (other[2] > 0) & (other[5] < _FORGOTTEN)
    likely = (faces[:, 3] >= _LIKELY) & searched & (own[2] > 0)
    from_own, from_other = _distance(own, faces, 0), _distance(other, faces, 1)
    apart = _apart(own, faces[:, :2])
    # Who appears where the followed one is no more may be that one, elsewhere.
    new = (apart > _BESIDE) & (likely & (apart <= _BESIDE)).any()
    its = (known & (from_other < from_own) & (from_other < _REACH + _QUICK * other[5]) | ~known & new) & likely
    row = torch.where(its, torch.where(known, from_other, apart), torch.inf).argmin()[None]
    moved = _moved(torch.where(known, other, 0.0), faces[row][0, :3], interval)
    other = torch.where(its.any(), moved, torch.where(known, other, 0.0))
    to_left = faces[:, 0] < _expected(own, 0)[0]
    others = likely & (apart > _BESIDE) & (faces[:, 3] >= _PERSON)  # a skull on a shirt has less, in most frames
    counted = torch.stack([(others & to_left).sum(), (others & ~to_left).sum()]).float()
    # Now and then something else looks like a face for a moment.
    known_beside = counted_beside(identity)
    counted = torch.where(searched, known_beside + _COUNTING * (counted - known_beside), known_beside)
    return torch.cat([own, other, counted, identity[2 * _MOTION + 2 :]])


def is_other(identity: Tensor, place: Tensor, look: Tensor, interval: Tensor) -> Tensor:
    """Whether a face at a place, that looks so (192,), is the other's rather than the followed one's; () bool."""
    own, other = _motions(identity)
    likeness = _likeness(identity, look)
    unlike = (_ALIKE - likeness).clamp(min=0) * _UNLIKE
    unlike = unlike + _RESEMBLING * (place[2].clamp(min=1) / own[2].clamp(min=1)).log().abs()
    from_own, from_other = _distance(own, place, 0) + unlike, _distance(other, place, 1)
    hidden = own[5] > 1.5 * interval
    nearer = from_other < from_own * torch.where(hidden, _CLEARLY, 1.0)
    nearer = nearer & ((other[5] > 0.5 * interval) | (from_other < _BESIDE))  # else the other is seen beside this face
    same = (likeness >= SAME) & (_apart(own, place[:2]) < _BESIDE)
    elsewhere = counted_beside(identity).sum() > _ELSEWHERE
    nearer = nearer & ~(hidden & same & elsewhere)
    # Who looks otherwise is somebody else, if one is known or was seen where the first one was not; else the first one
    # has turned, or the light is another. Who comes up elsewhere while the first one is hidden must look the same.
    somebody = _is_known(identity) | ((own[2] > 0) & elsewhere)
    # Who is where the first one was, while the other is seen elsewhere, is the first one, turned.
    seen_now = _is_known(identity) & (other[5] <= 0.5 * interval)
    back = seen_now & (_apart(other, place[:2]) > _AROUND) & (_apart(own, place[:2]) < _BEFORE)
    away = is_beside(identity) & (_apart(own, place[:2]) > _BEFORE)
    strange = likeness < torch.where(away, SAME, _STRANGE)
    theirs = (_is_known(identity) & nearer) | (somebody & hidden & strange & ~back)
    return theirs & (from_own > torch.where(hidden, 0.0, _SURE)) & (own[5] < _FORGOTTEN)


def after_face(identity: Tensor, place: Tensor, look: Tensor, whose: tuple[Tensor, Tensor], interval: Tensor) -> Tensor:
    """What is known after a face that looks so (192,) was seen; ``whose``, () bool: the followed one's, or the
    other's."""
    seen, stranger = whose
    own, other = _motions(identity)
    fresh = (own[2] <= 0) | (own[5] >= _FORGOTTEN)
    known = torch.where(fresh, 0.0, identity)
    moved = _moved(known[:_MOTION], place[:3], interval)
    # Whoever is about to cover the face is no part of its look.
    share = torch.where(is_beside(identity), 0.1, 1.0) * (1 - (-interval / _LEARNING).exp())
    before = known[2 * _MOTION + 2 :]
    mixed = before + torch.where(before.any(), share, 1.0) * (look - before)
    mixed = mixed / mixed.square().sum().sqrt().clamp(min=1e-6)
    other = torch.where(fresh, 0.0, other)
    followed = torch.cat([moved, other, counted_beside(identity), mixed])
    # Of two boxes that overlap the wrong one may have been taken for the other's.
    strange = _likeness(identity, look) < _STRANGE
    mistaken = (other[5] <= 0) & strange & ((other[2] <= 0) | (_apart(other, place[:2]) < _AROUND))
    within = _distance(other, place, 1) < _REACH + _QUICK * other[5]
    reached = (other[5] > 0) & within
    passing = torch.cat([own, _moved(torch.where(mistaken, 0.0, other), place[:3], interval), identity[2 * _MOTION :]])
    return torch.where(seen, followed, torch.where(stranger & (reached | mistaken), passing, identity))


def counted_beside(identity: Tensor) -> Tensor:
    """How many other people stand to the left of the followed one in the picture, and to the right, smoothed; (2,)."""
    return identity[2 * _MOTION : 2 * _MOTION + 2]


def _motions(identity: Tensor) -> tuple[Tensor, Tensor]:
    return identity[:_MOTION], identity[_MOTION : 2 * _MOTION]


def _is_known(identity: Tensor) -> Tensor:
    own, other = _motions(identity)
    return (own[2] > 0) & (other[2] > 0) & (other[5] < _LASTING)


def _likeness(identity: Tensor, look: Tensor) -> Tensor:
    """The correlation of a look with what is known of the followed one's; 1 where nothing is."""
    known = known_look(identity)
    return torch.where(known.any(), known @ look, 1.0)


def _expected(motion: Tensor, who: int) -> Tensor:
    return motion[:2] + motion[3:5] * motion[5].clamp(max=_COAST[who])


def _apart(motion: Tensor, middles: Tensor) -> Tensor:
    """How far middles (...,2) are from where somebody was seen last, in sides."""
    return (middles - motion[:2]).square().sum(-1).sqrt() / motion[2].clamp(min=1)


def _distance(motion: Tensor, faces: Tensor, who: int) -> Tensor:
    """How far faces (...,2+) are from where somebody is expected, in sides, (...)."""
    return (faces[..., :2] - _expected(motion, who)).square().sum(-1).sqrt() / motion[2].clamp(min=1)


def _moved(motion: Tensor, face: Tensor, interval: Tensor) -> Tensor:
    """A motion (6,) after its face (3,) was seen anew; of nobody's motion a new one."""
    known, since = motion[2] > 0, motion[5].clamp(min=1e-3)
    speed = (face[:2] - motion[:2]) / since
    share = 1 - (-interval / _SPEED).exp()
    speed = torch.where(known, motion[3:5] + torch.where(motion[3:5].any(), share, 1.0) * (speed - motion[3:5]), 0.0)
    side = torch.where(known, motion[2] + (1 - (-interval / _GROWTH).exp()) * (face[2] - motion[2]), face[2])
    return torch.cat([face[:2], side[None], speed, torch.zeros_like(side)[None]])
