"""Primitives of glTF that Draco has packed (``KHR_draco_mesh_compression``)."""

from typing import Any

from torchface.files.extra_packages import import_extra
from torchface.io.gltf.gltf_document import DRACO, Document, shown


def unpack_draco(document: Document, primitive: dict[str, Any], location: str) -> None:
    """Unpacks a primitive's triangles and attributes; its accessors give them from then on."""
    where = f"{location}.extensions.{DRACO}"
    packed = document.record(document.record(primitive.get("extensions"), f"{location}.extensions").get(DRACO), where)
    if not packed:
        return
    draco = import_extra("DracoPy", "DracoPy", "compressed", f"{document.path}: Draco compression")
    data = bytes(document.view(packed.get("bufferView"), f"{where}.bufferView")[0])
    try:
        mesh = draco.decode(data)
    except (draco.FileTypeException, draco.EncodingFailedException, ValueError, RuntimeError, MemoryError) as error:
        raise document.error(where, f"broken data ({str(error)[:80]})", "what Draco packs") from error
    rows = {one["unique_id"]: one["data"] for one in mesh.attributes}
    accessors = document.record(primitive.get("attributes"), f"{location}.attributes")
    for name, number in document.record(packed.get("attributes"), f"{where}.attributes").items():
        if number not in rows or name not in accessors:
            raise document.error(f"{where}.attributes.{name}", shown(number), f"one of {sorted(rows)}")
        document.unpacked_accessors[accessors[name]] = rows[number]
    if primitive.get("indices") is not None and getattr(mesh, "faces", None) is not None:
        document.unpacked_accessors[primitive["indices"]] = mesh.faces.reshape(-1, 1)
