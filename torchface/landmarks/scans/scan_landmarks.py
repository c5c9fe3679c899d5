"""The twelve landmarks and the lip and lid lines of a raw scan, found in its unwrapped image."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.landmarks.scans.contours import Contour, trace_contour
from torchface.landmarks.scans.cylinder import CylinderLayout, UnwrappedHead, unwrap
from torchface.landmarks.scans.line_shape import LineShape
from torchface.landmarks.scans.uv_detector import UVLandmarkDetector
from torchface.landmarks.scans.uv_landmark_names import LINES
from torchface.mesh import Mesh
from torchface.rendering.gaussian_blur import gaussian_blur


def curvature_image(head: UnwrappedHead, scale: float = 1.2, contrast: float = 8.0) -> Tensor:
    r"""Mean curvature of the unwrapped surface as grey: ridges bright, creases dark.

    .. math:: g = \tfrac12 + \tfrac12 \tanh(c H), \quad
       H = \tfrac12 \Big(\frac{n_u \cdot x_u}{x_u \cdot x_u} + \frac{n_v \cdot x_v}{x_v \cdot x_v}\Big)

    with x the surface after a Gaussian blur of its distance from the axis, n its unit normal, u and v along the
    image's axes (that they stay nearly perpendicular is the approximation).

    Between closed lids there is no furrow that a hand-held scanner resolves: the deepest one runs some 3 mm above the
    line where they meet. Tracing in this image therefore goes by the learned look of the line, not by darkness.

    Args:
        head: an unwrapped scan.
        scale: standard deviation of the blur, millimetres: below it all is scanner noise.
        contrast: c, millimetres.

    Returns:
        (1,S,S) in [0,1].

    Example:
        >>> from torchface.landmarks import CylinderLayout, unwrap
        >>> from torchface.geometry.similarity import Similarity
        >>> from torchface.synthetic import neutral_head
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> grey = curvature_image(unwrap(neutral_head(texture=False), still, CylinderLayout(size=64, pitch=4.0)))
        >>> bool(grey.min() >= 0), bool(grey.max() <= 1)
        (True, True)
    """
    layout = head.layout
    smooth = gaussian_blur(head.radius[None, None], scale / layout.pitch)[0, 0].double()
    surface = layout.points(layout.grid(), smooth)
    along_x, along_y = _difference(surface, 1), _difference(surface, 0)
    normal = torch.nn.functional.normalize(torch.linalg.cross(along_y, along_x), dim=-1)
    bend = (_difference(normal, 1) * along_x).sum(-1) / along_x.square().sum(-1)
    bend = bend + (_difference(normal, 0) * along_y).sum(-1) / along_y.square().sum(-1)
    return (0.5 + 0.5 * torch.tanh(contrast * 0.5 * bend))[None].float()


def _difference(field: Tensor, axis: int) -> Tensor:
    """Central differences a pixel along an axis; one-sided at the border."""
    return torch.gradient(field, dim=axis)[0]


_BROAD_SCALE, _BROAD_CONTRAST = 3.0, 16.0  # millimetres; facets of coarse scans and their noise are smaller


@dataclass(frozen=True, eq=False)
class ScanLandmarks:
    """What was found on a scan.

    Args:
        names: of the landmarks.
        points: (L,3) in the scan's space, millimetres.
        confidence: (L,) in [0,1]; 0 where only the usual place is known.
        pixels: (L,2) in the unwrapped image.
        contours: the traced lines by name, in pixels; a line whose corners lie the wrong way round is missing.
        head: the unwrapped scan.
        image: what the detector saw, (C,S,S).
    """

    names: tuple[str, ...]
    points: Tensor
    confidence: Tensor
    pixels: Tensor
    contours: dict[str, Contour]
    head: UnwrappedHead
    image: Tensor

    def line_points(self, scan: Mesh, name: str, shares: Tensor) -> tuple[Tensor, Tensor]:
        """Points (N,3) on the scan at shares (N,) in [0,1] of a line's length in 3D, and whether each can be trusted:
        it lies on the scan, not in a hole, and is as dark as the line."""
        contour = self.contours[name]
        points, seen = self.head.surface_points(scan, contour.points)
        steps = (points[1:] - points[:-1]).norm(dim=-1)
        along = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
        wanted = shares.to(along) * along[-1]
        after = torch.searchsorted(along, wanted).clamp(1, len(points) - 1)
        part = (wanted - along[after - 1]) / (along[after] - along[after - 1]).clamp(min=1e-9)
        good = seen & contour.kept
        return points[after - 1] + part[:, None] * (points[after] - points[after - 1]), good[after - 1] & good[after]


def appearance_image(head: UnwrappedHead, appearance: str) -> Tensor:
    """The image (C,S,S) that a detector of this appearance looks at.

    Raises:
        ValueRangeError: a texture is wanted and the scan has no colours.

    Example:
        >>> from torchface.landmarks import CylinderLayout, unwrap
        >>> from torchface.geometry.similarity import Similarity
        >>> from torchface.synthetic import neutral_head
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> head = unwrap(neutral_head(texture=False), still, CylinderLayout(size=64, pitch=4.0))
        >>> appearance_image(head, "curvature").shape
        torch.Size([1, 64, 64])
    """
    if appearance == "curvature":
        return curvature_image(head, _BROAD_SCALE, _BROAD_CONTRAST)
    if head.texture is None:
        raise ValueRangeError(
            "scan: found no texture and no vertex colours, expected some: this detector learned from textures; "
            "use one that learned from curvature"
        )
    return head.texture


def line_image(head: UnwrappedHead, appearance: str) -> Tensor:
    """The image (C,S,S) in which such a detector traces lines: lips and lids are finer than landmarks.

    Example:
        >>> from torchface.landmarks import CylinderLayout, unwrap
        >>> from torchface.geometry.similarity import Similarity
        >>> from torchface.synthetic import neutral_head
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> head = unwrap(neutral_head(texture=False), still, CylinderLayout(size=64, pitch=4.0))
        >>> line_image(head, "curvature").shape
        torch.Size([1, 64, 64])
    """
    return curvature_image(head) if appearance == "curvature" else appearance_image(head, appearance)


def scan_landmarks(detector: UVLandmarkDetector, scan: Mesh, pose: Similarity | None = None) -> ScanLandmarks:
    """Finds the twelve landmarks and traces lips and lids on a scan.

    Args:
        detector: fitted with a frame.
        scan: millimetres, in any pose.
        pose: a rough one, from the scan's space to the detector's frame; searched for if absent.

    Raises:
        ValueRangeError: the detector has no frame, no face is found, or the scan lacks the texture it needs.

    Source: thesis 3.2.2.
    """
    if detector.frame is None:
        raise ValueRangeError("detector: found one without a FaceFrame, expected one fitted with frame=")
    pose = detector.frame.locate(scan) if pose is None else detector.frame.settle(scan, pose)
    head = unwrap(scan, pose, CylinderLayout().resized(detector.size))
    image = appearance_image(head, detector.appearance)
    with torch.no_grad():
        detected = detector(image[None])
    pixels = detected.pixels[0]
    points, _ = head.surface_points(scan, pixels)
    contours = trace_lines(
        line_image(head, detector.appearance), dict(zip(detector.names, pixels, strict=True)), detector.line_shapes()
    )
    return ScanLandmarks(detector.names, points, detected.confidence[0], pixels, contours, head, image)


def trace_lines(
    image: Tensor, corners: dict[str, Tensor], shapes: dict[str, LineShape] | None = None
) -> dict[str, Contour]:
    """Every line of ``LINES`` whose two corners (2,) are there, the one on the left further left."""
    traced, usual = {}, shapes or {}
    for name, (left, right) in LINES.items():
        if left in corners and right in corners and float(corners[right][0] - corners[left][0]) >= 3:
            traced[name] = trace_contour(image, corners[left], corners[right], shape=usual.get(name))
    return traced
