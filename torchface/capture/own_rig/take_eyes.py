"""Eyes of a whole take: openness and gaze beside the person's own, as readings of the weights of a rig."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.own_rig.eye_geometry import (
    CORNERS,
    LOOKS,
    SURELY_OPEN,
    SURELY_SHUT,
    Eyeballs,
    arkit_names,
    gaze_of_looks,
    judged_openness,
    look_weights,
    openness_of,
    openness_rows,
    seen_gaze,
    shown_iris,
)
from torchface.capture.weight_readings import WeightReadings
from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT

_USUAL_OPEN, _USUAL_SHUT = 0.3, 0.05  # openness where a take shows none
_SHUT_FRAMES = 5.0  # that the usual shut level counts as
_LOWEST, _HIGHEST = (
    0.7,
    0.9,
)  # the open level is at least the first of this quantile: a squint of the whole take is none
_LEAST_SPAN = 0.05
_NOISE, _PIXELS = 0.08, 0.5  # of openness beside the open eye's; and what lids are off by, of their stated deviation
_BLINK_NOISE = 0.1  # of eyeBlink where the eye is surely shut
_GAZE_NOISE = 0.03  # of eyeLook's weights
_STRAYS = 0.35  # radians: what is further to the side or up is no looking straight ahead
_OPEN_FRAMES = 90.0  # that eyes open as people usually have them count as: people squint for seconds
# Radians: what eyes that look straight ahead are read apart by, of one person and another: the corners and the middle
# of an eyeball lie a millimetre otherwise, the line of sight is turned, the head's pitch is found wrong.
_PERSON = 0.15
# Radians that people who look at the lens look beside it in the mean of a take; radians that a head turns at least for
# it to show that they do; and how much more than it states the landmark network errs of looks in the mean of a take.
_BESIDE, _TURNED, _UNDERSTATED = 0.1, 0.02, 3.0
_ANY_FRAME = 0.1  # what a frame counts beside one in which the face surely rests
# Radians from straight, of each eye: less is what eyes were read apart by mistake, more is none.
_APART, _VERGENCE = 0.05, 0.12
_LEAST_GAZE = 0.3  # trust, under which a gaze is that of before
_DISAGREE = 0.08  # of openness by landmarks and by the eye network, at which lids' landmarks count half
_EYES = tuple(range(36, 42)), tuple(range(42, 48))


@dataclass(frozen=True, eq=False)
class TakeEyes:
    """Eyes in T frames, the right one first."""

    open: Tensor  # openness beside the person's own, 0 shut and 1 as at rest, (T,2); NaN where nothing is known
    open_deviation: Tensor  # of it, (T,2)
    closed: Tensor  # how likely each is shut, (T,2); NaN where nobody said
    # to the person's left and up, beside the head and straight ahead, (T,2,2) radians; held where eyes are shut, NaN
    # where they were never seen
    gaze: Tensor
    gaze_trust: Tensor  # (T,2) in [0,1]
    lid_trust: Tensor  # how far the landmarks of each eye agree with that, (T,2) in [0,1]
    # what was taken for the person's own straight ahead beside the model's, (2,2) radians; zero if absent
    straight: Tensor | None = None

    def readings(self, rest: Tensor, basis: Tensor, names: Sequence[str], eyeballs: Eyeballs) -> WeightReadings:
        """As readings of the weights of a rig whose landmarks have ``rest`` (68,3) and ``basis`` (68,3,N)."""
        called = arkit_names(names)
        opened, _ = openness_rows(rest.double(), basis.double(), called)
        one = torch.eye(len(called)).double()
        shut = ((self.closed.nan_to_num(0.0) - 0.5) / (SURELY_SHUT - 0.5)).clamp(0, 1).double()
        rows, values, deviation = [opened], [self.open.double() - 1], [self.open_deviation.double()]
        looks = look_weights(self.gaze.double(), eyeballs.turns)
        sides = torch.tensor([0, 0, 1, 1, 0, 0, 1, 1])
        for number, name in enumerate(called):
            eye = int(name.endswith("Left"))
            kind = name.removesuffix("Left").removesuffix("Right")
            if name in LOOKS:
                place = LOOKS.index(name)
                rows.append(one[number : number + 1])
                values.append(looks[:, place : place + 1])
                trust = self.gaze_trust[:, sides[place : place + 1]].double()
                deviation.append(_GAZE_NOISE / trust.sqrt())
            elif kind == "eyeBlink":
                rows.append(one[number : number + 1])
                values.append(torch.ones_like(shut[:, :1]))
                deviation.append(_BLINK_NOISE / shut[:, eye : eye + 1].sqrt())
        return WeightReadings(torch.cat(rows), torch.cat(values, 1), torch.cat(deviation, 1))

    def agreed(self, trust: Tensor) -> Tensor:
        """Trust in landmarks (T,68) with less of it in lids' that disagree with how far the eye is open."""
        lids = self.lid_trust.to(trust).repeat_interleave(len(_EYES[0]), dim=1)
        return torch.cat([trust[:, : _EYES[0][0]], trust[:, _EYES[0][0] : _EYES[1][-1] + 1] * lids, trust[:, 48:]], 1)

    def turned(self, weights: Tensor, names: Sequence[str], eyeballs: Eyeballs) -> Tensor:
        """Where eyes look, (T,2,2) radians, that have weights (T,N) of a rig; as was seen of a rig that turns none."""
        called = arkit_names(names)
        if not all(name in called for name in LOOKS):
            return self.gaze
        return gaze_of_looks(weights[:, [called.index(name) for name in LOOKS]].double(), eyeballs.turns)


