"""Script that Blender, or a Python with ``bpy``, runs to read; never imported by the library.

``reading_in_blender.py FILE FOLDER`` opens an FBX or Blender file and writes ``scene.json`` and ``arrays.npz`` (see
``torchface.io.scene_processes.scene_arrays``) into the folder, or ``refused.json``, a list of what was found and what
was expected.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

_MOST_FRAMES, _MOST_MESHES = 1_000_000, 4096
_NOTES = "torchface"
_CAGE = ("SUBSURF", "MULTIRES")
_HARMLESS = (*_CAGE, "ARMATURE")


class Refused(Exception):
    """The file cannot be read: what was found, and what was expected."""


def read(path: Path, folder: Path) -> None:
    """Opens a file and leaves its meshes, shape keys and their animation in the folder."""
    import bpy

    try:
        _open(path)
        arrays: dict[str, Any] = {}
        left_out: list[str] = []
        animation = _animation([one for one, _ in _shown_meshes()], arrays, left_out)
        for skeleton in bpy.data.armatures:
            skeleton.pose_position = "REST"
        for one in bpy.data.objects:
            for modifier in one.modifiers:
                modifier.show_viewport = modifier.show_viewport and modifier.type not in _CAGE
        bpy.context.view_layer.update()
        found = _shown_meshes()
        reader = _MeshReader(arrays, left_out)
        meshes = [reader.read(one, matrix, f"{number}/") for number, (one, matrix) in enumerate(found)]
        if len(reader.images) > 1:
            shown = ", ".join(name[:40] for name in list(reader.images)[:5])
            left_out.append(f"{len(reader.images)} textures ({shown}), of which a mesh has one: the first is taken")
        scene = {
            "metres_per_unit": bpy.context.scene.unit_settings.scale_length or 1.0,
            "up": "Z",
            "meshes": meshes,
            "bytes": path.stat().st_size,
            "animation": animation,
            "left_out": left_out,
        }
    except Refused as refused:
        (folder / "refused.json").write_text(json.dumps(list(refused.args)))
        return
    np.savez(folder / "arrays.npz", **arrays)
    (folder / "scene.json").write_text(json.dumps(scene))


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


def _shown_meshes() -> list[tuple[Any, Any]]:
    """The mesh objects that the scene shows, instances of collections among them, and where each stands, (4,4)."""
    import bpy

    meshes: list[tuple[Any, Any]] = []
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        one = instance.object.original
        if one.type != "MESH" or not len(one.data.polygons):
            continue
        if len(meshes) == _MOST_MESHES:
            raise Refused(f"more than {_MOST_MESHES} meshes in its scene", "a rig")
        meshes.append((one, np.array(instance.matrix_world, np.float64)))
    if not meshes:
        raise Refused("no mesh that its scene shows", "at least one with faces")
    return meshes


class _MeshReader:
    """Reads mesh objects one after the other, each one's arrays under its prefix, and what was left out, in words."""

    def __init__(self, arrays: dict[str, Any], left_out: list[str]) -> None:
        self.arrays, self.left_out = arrays, left_out
        self.images: dict[str, bytes | None] = {}

    def read(self, one: Any, matrix: Any, prefix: str) -> dict[str, Any]:
        """The record of an object that stands at ``matrix``."""
        import bpy

        keys, name = one.data.shape_keys, one.name
        changing = [
            modifier.name for modifier in one.modifiers if modifier.show_viewport and modifier.type not in _HARMLESS
        ]
        if keys is not None and changing:
            shown = ", ".join(changing)[:80]
            self._leave(f"modifiers of {name[:40]!r} ({shown}), which its shape keys are without: apply them before")
        if keys is None and changing:
            one = one.evaluated_get(bpy.context.evaluated_depsgraph_get())
            self._geometry(one.to_mesh(), None, prefix)
            one.to_mesh_clear()
        else:
            self._geometry(one.data, keys, prefix)
        shapes: list[dict[str, Any]] = []
        for block in [] if keys is None else keys.key_blocks:
            if block == keys.reference_key:
                continue
            offsets = _values(block.data, "co", 3) - _values(block.relative_key.data, "co", 3)
            if block.vertex_group and block.vertex_group in one.vertex_groups:
                offsets *= _group_weights(one, block.vertex_group)[:, None]
            rows = np.flatnonzero(offsets.any(1))
            self.arrays[f"{prefix}shape/{len(shapes)}/offsets"] = offsets[rows]
            self.arrays[f"{prefix}shape/{len(shapes)}/rows"] = rows
            shapes.append({"name": block.name, "between": []})
        return {
            "name": name,
            "place": name[:60],
            "matrix": matrix.T.ravel().tolist(),
            "notes": self._notes(one, {shape["name"] for shape in shapes}),
            "shapes": shapes,
        }

    def _geometry(self, mesh: Any, keys: Any, prefix: str) -> None:
        if keys is not None and not keys.use_relative:
            raise Refused(f"absolute shape keys on {mesh.name[:60]!r}", "relative ones, each a shape with a weight")
        points = _values(mesh.vertices if keys is None else keys.reference_key.data, "co", 3)
        corners = _values(mesh.loops, "vertex_index", 1, np.int32)[:, 0].astype(np.int64)
        counts = _values(mesh.polygons, "loop_total", 1, np.int32)[:, 0].astype(np.int64)
        self.arrays |= {f"{prefix}points": points, f"{prefix}counts": counts, f"{prefix}corners": corners}
        if mesh.uv_layers.active is not None:
            uvs = _values(mesh.uv_layers.active.uv, "vector", 2)
            # Corners of a vertex with equal coordinates are one: what is left apart is a seam.
            _, first, row = np.unique(
                np.column_stack([corners, (uvs + np.float32(0)).view(np.int32)]), axis=0, return_index=True,
                return_inverse=True,
            )  # fmt: skip
            self.arrays |= {f"{prefix}uvs": uvs[first], f"{prefix}uv_corners": row.ravel().astype(np.int64)}
        image = self._texture(mesh)
        if image is not None:
            self.arrays[f"{prefix}texture"] = np.frombuffer(image, np.uint8)

    def _notes(self, one: Any, names: set[str]) -> str | None:
        """What torchface noted of correctives, as long as their shape keys are there."""
        records = _noted_correctives(one)
        if records is None:
            self._leave(f"a damaged note of correctives at {one.name[:40]!r}: they are shapes of their own")
            return None
        kept = [record for record in records if names.issuperset([record["name"], *record["drivers"]])]
        if len(kept) < len(records):
            gone = len(records) - len(kept)
            self._leave(f"{gone} correctives noted at {one.name[:40]!r} whose shape keys or drivers have other names")
        return json.dumps({"correctives": kept}) if kept else None

    def _texture(self, mesh: Any) -> bytes | None:
        """The encoded image of the base colour of the first material that has one."""
        found: bytes | None = None
        for material in mesh.materials:
            for node in material.node_tree.nodes if material is not None and material.node_tree is not None else ():
                links = node.inputs["Base Color"].links if node.type == "BSDF_PRINCIPLED" else ()
                image = links[0].from_node.image if links and links[0].from_node.type == "TEX_IMAGE" else None
                if image is None or image.get(_NOTES) is not None:  # an image that torchface painted for a part
                    continue
                if image.source == "TILED":
                    tiles = ", ".join(str(tile.number) for tile in list(image.tiles)[:10])
                    self._leave(f"the tiled texture (UDIM) {image.name[:40]!r} of tiles {tiles}, expected one image")
                    continue
                if image.name not in self.images:
                    self.images[image.name] = _encoded(image)
                found = self.images[image.name] if found is None else found
        return found

    def _leave(self, what: str) -> None:
        if what not in self.left_out:
            self.left_out.append(what)


