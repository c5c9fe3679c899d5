"""The blendshape rig: a neutral mesh and named deltas, as a torch module."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchface.correctives.activation import CorrectiveActivation
from torchface.correctives.corrective_shapes import Corrective, Correctives
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.mesh import Mesh, submesh
from torchface.number_checks import as_tensor, checked_type
from torchface.optim.full_precision import full_precision
from torchface.shape_names import arkit_sources, mapping
from torchface.take import Track


class BlendshapeRig(nn.Module):
    r"""A face that moves by weights.

    .. math:: A(w) = A_0 + \sum_{i=1}^{N} w_i \, (A_i - A_0) + \sum_{c=1}^{C} a_c(w) \, D_c

    with the activations :math:`a_c` and the deltas :math:`D_c` of its correctives, where it has any.

    Args:
        neutral: the face at rest, V vertices, millimetres.
        deltas: :math:`A_i - A_0`, (N,V,3), millimetres.
        names: one a shape, no name twice.
        correctives: what is added where shapes act together or half-way; of as many vertices.

    Raises:
        ShapeError: ``deltas`` is not (N,V,3), or the correctives' not (C,V,3).
        NameMismatchError: not one name a shape, a name twice, or a corrective driven by a shape that is not there.
        ValueRangeError: a delta is NaN or infinite.

    Source: thesis 3.2.1, equation 1.

    Example:
        >>> face = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> rig = BlendshapeRig(face, torch.ones(2, 3, 3), ("jawOpen", "mouthPucker"))
        >>> rig(torch.tensor([[0.5, 0.0]]))[0, 0].tolist()
        [1.5, 0.5, 0.5]
    """

    vertices: Tensor
    deltas: Tensor
    corrective_deltas: Tensor | None

    def __init__(
        self, neutral: Mesh, deltas: Tensor, names: Sequence[str], correctives: Correctives | None = None
    ) -> None:
        super().__init__()
        checked_type("neutral", neutral, Mesh)
        if correctives is not None:
            checked_type("correctives", correctives, Correctives)
        if isinstance(names, str):
            raise NameMismatchError(f"names: found the text {names!r:.60}, expected a list of names: [{names!r:.60}]")
        deltas = as_tensor("deltas", deltas, f"(N,{len(neutral.vertices)},3)", torch.get_default_dtype())
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
        self._correctives = correctives
        self.activation = None
        if correctives is not None:
            activation = CorrectiveActivation(correctives.definitions, self.names)
            self.activation = activation if neutral.vertices.is_meta else activation.to(neutral.vertices.device)
        if correctives is not None and correctives.deltas.shape[1:] != neutral.vertices.shape:
            raise ShapeError(
                f"correctives: found deltas {tuple(correctives.deltas.shape)}, expected (C,{len(neutral.vertices)},3) "
                "for this neutral"
            )
        moved = None if correctives is None else correctives.deltas.to(neutral.vertices)
        self.register_buffer("corrective_deltas", moved)

    @staticmethod
    def from_tensors(
        vertices: Tensor,
        faces: Tensor,
        deltas: Tensor,
        names: Sequence[str] | None = None,
        correctives: Correctives | None = None,
        **rest: Any,
    ) -> BlendshapeRig:
        """A rig of plain tensors, as other PyTorch code has them, or of NumPy's arrays.

        Args:
            vertices: at rest, (V,3) float, millimetres; gradients flow through them and through the deltas.
            faces: triangles, (F,3), any integers; (P,K) with K above 3, padded with -1, for polygons.
            deltas: (N,V,3), millimetres; of target shapes take ``targets - vertices``.
            names: one a shape; ``shape_0`` and so on if absent.
            correctives: of the rig.
            rest: what else a :class:`~torchface.mesh.Mesh` has: ``uvs`` with ``uv_faces`` (laid out as ``faces``),
                ``colors``, ``texture``, ``annotations``.

        Raises:
            ShapeError: a tensor has the wrong shape.
            TopologyError: an index points outside.
            ValueRangeError: a position or a delta is NaN or infinite.
            NameMismatchError: not one name a shape, or a name twice.

        Example:
            >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(2, 3, 3))
            >>> rig.names
            ('shape_0', 'shape_1')
        """
        vertices, deltas = as_tensor("vertices", vertices, "(V,3)"), as_tensor("deltas", deltas, "(N,V,3)")
        faces = as_tensor("faces", faces, "(F,3)")
        faces, uv_faces = faces.long(), rest.pop("uv_faces", None)
        if faces.ndim == 2 and faces.shape[1] > 3:
            uv_polygons = None if uv_faces is None else uv_faces.long()
            mesh = Mesh.from_polygons(vertices, faces, rest.pop("uvs", None), uv_polygons, **rest)
        else:
            mesh = Mesh(vertices, faces, uv_faces=None if uv_faces is None else uv_faces.long(), **rest)
        return BlendshapeRig(mesh, deltas, names or [f"shape_{i}" for i in range(len(deltas))], correctives)

    @property
    def neutral(self) -> Mesh:
        """The face at rest, on the rig's device and in its dtype."""
        if self._neutral.vertices is not self.vertices:
            self._neutral = self._neutral.to(self.vertices.device).with_vertices(self.vertices)
        return self._neutral

    @property
    def correctives(self) -> Correctives | None:
        """What is added where shapes act together or half-way, on the rig's device and in its dtype."""
        if self._correctives is not None and self._correctives.deltas is not self.corrective_deltas:
            assert self.corrective_deltas is not None
            self._correctives = self._correctives.with_deltas(self.corrective_deltas)
        return self._correctives

    def without_correctives(self) -> BlendshapeRig:
        """The rig of its shapes alone, which is linear in their weights."""
        return BlendshapeRig(self.neutral, self.deltas, self.names)

    def linear(self, method: str) -> BlendshapeRig:
        """The rig for a method that takes faces as linear in the weights; one with correctives is warned of.

        Args:
            method: begins the warning.
        """
        if self.correctives is None:
            return self
        warnings.warn(
            f"{method}: leaves the rig's {len(self.correctives.names)} correctives out, as it takes faces as linear in "
            "the weights",
            stacklevel=3,
        )
        return self.without_correctives()

    @full_precision
    def forward(self, weights: Tensor) -> Tensor:
        """Vertices (B,V,3) at weights (B,N), taken in the rig's dtype; NumPy's arrays and lists do as well."""
        weights = as_tensor("weights", weights, f"(B,{len(self.names)})").to(self.deltas.dtype)
        if weights.ndim != 2 or weights.shape[1] != len(self.names):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected (B,{len(self.names)})")
        moved = weights @ self.deltas.flatten(1)
        if self.activation is not None and self.corrective_deltas is not None:
            moved = moved + self.activation(weights) @ self.corrective_deltas.flatten(1)
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
        checked_type("track", track, Track)
        matrix = mapping(track.names, self.names).to(track.values)
        if not matrix.any():
            raise NameMismatchError(
                f"weights: found {', '.join(track.names[:5])}, ...; expected some of the rig's shapes, "
                f"{', '.join(self.names[:5])}, ..."
            )
        return track.values[..., 0] @ matrix.T

    def select(self, names: Sequence[str]) -> BlendshapeRig:
        """The rig with these shapes only, in this order, and the correctives that these alone drive."""
        correctives = None if self.correctives is None else self.correctives.select(names)
        return BlendshapeRig(self.neutral, self.deltas[self.index(names)], names, correctives)

    def with_arkit_names(self) -> BlendshapeRig:
        """The rig under ARKit's names, halves of one of ARKit's shapes merged; see ``shape_names.arkit_sources``.

        Raises:
            NameMismatchError: a corrective is driven by both halves of what becomes one shape, hence by its square.
        """
        sources = arkit_sources(self.names)
        deltas = torch.stack([self.deltas[list(rows)].sum(0) for rows in sources.values()])
        correctives = self.correctives
        if correctives is not None:
            renamed = {self.names[row]: name for name, rows in sources.items() for row in rows}
            correctives = _merged_correctives(correctives, renamed)
        return BlendshapeRig(self.neutral, deltas, tuple(sources), correctives)

    def part(self, keep: Tensor) -> BlendshapeRig:
        """The rig of some vertices only: a mask (V,) or ids; see ``torchface.mesh.submesh``."""
        piece = submesh(self.neutral, keep)
        correctives = self.correctives
        if correctives is not None:
            correctives = correctives.with_deltas(correctives.deltas[:, piece.vertex_ids])
        return BlendshapeRig(piece.mesh, self.deltas[:, piece.vertex_ids], self.names, correctives)

    def extra_repr(self) -> str:
        return f"{self.neutral}, {len(self.names)} shapes"


