"""ARKit's shapes that a character has, under whatever names, and what moves by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchface.io.gltf.character_scene import Block, Character
from torchface.io.gltf.part_insertion import ExtendedBlock
from torchface.io.vrm.vrm_expressions import MorphBind, vrm_expressions
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, arkit_name, recognised_shapes
from torchface.shape_names.arkit_names import side_written_out
from torchface.shape_names.recognised_names import arkit_count
from torchface.workflows.rig.character_face import CharacterFace

_LARGEST = 2.0  # times a shape as it was made, to which that of a part may be brought


@dataclass(frozen=True)
class PresentShape:
    """One of ARKit's shapes that a character has: how it calls it, and how much of which morph targets it is."""

    names: tuple[str, ...]
    binds: tuple[MorphBind, ...]


def present_shapes(character: Character) -> tuple[dict[str, PresentShape], tuple[str, ...]]:
    """The shapes that a character has, by ARKit's names: as morph targets, else as a VRM's expressions.

    Behind them ARKit's names of targets by which nothing moves: they count as missing.
    """
    blocks: dict[tuple[int, int], Block] = {}
    for block in character.blocks:
        blocks.setdefault((block.node, block.mesh), block)
    names = list(dict.fromkeys(name for block in blocks.values() for name in block.names))
    found = {}
    for arkit, shape in recognised_shapes(names).items():
        binds = [
            MorphBind(block.node, block.mesh, block.names.index(name))
            for name in shape.names
            for block in blocks.values()
            if name in block.names
        ]
        found[arkit] = PresentShape(shape.names, tuple(binds))
    empty = tuple(
        name
        for name, shape in found.items()
        if shape.names == (name,)
        and not any(
            bool(character.targets(block)[bind.target].any())
            for bind in shape.binds
            for block in character.blocks
            if (block.node, block.mesh) == (bind.node, bind.mesh)
        )
    )
    found = {name: shape for name, shape in found.items() if name not in empty}
    for expression, bound in vrm_expressions(character.document).items():
        named = arkit_name(expression)
        if named is not None and named in ARKIT and bound and named not in found:
            found[named] = PresentShape((expression,), bound)
    return {name: found[name] for name in ARKIT if name in found}, empty


def spelled(present: dict[str, PresentShape]) -> dict[str, str]:
    """Names of the character's shapes that are ARKit's with a letter for the side, and ARKit's."""
    single = {shape.names[0]: name for name, shape in present.items() if len(shape.names) == 1}
    return {own: name for own, name in single.items() if own != name and side_written_out(own) == name}


def present_lines(there: dict[str, PresentShape], empty: Sequence[str]) -> list[str]:
    """The shapes that a character has, for people to read."""
    own = {name: shape.names for name, shape in there.items() if shape.names != (name,)}
    lines = [f"already there: {arkit_count(there, empty)}, kept as they are"] if there else []
    if renamed := spelled(there):
        some = ", ".join(f"{old} -> {new}" for old, new in list(renamed.items())[:3])
        lines.append(f"  written with ARKit's names: {len(renamed)} shapes, such as {some}")
        own = {name: names for name, names in own.items() if names[0] not in renamed}
    if own:
        lines.append("  by other names: " + ", ".join(f"{k} ({' + '.join(v)})" for k, v in own.items()))
    return lines


def present_motion(character: Character, face: CharacterFace, shape: PresentShape) -> Tensor:
    """How a shape that a character has moves its vertices, (V,3) at a head's size."""
    moved = torch.zeros_like(character.vertices)
    for bind in shape.binds:
        for block in character.blocks:
            if (block.node, block.mesh) == (bind.node, bind.mesh):
                own = character.targets(block)[bind.target].double() * bind.weight
                moved[block.rows] += torch.einsum("vij,vj->vi", character.linear[block.rows], own)
    return face.found.pose.inverse().apply_vectors(moved[None])[0]


def moving_parts(
    character: Character,
    face: CharacterFace,
    rig: BlendshapeRig,
    present: dict[str, PresentShape],
    blocks: Sequence[ExtendedBlock],
) -> list[ExtendedBlock]:
    """The added parts with their motion in the shapes that the character has: as made, and as far as its skin moves."""
    own = {name: present_motion(character, face, shape)[face.rows] for name, shape in present.items()}
    skin = torch.isin(face.rows, face.skin_rows)
    moving = []
    for one in blocks:
        block = character.blocks[one.block]
        parts = torch.from_numpy(~np.isnan(one.uvs[:, 0])).nonzero()[:, 0]
        rows = block.rows.stop - len(one.places) + parts
        place = torch.full((len(character.vertices),), -1)
        place[face.rows] = torch.arange(len(face.rows))
        head = place[rows]
        parts, rows, head = parts[head >= 0], rows[head >= 0], head[head >= 0]
        moves: dict[int, np.ndarray] = {}
        for name, shape in present.items():
            binds = [bind for bind in shape.binds if (bind.node, bind.mesh) == (block.node, block.mesh)]
            if name not in rig.names or not binds:
                continue
            made = rig.select([name]).deltas[0].double()
            size = float((own[name][skin] * made[skin]).sum() / made[skin].square().sum().clamp(min=1e-9))
            turned = face.found.pose.apply_vectors(made[head][None])[0] * min(max(size, 0.0), _LARGEST)
            back = torch.einsum("vij,vj->vi", torch.linalg.inv(character.linear[rows]), turned)
            for bind in binds:
                moved = moves.setdefault(bind.target, np.full((len(one.places), 3), np.nan))
                moved[parts] = (back / (len(binds) * (bind.weight or 1.0))).numpy()
        moving.append(replace(one, moves=moves))
    return moving
