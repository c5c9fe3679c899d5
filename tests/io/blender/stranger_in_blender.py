"""A scene as strangers build them, and what Blender shows of it: run by Blender's own Python.

``stranger_in_blender.py FOLDER`` leaves ``scene.blend``, ``.glb``, ``.usdc`` and ``.fbx`` of it, ``frames.npz`` of all
places, metres, and ``scene_at_rest.npz`` without animation.
"""

import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

FRAMES = 4


def add_keys(one: Any, names: tuple[str, ...], seed: int) -> None:
    generator = np.random.default_rng(seed)
    one.shape_key_add(name="Basis", from_mix=False)
    rest = np.array([vertex.co for vertex in one.data.vertices])
    for name in names:
        moved = rest + 0.1 * generator.normal(size=rest.shape) * (generator.random((len(rest), 1)) < 0.5)
        block = one.shape_key_add(name=name, from_mix=False)
        block.data.foreach_set("co", moved.astype(np.float32).ravel())


def animate(one: Any) -> None:
    for block in one.data.shape_keys.key_blocks[1:]:
        for frame in range(1, FRAMES + 1):
            block.value = frame * len(block.name) % 5 / 4
            block.keyframe_insert("value", frame=frame)


def painted(one: Any, color: tuple[float, ...]) -> None:
    material = bpy.data.materials.new(one.name)
    material.use_nodes = True
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = bpy.data.images.new(one.name, 8, 8)
    texture.image.generated_color = color
    surface = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(texture.outputs[0], surface.inputs["Base Color"])
    one.data.materials.append(material)


def build() -> None:
    """A head that is mirrored, stretched and tilted, teeth of a modifier, an instance, a hidden box."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = 30, 1, FRAMES
    above = bpy.data.objects.new("über", None)
    scene.collection.objects.link(above)
    above.scale, above.rotation_euler, above.location = (1, 2, 0.5), (0.1, 0.2, 0.3), (0, 0, 1)
    bpy.ops.mesh.primitive_monkey_add(location=(1, 2, 3), rotation=(0.3, 0.4, 0.5))
    head = bpy.context.object
    head.name, head.parent, head.scale = "Kopf", above, (-1, 1, 1)
    add_keys(head, ("Lächeln", "笑顔.L", 'a/b:"c"'), 0)
    head.modifiers.new("smooth", "SUBSURF").show_viewport = False
    group = head.vertex_groups.new(name="half")
    group.add(range(200), 0.5, "ADD")
    painted(head, (1, 0.5, 0.2, 1))
    animate(head)
    bpy.ops.mesh.primitive_cylinder_add(vertices=17, location=(4, 0, 0))  # its ends have 17 corners
    teeth = bpy.context.object
    teeth.name = "Zähne"
    teeth.modifiers.new("both sides", "MIRROR").mirror_object = above
    shelf = bpy.data.collections.new("shelf")
    scene.collection.children.link(shelf)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=8, ring_count=6, location=(-3, 0, 0))
    eye = bpy.context.object
    scene.collection.objects.unlink(eye)
    shelf.objects.link(eye)
    instance = bpy.data.objects.new("Auge", None)
    instance.instance_type, instance.instance_collection, instance.location = "COLLECTION", shelf, (0, 0, 5)
    scene.collection.objects.link(instance)
    bpy.ops.mesh.primitive_cube_add(size=30)
    bpy.context.object.hide_viewport = bpy.context.object.hide_render = True


def places() -> np.ndarray:
    """All vertices that the scene shows."""
    rows = []
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "MESH":
            mesh = instance.object.to_mesh()
            points = np.empty(len(mesh.vertices) * 3, np.float32)
            mesh.vertices.foreach_get("co", points)
            world = np.array(instance.matrix_world, np.float64)
            rows.append(points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
    return np.concatenate(rows)


if __name__ == "__main__":
    folder = Path((sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])[0])
    build()
    bpy.ops.export_scene.gltf(filepath=str(folder / "scene.glb"), export_apply=False)
    bpy.ops.wm.usd_export(filepath=str(folder / "scene.usdc"), export_animation=True)
    bpy.ops.export_scene.fbx(
        filepath=str(folder / "scene.fbx"),
        use_mesh_modifiers=False,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
    )
    frames = []
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        frames.append(places())
    np.savez(folder / "frames.npz", frames=frames)
    block = bpy.data.objects["Kopf"].data.shape_keys.key_blocks["Lächeln"]
    block.vertex_group = "half"  # which only Blender's own file knows
    frames = []
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        frames.append(places())
    np.savez(folder / "grouped.npz", frames=frames)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