def _merged_correctives(correctives: Correctives, renamed: Mapping[str, str]) -> Correctives:
    """Correctives of a rig in which shapes were renamed, and some of them summed under one name.

    What comes to act at the same combination is summed. In-betweens of summed shapes keep every peak of either: at each
    the sum of what all of them showed there.

    Args:
        renamed: for each shape what it is called afterwards; a shape that is not in it keeps its name.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, definition in enumerate(correctives.definitions):
        drivers = tuple(sorted(renamed.get(driver, driver) for driver in definition.drivers))
        if len(set(drivers)) < len(drivers):
            raise NameMismatchError(
                f"corrective {definition.name!r}: driven by {' x '.join(definition.drivers)}, which become one shape, "
                f"{Counter(drivers).most_common(1)[0][0]!r}; expected drivers that stay apart: take the corrective out"
            )
        groups.setdefault(drivers, []).append(row)
    definitions, deltas = [], []
    for drivers, rows in groups.items():
        first = correctives.definitions[rows[0]]
        if not first.is_in_between:
            others = tuple(dict.fromkeys(renamed.get(driver, driver) for driver in first.drivers))
            definitions.append(replace(first, drivers=others))
            deltas.append(correctives.deltas[rows].sum(0))
            continue
        own = [correctives.definitions[row] for row in rows]
        before = tuple(dict.fromkeys(definition.drivers[0] for definition in own))
        names = {definition.peak: definition.name for definition in reversed(own)}
        peaks = sorted(names, key=lambda peak: peak or 0.0)
        at_peaks = torch.tensor(peaks, dtype=torch.float64)[:, None].expand(-1, len(before))
        shares = CorrectiveActivation(own, before)(at_peaks).to(correctives.deltas)
        definitions += [Corrective(names[peak], drivers, peak) for peak in peaks]
        deltas += torch.einsum("pc,cvk->pvk", shares, correctives.deltas[rows]).unbind()
    return Correctives(torch.stack(deltas), tuple(definitions))
