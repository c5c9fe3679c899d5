"""How weights solved from a webcam compare with the truth: size, lag, tremor, blinks, gaze, and finding a lost face."""

import math

import torch
from torch import Tensor

from planted.landmark_measures import Agreement, agreement
from torchface.evaluation.expression_scores import REGIONS, moving, runs
from torchface.shape_names import ARKIT
from train.rendered_people.people import Person, closed_lids

SIGNALS = {
    "mouth open": {"jawOpen": 1.0},
    "smile": {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5},
    "brows": {"browInnerUp": 0.5, "browOuterUpLeft": 0.25, "browOuterUpRight": 0.25}
    | {"browDownLeft": -0.5, "browDownRight": -0.5},
    "lids": {"eyeBlinkLeft": 0.5, "eyeBlinkRight": 0.5},
}
"""What a region does as one number: sums of weights."""
_EACH = 3  # frames of which one is measured in millimetres


def weight_error(solved: Tensor, truth: Tensor, shapes: Tensor, seen: Tensor) -> float:
    """Root mean square over the shapes (52,) that the truth (T,52) moves and frames (T,) that show a face."""
    difference = (solved - truth)[seen][:, shapes & moving(truth)]
    return float(difference.square().mean().sqrt())


def vertex_error(person: Person, solved: Tensor, truth: Tensor, seen: Tensor) -> float:
    """Mean distance, millimetres, of the face's vertices of the person's own rig at solved and at true weights."""
    kind = person.kind
    place = kind.canonical
    face = kind.outer & (place[:, 2] > 15) & (place[:, 1] > -110) & (place[:, 1] < 60)
    errors = []
    for number in seen.nonzero()[::_EACH, 0].tolist():  # lids that meet are a frame's own
        both = (closed_lids(kind, person.head, weights[number].clamp(0, 1))[face] for weights in (solved, truth))
        errors.append((next(both) - next(both)).norm(dim=1).mean())
    return float(torch.stack(errors).mean())


def signal(weights: Tensor, name: str) -> Tensor:
    """One of ``SIGNALS`` of weights (T,52), (T,)."""
    return sum(share * weights[:, ARKIT.index(shape)] for shape, share in SIGNALS[name].items())


def follows(solved: Tensor, truth: Tensor, name: str, seen: Tensor) -> Agreement:
    """How one of ``SIGNALS`` follows the truth: correlation and slope, over frames (T,) that show a face."""
    return agreement(signal(solved, name)[seen], signal(truth, name)[seen])


def gaze_error(solved: Tensor, truth: Tensor, opened: Tensor) -> float:
    """Mean angle, degrees, between gazes (T,2,2) in radians, over eyes (T,2) that are open."""

    def way(gaze: Tensor) -> Tensor:
        across, up = gaze.double().unbind(-1)
        return torch.stack([across.sin() * up.cos(), up.sin(), across.cos() * up.cos()], -1)

    cosine = (way(solved) * way(truth)).sum(-1).clamp(-1, 1)[opened]
    return float(torch.rad2deg(cosine.acos()).mean())


def recovery(solved: Tensor, truth: Tensor, present: Tensor) -> list[float]:
    """Frames from each return of a face until its weights are as near to the truth as they mostly are.

    As near: the mean distance over shapes that move is under one and a half times its median for three frames on end.
    """
    distance = (solved - truth)[:, moving(truth) & ~REGIONS["gaze"]].abs().mean(1)
    good = distance < 1.5 * distance[present].nanmedian()
    took = []
    for start, end in runs(~present):
        if start == 0 or end + 4 >= len(present):
            continue
        settled = [t for t in range(end + 1, len(good) - 2) if bool(good[t : t + 3].all())]
        took.append(float(settled[0] - end - 1) if settled else math.inf)
    return took
