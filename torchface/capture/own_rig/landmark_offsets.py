"""Fixed offsets between a rig's landmarks and where a finder of landmarks sees them, and their file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import JAW, LANDMARKS, FacePoints
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.documents import read_json, write_json
from torchface.shape_names import mapping

_FORMAT = "torchface.landmark-offsets/1"
_LARGEST = 100.0  # millimetres
# Of one person: two takes of a known rig lie up to 0.5 mm apart, or correlate by 0.91 at least, as halves of films do;
# of two people, films correlate by 0.88 at most.
_APART, _ALIKE = 0.6, 0.9
# Upper and lower lid's landmarks across from each other, and the shape that closes them.
_LIDS = ((37, 41, "eyeBlinkRight"), (38, 40, "eyeBlinkRight"), (43, 47, "eyeBlinkLeft"), (44, 46, "eyeBlinkLeft"))


@dataclass(frozen=True, eq=False)
class LandmarkOffsets:
    """What a finder of landmarks and a rig disagree by, whatever the face does.

    They hold for one rig and one finder: what annotators call an eyebrow's edge, and where the rig is not the person.
    They are in the rig's own space and so turn, and grow with the face's nearness, as the head does.
    """

    millimetres: Tensor  # added to each landmark's place on the rig, (68,3) float64
    # what landmarks are off by beside that, standard deviation of a coordinate, as a share of the distance of the eyes'
    # outer corners
    noise: float
    # rig, finder: digests of what they were estimated with; empty if not known
    rig: str = ""
    finder: str = ""
    # video, source: digest and name of the video that they were estimated from; empty if not known
    video: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        if self.millimetres.shape != (LANDMARKS, 3):
            raise ShapeError(
                f"landmark offsets: found {tuple(self.millimetres.shape)}, expected ({LANDMARKS},3) millimetres"
            )
        largest = float(self.millimetres.abs().max())
        if not largest <= _LARGEST or not 0 < self.noise < 1:
            raise ValueRangeError(
                f"landmark offsets: found offsets of up to {largest:g} mm and a noise of {self.noise:g}, expected at "
                f"most {_LARGEST:g} mm and a share of the eyes' distance, above 0 and below 1"
            )

    def rounded(self) -> "LandmarkOffsets":
        """To a tenth of a micrometre, as files hold them."""
        return replace(self, millimetres=self.millimetres.double().round(decimals=4), noise=round(self.noise, 6))

    def save(self, path: str | Path) -> None:
        """Writes them as JSON."""
        write_json(
            path,
            {
                "format": _FORMAT,
                "unit": "millimetres",
                "noise": self.rounded().noise,
                "rig": self.rig,
                "finder": self.finder,
                "video": self.video,
                "source": self.source,
                "offsets": self.rounded().millimetres.tolist(),
            },
        )

    @staticmethod
    def load(path: str | Path) -> "LandmarkOffsets":
        """Reads what :meth:`save` wrote."""
        document = read_json(path)
        if document["format"].found != _FORMAT:
            raise document["format"].error(f"{_FORMAT!r}: landmark offsets as torchface track writes them")
        try:
            return LandmarkOffsets(
                document["offsets"].tensor(LANDMARKS, 3),
                document["noise"].number(),
                document["rig"].text(),
                document["finder"].text(),
                *(document[name].text() if document[name] else "" for name in ("video", "source")),
            )
        except ValueRangeError as error:
            raise FileFormatError(f"{path}: {error}") from error

    def require(self, rig: str, finder: str, source: str | Path = "landmark offsets") -> None:
        """Refuses offsets of another rig or finder than the digests say."""
        for what, stated, other in (("rig", self.rig, rig), ("finder of landmarks", self.finder, finder)):
            if stated and other and stated != other:
                raise ValueRangeError(
                    f"{source}: found offsets that were estimated with another {what}, expected those of this one; "
                    "leave --offsets out and they are estimated anew"
                )

    def mismatch(self, other: "LandmarkOffsets") -> tuple[float, float] | None:
        """How far other offsets lie from these: the mean distance of landmarks within the face, millimetres, and their
        correlation; None where they agree within what two takes of one person do."""
        one, two = self.millimetres[JAW:], other.millimetres.to(self.millimetres)[JAW:]
        apart = float((one - two).norm(dim=1).mean())
        alike = float((one * two).sum() / (one.norm() * two.norm()).clamp(min=1e-9))
        return (apart, alike) if apart > _APART and alike < _ALIKE else None


def lid_pairs(names: Sequence[str]) -> list[tuple[int, int, Tensor]]:
    """Upper and lower lid's landmarks across from each other, and how far each shape closes them, (N,); lids that no
    shape closes are left out."""
    rows = {name: mapping(names, [name])[0] for name in {pair[2] for pair in _LIDS}}
    return [(upper, lower, rows[name]) for upper, lower, name in _LIDS if bool(rows[name].any())]


def offset_shares(names: Sequence[str], weights: Tensor) -> Tensor:
    """How much of each landmark's offset stands at each landmark, (B,68,68), at weights (B,N).

    Lids that are open further on the rig than on the person are shut alike: what upper and lower lid's offsets differ
    by fades as the lid closes.
    """
    shares = torch.eye(LANDMARKS, dtype=weights.dtype, device=weights.device).repeat(len(weights), 1, 1)
    for upper, lower, closing in lid_pairs(names):
        half = 0.5 * weights @ closing.to(weights)
        for one, other in ((upper, lower), (lower, upper)):
            shares[:, one, one] -= half
            shares[:, one, other] += half
    return shares


def shifted_points(points: FacePoints, names: Sequence[str], offsets: Tensor) -> FacePoints:
    """A rig's points where a finder sees them: each with its landmark's offset (68,3); lids' fade as they close.

    All points of a contour landmark's curve take its offset.
    """
    offsets = offsets.to(points.rest)
    rest, basis = points.rest.clone(), points.basis.clone()
    rest[:LANDMARKS] += offsets
    for row, valid, offset in zip(points.rows, points.valid, offsets, strict=False):  # curves have own lengths
        beyond = row[valid & (row >= LANDMARKS)]
        rest[beyond] += offset
    for upper, lower, closing in lid_pairs(names):
        apart = 0.5 * (offsets[upper] - offsets[lower])[:, None] * closing.to(offsets)
        basis[upper] -= apart
        basis[lower] += apart
    return replace(points, rest=rest, basis=basis)
