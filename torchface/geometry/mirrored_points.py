"""Check for points mirrored on their way, as left-handed axes or swapped sides do."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.similarity import similarity_transform

# Of labelled markers on a real face the wrong hand leaves 10 to 100 times the distance of the right one, 30 to 65 mm,
# with 12 markers as with 100; a head's landmarks on another head's five times and more. Points in a plane, which no
# fit can distinguish from their mirror image, leave the same twice.
_CLEARLY_LESS = 0.5
_LEAST_SHARE = 0.05  # of the points' mean distance from their centre: below it there is nothing to explain


@dataclass(frozen=True)
class MirrorCheck:
    """How well two fits lay corresponding points on one another."""

    distance: float  # that the best similarity leaves, root mean square, in the target's unit
    mirrored_distance: float  # that is left where the points are mirrored first
    radius: float  # of the target, mean distance from its centre

    @property
    def mirrored(self) -> bool:
        """The reflection explains the points clearly better."""
        far = self.distance > _LEAST_SHARE * self.radius
        return far and self.mirrored_distance < _CLEARLY_LESS * self.distance

    def figures(self) -> str:
        """Both distances, for messages."""
        return (
            f"turned, moved and scaled {self.distance:.3g} mm (root mean square), mirrored as well "
            f"{self.mirrored_distance:.2g} mm"
        )


def check_mirrored(source: Tensor, target: Tensor) -> MirrorCheck:
    """Compares the best similarity with the best one of the mirror image, of points (N,3), whichever plane mirrors.

    Rows of NaN are skipped. Fewer than four common points, which always lie in a plane, have a check of no distance.
    """
    x, y = source.detach().double(), target.detach().double()
    seen = torch.isfinite(x).all(-1) & torch.isfinite(y).all(-1)
    if int(seen.sum()) < 4:
        return MirrorCheck(0.0, 0.0, 0.0)
    x, y = x[seen], y[seen]
    both = torch.stack([x, x * x.new_tensor([-1.0, 1.0, 1.0])])
    laid = similarity_transform(both, y.expand_as(both)).apply(both)
    distance = (laid - y).square().sum(-1).mean(-1).sqrt().tolist()
    return MirrorCheck(distance[0], distance[1], float((y - y.mean(0)).norm(dim=-1).mean()))