def _noted_correctives(one: Any) -> list[dict[str, Any]] | None:
    """The records of correctives in an object's custom property; none where that is damaged."""
    if not isinstance(one.get(_NOTES), str):
        return []
    try:
        records = list(json.loads(one[_NOTES]).get("correctives", ()))
        named = all(isinstance(name, str) for record in records for name in (record["name"], *record["drivers"]))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return records if named else None


def _group_weights(one: Any, name: str) -> Any:
    """How much each vertex belongs to a group, (V,)."""
    index = one.vertex_groups[name].index
    found = np.zeros(len(one.data.vertices), np.float32)
    for row, vertex in enumerate(one.data.vertices):  # Blender gives groups a vertex at a time
        for group in vertex.groups:
            if group.group == index:
                found[row] = group.weight
    return found


def _animation(found: list[Any], arrays: dict[str, Any], left_out: list[str]) -> dict[str, Any] | None:
    """Weights of all shapes, frame by frame over what their keys span; none where no shape has keys."""
    import bpy

    scene = bpy.context.scene
    keys = list({one.data.name: one.data.shape_keys for one in found if one.data.shape_keys is not None}.values())
    spans = [span for one in keys if one.animation_data is not None for span in _spans(one.animation_data)]
    driven = any(key.animation_data is not None and len(key.animation_data.drivers) for key in keys)
    if not spans and driven and len(bpy.data.actions):
        spans = [(scene.frame_start, scene.frame_end)]  # what moves their drivers may be anywhere
    if not spans:
        return None
    first, last = round(min(span[0] for span in spans)), round(max(span[1] for span in spans))
    if last - first >= _MOST_FRAMES:
        raise Refused(f"an animation of {last - first} frames", f"at most {_MOST_FRAMES}")
    noted = {record["name"] for one in found for record in _noted_correctives(one) or ()}
    shapes = [(one, block) for one in keys for block in one.key_blocks if block != one.reference_key]
    blocks = [(one, block) for one, block in shapes if block.name not in noted]  # correctives follow these
    followers = {_path(name) for name in noted}
    if not blocks:
        return None
    values = _sampled(blocks, range(first, last + 1), followers)
    scene.frame_set(first)
    columns: dict[str, int] = {}
    for column, (_, block) in enumerate(blocks):
        taken = columns.setdefault(block.name, column)
        if np.abs(values[:, taken] - values[:, column]).max() > 1e-4:
            left_out.append(f"other keys of {block.name[:40]!r} on a further mesh: those of the first are taken")
    rate = scene.render.fps / scene.render.fps_base
    weights = values[:, list(columns.values())]
    arrays |= {"animation/times": np.arange(len(values)) / rate, "animation/weights": weights}
    return {"names": list(columns)}