def take_eyes(
    reading: FaceReading,
    rays: Tensor,
    iris: Tensor,
    rotation: Tensor,
    depth: Tensor,
    resting: Tensor,
    eyeballs: Eyeballs | None = None,
    looking: Tensor | None = None,
) -> TakeEyes:
    """What a take shows of the eyes beside the person's own open and shut eyes, and beside looking straight ahead.

    Args:
        rays: of the 68 landmarks at depth 1, (T,68,2); NaN where none was found.
        iris: of the irises at depth 1, (T,2,2).
        rotation: head to camera, (T,3,3); NaN for lost.
        depth: of the eyes, (T,2), millimetres.
        resting: how far the face rests in each frame, (T,) in [0,1].
        looking: what looking up or down adds to openness at weights (8,) of ``LOOKS``, (2,8); nothing if absent.
    """
    closed, seen = reading.closed.double(), reading.eye_visibility.double().clamp(0, 1)
    shut = closed.nan_to_num(0.0)
    raw = seen_gaze(rays.double(), iris.double(), rotation.double(), depth.double(), eyeballs)
    looks, openness = torch.isfinite(raw).all(-1), reading.openness.double()
    usual = torch.where(shut < SURELY_OPEN, openness, torch.nan).nanmedian(0).values
    part = (openness - _USUAL_SHUT) / (usual - _USUAL_SHUT).clamp(min=_LEAST_SPAN)
    trust = torch.where(looks, seen * (1 - shut) * shown_iris(part.nan_to_num(1.0)), 0.0)
    raw = torch.where(looks[..., None], raw, 0.0)
    straight = _straight(raw, trust, _toward_lens(rays.double(), rotation.double()), reading, eyeballs)
    gaze = _one_gaze(raw - straight, trust)

    known = torch.isfinite(openness)
    by_look = torch.ones_like(openness)
    if looking is not None:
        turns = None if eyeballs is None else eyeballs.turns
        by_look = (1 + look_weights(gaze, turns) @ looking.double().T * trust).clamp(min=0.4)
    lowest, level = _levels(openness, by_look, shut, known * seen, resting.double())
    span = (level - lowest).clamp(min=_LEAST_SPAN)
    part, counts = judged_openness(((openness - lowest) / span).nan_to_num(1.0), closed, known * seen)
    width = torch.stack([(reading.landmarks[:, a] - reading.landmarks[:, b]).norm(dim=1) for a, b in CORNERS], 1)
    off = torch.stack([reading.deviation[:, list(eye)].mean(1) for eye in _EYES], 1)
    blurred = (_PIXELS * off / width.clamp(min=1.0)).double().nan_to_num(0.0) / span
    deviation = (_NOISE**2 + blurred.square()).sqrt() / counts.sqrt()
    apart = (openness_of(reading.landmarks.double()) - openness).abs() - blurred
    agree = 1 / (1 + (apart.clamp(min=0) / _DISAGREE).square())
    return TakeEyes(
        torch.where(counts > 0, part.clamp(-0.1, 1.8), torch.nan),
        deviation,
        closed,
        _held(gaze, trust.amax(1) > _LEAST_GAZE),
        trust.amax(1, keepdim=True).expand(-1, 2),
        torch.where(known, agree.nan_to_num(1.0), 1.0),
        straight,
    )


def _levels(openness: Tensor, by_look: Tensor, shut: Tensor, counts: Tensor, resting: Tensor) -> tuple[Tensor, Tensor]:
    """The person's shut and open eyes, (2,) each."""
    lowest, level = [], []
    for eye in range(2):
        seen = counts[:, eye] > 0.5
        is_shut = openness[seen & (shut[:, eye] > SURELY_SHUT), eye]
        share = len(is_shut) / (len(is_shut) + _SHUT_FRAMES)
        low = is_shut.median() if len(is_shut) else openness.new_tensor(_USUAL_SHUT)
        lowest.append(share * low + (1 - share) * _USUAL_SHUT)
        is_open = seen & (shut[:, eye] < SURELY_OPEN)
        if not bool(is_open.any()):
            level.append(openness.new_tensor(_USUAL_OPEN))
            continue
        values = openness[is_open, eye] / by_look[is_open, eye]
        high = values.quantile(_HIGHEST)
        own = _weighted_median(values, resting[is_open] + _ANY_FRAME).clamp(_LOWEST * high, high)
        level.append(own + (_USUAL_OPEN - own) * _OPEN_FRAMES / (len(values) + _OPEN_FRAMES))
    return torch.stack(lowest), torch.stack(level)


