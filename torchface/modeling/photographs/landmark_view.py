"""Landmarks in photographs of a linear face: where its points are seen, and their derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.cameras.sliding_contour import LevelCurves, outermost
from torchface.geometry.rotations import cross_matrix, rotation_matrix
from torchface.landmarks.images.ibug_68 import as_annotated

LANDMARKS = 68
JAW = 17
"""How many of the 68 landmarks trace the face's contour; they come first."""
BROWS = slice(17, 27)
"""Which of them trace the brows."""
LIPS = slice(48, 68)
"""Which of them trace the lips."""


@dataclass(frozen=True, eq=False)
class LandmarkSites:
    """Where on a mesh points are that pictures show."""

    landmarks: Tensor  # vertices of the 68, (68,)
    curves: LevelCurves  # that the contour's ones slide along
    annotated: bool = False  # the 68 lie where annotators put them
    faces: Tensor | None = None  # of the mesh, (F,3); not needed without other points
    surface: Attachment | None = None  # other points of the surface; none if absent


@dataclass(frozen=True, eq=False)
class LinearPoints:
    """Points by D coefficients: landmarks, others of the surface, curves that contour landmarks slide along."""

    mean: Tensor  # (P,3); the first 68 rows are the landmarks, those of the surface follow, then the curves
    basis: Tensor  # what a unit of each coefficient adds, (D,P,3)
    rows: Tensor  # which points each contour landmark may be, (J,C) into P; the first is the landmark itself
    valid: Tensor  # which of them count, (J,C) bool
    side: Tensor  # of the face, +1 toward positive x, (J,)

    @staticmethod
    def of(mean: Tensor, modes: Tensor, sites: LandmarkSites) -> "LinearPoints":
        """Those of a whole mesh: mean (V,3), modes (D,V,3)."""
        stacked, curves, landmarks = torch.cat([mean[None], modes]), sites.curves, sites.landmarks
        used, place = torch.cat([landmarks, curves.vertices.flatten()]).unique(return_inverse=True)
        values = stacked[:, used].transpose(0, 1).double()
        local = replace(curves, vertices=place[len(landmarks) :].reshape(curves.vertices.shape))
        on_curves = local.interpolate(values).flatten(0, 1).transpose(0, 1)
        marks = values[place[: len(landmarks)]].transpose(0, 1)
        points = [as_annotated(marks) if sites.annotated else marks]
        if sites.surface is not None and sites.faces is not None:
            points.append(sites.surface.on(sites.faces, stacked).double())
        count = sum(part.shape[1] for part in points)
        rows = count + torch.arange(curves.valid.numel()).reshape(curves.valid.shape)
        whole = torch.cat([*points, on_curves], dim=1)
        return LinearPoints(whole[0], whole[1:], rows, curves.valid, curves.side)

    @property
    def count(self) -> int:
        """How many points are looked for in a picture: the landmarks and those of the surface."""
        return len(self.mean) - self.rows.numel()

    def at(self, coefficients: Tensor) -> Tensor:
        """Positions (...,P,3) at coefficients (...,D)."""
        return self.mean + torch.tensordot(coefficients, self.basis, dims=1)

    def picked(self, rows: Tensor) -> "PickedPoints":
        """Those of rows (I,L)."""
        return PickedPoints(self.mean[rows], self.basis.movedim(0, -1)[rows])


@dataclass(frozen=True, eq=False)
class PickedPoints:
    """The points that are landmarks in I views: mean (I,L,3) and basis (I,L,3,D)."""

    mean: Tensor
    basis: Tensor

    def at(self, coefficients: Tensor) -> Tensor:
        """Positions (I,L,3) at each view's coefficients (I,D)."""
        return self.mean + (self.basis @ coefficients[:, None, :, None])[..., 0]


