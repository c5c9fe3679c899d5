"""Markers that a solve is given: which there are, by what labels, in which frames."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.number_checks import checked_type
from torchface.take import Take, Track


def check_labels(found: Sequence[str], known: Sequence[str]) -> None:
    """Raises ``NameMismatchError`` for marker labels that an attachment does not know, or where it knows none."""
    unknown = sorted(set(found) - set(known))
    if unknown or not found:
        shown = ", ".join(map(repr, unknown[:5])) or "no marker at all"
        raise NameMismatchError(
            f"markers: found {shown}{' and others' if len(unknown) > 5 else ''}, expected labels of the attachment: "
            f"{', '.join(known[:5])}, ...; torchface.capture.markers.match_labels finds them without a subject's "
            "prefix (Actor:M001) and in another case; drop markers that are not of the face with Track.select"
        )


def markers_of(take: Take) -> Track:
    """The markers of a take, which it must have."""
    if checked_type("take", take, Take).markers is None:
        raise NameMismatchError("take: has no markers, expected a track of them")
    return take.markers  # type: ignore[return-value]


def frames_seen(markers: Tensor) -> Tensor:
    """The frames of markers (T,M,3) that show at least one, (K,) int64."""
    rows = (~torch.isnan(markers).any(-1)).any(-1).nonzero()[:, 0]
    if not len(rows):
        raise ValueRangeError(f"markers: found none in any of {len(markers)} frames, expected some")
    return rows


def check_seen(missing: Tensor) -> None:
    """Raises ``ValueRangeError`` where all markers of a frame are missing (T,M)."""
    empty = missing.all(-1).nonzero()[:, 0].tolist()
    if empty:
        shown = ", ".join(map(str, empty[:10])) + (", ..." if len(empty) > 10 else "")
        raise ValueRangeError(
            f"markers: all {missing.shape[1]} are missing in {len(empty)} of {len(missing)} frames ({shown}); "
            "expected at least one seen in every frame: cut these frames or fill them first"
        )
