"""What Blender runs: as a script of its own, or of a Python with ``bpy``; never imported by the library.

``blender_process.py read FILE FOLDER`` opens an FBX or Blender file and writes ``scene.json`` and ``arrays.npz`` (see
``torchface.io.scene_processes.scene_arrays``) into the folder, or ``refused.json``, a list of what was found and what
was expected. ``blender_process.py write USD FILE FPS`` opens a USD file and writes it as FBX or Blender file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

_MOST_FRAMES = 1_000_000


class Refused(Exception):
    """The file cannot be read: what was found, and what was expected."""


def read(path: Path, folder: Path) -> None:
    """Opens a file and leaves its meshes, shape keys and their animation in the folder."""
    import bpy

    try:
        _open(path)
        for skeleton in bpy.data.armatures:
            skeleton.pose_position = "REST"
        bpy.context.view_layer.update()
        arrays: dict[str, Any] = {}
        found = [one for one in bpy.context.scene.objects if one.type == "MESH" and len(one.data.polygons)]
        if not found:
            raise Refused("no mesh in its scene", "at least one with faces")
        meshes = [_mesh(one, f"{number}/", arrays) for number, one in enumerate(found)]
        scene = {
            "metres_per_unit": bpy.context.scene.unit_settings.scale_length or 1.0,
            "up": "Z",
            "meshes": meshes,
            "bytes": path.stat().st_size,
            "animation": _animation(found, arrays),
        }
    except Refused as refused:
        (folder / "refused.json").write_text(json.dumps(list(refused.args)))
        return
    np.savez(folder / "arrays.npz", **arrays)
    (folder / "scene.json").write_text(json.dumps(scene))


def write(source: Path, path: Path, fps: float) -> None:
    """Opens a USD file that torchface wrote and writes it for those who read FBX or Blender's own files."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps
    bpy.ops.wm.usd_import(filepath=str(source), set_frame_range=True)
    bpy.ops.file.pack_all()
    for one in [one for one in scene.objects if one.type in ("ARMATURE", "EMPTY") and not one.children]:
        bpy.data.objects.remove(one)  # USD's skeleton without joints, and the scope of its materials
    if path.suffix.lower() == ".blend":
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
        return
    bpy.ops.export_scene.fbx(
        filepath=str(path),
        object_types={"MESH", "EMPTY"},
        use_mesh_modifiers=False,  # meshes with modifiers lose their shapes
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
        path_mode="COPY",
        embed_textures=True,
    )


def _open(path: Path) -> None:
    import bpy

    try:
        if path.suffix.lower() == ".blend":
            bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
        else:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            bpy.ops.import_scene.fbx(filepath=str(path))
    except RuntimeError as error:
        raise Refused(f"what Blender does not read ({str(error).strip()[:300]})", "an FBX or Blender file") from error


def _mesh(one: Any, prefix: str, arrays: dict[str, Any]) -> dict[str, Any]:
    """The record of a mesh object; its arrays go under the prefix."""
    mesh = one.data
    keys = mesh.shape_keys
    if keys is not None and not keys.use_relative:
        raise Refused(f"absolute shape keys on {one.name[:60]!r}", "relative ones, each a shape with a weight")
    points = _values(mesh.vertices if keys is None else keys.reference_key.data, "co", 3)
    corners = _values(mesh.loops, "vertex_index", 1, np.int32)[:, 0].astype(np.int64)
    counts = _values(mesh.polygons, "loop_total", 1, np.int32)[:, 0].astype(np.int64)
    arrays |= {f"{prefix}points": points, f"{prefix}counts": counts, f"{prefix}corners": corners}
    if mesh.uv_layers.active is not None:
        uvs = _values(mesh.uv_layers.active.uv, "vector", 2)
        # Corners of a vertex with equal coordinates are one: what is left apart is a seam.
        _, first, row = np.unique(
            np.column_stack([corners, (uvs + np.float32(0)).view(np.int32)]), axis=0, return_index=True,
            return_inverse=True,
        )  # fmt: skip
        arrays |= {f"{prefix}uvs": uvs[first], f"{prefix}uv_corners": row.ravel().astype(np.int64)}
    image = _image(mesh)
    if image is not None:
        arrays[f"{prefix}texture"] = np.frombuffer(image, np.uint8)
    shapes: list[dict[str, Any]] = []
    for block in [] if keys is None else keys.key_blocks:
        if block == keys.reference_key:
            continue
        offsets = _values(block.data, "co", 3) - _values(block.relative_key.data, "co", 3)
        rows = np.flatnonzero(offsets.any(1))
        arrays[f"{prefix}shape/{len(shapes)}/offsets"] = offsets[rows]
        arrays[f"{prefix}shape/{len(shapes)}/rows"] = rows
        shapes.append({"name": block.name, "between": []})
    return {
        "name": one.name,
        "place": one.name[:60],
        "matrix": np.array(one.matrix_world, np.float64).T.ravel().tolist(),
        "notes": None,
        "shapes": shapes,
    }


def _animation(found: list[Any], arrays: dict[str, Any]) -> dict[str, Any] | None:
    """Weights of all shapes, frame by frame over what their keys span; none where no shape has keys."""
    import bpy

    keys = [one.data.shape_keys for one in found if one.data.shape_keys is not None]
    spans = [
        tuple(one.animation_data.action.frame_range)
        for one in keys
        if one.animation_data is not None and one.animation_data.action is not None
    ]
    if not spans:
        return None
    first, last = round(min(span[0] for span in spans)), round(max(span[1] for span in spans))
    if last - first >= _MOST_FRAMES:
        raise Refused(f"an animation of {last - first} frames", f"at most {_MOST_FRAMES}")
    blocks: dict[str, Any] = {}
    for one in keys:
        for block in one.key_blocks:
            if block != one.reference_key:
                blocks.setdefault(block.name, block)
    scene = bpy.context.scene
    values = np.zeros((last - first + 1, len(blocks)), np.float32)
    for row in range(len(values)):  # Blender evaluates one frame at a time
        scene.frame_set(first + row)
        values[row] = [block.value for block in blocks.values()]
    rate = scene.render.fps / scene.render.fps_base
    arrays |= {"animation/times": np.arange(len(values)) / rate, "animation/weights": values}
    return {"names": list(blocks)}


def _image(mesh: Any) -> bytes | None:
    """The encoded image of the base colour of the first material that has one."""
    import bpy

    for material in mesh.materials:
        for node in material.node_tree.nodes if material is not None and material.node_tree is not None else ():
            links = node.inputs["Base Color"].links if node.type == "BSDF_PRINCIPLED" else ()
            image = links[0].from_node.image if links and links[0].from_node.type == "TEX_IMAGE" else None
            if image is None:
                continue
            if image.packed_file is not None:
                return bytes(image.packed_file.data)
            file = Path(bpy.path.abspath(image.filepath))
            if file.is_file():
                return file.read_bytes()
    return None


def _values(rows: Any, field: str, width: int, kind: Any = np.float32) -> Any:
    found = np.empty(len(rows) * width, kind)
    rows.foreach_get(field, found)
    return found.reshape(-1, width)


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if words[0] == "read":
        read(Path(words[1]), Path(words[2]))
    else:
        write(Path(words[1]), Path(words[2]), float(words[3]))
