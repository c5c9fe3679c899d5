"""Settings of the matching of landmarks in UV space."""

from dataclasses import dataclass, field
from typing import Any

from torchface.landmarks.scans.hog import HogLayout


@dataclass(frozen=True)
class DetectorSettings:
    """How landmarks are matched; lengths in pixels of the image.

    Args:
        hog: the descriptor.
        unsharp_sigma, unsharp_amount: of the pre-filter.
        good_radius: a match this near to the landmark is a good one.
        similarity_threshold: matches below it are not looked at.
        responses: the best so many matches of each filter are kept, counted in pixels: a match at every fourth pixel of
            a row and a column stands for sixteen.
        bandwidth: of the mean shift.

    Example:
        >>> DetectorSettings(responses=160).matches  # each stands for sixteen pixels
        10
    """

    hog: HogLayout = field(default_factory=HogLayout)
    unsharp_sigma: float = 3.0
    unsharp_amount: float = 1.0
    good_radius: float = 20.0
    similarity_threshold: float = 0.3
    responses: int = 200
    bandwidth: float = 10.0

    @staticmethod
    def of(given: "DetectorSettings | dict[str, Any] | None") -> "DetectorSettings":
        """From the settings themselves, from a dict of them, or the usual ones."""
        if given is None:
            return DetectorSettings()
        if isinstance(given, DetectorSettings):
            return given
        rest = {**given, "hog": HogLayout(**given["hog"])} if isinstance(given.get("hog"), dict) else given
        return DetectorSettings(**rest)

    @property
    def matches(self) -> int:
        """How many matches of a filter are kept."""
        return max(4, round(self.responses / self.hog.stride**2))
