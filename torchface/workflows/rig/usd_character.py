"""ARKit's shapes on the face of a character in a USD file: found and made on its meshes in a ``.glb`` for the time."""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchface.errors import FileFormatError
from torchface.files.whole_files import check_ending, replaced_file, write_file
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.character_scene import read_character
from torchface.io.gltf.gltf_document import glb_pieces, read_document
from torchface.io.scene_processes.reading_process import run_process
from torchface.io.scene_processes.scene_arrays import Scene, mesh_transform, pieces_of
from torchface.io.usd import shapes_in_stage
from torchface.io.usd.usd_reading import read_stage
from torchface.progress import Progress
from torchface.workflows.rig.character_rig import PICTURE_ENDING, CharacterReport, rig_character

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
_SECONDS = 600.0


def rig_usd_character(path: Path, out: Path, progress: Progress | None = None) -> CharacterReport:
    """Adds ARKit's shapes as blend shapes to the meshes of a USD character's face; all else of its layer stays."""
    check_ending(out, path.suffix.lower())
    scene = read_stage(path)
    with tempfile.TemporaryDirectory(prefix="torchface-usd-") as folder:
        bare, made = Path(folder, "character.glb"), Path(folder, "rigged.glb")
        _write_glb(scene, bare)
        try:
            report = rig_character(bare, made, progress)
        finally:
            picture = Path(folder, f"rigged{PICTURE_ENDING}")
            figure = out.with_name(f"{out.stem}{PICTURE_ENDING}")
            if picture.is_file():
                write_file(figure, picture.read_bytes())
        _write_shapes(scene, made, report.made, Path(folder))
        with replaced_file(out) as temporary:
            target = temporary.with_suffix(path.suffix)  # OpenUSD goes by the ending
            script = str(Path(shapes_in_stage.__file__).resolve())
            command = [sys.executable, "-P", script, str(path.absolute()), folder, str(target.absolute())]
            try:
                run_process(command, str(path), "OpenUSD", _SECONDS)
                if not target.is_file():
                    raise FileFormatError(f"{path}: OpenUSD wrote no file")
                target.replace(temporary)
            finally:
                if target != temporary:
                    target.unlink(missing_ok=True)
    return replace(report, figure=report.figure and figure)


def _write_glb(scene: Scene, path: Path) -> None:
    """A mesh for each of the scene's, in its place and order, with the shapes that it has."""
    buffers = BufferWriter()
    root: dict[str, Any] = {"nodes": [{"name": "scene", "children": []}], "meshes": []}
    for piece in pieces_of(scene):
        attributes = {"POSITION": buffers.vertices((piece.vertices / 1000).numpy())}
        primitive: dict[str, Any] = {"attributes": attributes, "indices": buffers.triangles(piece.faces.numpy())}
        mesh: dict[str, Any] = {"name": piece.name, "primitives": [primitive]}
        if piece.names:
            primitive["targets"] = [
                {"POSITION": buffers.deltas(one.numpy() / np.float32(1000))} for one in piece.deltas
            ]
            mesh["extras"] = {"targetNames": list(piece.names)}
        root["nodes"][0]["children"].append(len(root["nodes"]))
        root["nodes"].append({"name": piece.name, "mesh": len(root["meshes"])})
        root["meshes"].append(mesh)
    write_file(path, b"".join(glb_pieces(root, buffers, path)))


def _write_shapes(scene: Scene, made: Path, names: tuple[str, ...], folder: Path) -> None:
    """What the process takes: the new shapes of each mesh in its own axes and unit, and landmarks and regions."""
    character = read_character(read_document(made))
    meshes: list[dict[str, Any]] = []
    arrays: dict[str, Any] = {}
    for block in character.blocks:
        new = [name for name in block.names if name in names]
        notes = character.document.objects("meshes")[block.mesh].get("extras", {}).get("torchface")
        if not new and notes is None:
            continue
        record = scene.record["meshes"][block.mesh]
        back = np.linalg.inv(mesh_transform(scene, record, None)[0])
        for row, name in enumerate(new):
            delta = character.targets(block)[block.names.index(name)].double().numpy() * 1000 @ back
            moved = np.flatnonzero((delta != 0).any(1))
            arrays[f"{len(meshes)}/{row}/rows"], arrays[f"{len(meshes)}/{row}/offsets"] = moved, delta[moved]
        noted = None if notes is None else json.dumps(notes, separators=(",", ":"))
        meshes.append({"path": record["path"], "names": new, "notes": noted})
    write_file(folder / "shapes.json", json.dumps(meshes).encode())
    np.savez(folder / "shapes.npz", **arrays)
