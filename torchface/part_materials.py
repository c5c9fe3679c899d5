"""Materials of the parts of a head, by the names of the regions that they are annotated as."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PartMaterial:
    """The look of a part that nobody has painted."""

    name: str
    words: tuple[str, ...]  # a region whose name holds one of them is made of it
    color: tuple[float, float, float]  # sRGB in [0,1]
    roughness: float  # 0 a mirror, 1 chalk
    opacity: float = 1.0  # of the whole part, in [0,1]
    # GlTF's mode: "OPAQUE"; "MASK", with holes where its image has no opacity; "BLEND", clear.
    alpha: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"


SKIN = PartMaterial("skin", (), (0.881, 0.767, 0.702), 0.6)
EYEBALL = PartMaterial("eyeball", ("eyeball",), (0.93, 0.91, 0.89), 0.25)
SCLERA = PartMaterial("sclera", (), EYEBALL.color, 0.25, alpha="MASK")
CORNEA = PartMaterial("cornea", (), (1.0, 1.0, 1.0), 0.05, opacity=0.03, alpha="BLEND")
IRIS = PartMaterial("iris", (), (0.33, 0.24, 0.16), 0.5)
EYELASHES = PartMaterial("eyelashes", ("eyelash",), (0.07, 0.05, 0.045), 0.9, alpha="BLEND")

PARTS: tuple[PartMaterial, ...] = (
    EYEBALL,
    PartMaterial("lacrimal_fluid", ("lacrimal",), (1.0, 1.0, 1.0), 0.05, opacity=0.12, alpha="BLEND"),
    PartMaterial("eye_blend", ("eye_blend",), (0.82, 0.60, 0.56), 0.5, opacity=0.25, alpha="BLEND"),
    PartMaterial("eye_occlusion", ("eye_occlusion",), (0.12, 0.06, 0.05), 1.0, opacity=0.2, alpha="BLEND"),
    EYELASHES,
    PartMaterial("teeth", ("teeth",), (0.90, 0.86, 0.78), 0.25),
    PartMaterial("gums_and_tongue", ("gums", "tongue"), (0.70, 0.40, 0.38), 0.4),
    PartMaterial("mouth", ("mouth_socket", "mouth_interior"), (0.42, 0.18, 0.17), 0.8),
    PartMaterial("eye_socket", ("eye_socket",), (0.74, 0.46, 0.41), 0.6),
)
"""In this order: a triangle of several regions is made of the first. What no word names is skin."""


def part_material(region: str) -> PartMaterial | None:
    """What a region is made of; none where its name says nothing of it, as of parts of the skin."""
    name = region.lower()
    return next((part for part in PARTS if any(word in name for word in part.words)), None)
