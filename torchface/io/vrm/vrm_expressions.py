"""Expressions of VRM 1.0 (``VRMC_vrm``) and clips of VRM 0.x (``VRM``): read, and new ones added behind the others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchface.io.gltf.gltf_document import Document

VRM_ENDING = ".vrm"
_V1, _V0 = "VRMC_vrm", "VRM"
_FULL_V0 = 100.0  # VRM 0 counts weights to 100


@dataclass(frozen=True)
class MorphBind:
    """A morph target that an expression drives."""

    node: int  # that shows the mesh
    mesh: int
    target: int  # index among the mesh's morph targets
    weight: float = 1.0  # at the expression's full strength, 1 for the whole target


def vrm_version(document: Document) -> str | None:
    """The extension that makes a file a VRM: ``"VRMC_vrm"`` (1.0) or ``"VRM"`` (0.x); None for others."""
    extensions = document.record(document.root.get("extensions"), "extensions")
    return next((name for name in (_V1, _V0) if isinstance(extensions.get(name), dict)), None)


def vrm_expressions(document: Document) -> dict[str, tuple[MorphBind, ...]]:
    """The expressions of a VRM by name and what morph targets each drives; none of a file that is no VRM.

    Presets have their preset's name (``blinkLeft``, in VRM 0 ``blink_l``), others their own.
    """
    version = vrm_version(document)
    if version is None:
        return {}
    extension = document.root["extensions"][version]
    found: dict[str, tuple[MorphBind, ...]] = {}
    if version == _V1:
        expressions = document.record(extension.get("expressions"), f"{_V1}.expressions")
        for kind in ("preset", "custom"):
            for name, value in document.record(expressions.get(kind), f"{_V1}.expressions.{kind}").items():
                where = f"{_V1}.expressions.{kind}.{name[:40]}"
                rows = document.array(document.record(value, where), "morphTargetBinds", where)
                found[name] = tuple(_bind_v1(document, document.record(row, where), where) for row in rows)
        return found
    for number, row in enumerate(_clips(document, extension)):
        where = f"{_V0}.blendShapeMaster.blendShapeGroups[{number}]"
        clip = document.record(row, where)
        preset, own = clip.get("presetName"), clip.get("name")
        key = preset if isinstance(preset, str) and preset not in ("", "unknown") else own
        if isinstance(key, str):
            rows = document.array(clip, "binds", where)
            found[key] = tuple(_bind_v0(document, document.record(bind, where), where) for bind in rows)
    return found


def add_expressions(
    document: Document, root: dict[str, Any], added: Mapping[str, Sequence[MorphBind]]
) -> tuple[str, ...]:
    """Adds custom expressions behind those of a VRM's JSON, by name what each drives; which were added.

    An expression that the file has by the same name, in any case of letters, is kept as it is.
    """
    version = vrm_version(document)
    known = {name.lower() for name in vrm_expressions(document)}
    new = {name: list(binds) for name, binds in added.items() if binds and name.lower() not in known}
    if version == _V1:
        custom = _child(_child(root["extensions"][_V1], "expressions", {}), "custom", {})
        for name, binds in new.items():
            custom[name] = {
                "morphTargetBinds": [{"node": b.node, "index": b.target, "weight": b.weight} for b in binds],
                "isBinary": False,
                "overrideBlink": "none",
                "overrideLookAt": "none",
                "overrideMouth": "none",
            }
    elif version == _V0:
        groups = _child(_child(root["extensions"][_V0], "blendShapeMaster", {}), "blendShapeGroups", [])
        for name, binds in new.items():
            meshes = {(b.mesh, b.target): b for b in binds}.values()  # a mesh that two nodes show is bound once
            rows = [{"mesh": b.mesh, "index": b.target, "weight": b.weight * _FULL_V0} for b in meshes]
            clip = {"name": name, "presetName": "unknown", "binds": rows, "materialValues": [], "isBinary": False}
            groups.append(clip)
    else:
        return ()
    return tuple(new)


def _child(parent: dict[str, Any], key: str, empty: Any) -> Any:
    """What a field holds; made where it is absent or null."""
    if parent.get(key) is None:
        parent[key] = empty
    return parent[key]


def _clips(document: Document, extension: dict[str, Any]) -> list[Any]:
    master = document.record(extension.get("blendShapeMaster"), f"{_V0}.blendShapeMaster")
    return document.array(master, "blendShapeGroups", f"{_V0}.blendShapeMaster")


def _bind_v1(document: Document, row: dict[str, Any], where: str) -> MorphBind:
    node = document.integer(row, "node", where)
    mesh = document.integer(document.item("nodes", node, where), "mesh", f"{where}.node")
    return MorphBind(node, mesh, document.integer(row, "index", where), _weight(document, row, where, 1.0))


def _bind_v0(document: Document, row: dict[str, Any], where: str) -> MorphBind:
    mesh = document.integer(row, "mesh", where)
    nodes = [number for number, node in enumerate(document.objects("nodes")) if node.get("mesh") == mesh]
    weight = _weight(document, row, where, _FULL_V0) / _FULL_V0
    return MorphBind(nodes[0] if nodes else -1, mesh, document.integer(row, "index", where), weight)


def _weight(document: Document, row: dict[str, Any], where: str, default: float) -> float:
    value = row.get("weight", default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e6:
        raise document.error(f"{where}.weight", str(value)[:40], "a number")
    return float(value)