@dataclass(frozen=True, eq=False)
class Views:
    """How I cameras stand: intrinsics (I,3,3), world to camera rotation (I,3,3) and translation (I,3)."""

    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "Views":
        """Those of cameras."""
        intrinsics, rotation, translation = zip(
            *((c.intrinsics, c.rotation, c.translation) for c in cameras), strict=True
        )
        return Views(*(torch.stack(part).double() for part in (intrinsics, rotation, translation)))

    def moved(self, step: Tensor, focal_step: Tensor) -> "Views":
        """Rotated and translated by (I,6), with focal lengths longer by the factors exp of (I,)."""
        focal = torch.stack([focal_step.exp(), focal_step.exp(), torch.ones_like(focal_step)], dim=-1)
        scaled = self.intrinsics * torch.where(torch.eye(3, dtype=torch.bool), focal[:, :, None], 1.0)
        return Views(scaled, rotation_matrix(step[:, :3]) @ self.rotation, self.translation + step[:, 3:])

    def pixels(self, points: Tensor) -> Tensor:
        """Where points (I,L,3) or (L,3) are seen, (I,L,2)."""
        seen = points @ self.rotation.transpose(-1, -2) + self.translation[:, None]
        image = seen @ self.intrinsics.transpose(-1, -2)
        return image[..., :2] / image[..., 2:]


def chosen_points(points: LinearPoints, coefficients: Tensor, views: Views, slides: bool = True) -> Tensor:
    """Which point each landmark is in each view, rows (I,68) into the points, of the views' coefficients (I,D).

    A contour landmark is the point of its curve that the view shows furthest out from the face's own vertical;
    on the near side of a rotated face that is the landmark's own vertex.
    """
    rows = torch.arange(points.count).expand(len(views.rotation), -1).clone()
    if slides:
        at = points.at(coefficients)
        seen = views.pixels(at[:, points.rows].flatten(1, 2)).unflatten(1, points.rows.shape)
        up = views.rotation[:, :2, 1]
        across = torch.nn.functional.normalize(torch.stack([-up[:, 1], up[:, 0]], dim=-1), dim=-1)
        across = across * torch.where((across * views.rotation[:, :2, 0]).sum(-1) < 0, -1.0, 1.0)[:, None]
        best = outermost(seen, points.valid, across[:, None] * points.side[:, None])
        moved = best > 0
        slid = points.rows[torch.arange(len(points.rows)), best]
        rows[:, : len(points.rows)] = torch.where(moved, slid, rows[:, : len(points.rows)])
    return rows


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals of I views with L landmarks, whitened, and their derivatives."""

    residual: Tensor  # seen minus found, (I,L,2)
    by_coefficients: Tensor  # (I,L,2,D)
    by_camera: Tensor  # by rotation and translation, (I,L,2,6)
    by_focal: Tensor  # by the focal length's logarithm, (I,L,2)


@dataclass(frozen=True, eq=False)
class Whitening:
    """What makes errors of L points in I views unit and independent."""

    factors: Tensor  # of each point, (I,L,2,2)
    mixing: Tensor | None = None  # across points whose errors go together, (I,L,L); nothing if absent

    def scaled(self, values: Tensor) -> Tensor:
        """Values (I,L,2,...) in each point's own deviations."""
        whole = values.flatten(3) if values.ndim > 3 else values[..., None]
        return (self.factors @ whole).reshape(values.shape)

    def mixed(self, values: Tensor) -> Tensor:
        """What ``scaled`` gives, free of what points' errors have in common."""
        if self.mixing is None:
            return values
        return (self.mixing @ values.flatten(2)).reshape(values.shape)


def linearised(
    points: PickedPoints, coefficients: Tensor, views: Views, found: Tensor, whitening: Whitening
) -> Linearised:
    """At coefficients (I,D) and landmarks found (I,L,2)."""
    rotated = points.at(coefficients) @ views.rotation.transpose(-1, -2)
    pixels, by_translation = pixel_jacobian(rotated + views.translation[:, None], views.intrinsics)
    by_translation = whitening.scaled(by_translation)
    by_world = by_translation @ views.rotation[:, None]
    return Linearised(
        whitening.mixed(whitening.scaled(pixels - found)),
        whitening.mixed(by_world @ points.basis),
        whitening.mixed(torch.cat([by_translation @ -cross_matrix(rotated), by_translation], dim=-1)),
        whitening.mixed(whitening.scaled(pixels - views.intrinsics[:, None, :2, 2])),
    )


def residuals(points: PickedPoints, coefficients: Tensor, views: Views, found: Tensor, whitening: Whitening) -> Tensor:
    """The residuals of ``linearised`` alone, (I,L,2)."""
    return whitening.mixed(whitening.scaled(views.pixels(points.at(coefficients)) - found))
