"""A character's landmarks and regions in the extras of its meshes, where ``gltf_reading`` finds them."""

from typing import Any

import torch
from torch import Tensor

from torchface.io.gltf.character_scene import Character
from torchface.io.gltf.mesh_extras import row_extras
from torchface.mesh import Annotations
from torchface.part_materials import EYEBALL, part_material


def annotate_character(root: dict[str, Any], character: Character, rows: Tensor, notes: Annotations) -> None:
    """Adds to the JSON ``root`` landmarks and regions of a character's vertices (K,), on meshes that have some of them.

    Regions of parts that are drawn in colours of their own (mouth, sockets) are left out: a character has its colours.
    """
    if notes.landmarks is None:
        return
    marks = rows[notes.landmarks]
    regions: dict[str, Tensor] = {}
    for name, mask in notes.regions.items():
        if part_material(name) in (None, EYEBALL):
            regions[name] = torch.zeros(len(character.vertices), dtype=torch.bool)
            regions[name][rows[mask]] = True
    blocks: dict[tuple[int, int], list[slice]] = {}
    for block in character.blocks:
        blocks.setdefault((block.mesh, block.node), []).append(block.rows)
    found: dict[int, list[int]] = {}  # of the nodes that show one mesh, the one whose face it is
    for (mesh, _), slices in blocks.items():
        ids = torch.cat([torch.arange(one.start, one.stop) for one in slices])
        place = torch.full((len(character.vertices),), -1)
        place[ids] = torch.arange(len(ids))
        own = {name: mask[ids] for name, mask in regions.items() if bool(mask[ids].any())}
        known = place[marks]
        count = [int((known >= 0).sum()), sum(int(mask.sum()) for mask in own.values())]
        if max(count) and count > found.get(mesh, [0, 0]):
            found[mesh] = count
            here = Annotations(known, own)
            record = root["meshes"][mesh]
            record["extras"] = row_extras(record.get("extras"), character.vertices[ids].numpy(), here)
