"""Pull of landmarks: points of the face in full, those of its contour as far as the surface agrees."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import INNER
from torchface.mesh import Mesh

_DISAGREES = 10.0
_CONTOUR, _NOSE, _NOSE_SHARE = slice(INNER.start), slice(27, 36), 0.01
_REMARKABLE, _MOST_NAMED = 5.0, 8


@dataclass(frozen=True, eq=False)
class LandmarkPull:
    """Template vertices and where they belong."""

    vertices: Tensor  # (L,) int64
    points: Tensor  # (L,3) float64
    # Which of them outline the jaw, (L,) bool: annotators set these along the outline that they see, in an image or
    # from a side, and not at a place of the skin.
    contour: Tensor
    # Which of them lie on the nose, (L,) bool, whose shape shows where each belongs: where every vertex moves by
    # itself, a landmark that is a millimetre off would pull the tip out of the surface or along it.
    shaped: Tensor
    numbers: Tensor  # what each is called in messages, (L,): iBUG's number from 0, or the row of the given ones

    @staticmethod
    def of(vertices: Tensor, points: Tensor, template: Mesh) -> "LandmarkPull":
        """With the contour given by the template's 68 landmarks, where it has as many."""
        contour = shaped = torch.zeros(len(vertices), dtype=torch.bool)
        known = None if template.annotations is None else template.annotations.landmarks
        if known is not None and len(known) == 68:
            contour, shaped = (torch.isin(vertices, known[rows].cpu()) for rows in (_CONTOUR, _NOSE))
        numbers = torch.arange(len(vertices))
        if known is not None:
            same = vertices[:, None] == known.cpu()
            numbers = torch.where(same.any(1), same.long().argmax(1), numbers)
        return LandmarkPull(vertices, points, contour, shaped, numbers)

    @staticmethod
    def none() -> "LandmarkPull":
        """No landmark at all."""
        empty = torch.zeros(0, dtype=torch.int64)
        return LandmarkPull(empty, torch.zeros(0, 3, dtype=torch.float64), empty.bool(), empty.bool(), empty)

    def subset(self, rows: Tensor) -> "LandmarkPull":
        """Those of a mask (L,) or of rows."""
        return LandmarkPull(*(part[rows] for part in vars(self).values()))

    def distance(self, current: Tensor) -> Tensor:
        """How far each landmark's vertex is from its point, (L,) millimetres, with the vertices (V,3)."""
        return (current[self.vertices] - self.points).norm(dim=-1)

    def slid(self, current: Tensor) -> float:
        """How far the landmarks inside the face lie from their vertices (V,3), median, millimetres; NaN without any."""
        inside = self.distance(current)[~self.contour]
        return float(inside.median()) if len(inside) else float("nan")

    def weights(self, current: Tensor, single: bool = False) -> Tensor:
        r"""How much each counts, (L,) in [0,1], with the vertices (V,3) where they are.

        1 inside the face, but 0.01 on the nose where each vertex moves by itself (``single``): there the surface is
        right. Along the contour :math:`(1 - r^2/c^2)^2` (Tukey) with r the distance that is left, and nothing from
        c = 10 mm on: what the surface and the other landmarks contradict lets go.
        """
        kept = (1 - (self.distance(current) / _DISAGREES).square()).clamp(min=0).square()
        inside = torch.where(self.shaped, _NOSE_SHARE, 1.0) if single else torch.ones_like(kept)
        return torch.where(self.contour, kept, inside.to(kept))

    def disagreement(self, current: Tensor) -> list[str]:
        """A note of what the landmarks contradict, with the vertices (V,3) as the surface has left them; else none."""
        off = self.distance(current)
        remarks = []
        for what, rows in (("along the jaw", self.contour), ("inside the face", ~self.contour)):
            wrong = rows & (off > _REMARKABLE)
            if wrong.any():
                worst = [i for i in off.argsort(descending=True).tolist() if wrong[i]]
                named = ", ".join(str(int(self.numbers[i])) for i in worst[:_MOST_NAMED])
                more = " ..." if len(worst) > _MOST_NAMED else ""
                remarks.append(
                    f"{len(worst)} of {int(rows.sum())} {what} ({named}{more}) by {float(off[wrong].mean()):.1f} mm on "
                    f"average, at worst {float(off[wrong].max()):.1f} mm"
                )
        if not remarks:
            return []
        let_go = "; those along the jaw were let go" if (self.contour & (off > _DISAGREES)).any() else ""
        return [
            f"landmarks disagree with the surface, on which the registered mesh lies beside them: "
            f"{' and '.join(remarks)}{let_go}. They are likely picked or found at wrong places: look at them beside "
            "the registered mesh (torchface register writes NAME.glb and contact_sheet.png), "
            "correct them in their file or leave those out"
        ]
