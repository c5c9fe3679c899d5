"""Choice of a head model and of the rig whose shapes its heads are given."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import TopologyError
from torchface.io import load_rig
from torchface.io.head_models.head_model_files import is_head_model_file
from torchface.io.rigs.ict_facekit import region
from torchface.modeling import HeadModel
from torchface.part_materials import part_material
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.workflows.arkit.arkit_rig import published_head
from torchface.zoo.kinds import KINDS

SHIPPED = "head"
_KIND = next(name for name, kind in KINDS.items() if kind is HeadModel)
_BETTER = (
    "for a likeness of real people: torchface train morphable --ict FaceXModel, once, "
    "with the folder of github.com/ICT-VGL/ICT-FaceKit (MIT; its hair is a cap, without a shirt); or --published FILE "
    "of GNM Head, FLAME or Basel"
)


@dataclass(frozen=True)
class NamedHeads:
    """A head model by name or folder, and what there is to say of it where nobody has named it."""

    name: str | Path
    line: str = ""

    @staticmethod
    def of(name: str | Path | None) -> "NamedHeads":
        """What the user names; else the best at hand.

        Models of people go before those of performers made by code, models that carry a rig before others, then those
        of more modes. The user's own lie in ``$TORCHFACE_HOME`` or the checkout, see ``zoo.find``.
        """
        if name is not None:
            return NamedHeads(name)
        known = [zoo.describe(one) for one in zoo.list_models()]
        people = [one for one in known if one.kind == _KIND and not one.settings.get("performers")]
        if not people:
            return NamedHeads(SHIPPED, f"head model: {SHIPPED}, of performers made by code; {_BETTER}")

        def worth(one: zoo.ModelDescription) -> tuple[bool, float]:
            return "rig" in one.config, one.metrics.get("shape components", 0.0)

        best = max(people, key=worth)
        return NamedHeads(best.name, f"head model: {best.name}, {best.data.rstrip('.')}; choose another with --model")


def load_head_model(name_or_path: str | Path) -> HeadModel:
    """A head model by name or folder, see ``zoo.get_model``; or a file of others, see ``published_head``."""
    if is_head_model_file(name_or_path):
        return published_head(Path(name_or_path))
    return zoo.get_model(name_or_path, HeadModel)


def matching(
    model: HeadModel, template: Path | None = None, part: str | None = None
) -> tuple[HeadModel, BlendshapeRig]:
    """A model, and the rig whose shapes its heads get, of one topology, both cut to a part: the template, else the
    model's, else the embedded performer."""
    source, rig = "the model's own rig", model.rig
    if template is not None:
        source, rig = str(template), load_rig(template)
    elif rig is None:
        source, rig = "the embedded performer", performer()
    if part is not None:
        keep = region(rig.neutral, part)
        if _same_topology(model, rig):
            model = model.part(keep)
        rig = rig.part(keep)
    if _same_topology(model, rig):
        return model, _with_one_image(rig)
    count = len(model.shape.mean)
    fitting = [name for name, mask in rig.neutral.regions.items() if part is None and int(mask.sum()) == count]
    hint = "; name a rig with --template whose topology is the model's" if template is None else ""
    raise TopologyError(
        f"{source}: found {len(rig.vertices)} vertices and {len(rig.neutral.faces)} triangles, expected the model's "
        f"{count} and {len(model.faces)}" + (f"; try --part {fitting[0]}" if fitting else hint)
    )


def _with_one_image(rig: BlendshapeRig) -> BlendshapeRig:
    """A rig whose charts all have a place in the one image that is painted, each part that is no skin its own."""
    mesh = rig.neutral
    if mesh.texture is not None or mesh.uvs is None or mesh.uv_faces is None:
        return rig
    kind = torch.zeros(len(mesh.faces), dtype=torch.int64)
    # Each eyeball has its own, and clear shells have one.
    for number, (name, mask) in enumerate(mesh.regions.items(), 2):
        material = part_material(name)
        if material is not None:
            kind[mask.cpu()[mesh.faces.cpu()].all(1)] = 1 if material.alpha == "BLEND" else number
    own = mesh.uvs.cpu()
    uvs, rows = in_one_tile(own, mesh.uv_faces.cpu(), kind)
    if uvs is own:
        return rig
    packed = replace(mesh, uvs=uvs.to(mesh.uvs), uv_faces=rows.to(mesh.uv_faces))
    return BlendshapeRig(packed, rig.deltas, rig.names, rig.correctives)


def _same_topology(model: HeadModel, rig: BlendshapeRig) -> bool:
    """Whether a model's heads have the rig's triangles."""
    return len(rig.vertices) == len(model.shape.mean) and torch.equal(rig.neutral.faces, model.faces.cpu())


_MARGIN = 0.02  # of a cell's side, so that no chart's colour runs into the next


def in_one_tile(uvs: Tensor, uv_faces: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    """Charts that all lie in [0,1] without covering each other; the same where none lies in a further tile.

    The tile of the most triangles keeps a large square of the image; all others, and what lies over it but is of
    another ``kind`` (F,), as eyeballs over a face, have small ones along two edges.
    """
    tiles = uvs[uv_faces].mean(1).floor().long()
    if not bool(tiles.any()):
        return uvs, uv_faces
    keys = torch.cat([tiles, kind[:, None]], dim=1)
    groups, own, counts = keys.unique(dim=0, return_inverse=True, return_counts=True)
    order = counts.argsort(descending=True)
    place = order.argsort()[own]  # 0 for the largest
    side = next(k for k in range(2, len(groups) + 2) if 2 * k - 1 >= len(groups) - 1)
    cells = [(0.0, 0.0, (side - 1) / side)]
    cells += [((side - 1) / side, row / side, 1 / side) for row in range(side)]
    cells += [(column / side, (side - 1) / side, 1 / side) for column in range(side - 1)]
    cell = torch.tensor(cells)[place]  # (F,3): left, low, side
    pairs, rows = (uv_faces * len(groups) + own[:, None]).unique(return_inverse=True)
    face = torch.zeros(len(pairs), dtype=torch.int64)
    face[rows.flatten()] = torch.arange(len(uv_faces)).repeat_interleave(3)
    within = (uvs[pairs // len(groups)] - tiles[face]).clamp(0, 1)
    packed = cell[face, :2] + cell[face, 2:] * (_MARGIN + (1 - 2 * _MARGIN) * within)
    return packed.to(uvs), rows
