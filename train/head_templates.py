"""What a head model learns on or is made of: templates that bring a rig, and ICT-FaceKit's own modes."""

from __future__ import annotations

from pathlib import Path

from torchface import BlendshapeRig, Mesh, load_mesh, load_rig
from torchface.errors import FileFormatError
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.io.rigs.ict_facekit import region
from torchface.mesh import submesh
from torchface.modeling import HeadModel, MorphableModel

from .head_samples import vertex_colored


def ict_head_model(folder: Path, part: str | None = None, components: int | None = None) -> HeadModel:
    """ICT-FaceKit's identity modes as a head model that carries its expressions.

    Args:
        folder: ``FaceXModel``.
        part: a region to keep, such as ``"face"``.
        components: how many modes; all that the folder has if absent.
    """
    rig, modes = load_ict_facekit(folder), load_identity_modes(folder, components).deltas
    deviations = modes.flatten(1).norm(dim=1)
    shape = MorphableModel(rig.vertices, modes / deviations[:, None, None], deviations)
    model = HeadModel.on(rig.neutral, shape, rig=rig)
    return model if part is None else model.part(region(rig.neutral, part))


def load_template(path: Path, part: str | None = None, unit: str | None = None) -> tuple[Mesh, BlendshapeRig | None]:
    """The neutral of a rig, and the rig; or a mesh alone, in ``unit``."""
    if path.is_dir() or path.suffix.lower() in SCENE_ENDINGS:
        try:
            rig = load_rig(path, part=part)
        except FileFormatError:  # no shapes in it: a mesh
            if path.is_dir():
                raise
        else:
            neutral = vertex_colored(rig.neutral)
            return neutral, BlendshapeRig(neutral, rig.deltas, rig.names)
    mesh = load_mesh(path, unit)
    return mesh if part is None else submesh(mesh, region(mesh, part)).mesh, None
