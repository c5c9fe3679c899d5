"""Nodes of a glTF character that a performance turns: head, neck and eyes, by VRM's table or by their names."""

import re
from collections.abc import Mapping
from typing import Any

from torchface.io.gltf.gltf_document import Document

_WORD = r"(?:^|[_ :.]|mixamorig)"
_EYE = "eye(?:ball)?"


def _name(pattern: str) -> re.Pattern[str]:
    return re.compile(f"{_WORD}(?:{pattern})$", re.IGNORECASE)


def _sided(side: str, letter: str, part: str) -> re.Pattern[str]:
    return _name(rf"{side}_?{part}|{part}[_.]?{letter}|{part}[_.]?{side}|{letter}_{part}")


_NAMES = {
    "head": _name("head"),
    "neck": _name("neck(?:_?0?1)?"),
    "rightEye": _sided("right", "r", _EYE),
    "leftEye": _sided("left", "l", _EYE),
}


def character_nodes(document: Document) -> dict[str, int]:
    """The nodes ``head``, ``neck``, ``rightEye`` and ``leftEye``, those that are there.

    Heads and necks are bones of a skeleton; eyes may be any node.
    """
    nodes = document.objects("nodes")
    joints = {joint for skin in document.objects("skins") for joint in document.array(skin, "joints", "skins")}
    table = vrm_bones(document)
    found: dict[str, int] = {}
    for part, pattern in _NAMES.items():
        named = (
            index
            for index, node in enumerate(nodes)
            if (index in joints or part.endswith("Eye")) and pattern.search(str(node.get("name", "")))
        )
        index = table.get(part, next(named, None))
        if isinstance(index, int) and not isinstance(index, bool) and 0 <= index < len(nodes):
            found[part] = index
    return found


def looks_back(document: Document) -> bool:
    """Whether the character looks along -z at rest, as VRM 0 has it."""
    extensions = document.record(document.root.get("extensions"), "extensions")
    return "VRM" in extensions and "VRMC_vrm" not in extensions


def vrm_bones(document: Document) -> dict[str, Any]:
    """The nodes that a VRM calls its bones, by part; none of other files."""
    extensions = document.record(document.root.get("extensions"), "extensions")
    for name in ("VRMC_vrm", "VRM"):
        if name in extensions:
            humanoid = document.record(document.record(extensions[name], name).get("humanoid"), f"{name}.humanoid")
            bones = humanoid.get("humanBones")
            if isinstance(bones, Mapping):
                return {part: bone.get("node") for part, bone in bones.items() if isinstance(bone, Mapping)}
            if isinstance(bones, list):
                return {str(bone.get("bone")): bone.get("node") for bone in bones if isinstance(bone, Mapping)}
    return {}
