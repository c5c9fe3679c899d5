"""A rig's poses on the dense mesh of an actor's model."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement.detail.low_pass import small_part_triangles
from torchface.geometry.meshes.rasterization import interpolate
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Mesh
from torchface.progress import Progress
from torchface.rig import BlendshapeRig
from torchface.workflows.enhance.head_correspondence import HeadCorrespondence, find_correspondence

_SITES = 2000


@dataclass(frozen=True, eq=False)
class RigOnModel:
    """How a rig lies on a model's mesh."""

    rig: BlendshapeRig
    correspondence: HeadCorrespondence  # of its neutral with the model's
    dense: Callable[[Tensor], Tensor]  # vertices (T,V,3) of the model's mesh for the rig's own (T,N,3)
    notes: tuple[str, ...]  # lines for people to read; warnings begin with warning:

    @property
    def neutral(self) -> Mesh:
        """The rig's neutral on the model's surface, with its texture coordinates."""
        return self.rig.neutral.with_vertices(self.correspondence.bent)

    @property
    def scale(self) -> float:
        """From the rig's millimetres to the model's."""
        return float(self.correspondence.pose.scale[0])

    def carried(self, values: Tensor, surface: Mesh) -> Tensor:
        """Values (C,V) at the model's vertices, read where the rig's lie: (C,N)."""
        places = SurfaceIndex(surface.vertices, surface.faces).nearest(self.correspondence.bent)
        read = interpolate(values.T.double(), surface.faces[places.triangle], places.barycentric.double())
        return read.T.float()

    def sites(self) -> Tensor:
        """At most 2,000 vertices of the rig's skin that lie on the model, spread evenly, (S,)."""
        faces = self.rig.neutral.faces
        loose = faces[small_part_triangles(self.rig.vertices, faces)].flatten()
        known = self.correspondence.known.clone()
        known[loose] = False
        ids = known.nonzero()[:, 0] if known.any() else torch.arange(len(known))
        return ids[torch.linspace(0, len(ids) - 1, min(_SITES, len(ids))).round().long()]


def rig_on_model(
    rig: BlendshapeRig, path: Path, model: Mesh, pairs: Path | None, state: Path, progress: Progress
) -> RigOnModel:
    """Finds how a rig lies on a model's mesh: by its vertices if they are the model's, else by pairs or
    registration, which the file ``state`` keeps for a later run."""
    correspondence = find_correspondence(rig.neutral, model, pairs, path, state, progress)
    progress("setting up the thin shell")
    dense = correspondence.carrier(rig.neutral, model, path)
    return RigOnModel(rig, correspondence, dense, tuple(correspondence.notes(path)))
