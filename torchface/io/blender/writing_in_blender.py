"""Script that Blender, or a Python with ``bpy``, runs to write; never imported by the library.

``writing_in_blender.py USD FILE NOTES`` opens a USD file of one mesh and writes it as FBX or Blender file. NOTES is
JSON: ``fps``, ``names`` of all shape keys, ``ranges``, the least and the largest weight of each, and ``correctives``,
records of ``torchface.correctives`` with the ``expression`` that drives each.
"""

import json
import sys
from pathlib import Path
from typing import Any

_NOTES = "torchface"


def write(source: Path, path: Path, notes: dict[str, Any]) -> None:
    """Opens a USD file that torchface wrote and writes it for those who read FBX or Blender's own files."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(notes["fps"]))
    scene.render.fps_base = scene.render.fps / notes["fps"]
    bpy.ops.wm.usd_import(filepath=str(source), set_frame_range=True)
    bpy.ops.file.pack_all()
    for image in bpy.data.images:
        if Path(image.filepath).stem != source.stem:
            image[_NOTES] = "painted"  # for a part without texture; no part of the mesh's own
    for one in [item for item in scene.objects if item.type in ("ARMATURE", "EMPTY") and not item.children]:
        bpy.data.objects.remove(one)  # USD's skeleton without joints, and the scope of its materials
    face = next(item for item in scene.objects if item.type == "MESH")
    keys = face.data.shape_keys
    blocks = list(keys.key_blocks)[1:]
    for block, name, (least, largest) in zip(blocks, notes["names"], notes["ranges"], strict=True):
        block.name = name  # Blender's USD import does not escape names in the paths of its keyframes, this does
        block.slider_min, block.slider_max = least, largest
    called = {name: block.name for name, block in zip(notes["names"], blocks, strict=True)}  # long names are cut
    correctives = [
        note | {"name": called[note["name"]], "drivers": [called[name] for name in note["drivers"]]}
        for note in notes["correctives"]
    ]
    if correctives:
        records = [
            {key: value for key, value in corrective.items() if key != "expression"} for corrective in correctives
        ]
        face[_NOTES] = json.dumps({"correctives": records}, ensure_ascii=False)
    if path.suffix.lower() == ".blend":
        _drive(keys, correctives)
        bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True)
        return
    bpy.ops.export_scene.fbx(
        filepath=str(path),
        object_types={"MESH", "EMPTY"},
        use_mesh_modifiers=False,  # meshes with modifiers lose their shapes
        use_custom_props=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
        path_mode="COPY",
        embed_textures=True,
    )


def _drive(keys: Any, correctives: list[dict[str, Any]]) -> None:
    """Has the correctives' keys follow the shapes' by drivers, in place of keyframes."""
    import bpy

    paths = {f'key_blocks["{bpy.utils.escape_identifier(one["name"])}"].value' for one in correctives}
    action = keys.animation_data.action if keys.animation_data is not None else None
    for curves in [] if action is None else _curves(action):
        for curve in [curve for curve in curves if curve.data_path in paths]:
            curves.remove(curve)
    for one in correctives:
        driver = keys.key_blocks[one["name"]].driver_add("value").driver
        for number, name in enumerate(one["drivers"]):
            variable = driver.variables.new()
            variable.name = f"w{number}"
            variable.targets[0].id_type = "KEY"
            variable.targets[0].id = keys
            variable.targets[0].data_path = f'key_blocks["{bpy.utils.escape_identifier(name)}"].value'
        driver.type = "SCRIPTED"
        driver.expression = one["expression"]


def _curves(action: Any) -> list[Any]:
    """The lists of curves of an action; Blender before 4.4 has one."""
    if hasattr(action, "layers"):
        return [bag.fcurves for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [action.fcurves]


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    write(Path(words[0]), Path(words[1]), json.loads(Path(words[2]).read_text()))
