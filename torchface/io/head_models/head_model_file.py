"""A head model of others: mean head, ways in which people and expressions differ, joints and landmarks."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.skinning import joint_transforms, skinned
from torchface.mesh import Mesh


@dataclass(frozen=True, eq=False)
class HeadJoints:
    """The joints that a head's vertices follow.

    Args:
        names: such as ``jaw``, ``left_eye``.
        parents: of each, -1 for a root; before its children.
        positions: at rest, (J,3), millimetres.
        weights: how much each vertex follows each, (V,J).
        regressor: the positions as means of vertices, (J,V), where the model says how.
        correctives: what each entry of the rotations minus one adds, without the root's, (9(J-1),V,3), millimetres.

    Example:
        >>> joints = HeadJoints(("neck", "left_eye"), (-1, 0), torch.zeros(2, 3), torch.ones(5, 2) / 2)
        >>> joints.index("leftEye"), joints.index("jaw")
        (1, None)
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: Tensor
    weights: Tensor
    regressor: Tensor | None = None
    correctives: Tensor | None = None

    def of(self, vertices: Tensor) -> Tensor:
        """The joints' positions (J,3) in a head (V,3) at rest."""
        return self.positions if self.regressor is None else self.regressor @ vertices.to(self.regressor)

    def index(self, name: str) -> int | None:
        """The joint of a name, whatever its spelling; None where there is none."""
        plain = [_plain(own) for own in self.names]
        return plain.index(_plain(name)) if _plain(name) in plain else None


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(" ", "")


@dataclass(frozen=True, eq=False)
class SurfacePlaces:
    """Landmarks on a head's surface.

    Args:
        rows: of iBUG's 68, (L,) int64.
        vertices: around each, (L,3) int64.
        shares: of these, (L,3).

    Example:
        >>> nose = SurfacePlaces(torch.tensor([30]), torch.tensor([[0, 1, 2]]), torch.tensor([[0.5, 0.5, 0.0]]))
        >>> nose.on(torch.eye(3)).tolist()
        [[0.5, 0.5, 0.0]]
    """

    rows: Tensor
    vertices: Tensor
    shares: Tensor

    @classmethod
    def at_vertices(cls, places: Mapping[int, int]) -> "SurfacePlaces":
        """Each landmark of iBUG's, by row, on one vertex."""
        ids = torch.tensor(list(places.values()))[:, None].expand(-1, 3).contiguous()
        return cls(torch.tensor(list(places)), ids, torch.tensor([1.0, 0.0, 0.0]).repeat(len(ids), 1))

    def nearest(self) -> Tensor:
        """The vertex that each lies closest to, (L,)."""
        return self.vertices.gather(1, self.shares.argmax(1, keepdim=True))[:, 0]

    def on(self, vertices: Tensor) -> Tensor:
        """Where they lie on a head (V,3), (L,3)."""
        return (vertices[self.vertices] * self.shares[..., None].to(vertices)).sum(1)


@dataclass(frozen=True, eq=False)
class HeadModelFile:
    """A head model as its file gives it, in millimetres, y up, z toward the viewer.

    Args:
        name: of the model, such as ``FLAME``.
        neutral: the mean head.
        identity: what one standard deviation of each way to differ adds, (K,V,3).
        expressions: what a unit of each expression parameter adds, (E,V,3).
        expression_names: (E,).
        joints: that the vertices follow, where the model has them.
        landmarks: on the surface, where they are known.
        licence: that its authors give it.
    """

    name: str
    neutral: Mesh
    identity: Tensor
    expressions: Tensor
    expression_names: tuple[str, ...]
    joints: HeadJoints | None = None
    landmarks: SurfacePlaces | None = None
    licence: str = ""
    notes: tuple[str, ...] = field(default=())

    def person(self, coefficients: Tensor) -> Tensor:
        """The head at rest of identity coefficients (k,), k at most K, (V,3).

        Raises:
            FileFormatError: there are more than the model has.
        """
        count = len(coefficients)
        if count > len(self.identity):
            raise FileFormatError(
                f"{self.name}: found {count} identity parameters, expected at most {len(self.identity)}"
            )
        return self.neutral.vertices + torch.tensordot(coefficients.to(self.identity), self.identity[:count], 1)

    def posed(self, person: Tensor, expressions: Tensor, rotations: Tensor | None = None) -> Tensor:
        """Heads of a person (V,3) at expression parameters (B,e) and joint rotations (B,J,3), (B,V,3)."""
        offsets = expressions.to(self.expressions) @ self.expressions[: expressions.shape[1]].flatten(1)
        heads = person + offsets.unflatten(1, person.shape)
        if rotations is None or self.joints is None:
            return heads
        joints = self.joints
        turns, shifts = joint_transforms(joints.of(person), joints.parents, rotations.to(person))
        if joints.correctives is not None:
            heads = heads + self.pose_correctives(rotations)
        return skinned(heads, joints.weights, turns, shifts)

    def pose_correctives(self, rotations: Tensor) -> Tensor:
        """What joint rotations (B,J,3) add before the skinning, (B,V,3); the root's add nothing."""
        assert self.joints is not None
        correctives = self.joints.correctives
        if correctives is None:
            return self.neutral.vertices.new_zeros(len(rotations), *self.neutral.vertices.shape)
        inner = rotation_matrix(rotations[:, 1:].reshape(-1, 3)) - torch.eye(3, dtype=rotations.dtype)
        feature = inner.reshape(len(rotations), -1).to(correctives)
        return (feature @ correctives.flatten(1)).unflatten(1, correctives.shape[1:])
