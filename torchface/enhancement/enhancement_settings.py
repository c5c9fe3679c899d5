"""Settings of an enhancement: how it splits frames and finds detail, and how large it is."""

from dataclasses import dataclass
from typing import Literal

from torchface.enhancement.detail.detail_encodings import DetailKind
from torchface.enhancement.detail.low_pass import WAVELENGTH
from torchface.errors import ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, MAX_FPS, MIN_FPS, checked_number

Matching = Literal["projection", "learned"]
_MATCHINGS: tuple[Matching, ...] = ("projection", "learned")
_DETAILS: tuple[DetailKind, ...] = ("displacements", "gradients")


@dataclass(frozen=True)
class EnhancementSettings:
    """How an enhancement splits frames into a smooth part and detail, and how detail is found.

    Args:
        fps: of the database.
        wavelength: of which the smooth part keeps half the amplitude, millimetres.
        detail: how detail is encoded: as "displacements" from the smooth part or as "gradients" of its triangles.
        matching: how detail is found: by the "projection" onto the database alone, or with what a "learned" map adds
            for frames beyond it.
        temporal: how much weights hold on to those of the frame before, see ``RegionProjection``.

    Raises:
        ValueRangeError: a word that is none of these, or a number out of its range.

    Example:
        >>> EnhancementSettings(fps=60.0, matching="projection").detail
        'displacements'
    """

    fps: float = 30.0
    wavelength: float = WAVELENGTH
    detail: DetailKind = "displacements"
    matching: Matching = "learned"
    temporal: float = 0.0

    def __post_init__(self) -> None:
        if self.detail not in _DETAILS:
            raise ValueRangeError(f"detail: found {self.detail!r:.40}, expected one of {', '.join(_DETAILS)}")
        if self.matching not in _MATCHINGS:
            raise ValueRangeError(f"matching: found {self.matching!r:.40}, expected one of {', '.join(_MATCHINGS)}")
        checked_number("fps", self.fps, MIN_FPS, MAX_FPS)
        checked_number("wavelength", self.wavelength, above=True, most=1e6)
        checked_number("temporal", self.temporal, most=LARGEST_WEIGHT)


DEFAULT_SETTINGS = EnhancementSettings()


@dataclass(frozen=True)
class EnhancementSizes:
    """How large an enhancement is.

    Args:
        vertices, triangles, patches, frames, rank: V, F, P, K and r.
        color_rank: components of the colours; 0 without colours.

    Example:
        >>> EnhancementSizes(vertices=6419, triangles=12610, patches=64, frames=36, rank=8).color_rank
        0
    """

    vertices: int
    triangles: int
    patches: int
    frames: int
    rank: int
    color_rank: int = 0
