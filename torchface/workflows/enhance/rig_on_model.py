"""A rig's poses on the dense mesh of an actor's model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement.detail.low_pass import small_part_triangles
from torchface.enhancement.thin_shell import LEAST_POINTS, ThinShell
from torchface.errors import AlignmentError
from torchface.geometry.meshes.proximity import SurfaceIndex
from torchface.geometry.meshes.uv_raster import interpolate
from torchface.mesh import Mesh
from torchface.progress import Progress
from torchface.rig import BlendshapeRig
from torchface.workflows.enhance.coarse_animation import check_scale, residual_notes
from torchface.workflows.enhance.coarse_input import has_topology_of
from torchface.workflows.enhance.head_correspondence import (
    HeadCorrespondence,
    correspondence_notes,
    find_correspondence,
    of_one_topology,
)
from torchface.workflows.enhance.mesh_input import placed

_SITES = 2000


@dataclass(frozen=True, eq=False)
class RigOnModel:
    """How a rig lies on a model's mesh.

    Args:
        rig: the rig.
        found: how its neutral lies there.
        dense: vertices (T,V,3) of the model's mesh for the rig's own (T,N,3).
        notes: lines for people to read; warnings begin with ``warning: ``.
    """

    rig: BlendshapeRig
    found: HeadCorrespondence
    dense: Callable[[Tensor], Tensor]
    notes: tuple[str, ...]

    @property
    def laid(self) -> Mesh:
        """The rig's neutral on the model's surface, with its texture coordinates."""
        return self.rig.neutral.with_vertices(self.found.laid)

    @property
    def scale(self) -> float:
        """From the rig's millimetres to the model's."""
        return float(self.found.pose.scale[0])

    def carried(self, values: Tensor, surface: Mesh) -> Tensor:
        """Values (C,V) at the model's vertices, read where the rig's lie: (C,N)."""
        places = SurfaceIndex(surface.vertices, surface.faces).nearest(self.found.laid)
        read = interpolate(values.T.double(), surface.faces[places.triangle], places.barycentric.double())
        return read.T.float()

    def sites(self) -> Tensor:
        """At most 2,000 vertices of the rig's skin that lie on the model, spread evenly, (S,)."""
        faces = self.rig.neutral.faces
        loose = faces[small_part_triangles(self.rig.vertices, faces)].flatten()
        known = self.found.known.clone()
        known[loose] = False
        ids = known.nonzero()[:, 0] if known.any() else torch.arange(len(known))
        return ids[torch.linspace(0, len(ids) - 1, min(_SITES, len(ids))).round().long()]


def lay_rig(
    rig: BlendshapeRig, path: Path, model: Mesh, pairs: Path | None, kept: Path, progress: Progress
) -> RigOnModel:
    """Finds how a rig lies on a model's mesh: by its vertices if they are the model's, else by registration or pairs.

    Args:
        rig: millimetres.
        path: of the rig, for messages.
        model: the model's neutral.
        pairs: vertices of the rig and where they lie on the model; registration tells if absent.
        kept: a file that keeps what was found for a later run of the same.
        progress: called with each step and how far it is.

    Raises:
        AlignmentError: it does not lie on the model, or is of another size.
        TorchfaceError: the files do not fit each other.
    """
    if has_topology_of(rig.neutral, model):
        found = of_one_topology(rig.neutral, model)
        check_scale(float(found.pose.scale[0]), path)
        notes = residual_notes(found.residual, path)
        return RigOnModel(rig, found, lambda vertices: placed(found.pose, vertices), tuple(notes))
    found = find_correspondence(rig.neutral, model, pairs, path, kept, progress)
    ids, sites = found.on_model(SurfaceIndex(model.vertices, model.faces), rig.neutral.faces)
    if len(ids) < LEAST_POINTS:
        raise AlignmentError(
            f"{path}: found {len(ids)} vertices with a place on the model, expected at least {LEAST_POINTS}; give "
            "pairs (--pairs), or bring the rig's neutral nearer to the model's"
        )
    progress("setting up the thin shell")
    shell = ThinShell(model.vertices, model.faces, sites)
    rest = found.pose.apply(rig.vertices[ids].double())[0]
    notes = correspondence_notes(found, path)
    return RigOnModel(
        rig, found, lambda vertices: shell.follow(placed(found.pose, vertices[:, ids]), rest), tuple(notes)
    )
