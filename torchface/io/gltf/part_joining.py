"""The meshes that ``writing`` made of one mesh, put together again as one part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from torchface.io.gltf.container import Document
from torchface.io.gltf.mesh_extras import read_mesh_count
from torchface.io.gltf.primitive_reading import Part, filled
from torchface.io.gltf.scene import Instance


def rejoined(document: Document, found: Sequence[tuple[Instance, Part]]) -> tuple[Instance, Part] | None:
    """The parts of a scene as one, in the scene's axes; none where they were not written as one.

    Args:
        document: the file.
        found: the scene's meshes and where they stand.
    """
    first = found[0]
    place = f"meshes[{first[0].mesh}].extras.torchface"
    if read_mesh_count(document, first[1].extras.get("torchface"), place) != len(found) or len(found) == 1:
        return None
    parts = [part for _, part in found]
    if any(part.vertex_ids is None or part.names != first[1].names for part in parts):
        return None
    count = [len(part.positions) for part in parts]
    document.reserve(sum(part.deltas.nbytes + part.positions.nbytes for part in parts), "nodes")
    positions, deltas = [], []
    for instance, part in found:
        linear, translation = instance.transform[:3, :3], instance.transform[:3, 3]
        with np.errstate(over="ignore", invalid="ignore"):
            positions.append((part.positions @ linear.T + translation).astype(np.float32))
            deltas.append((part.deltas @ linear.T).astype(np.float32))
    starts = [0, *accumulate(count[:-1])]
    whole = Part(
        np.concatenate(positions),
        np.concatenate(deltas, axis=1),
        first[1].names,
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)]),
        filled([part.uvs for part in parts], count, 0.0),
        filled([part.colors for part in parts], count, 1.0),
        np.concatenate([part.vertex_ids for part in parts if part.vertex_ids is not None]),
        next((part.texture for part in parts if part.texture is not None), None),
        first[1].extras,
    )
    return replace(first[0], transform=np.eye(4)), whole
