"""Other ways from a smooth frame and a database of captured frames to the frame's fine detail."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchface.enhancement.detail.detail_encodings import DisplacementDetail, GradientDetail
from torchface.enhancement.detail.low_pass import LowPass
from torchface.enhancement.detail.surface_frames import SurfaceFrames
from torchface.enhancement.matching.patches import grow_patches
from torchface.geometry.meshes.operators import edges, triangle_areas
from torchface.optim import simplex_qp

_FRAMES = 20  # at once
_RIDGE = 1e-4  # of H's mean diagonal: neighbouring frames are nearly equal

Method = Callable[[Tensor], Tensor]
"""From coarse frames (T,V,3) to enhanced ones (T,V,3)."""


class Database:
    """Captured frames as every peer is given them: smooth part, features of it, and fine part, uncompressed.

    The head does not move in these frames, so nothing is aligned.

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.
        frames: (K,V,3).
        coarse: the same frames as the coarse animation has them, (K,V,3): details are then what that lacks, and what
            is asked keeps all of its own.
        patch_size: vertices of a patch whose features are averaged.
    """

    def __init__(
        self, neutral: Tensor, faces: Tensor, frames: Tensor, coarse: Tensor | None = None, patch_size: int = 100
    ) -> None:
        self.faces, self.low_pass = faces, LowPass(neutral, faces)
        self.neutral = neutral
        self.rest = self.smooth(neutral[None])[0]
        self.patches = grow_patches(faces, len(neutral), patch_size)
        frames_of = self._frames = SurfaceFrames(self.rest, faces)
        self._gradients = frames_of.patch_gradients(self.patches, faces, self.rest)
        self.detail = self._detail(frames_of)
        areas = triangle_areas(neutral, faces)
        self.patch_areas = torch.zeros(int(self.patches.max()) + 1).index_add_(0, self.patches, areas)
        self.paired = coarse is not None
        self.low = self.smooth(frames if coarse is None else coarse)
        self.features = self.encode(self.low)
        lacking = frames if coarse is None else self.low + (frames - coarse)
        pairs = zip(self.low.split(_FRAMES), lacking.split(_FRAMES), strict=True)
        self.details = torch.cat([self.detail.encode(low, full).half() for low, full in pairs])

    def _detail(self, frames_of: SurfaceFrames) -> DisplacementDetail | GradientDetail:
        return DisplacementDetail(self.neutral, self.faces, frames_of)

    def smooth(self, frames: Tensor) -> Tensor:
        """The smooth part of frames (T,V,3): of displacements, so that the neutral stays as it is."""
        return torch.cat([self.neutral + self.low_pass(some - self.neutral) for some in frames.split(_FRAMES)])

    def encode(self, low: Tensor) -> Tensor:
        """Features (T,P,9) of smooth frames."""
        moved = [some - self.rest for some in low.split(_FRAMES)]
        return torch.cat([self._gradients.features(some, self._frames.turned(some)) for some in moved])

    def weighted(self, features: Tensor, patch_weights: Tensor | None = None) -> Tensor:
        """Features as vectors (T,9P) whose squared distance counts each patch by its area and weight (P,)."""
        weight = self.patch_areas if patch_weights is None else self.patch_areas * patch_weights
        return (features * (weight / weight.sum()).sqrt()[None, :, None]).flatten(1)

    def blend(self, weights: Tensor) -> Tensor:
        """Details (T,n) of weights (T,K): of the frames that have any."""
        used = (weights != 0).any(0)
        return weights[:, used] @ self.details[used].float()

    def compose(self, coarse: Tensor, low: Tensor, details: Tensor) -> Tensor:
        """Frames (T,V,3) of coarse ones, their smooth parts, and details."""
        pairs = zip(low.split(_FRAMES), details.split(_FRAMES), strict=True)
        found = torch.cat([self.detail.compose(some, fine) for some, fine in pairs])
        return found + (coarse - low) if self.paired else found


class PapersForm(Database):
    """The same as the paper has it: whole shapes are smoothed, and details are gradients of triangles.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, sections 4.2, 5.4, 5.5.
    """

    def _detail(self, frames_of: SurfaceFrames) -> DisplacementDetail | GradientDetail:
        return GradientDetail(self.rest, self.faces)

    def smooth(self, frames: Tensor) -> Tensor:
        """One implicit step of curvature flow, then one pass of the uniform Laplacian against collapsed triangles."""
        ends = edges(self.faces)
        both = torch.cat([ends, ends.flip(1)])
        count = both[:, 0].bincount(minlength=len(self.neutral)).clamp(min=1)[:, None]
        smooth = []
        for some in frames.split(_FRAMES):
            once = self.low_pass(some)
            smooth.append(torch.zeros_like(once).index_add_(1, both[:, 0], once[:, both[:, 1]]) / count)
        return torch.cat(smooth)


def convex_weights(database: Tensor, asked: Tensor) -> Tensor:
    """Weights (T,K) of the convex combination of the database's vectors (K,D) that is nearest to those asked (T,D)."""
    rows = database.double()
    H = rows @ rows.T
    H += _RIDGE * float(H.diagonal().mean()) * torch.eye(len(H), dtype=H.dtype)
    return simplex_qp(H, -asked.double() @ rows.T).float()


