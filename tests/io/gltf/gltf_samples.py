"""glTF documents put together field by field, as other programs write them."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Builder:
    """Collects accessors in one buffer, then writes the JSON with the buffer inside or beside it."""

    def __init__(self) -> None:
        self.root: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}
        self.data = b""

    def view(self, data: bytes, **fields: Any) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.root["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **fields})
        self.data += data
        return len(self.root["bufferViews"]) - 1

    def accessor(self, rows: np.ndarray, **fields: Any) -> int:
        """One accessor with a view of its own."""
        rows = np.asarray(rows).reshape(len(rows), -1)
        view = {"bufferView": self.view(rows.tobytes())} if "bufferView" not in fields else {}
        kind = {"componentType": COMPONENTS[rows.dtype.str[1:]], "count": len(rows), "type": TYPES[rows.shape[1]]}
        self.root["accessors"].append({**view, **kind, **fields})
        return len(self.root["accessors"]) - 1

    def bare(self, **fields: Any) -> int:
        self.root["accessors"].append(fields)
        return len(self.root["accessors"]) - 1

    def save(self, path: Path, **fields: Any) -> Path:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        root = {**self.root, "buffers": [{"byteLength": len(self.data), "uri": uri}], **fields}
        path.write_text(json.dumps(root))
        return path

    def save_beside(self, path: Path, uri: str) -> Path:
        (path.parent / "data folder").mkdir(exist_ok=True)
        (path.parent / "data folder" / "face.bin").write_bytes(self.data)
        path.write_text(json.dumps({**self.root, "buffers": [{"byteLength": len(self.data), "uri": uri}]}))
        return path


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
SQUARE_TRIANGLES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
LIFT = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0.5], [0, 0, 0]], np.float32)


def square(names: list[str] | None = None) -> Builder:
    """A square of a metre with two morph targets: one lifts a corner, one moves all to the right."""
    build = Builder()
    shift = np.tile(np.array([[0.25, 0, 0]], np.float32), (4, 1))
    primitive = {
        "attributes": {"POSITION": build.accessor(SQUARE)},
        "indices": build.accessor(SQUARE_TRIANGLES),
        "targets": [{"POSITION": build.accessor(LIFT)}, {"POSITION": build.accessor(shift)}],
    }
    mesh: dict[str, Any] = {"primitives": [primitive]}
    if names is not None:
        mesh["extras"] = {"targetNames": names}
    build.root |= {"meshes": [mesh], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    return build
