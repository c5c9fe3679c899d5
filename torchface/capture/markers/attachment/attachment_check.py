"""Checks sites that were fitted to a range of motion; errors name the figure and the likely cause."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.markers.attachment.site_uncertainty import SiteUncertainty
from torchface.capture.markers.marker_labels import listed
from torchface.capture.markers.rest_pose import inlier_markers
from torchface.capture.markers.rig_fit_check import DOUBTFUL_SHARE
from torchface.errors import AlignmentError, ValueRangeError

# Median over the markers. With a head's own rig it is 0.02 to 0.06 mm; with a rig whose neutral is 0.5 or 1 mm and
# whose shapes are a fifth wrong 0.09 or 0.16; with markers 2 mm off the skin 0.13, since the scale takes most of that
# up; with the rig of a similar head 0.3 to 0.4, of any other 0.7 to 0.9.
MAX_OFF_SKIN = 0.3


def check_sites(
    labels: Sequence[str], error: Tensor, off_skin: Tensor, radius: float, uncertainty: SiteUncertainty
) -> None:
    """Raises where sites do not explain their markers, or where the take leaves most of them uncertain.

    ``fit_check.check_fit`` judges markers on sites that are given; here the sites could move to wherever they fit best,
    and unit, pose and slip are solved for, so what is left has other causes and smaller limits.

    Args:
        labels: of the M markers.
        error: root mean square distance of each marker to its site, (M,), millimetres.
        off_skin: distance of each marker from its site that lasts over the take, (M,), millimetres.
        radius: of the sites at rest, mean distance from their centre, millimetres.
    """
    typical, offset, limit = float(error.median()), float(off_skin.median()), DOUBTFUL_SHARE * radius
    if not typical <= limit:
        raise AlignmentError(
            f"markers: wherever they sit on the rig, they stay {typical:.2g} mm from their sites (median), expected at "
            f"most {limit:.2g} mm: labels are mixed up, or it is the rig of another head"
        )
    if offset > MAX_OFF_SKIN:
        raise AlignmentError(
            f"markers: they stay {offset:.2g} mm off the rig's skin all the time (median), expected at most "
            f"{MAX_OFF_SKIN} mm: it is the rig of another head, or a rig that is not this exact"
        )
    far = (~inlier_markers(error)).nonzero()[:, 0]
    if len(far):
        worst = far[error[far].argsort(descending=True)].tolist()
        named = listed([f"{labels[i]} ({float(error[i]):.0f} mm)" for i in worst])
        raise AlignmentError(
            f"markers: {named} stay far from the skin while most stay within {typical:.2g} mm: they sit on the "
            "helmet, fell off, or carry another marker's label; leave them out of the take or correct their label"
        )
    if uncertainty.mostly_uncertain:
        sites, shapes = uncertainty.markers, uncertainty.shapes
        raise ValueRangeError(
            f"range of motion: leaves {len(sites)} of {len(labels)} sites uncertain by more than a millimetre and "
            f"{len(shapes)} of {len(uncertainty.names) - len(uncertainty.unseen)} shapes that the markers see "
            f"({listed(shapes)}), expected at most half: play every expression strongly, each by itself"
        )


def mean_radius(points: Tensor) -> float:
    """Mean distance of points (M,3) from their centre."""
    return float(torch.linalg.vector_norm(points - points.mean(0), dim=1).mean())
