"""A rig's correctives in glTF: morph targets after the shapes', and in ``mesh.extras.torchface.correctives`` when each
acts, as ``{"name": target, "drivers": [shape, ...], "peak": weight}``; only in-betweens have a peak.

Other programs see plain morph targets, whose weights ``save_animation`` writes with the shapes'.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchface.correctives.corrective_shapes import Corrective, Correctives, definitions_from_records
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io.gltf.gltf_document import Document
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig

_FIELD = "correctives"


def write_correctives(definitions: Sequence[Corrective]) -> dict[str, Any]:
    """The JSON of correctives; empty where there are none."""
    return {_FIELD: [definition.record() for definition in definitions]} if definitions else {}


def scene_correctives(document: Document) -> tuple[Corrective, ...]:
    """The definitions of the first mesh that has any."""
    found = document.first_extras(_FIELD)
    return () if found is None else read_correctives(document, found[0]["extras"]["torchface"], found[1])


def read_correctives(document: Document, extras: Mapping[str, Any], location: str) -> tuple[Corrective, ...]:
    """The definitions that a record of ours holds; none where it has no such field."""
    try:
        return definitions_from_records(extras.get(_FIELD, []))
    except (NameMismatchError, ValueRangeError) as error:
        raise FileFormatError(f"{document.path}: {location}: {error}") from error


def rig_of_targets(
    document: Document, neutral: Mesh, deltas: Tensor, names: Sequence[str], definitions: Sequence[Corrective]
) -> BlendshapeRig:
    """The rig of a file's morph targets (N+C,V,3), of which some are correctives."""
    if not definitions:
        return BlendshapeRig(neutral, deltas, names)
    row = {name: i for i, name in enumerate(names)}
    followers = {definition.name for definition in definitions}
    shapes = [name for name in names if name not in followers]
    for definition in definitions:
        missing = [name for name in (definition.name, *definition.drivers) if name not in row]
        if missing:
            target_less = f"a corrective {definition.name[:60]!r} and no morph target {missing[0][:60]!r}"
            raise document.error(_FIELD, target_less, "a target for it and for each driver")
    correctives = Correctives(deltas[[row[definition.name] for definition in definitions]], tuple(definitions))
    return BlendshapeRig(neutral, deltas[[row[name] for name in shapes]], shapes, correctives)


def all_targets(rig: BlendshapeRig) -> tuple[Tensor, tuple[str, ...]]:
    """The deltas (N+C,V,3) and names of a rig's shapes and correctives, as they go into a file."""
    correctives = rig.correctives
    if correctives is None:
        return rig.deltas, rig.names
    return torch.cat([rig.deltas, correctives.deltas]), (*rig.names, *correctives.names)