def _sampled(blocks: list[tuple[Any, Any]], frames: range, followers: set[str]) -> Any:
    """What animation gives shape keys, each with what holds it, in each frame, (T,N)."""
    import bpy

    values = np.zeros((len(frames), len(blocks)), np.float32)
    curves: dict[Any, dict[str, Any]] = {}
    for one, _ in blocks:
        found = curves[one] if one in curves else _curves(one.animation_data, followers)
        if found is None:
            break
        curves[one] = found
    else:
        for column, (one, block) in enumerate(blocks):
            curve = curves[one].get(_path(block.name))
            along = [block.value] * len(frames) if curve is None else [curve.evaluate(frame) for frame in frames]
            values[:, column] = 0.0 if block.mute else np.clip(along, block.slider_min, block.slider_max)
        return values
    for row, frame in enumerate(frames):  # Blender evaluates one frame at a time, and the meshes with it
        bpy.context.scene.frame_set(frame)
        values[row] = [0.0 if block.mute else block.value for _, block in blocks]
    return values


def _curves(animated: Any, followers: set[str]) -> dict[str, Any] | None:
    """The curves of an action by what they move; none where more than they may move shapes, strips and drivers."""
    if animated is None:
        return {}
    strange = any(driver.data_path not in followers for driver in animated.drivers)
    if len(animated.nla_tracks) or strange or animated.action_influence != 1:
        return None
    if animated.action is None:
        return {}
    if not hasattr(animated.action, "layers"):  # Blender before 4.4
        return {curve.data_path: curve for curve in animated.action.fcurves if not curve.mute}
    bags = [bag for layer in animated.action.layers for strip in layer.strips for bag in strip.channelbags]
    own = [bag for bag in bags if bag.slot == animated.action_slot]
    return {curve.data_path: curve for bag in own for curve in bag.fcurves if not curve.mute}


def _path(name: str) -> str:
    """What Blender's curves and drivers call the value of a shape key."""
    import bpy

    return f'key_blocks["{bpy.utils.escape_identifier(name)}"].value'


def _spans(animated: Any) -> list[tuple[float, float]]:
    """First and last frames of an action or of strips."""
    spans = [tuple(animated.action.frame_range)] if animated.action is not None else []
    return spans + [
        (strip.frame_start, strip.frame_end)
        for track in animated.nla_tracks
        if not track.mute
        for strip in track.strips
        if not strip.mute
    ]


def _encoded(image: Any) -> bytes | None:
    """An image as PNG or JPEG; none where Blender has no pixels of it."""
    import bpy

    if image.file_format in ("PNG", "JPEG"):
        if image.packed_file is not None:
            return bytes(image.packed_file.data)
        file = Path(bpy.path.abspath(image.filepath))
        if image.filepath and file.is_file():
            return file.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "image.png")
        try:
            image.file_format = "PNG"
            image.save(filepath=str(file))
        except RuntimeError:
            return None
        return file.read_bytes() if file.is_file() else None


def _values(rows: Any, field: str, width: int, kind: Any = np.float32) -> Any:
    found = np.empty(len(rows) * width, kind)
    rows.foreach_get(field, found)
    return found.reshape(-1, width)


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    read(Path(words[0]), Path(words[1]))