def nearest_frame(database: Database) -> Method:
    """The detail of the one frame whose smooth part is most alike."""

    def enhance(coarse: Tensor) -> Tensor:
        low = database.smooth(coarse)
        asked = database.weighted(database.encode(low))
        found = torch.cdist(asked, database.weighted(database.features)).argmin(1)
        return database.compose(coarse, low, database.details[found].float())

    return enhance


def convex(database: Database, patch_weights: Tensor, vertex_weights: Tensor) -> Method:
    """Convex combinations of frames, one a region: equations 2 to 4 of the paper.

    Args:
        database: the captured frames.
        patch_weights: how much each patch counts in each region's match, (R,P).
        vertex_weights: how much of each region's detail each vertex gets, (R,V), sum 1.
    """

    def enhance(coarse: Tensor) -> Tensor:
        low = database.smooth(coarse)
        features = database.encode(low)
        details = torch.zeros(len(coarse), database.details.shape[1])
        for patches, vertices in zip(patch_weights, vertex_weights, strict=True):
            weights = convex_weights(
                database.weighted(database.features, patches), database.weighted(features, patches)
            )
            share = database.detail.site_weights(vertices[None])
            details += database.blend(weights) * share.repeat(1, details.shape[1] // share.shape[1])
        return database.compose(coarse, low, details)

    return enhance


def holistic(database: Database) -> Method:
    """One convex combination for the whole face."""
    return convex(database, torch.ones(1, len(database.patch_areas)), torch.ones(1, len(database.neutral)))


def ridge_on_components(database: Database, components: int = 60) -> Method:
    """Linear regression of the detail on principal components of the features, its ridge by leaving one frame out."""
    vectors = database.weighted(database.features)
    details = database.details.float()
    mean, detail_mean = vectors.mean(0), details.mean(0)
    _, sizes, rows = torch.linalg.svd(vectors - mean, full_matrices=False)
    rows = rows[:components]
    codes = (vectors - mean) @ rows.T
    scores = details - detail_mean
    basis, spread, _ = torch.linalg.svd(codes, full_matrices=False)
    best, ridge = float("inf"), 0.0
    gram = scores @ scores.T  # the left-out error needs products of details alone
    for trial in torch.logspace(-7, 0, 15).tolist():
        hat = (basis * (spread.square() / (spread.square() + trial * sizes[0] ** 2))) @ basis.T
        left = torch.eye(len(hat)) - hat
        scaled = left / (1 - hat.diagonal()).clamp(min=1e-3)[:, None]
        error = float(((scaled @ gram) * scaled).sum())
        if error < best:
            best, ridge = error, trial * float(sizes[0] ** 2)
    regression = torch.linalg.solve(codes.T @ codes + ridge * torch.eye(codes.shape[1]), codes.T)

    def enhance(coarse: Tensor) -> Tensor:
        low = database.smooth(coarse)
        asked = (database.weighted(database.encode(low)) - mean) @ rows.T
        return database.compose(coarse, low, detail_mean + (asked @ regression) @ scores)

    return enhance


def polynomial_maps(database: Database, strain: bool, ridge: float = 1e-3) -> Method:
    r"""Biquadratic polynomials of two local motion parameters, fitted at every vertex.

    The parameters are the first two principal components, over the database, of the smooth motion at the vertex: its
    displacement, or (``strain``) the features of the patch round it.

    Source: Ma et al. 2008, Facial performance synthesis using deformation-driven polynomial displacement maps.
    """
    patch_of = torch.zeros(len(database.neutral), dtype=torch.int64)
    for corner in database.faces.unbind(1):
        patch_of[corner] = database.patches

    def motion(low: Tensor) -> Tensor:
        return database.encode(low)[:, patch_of] if strain else low - database.neutral

    known = motion(database.low)
    centre = known.mean(0)
    spread = torch.einsum("kvi,kvj->vij", known - centre, known - centre) / len(known)
    sizes, axes = torch.linalg.eigh(spread)
    axes = axes[:, :, -2:] / sizes[:, None, -2:].clamp(min=1e-12).sqrt()

    def polynomial(low: Tensor) -> Tensor:
        u, v = torch.einsum("kvi,vij->kvj", motion(low) - centre, axes).unbind(-1)
        return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], dim=-1)

    terms = polynomial(database.low)
    targets = database.details.float().unflatten(1, (3, -1))
    gram = torch.einsum("kvi,kvj->vij", terms, terms) + ridge * len(terms) * torch.eye(6)
    coefficients = torch.linalg.solve(gram, torch.einsum("kvi,kcv->vic", terms, targets))

    def enhance(coarse: Tensor) -> Tensor:
        low = database.smooth(coarse)
        details = [
            torch.einsum("kvi,vic->kcv", polynomial(some), coefficients).flatten(1) for some in low.split(_FRAMES)
        ]
        return database.compose(coarse, low, torch.cat(details))

    return enhance
