"""The two encodings of detail: displacements of vertices, or turns and stretches of triangles; both in axes that turn.

Either encodes what a frame has beyond its smooth part, and puts it on another smooth part.
"""

from typing import Literal

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.enhancement.detail.polar_parts import decode_gradients, encode_gradients, polar_parts
from torchface.enhancement.detail.sparse_operator import SparseOperator, solved
from torchface.enhancement.detail.surface_frames import SurfaceFrames, TurnedFrames
from torchface.geometry.meshes.deformation import degenerate_triangles, gradient_operator, triangle_frames
from torchface.geometry.meshes.operators import border_edges, triangle_areas
from torchface.optim.sparse import SparseCholesky

DetailKind = Literal["displacements", "gradients"]

_BORDER = 0.05
_ANCHOR = 1e-6  # of the diagonal's mean: places each part of the mesh, and bends next to nothing


class DisplacementDetail:
    r"""Encodes what a frame has beyond its smooth part, and adds it to another smooth part.

    :math:`d = R_v^\top (x_v - \ell_v)`, with :math:`R_v` the turn of the smooth part's surface at the vertex. Nothing
    is solved for. Numbers of a frame are ordered by axis, (3,V): two tangents, then the normal.
    """

    def __init__(self, neutral: Tensor, faces: Tensor, frames: SurfaceFrames | None = None) -> None:
        self._frames = SurfaceFrames(neutral, faces) if frames is None else frames
        self._neutral = neutral

    @property
    def size(self) -> int:
        """Numbers of one frame's detail, 3V."""
        return 3 * len(self._neutral)

    def encode(self, low: Tensor, frames: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """The detail (B,3V), millimetres, of frames (B,V,3) beyond their smooth parts, whose surface is ``turned``."""
        turned = self._frames.turned(low - self._neutral.to(low)) if turned is None else turned
        return turned.to_local(frames - low).reshape(len(low), -1)

    def compose(self, low: Tensor, details: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """Frames (B,V,3) of smooth parts (B,V,3) and details (B,3V); ``turned`` as for :meth:`encode`."""
        turned = self._frames.turned(low - self._neutral.to(low)) if turned is None else turned
        return low + turned.to_world(details.unflatten(1, (3, -1)))

    def site_weights(self, vertex_weights: Tensor) -> Tensor:
        """Weights of regions where this detail is: at the vertices, (R,V)."""
        return vertex_weights


class GradientDetail:
    r"""Encodes what a frame has beyond its smooth part by triangles, and puts it on another smooth part.

    With :math:`F_\ell = R_\ell S_\ell` the gradient of a triangle from the neutral to the smooth part and F that to
    the frame, the detail is :math:`G = R_\ell^\top F S_\ell^{-1}`, as rotation vector and stretch: the paper's, in
    axes that turn with the smooth part. On another smooth part it becomes :math:`F = R_\ell G S_\ell`, and one solve
    finds the surface. Numbers of a frame are ordered by part, (9,F).

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, sections 4.2, 5.4 and 5.5.
    """

    def __init__(self, neutral: Tensor, faces: Tensor) -> None:
        self._faces = faces
        flat = degenerate_triangles(neutral, faces)
        frames = triangle_frames(neutral.detach().double(), faces)
        frames[flat] = torch.eye(3).to(frames)
        self._inverse = torch.linalg.inv(frames)
        self._flat = flat
        self._reconstruction = SurfaceReconstruction(neutral, faces)

    @property
    def size(self) -> int:
        """Numbers of one frame's detail, 9F."""
        return 9 * len(self._faces)

    def encode(self, low: Tensor, frames: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """The detail (B,9F) of frames (B,V,3) beyond their smooth parts; triangles have rotations of their own."""
        rotation, stretch = polar_parts(self._gradients(low))
        G = rotation.transpose(-1, -2) @ self._gradients(frames) @ torch.linalg.inv(stretch)
        return encode_gradients(G).transpose(1, 2).flatten(1)

    def compose(self, low: Tensor, details: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """Frames (B,V,3) of smooth parts (B,V,3) and details (B,9F); ``turned`` as for :meth:`encode`."""
        rotation, stretch = polar_parts(self._gradients(low))
        G = decode_gradients(details.unflatten(1, (9, -1)).transpose(1, 2))
        changes = rotation @ (G - torch.eye(3).to(G)) @ stretch
        return self._reconstruction(low, changes)

    def site_weights(self, vertex_weights: Tensor) -> Tensor:
        """Weights of regions where this detail is: at the triangles, (R,F)."""
        return vertex_weights[:, self._faces].mean(2)

    def _gradients(self, vertices: Tensor) -> Tensor:
        gradients = triangle_frames(vertices, self._faces) @ self._inverse.to(vertices)
        return torch.where(self._flat[:, None, None], torch.eye(3).to(gradients), gradients)


class SurfaceReconstruction:
    r"""Finds the surface whose gradients differ from a smooth surface's as they should.

    .. math:: x = \ell + A^{-1} \nabla^\top a\,(F - F_\ell), \qquad
        A = \nabla^\top a \nabla + 0.05\, B^\top B + \epsilon I

    with the neutral's gradients :math:`\nabla` and triangle areas a, and B the one-dimensional Laplacian along borders,
    whose bends stay those of the smooth surface. As the unknown is the step from :math:`\ell`, each part of the mesh
    stays in its place.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 5.5; Botsch et al. 2006.
    """

    def __init__(self, neutral: Tensor, faces: Tensor) -> None:
        rest, faces = neutral.detach().double().cpu(), faces.cpu()
        operator = gradient_operator(rest, faces)
        transposed = sparse.csr_array(
            operator.T @ sparse.diags_array(np.repeat(triangle_areas(rest, faces).numpy(), 3))
        )
        border = _border_laplacian(faces, len(rest))
        system = transposed @ operator + _BORDER * (border.T @ border)
        anchor = _ANCHOR * max(float(system.diagonal().mean()), 1e-6)
        self._divergence = SparseOperator(transposed)
        self._factor = SparseCholesky(system + anchor * sparse.eye_array(len(rest)))

    def __call__(self, low: Tensor, changes: Tensor) -> Tensor:
        """The surface (B,V,3) near a smooth one, by its triangles' changes (B,F,3,3) of gradient; differentiable in
        both."""
        count, triangles = changes.shape[:2]
        columns = changes.permute(1, 3, 0, 2).reshape(3 * triangles, 3 * count)
        step = solved(self._factor, self._divergence(columns))
        return low + step.view(-1, count, 3).transpose(0, 1)


def _border_laplacian(faces: Tensor, vertex_count: int) -> sparse.csr_array:
    """Each border vertex against the mean of its neighbours along the border, (V,V); other rows are empty."""
    corner, opposite = border_edges(faces).nonzero(as_tuple=True)
    begin, end = faces[corner, (opposite + 1) % 3].numpy(), faces[corner, (opposite + 2) % 3].numpy()
    links = sparse.coo_array((np.ones(len(begin)), (begin, end)), shape=(vertex_count,) * 2).tocsr()
    links = links + links.T
    degree = links.sum(axis=1)
    on_border = (degree > 0).astype(np.float64)
    mean = sparse.diags_array(on_border / np.maximum(degree, 1)) @ links
    return sparse.csr_array(sparse.diags_array(on_border) - mean)
