"""The blendshape rig: a neutral mesh and named deltas, as a torch module."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.mesh import Mesh, submesh
from torchface.shape_names import arkit_sources, mapping
from torchface.take import Track


class BlendshapeRig(nn.Module):
    r"""A face that moves by weights.

    .. math:: A(w) = A_0 + \sum_{i=1}^{N} w_i \, (A_i - A_0)

    Args:
        neutral: the face at rest, V vertices, millimetres.
        deltas: :math:`A_i - A_0`, (N,V,3), millimetres.
        names: one a shape, no name twice.

    Raises:
        ShapeError: ``deltas`` is not (N,V,3).
        NameMismatchError: not one name a shape, or a name twice.
        ValueRangeError: a delta is NaN or infinite.

    Source: thesis 3.2.1, equation 1.
    """

    vertices: Tensor
    deltas: Tensor

    def __init__(self, neutral: Mesh, deltas: Tensor, names: Sequence[str]) -> None:
        super().__init__()
        if deltas.ndim != 3 or deltas.shape[1:] != neutral.vertices.shape:
            raise ShapeError(
                f"deltas: found {tuple(deltas.shape)}, expected (N,{len(neutral.vertices)},3) for this neutral"
            )
        if len(names) != len(deltas):
            raise NameMismatchError(f"rig: found {len(names)} names for {len(deltas)} deltas, expected one each")
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if list(names).count(name) > 1})
            raise NameMismatchError(f"rig: found shape names more than once: {', '.join(twice[:5])}")
        if not torch.isfinite(deltas).all():
            bad = [names[i] for i in (~torch.isfinite(deltas)).flatten(1).any(1).nonzero()[:, 0].tolist()]
            raise ValueRangeError(f"deltas: NaN or infinite in {', '.join(bad[:5])}; expected finite millimetres")
        self.names = tuple(names)
        self._neutral = neutral
        self.register_buffer("vertices", neutral.vertices)
        self.register_buffer("deltas", deltas.to(neutral.vertices))

    @property
    def neutral(self) -> Mesh:
        """The face at rest, on the rig's device and in its dtype."""
        if self._neutral.vertices is not self.vertices:
            self._neutral = self._neutral.to(self.vertices.device).with_vertices(self.vertices)
        return self._neutral

    def forward(self, weights: Tensor) -> Tensor:
        """Vertices (B,V,3) at weights (B,N)."""
        if weights.ndim != 2 or weights.shape[1] != len(self.names):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected (B,{len(self.names)})")
        moved = weights @ self.deltas.flatten(1)
        return self.vertices + moved.view(len(weights), *self.vertices.shape)

    def index(self, names: Sequence[str]) -> list[int]:
        """Rows of these shapes.

        Raises:
            NameMismatchError: the rig lacks one, or ``names`` is a text where a list belongs.
        """
        if isinstance(names, str):
            raise NameMismatchError(f"rig: found the text {names!r}, expected a list of names: [{names!r}]")
        row = {name: i for i, name in enumerate(self.names)}
        missing = [name for name in names if name not in row]
        if missing:
            raise NameMismatchError(
                f"rig: no shape {', '.join(map(repr, missing[:5]))}; its {len(self.names)} shapes are "
                f"{', '.join(self.names[:5])}, ..."
            )
        return [row[name] for name in names]

    def weights_from(self, track: Track) -> Tensor:
        """A weight track in the order of the rig's shapes, (T,N); see ``torchface.shape_names.mapping``.

        Raises:
            NameMismatchError: no name of the track means a shape of the rig.
        """
        matrix = mapping(track.names, self.names).to(track.values)
        if not matrix.any():
            raise NameMismatchError(
                f"weights: found {', '.join(track.names[:5])}, ...; expected some of the rig's shapes, "
                f"{', '.join(self.names[:5])}, ..."
            )
        return track.values[..., 0] @ matrix.T

    def select(self, names: Sequence[str]) -> BlendshapeRig:
        """The rig with these shapes only, in this order."""
        return BlendshapeRig(self.neutral, self.deltas[self.index(names)], names)

    def with_arkit_names(self) -> BlendshapeRig:
        """The rig under ARKit's names, halves of one of ARKit's shapes merged; see ``shape_names.arkit_sources``."""
        sources = arkit_sources(self.names)
        deltas = torch.stack([self.deltas[list(rows)].sum(0) for rows in sources.values()])
        return BlendshapeRig(self.neutral, deltas, tuple(sources))

    def part(self, keep: Tensor) -> BlendshapeRig:
        """The rig of some vertices only: a mask (V,) or ids; see ``torchface.mesh.submesh``."""
        piece = submesh(self.neutral, keep)
        return BlendshapeRig(piece.mesh, self.deltas[:, piece.vertex_ids], self.names)

    def extra_repr(self) -> str:
        return f"{self.neutral}, {len(self.names)} shapes"
