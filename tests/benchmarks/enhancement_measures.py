"""How an enhanced animation compares with the truth: its fine part, its normals, its places, its flicker."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.enhancement.detail.low_pass import LowPass, vertex_areas
from torchface.geometry.meshes.operators import components, vertex_normals

_FRAMES = 20  # at once


@dataclass(frozen=True, eq=False)
class Errors:
    """Sums over frames of squared errors at each vertex, and how many frames they are of."""

    fine: Tensor  # of the part that the low-pass takes away, mm², (V,)
    angle: Tensor  # of normals, square degrees, (V,)
    place: Tensor  # of vertices, mm², (V,)
    flicker: Tensor  # squared second difference in time of the fine part, mm², (V,)
    frames: int  # that were compared

    def __add__(self, other: "Errors") -> "Errors":
        return Errors(
            self.fine + other.fine, self.angle + other.angle, self.place + other.place, self.flicker + other.flicker,
            self.frames + other.frames,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Known:
    """The truth (T,V,3), its fine part and normals, (T,V,3) each, and its squared second differences summed, (V,)."""

    truth: Tensor
    fine: Tensor
    normals: Tensor
    flicker: Tensor


@dataclass(frozen=True)
class Shares:
    """Figures of one method in one region: shares of the smooth input's error, and flicker as one of the truth's."""

    fine: float  # root mean square error of the fine part
    angle: float  # root mean square angle of normals
    place: float  # root mean square error of vertices, millimetres
    flicker: float  # root mean square second difference in time of the fine part, of the truth's own


class Ruler:
    """Compares animations of one skin.

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.
        low_pass: what separates fine from smooth.
    """

    def __init__(self, neutral: Tensor, faces: Tensor, low_pass: LowPass) -> None:
        self._faces, self._low_pass = faces, low_pass
        self.areas = vertex_areas(neutral, faces).float()
        part = components(faces, len(neutral))
        self.skin = part == part.bincount().argmax()
        """Which vertices are compared, (V,): those of the largest connected part, not eyes or teeth."""

    def smooth(self, displacements: Tensor) -> Tensor:
        """What the low-pass leaves of displacements (T,V,3)."""
        return torch.cat([self._low_pass(some) for some in displacements.split(_FRAMES)])

    def fine(self, displacements: Tensor) -> Tensor:
        """What the low-pass takes away of displacements (T,V,3)."""
        return displacements - self.smooth(displacements)

    def known(self, truth: Tensor) -> Known:
        """What is asked of the truth, consecutive frames (T,V,3), again and again."""
        normals = torch.cat([vertex_normals(some, self._faces) for some in truth.split(_FRAMES)])
        fine = self.fine(truth)
        return Known(truth, fine, normals, fine.diff(n=2, dim=0).square().sum((0, 2)))

    def errors(self, found: Tensor, known: Known) -> Errors:
        """Of consecutive frames (T,V,3)."""
        fine = self.fine(found)
        angle = torch.zeros(len(self.areas))
        for ours, true in zip(found.split(_FRAMES), known.normals.split(_FRAMES), strict=True):
            product = vertex_normals(ours, self._faces).mul(true).sum(-1)
            angle += product.clamp(-1, 1).acos().rad2deg().square().sum(0)
        return Errors(
            (fine - known.fine).square().sum((0, 2)), angle, (found - known.truth).square().sum((0, 2)),
            fine.diff(n=2, dim=0).square().sum((0, 2)), len(found),
        )  # fmt: skip

    def shares(self, found: Errors, smooth: Errors, truth_flicker: Tensor, where: Tensor | None = None) -> Shares:
        """Within some of the vertices (V,), or all of the skin."""
        area = self.areas * (self.skin if where is None else self.skin & where)

        def ratio(one: Tensor, other: Tensor) -> float:
            return float(((one * area).sum() / (other * area).sum().clamp(min=1e-12)).sqrt())

        place = float(((found.place * area).sum() / area.sum() / found.frames).sqrt())
        return Shares(
            ratio(found.fine, smooth.fine), ratio(found.angle, smooth.angle), place,
            ratio(found.flicker, truth_flicker),
        )  # fmt: skip

    def relief(self, errors: Errors, where: Tensor | None = None) -> float:
        """Root mean square of the fine part's error itself, micrometres."""
        area = self.areas * (self.skin if where is None else self.skin & where)
        return 1000 * float(((errors.fine * area).sum() / area.sum() / errors.frames).sqrt())
