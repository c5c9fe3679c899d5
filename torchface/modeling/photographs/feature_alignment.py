"""Photographs bent so that eyes, nose and lips lie where the fitted head has them."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.landmark_view import BROWS, JAW

# In distances between the eyes' outer corners: how far a landmark's displacement reaches, and how far apart it is
# looked up. Landmarks are off by a part of their displacement, so it is not followed in full.
_REACH, _STEP, _DOUBT = 0.25, 0.04, 0.2


@dataclass(frozen=True, eq=False)
class Displacement:
    """A smooth displacement of a picture that moves L places by given steps; it fades beyond them."""

    places: Tensor  # (L,2) pixels
    factors: Tensor  # of the Gaussian bumps about them, (L,2) pixels
    reach: float  # their standard deviation, pixels

    @staticmethod
    def of(places: Tensor, steps: Tensor, unit: float) -> "Displacement":
        """Follows steps (L,2) of places (L,2), NaN for missing, as far as they agree; ``unit`` is the eyes'
        distance, pixels. Source: the mean of a Gaussian process; Rasmussen and Williams 2006, equation 2.25."""
        known = torch.isfinite(steps).all(-1) & torch.isfinite(places).all(-1)
        places, reach = places[known].double(), _REACH * unit
        alike = _bumps(places, places, reach) + _DOUBT * torch.eye(len(places), dtype=torch.float64)
        return Displacement(places, torch.linalg.solve(alike, steps[known].double()), reach)

    def at(self, pixels: Tensor) -> Tensor:
        """The displacement (...,2) of pixels (...,2)."""
        return _bumps(pixels.double().reshape(-1, 2), self.places, self.reach) @ self.factors.reshape(-1, 2)


def _bumps(pixels: Tensor, places: Tensor, reach: float) -> Tensor:
    return torch.exp(-torch.cdist(pixels, places).square() / (2 * reach**2))


@dataclass(frozen=True, eq=False)
class FeatureAlignment:
    """How a photograph is bent."""

    to_found: Displacement  # from where the fitted head shows a place to where the photograph does
    to_fitted: Displacement  # the way back
    unit: float  # the distance of the eyes' outer corners, pixels

    @staticmethod
    def of(fitted: Tensor, residuals: Tensor) -> "FeatureAlignment":
        """By the landmarks (68,2) of the fitted head and how far they lie from those found, (68,2); NaN for missing.

        Landmarks of the contour slide along it, so what they are off along it is none of the face's. Brows are hair:
        they stay where they grow.
        """
        steps = -residuals.double()
        along = normalize(fitted[1:JAW].double() - fitted[: JAW - 1].double(), dim=-1)
        along = normalize(torch.cat([along[:1], along[1:] + along[:-1], along[-1:]]), dim=-1)
        steps[:JAW] -= (steps[:JAW] * along).sum(-1, keepdim=True) * along
        steps[BROWS] = torch.nan
        unit = float((fitted[45] - fitted[36]).norm())
        places = fitted.double()
        return FeatureAlignment(
            Displacement.of(places, steps, unit), Displacement.of(places + steps, -steps, unit), unit
        )

    def image(self, image: Tensor) -> Tensor:
        """A photograph (3,H,W) as the fitted head shows it."""
        height, width = image.shape[1:]
        step = max(1.0, _STEP * self.unit)
        across, down = (max(2, round(n / step)) for n in (width, height))
        coarse = (torch.linspace(0, n - 1, k, dtype=torch.float64) for n, k in ((width, across), (height, down)))
        grid = torch.stack(torch.meshgrid(*coarse, indexing="xy"), dim=-1)
        moved = self.to_found.at(grid).view_as(grid).float().numpy()
        fine = (np.linspace(0, k - 1, n, dtype=np.float32) for n, k in ((width, across), (height, down)))
        x, y = np.meshgrid(*fine)
        at = cv2.remap(moved, x, y, cv2.INTER_LINEAR)  # float32, for photographs are large
        at += np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (width, height))), axis=-1)
        return torch.stack([_looked_up(channel, at, cv2.INTER_CUBIC) for channel in image]).clamp(0, 1)

    def parts(self, parts: FaceParts) -> FaceParts:
        """What the bent photograph shows."""
        size = parts.shares.shape[-1]
        side = torch.arange(size, dtype=torch.float64)
        crop = torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1)
        turn, shift = parts.transform[:, :2], parts.transform[:, 2]
        moved = self.to_found.at((crop - shift) @ torch.linalg.inv(turn).T).view_as(crop) @ turn.T
        at = (crop + moved).float().numpy()
        return replace(parts, shares=torch.stack([_looked_up(share, at, cv2.INTER_LINEAR) for share in parts.shares]))

    def points(self, points: Tensor) -> Tensor:
        """Where the bent photograph shows its points (...,2)."""
        return points.double() + self.to_fitted.at(points).view(points.shape)


def _looked_up(picture: Tensor, at: np.ndarray, how: int) -> Tensor:
    """A picture (H,W) at places (H,W,2) float32, x before y."""
    x, y = at[..., 0].copy(), at[..., 1].copy()
    return torch.from_numpy(cv2.remap(picture.numpy(), x, y, how, borderMode=cv2.BORDER_REPLICATE))