def _weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    order = values.argsort()
    total = weight[order].cumsum(0)
    return values[order[int((total < 0.5 * total[-1]).sum())]]


def _toward_lens(rays: Tensor, rotation: Tensor) -> Tensor:
    """Where the lens is beside the head, (T,2) radians to the person's left and up, of landmarks' rays (T,68,2)."""
    eyes = torch.stack([rays[:, number] for pair in CORNERS for number in pair]).nanmean(0)
    way = -torch.nn.functional.normalize(torch.nn.functional.pad(eyes, (0, 1), value=1.0), dim=1)
    left, up, ahead = (way[:, None] @ rotation)[:, 0].unbind(1)
    return torch.stack([torch.atan2(left, ahead), torch.asin(up.clamp(-1, 1))], 1)


def _straight(raw: Tensor, trust: Tensor, lens: Tensor, reading: FaceReading, eyeballs: Eyeballs | None) -> Tensor:
    r"""What a person's eyes are read apart from straight ahead by, (2,2) radians: a Gaussian's mean beside what says
    where eyes look in the mean of a take without knowing their geometry.

    .. math:: b = (\bar r - m) \frac{s_b^2}{s_b^2 + s_m^2}, \quad \bar r = m + b

    with :math:`\bar r` what was read in the mean; m, known to :math:`s_m`, is from what the landmark network expects of
    the looks, whose errors are alike in all frames, and of the lens, where eyes turn against the head to stay on it.
    """
    turns = (eyeballs or Eyeballs.usual()).turns.to(raw)
    rows = [ARKIT.index(name) for name in LOOKS]
    expected = gaze_of_looks(reading.expression[:, rows].double(), turns)
    # Both shapes of an axis, of each eye: in and out, then down and up.
    variance = (reading.expression_deviation[:, rows].double() * turns).square().unflatten(1, (2, 2, 2)).sum(-1)
    variance = variance.transpose(1, 2)
    straight = torch.zeros_like(raw[0])
    for eye in range(2):
        frames = (trust[:, eye] > _LEAST_GAZE) & torch.isfinite(lens).all(1)
        if not bool(frames.any()):
            continue
        lasting = raw[frames, eye].clamp(-_STRAYS, _STRAYS).median(0).values
        known = (1 / variance[frames, eye].nan_to_num(torch.inf)).mean(0) / _UNDERSTATED**2  # 0 where nobody read it
        read = expected[frames, eye].nan_to_num(0.0).mean(0)
        looked_at = _follows(raw[frames, eye], lens[frames]) / _BESIDE**2
        mean = (lens[frames].median(0).values * looked_at + read * known) / (looked_at + known).clamp(min=1e-9)
        sure = looked_at + known + 1 / _STRAYS**2
        straight[eye] = (lasting - mean) * _PERSON**2 / (_PERSON**2 + 1 / sure)
    return straight.clamp(-2 * _PERSON, 2 * _PERSON)


def _follows(gaze: Tensor, lens: Tensor) -> Tensor:
    """How far gaze (F,2) turns against the head, so that it stays on the lens (F,2) or near it, (2,) in [0,1]."""
    gaze, lens = (one - one.median(0).values for one in (gaze, lens))
    gaze, lens = (one.clamp(-reach, reach) for one in (gaze, lens) for reach in [3 * one.abs().median(0).values])
    moved, turned = gaze.square().mean(0), lens.square().mean(0)
    alike = (gaze * lens).mean(0) / (moved * turned).sqrt().clamp(min=1e-9)
    return alike.clamp(0, 1).square() * turned / (turned + _TURNED**2)


def _one_gaze(ahead: Tensor, trust: Tensor) -> Tensor:
    """Both eyes' gaze at one thing, (T,2,2), of each eye's beside straight ahead that counts (T,2)."""
    share = (trust + 1e-3)[..., None]
    both = (share * ahead).sum(1) / share.sum(1)
    cross = 0.5 * (ahead[:, 0, 0] - ahead[:, 1, 0]) * (trust.amin(1) > _LEAST_GAZE)
    cross = (cross - _APART).clamp(0, _VERGENCE)
    made = both[:, None].expand(-1, 2, 2).clone()
    made[:, 0, 0] += cross
    made[:, 1, 0] -= cross
    return made


def _held(gaze: Tensor, seen: Tensor) -> Tensor:
    """Gaze of frames (T,...) as of the last one that was seen, the first one's before it."""
    if not bool(seen.any()):
        return torch.full_like(gaze, torch.nan)
    frames = torch.arange(len(gaze))
    last = torch.where(seen, frames, -1).cummax(0).values
    return gaze[torch.where(last < 0, int(seen.nonzero()[0, 0]), last)]
