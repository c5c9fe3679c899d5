"""What Blender shows of a file, and what it writes of it: run by Blender's own Python.

``shown_in_blender.py show FILE OUT.npz FPS`` opens a file and keeps the names of its shape keys and the places of all
evaluated vertices, metres, frame by frame. ``shown_in_blender.py pose FILE OUT.npz NAME=WEIGHT ...`` keeps the places
that they have when somebody moves these sliders. ``shown_in_blender.py export FILE OUT`` opens one and writes it with
Blender's exporters and their defaults.
"""

import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

OPEN = {
    ".glb": bpy.ops.import_scene.gltf,
    ".usdc": bpy.ops.wm.usd_import,
    ".usdz": bpy.ops.wm.usd_import,
    ".fbx": bpy.ops.import_scene.fbx,
}


def opened(path: str, fps: float) -> list[Any]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = round(fps)
    if path.endswith(".blend"):
        bpy.ops.wm.open_mainfile(filepath=path)
    else:
        OPEN[Path(path).suffix](filepath=path)
    return [one for one in bpy.context.scene.objects if one.type == "MESH"]


def places(found: list[Any]) -> np.ndarray:
    graph = bpy.context.evaluated_depsgraph_get()
    rows = []
    for one in found:
        moved = one.evaluated_get(graph)
        mesh = moved.to_mesh()
        points = np.empty(len(mesh.vertices) * 3, np.float32)
        mesh.vertices.foreach_get("co", points)
        world = np.array(moved.matrix_world, np.float64)
        rows.append(points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
    return np.concatenate(rows)


def show(path: str, out: str, fps: str) -> None:
    found = opened(path, float(fps))
    keys = [one.data.shape_keys for one in found if one.data.shape_keys is not None]
    names = [block.name for block in keys[0].key_blocks[1:]]
    actions = [one.animation_data.action for one in keys if one.animation_data and one.animation_data.action]
    frames = []
    if actions:
        first, last = (round(end) for end in actions[0].frame_range)
        for frame in range(first, last + 1):
            bpy.context.scene.frame_set(frame)
            frames.append(places(found))
    for one in keys:
        one.animation_data_clear()
        for block in one.key_blocks:
            block.value = 0.0
    bpy.context.view_layer.update()
    images = [image.name for image in bpy.data.images if image.size[0] > 0]
    np.savez(out, names=names, rest=places(found), frames=np.array(frames), images=images)


def pose(path: str, out: str, *sliders: str) -> None:
    found = opened(path, 24.0)
    for one in found:
        for slider in sliders:
            name, _, value = slider.partition("=")
            one.data.shape_keys.key_blocks[name].value = float(value)
    bpy.context.view_layer.update()
    np.savez(out, places=places(found))


def export(path: str, out: str) -> None:
    opened(path, 24.0)
    if out.endswith(".glb"):
        bpy.ops.export_scene.gltf(filepath=out)
    elif out.endswith(".fbx"):
        bpy.ops.export_scene.fbx(filepath=out, path_mode="COPY", embed_textures=True)
    else:
        bpy.ops.wm.usd_export(filepath=out, export_animation=True)


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    {"show": show, "pose": pose, "export": export}[words[0]](*words[1:])
