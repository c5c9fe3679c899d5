"""Settings of a fit to photographs: the noise of points, the priors on faces, and what is made of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ShapeError
from torchface.geometry.cameras.pinhole import MAX_SIDE
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number


class WeightQuadratic(Protocol):
    """An energy ½ wᵀ H w + fᵀ w of weights (E,N): H (E,N,N) or (N,N), f (E,N)."""

    @property
    def H(self) -> Tensor: ...
    @property
    def f(self) -> Tensor: ...


class ExpressionPrior(Protocol):
    """Which weights faces have, as ``ShapePrior`` knows it."""

    def energy(self, weights: Tensor) -> WeightQuadratic:
        """A quadratic that touches minus the log density at weights (E,N) from above."""
        ...


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of the face's surface as a dense network finds them beside the 68 landmarks."""

    points: Tensor  # (I,P,2) pixels; NaN for missing
    deviations: Tensor  # standard deviations of a coordinate as they are stated, (I,P) pixels
    sites: Attachment  # where they lie on the rig's mesh, P of them


@dataclass(frozen=True)
class FitSettings:
    """The noise of landmarks, the priors on faces, and what is made of them.

    Args:
        inner_weight: of a squared error at brows, eyes, nose and mouth beside one at the contour.
        contour_slide: how much less an error along the face's contour counts than one across it, 0 to 1; 1 takes
            contour landmarks as points.
        sliding: contour landmarks of the far side move to the visible silhouette; what fits better if absent.
        deviations: what each landmark is expected to be off by, (I,68) pixels, counted beside their view's median.
        surface: further points of the face; with them errors of neighbours are taken to go together.
        annotated: landmarks lie where annotators put them; see ``as_annotated`` and ``annotated_vertices``.
        expression_prior: which weights of the rig's shapes go together, in place of the mean and the ridge below.
        sparsity: beside that prior, for a weight of 1.
        expression_mean: how strong a shape is on average, in weights; the prior falls exponentially.
        expression_ridge: prior deviation of a weight beside that.
        asymmetry: prior deviation of the difference between a shape's weight and its mirror image's.
        one_expression: all photographs show the same one, as taken at once; else each has its own.
        identity_bound: on each coefficient, standard deviations.
        unknown_deviation: of differences that the model does not know, millimetres on average; 0 holds heads to it.
        noise: of an inner landmark, pixels; estimated from the residuals if absent.
        least_noise: that such an estimate comes down to, of the distance of the eyes' outer corners.
        focal_deviation: relative deviation of the true focal length from the given one; 0 takes it as exact.
        shared_focal: one focal length for all photographs.
        max_iterations: of Gauss-Newton.
        transfers: how often shapes are transferred to the head found; 0 keeps the template's.
        texture_size: of the skin, texels a side; 0 makes no texture.
        irises: centres of the irises in each photograph, (I,2,2) pixels, NaN where unknown: their colour is there.
        parts: what each photograph shows: skin and features alone are projected onto the head; all if absent.
        match_skin: move the head until several photographs show the same skin at the same place; see ``agreed_skin``.
        paint_hair: paint the hair that photographs show on the head; else its colour is found alone.

    Raises:
        ValueRangeError: a setting is NaN, infinite or out of its range.
        ShapeError: deviations of another shape.

    Example:
        >>> FitSettings(focal_deviation=0.05, shared_focal=True).identity_bound
        3.0
    """

    inner_weight: float = 2.0
    contour_slide: float = 0.3
    sliding: bool | None = None
    deviations: Tensor | None = None
    surface: SurfacePoints | None = None
    annotated: bool = False
    expression_prior: ExpressionPrior | None = None
    sparsity: float = 1.0
    expression_mean: float = 0.2
    expression_ridge: float = 0.5
    asymmetry: float = 0.1
    one_expression: bool = False
    identity_bound: float = 3.0
    unknown_deviation: float = 1.0
    noise: float | None = None
    least_noise: float = 0.0
    focal_deviation: float = 0.0
    shared_focal: bool = True
    max_iterations: int = 20
    transfers: int = 1
    texture_size: int = 1024
    irises: Tensor | None = None
    parts: Sequence[FaceParts] | None = None
    paint_hair: bool = True
    match_skin: bool = True

    def __post_init__(self) -> None:
        for name in ("inner_weight", "expression_mean", "expression_ridge", "asymmetry", "identity_bound"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT, above=True)
        if self.deviations is not None and self.deviations.shape[1:] != (LANDMARKS,):
            raise ShapeError(f"deviations: found {tuple(self.deviations.shape)}, expected (I,{LANDMARKS})")
        if self.noise is not None:
            checked_number("noise", self.noise, above=True)
        checked_number("contour_slide", self.contour_slide, 0.0, 1.0)
        for name in ("focal_deviation", "sparsity", "unknown_deviation", "least_noise"):
            checked_number(name, getattr(self, name))
        checked_count("max_iterations", self.max_iterations, 1)
        checked_count("transfers", self.transfers)
        checked_count("texture_size", self.texture_size, 0, MAX_SIDE)
