"""A rig, its animation or a mesh from one kind of file to another, FBX and Blender's own by way of Blender."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.files.whole_files import check_ending, check_writable, make_folder
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.io import load_animation, load_detail_maps, load_region_maps, save_mesh
from torchface.io.blender import BLENDER_ENDINGS, blender_program, read_blender_file, write_blender_file
from torchface.io.maya.maya_writing import MAYA_ENDING, maya_notes
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import (
    ANIMATION_ENDINGS,
    GLTF_ENDINGS,
    SCENE_ENDINGS,
    check_rig_ending,
    reduced_keys,
    write_rig,
)
from torchface.io.rigs.ict_facekit import region
from torchface.io.scenes.weight_keys import weight_keys
from torchface.io.take_files import RECORDING_ENDINGS, TAKE_ENDINGS
from torchface.io.usd.usd_library import require_usd
from torchface.mesh import Mesh, submesh
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take
from torchface.workflows.posed_mesh import load_neutral, posed_mesh, several_heads
from torchface.workflows.rig_names import Naming, naming_lines, renamed, renamed_detail
from torchface.workflows.weight_files import checked_reduction, unread_turns


@dataclass(frozen=True, eq=False)
class Converted:
    """What was written."""

    mesh: Mesh  # at rest
    rig: BlendshapeRig | None  # as written, where there are shapes
    take: Take | None  # its animation, where there is one
    notes: tuple[str, ...]  # what the new file has no place for, and how shapes were named


def convert_file(
    source: Path,
    out: Path,
    unit: str | None = None,
    part: str | None = None,
    names: Naming | None = None,
    progress: Progress | None = None,
    pose: Mapping[str, float] | None = None,
    reduce: float | None = None,
) -> Converted:
    """Reads whatever holds a rig or a mesh and writes it as ``out``'s ending says.

    Args:
        out: ``.glb``, USD, ``.ma``, ``.fbx``, ``.blend``, or a name without an ending for a folder of OBJ files; for
            what has no shapes any mesh's ending.
        unit: of the source's numbers, where it is not the format's own.
        names: how shapes are called in ``out``; see ``rig_names``.
        reduce: keep as few keys as stay within this of every frame's weights; all if absent.
    """
    progress = progress or silent
    if source.suffix.lower() in (*TAKE_ENDINGS, *RECORDING_ENDINGS):
        raise FileFormatError(
            f"{source}: found a take, expected a rig or a mesh: `torchface solve` makes weights of markers, "
            "`torchface retarget` an animated rig of weights, torchface.save_take(torchface.load_take(...), ...) "
            "another kind of take"
        )
    if out.suffix.lower() in BLENDER_ENDINGS:
        require_usd()
    if {source.suffix.lower(), out.suffix.lower()} & set(BLENDER_ENDINGS):
        blender_program()
    if out.suffix:
        check_ending(out, *ANIMATION_ENDINGS, *BLENDER_ENDINGS, *MESH_ENDINGS)
        check_writable(out)
    else:
        check_writable(folder=out)
    if reduce is not None:
        checked_reduction(reduce)
        check_ending(out, *ANIMATION_ENDINGS)  # Blender bakes a key a frame
    progress("reading")
    source_rig = read_source(source, unit, part)
    if pose:
        if source_rig.rig is None:
            raise FileFormatError(f"{source}: found a mesh without shapes, expected a rig for a pose")
        source_rig = Converted(posed_mesh(source_rig.rig, pose, "--at"), None, None, ())
    progress("writing")
    make_folder(out.parent)
    if source_rig.rig is None:
        if out.suffix.lower() in (*BLENDER_ENDINGS, MAYA_ENDING, ""):
            raise FileFormatError(f"{source}: found a mesh without shapes, expected a rig to write {out.name} from")
        save_mesh(source_rig.mesh, out)
        return source_rig
    rig = renamed(source_rig.rig, names)
    detail, notes = (None, []) if part is not None else maps_for(source, out)
    if isinstance(detail, DetailMaps):
        detail = renamed_detail(detail, source_rig.rig, names)
    notes += () if source_rig.take is None else unread_turns(source)
    notes += write_source(rig, source_rig.take, detail, out, reduce)
    if part is None and (heads := several_heads(source_rig.rig)):
        notes.append(f"heads: {heads}")
    return Converted(rig.neutral, rig, source_rig.take, (*naming_lines(source_rig.rig, names), *notes))


def maps_for(source: Path, out: Path) -> tuple[DetailMaps | RegionMaps | None, list[str]]:
    """The detail maps of a rig's file that ``out`` has a place for, and lines on those that it has none for."""
    notes = []
    if source.suffix.lower() in GLTF_ENDINGS and (by_region := load_region_maps(source)) is not None:
        if out.suffix.lower() == ".glb":
            return by_region, []
        notes.append(f"{out.name} has no place for wrinkle maps by region, which are left out; .glb has")
    return (load_detail_maps(source) if source.suffix.lower() in SCENE_ENDINGS else None), notes


def read_source(source: Path, unit: str | None = None, part: str | None = None) -> Converted:
    """A mesh, its shapes and their animation, as far as a file has them."""
    suffix = source.suffix.lower()
    if suffix in BLENDER_ENDINGS:
        scene = read_blender_file(source, unit)
        mesh, rig, take = scene.mesh, scene.rig, scene.take
        if part is not None:
            keep = region(mesh, part)
            mesh, rig = submesh(mesh, keep).mesh, None if rig is None else rig.part(keep)
    else:
        mesh, rig = load_neutral(source, unit, part)
        take = load_animation(source) if suffix in SCENE_ENDINGS and rig is not None else None
    return Converted(mesh, rig, take, ())


def write_source(
    rig: BlendshapeRig,
    take: Take | None,
    detail: DetailMaps | RegionMaps | None,
    out: Path,
    reduce: float | None = None,
) -> list[str]:
    """Writes the rig with what ``out`` has a place for; says what it has none for."""
    suffix, notes = out.suffix.lower(), []
    if take is not None and not suffix:
        notes.append("a folder of OBJ files has no place for the animation, which is left out")
        take = None
    if isinstance(detail, DetailMaps) and suffix in (*BLENDER_ENDINGS, MAYA_ENDING):
        notes.append(f"{suffix} has no place for the detail maps of {len(detail.names)} shapes, which are left out")
        detail = None
    keys = None if take is None else weight_keys(rig, take)[0]
    if reduce is not None:
        keys, reduction = (None, None) if keys is None else reduced_keys(rig, keys, out, reduce)
        notes.append(f"{out.name}: {reduction or 'no animation to reduce'}")
    if suffix == ".fbx" and rig.correctives is not None:
        moved = "which the animation moves and sliders do not" if take is not None else "which no slider moves"
        notes.append(
            f"{suffix} has no correctives: the {len(rig.correctives.names)} are shape keys of their own, {moved}; "
            ".blend has drivers for them"
        )
    if suffix == MAYA_ENDING:
        notes += maya_notes(rig, keys)
    if suffix in BLENDER_ENDINGS:
        write_blender_file(rig, out, keys)
    else:
        check_rig_ending(out)
        write_rig(rig, out, detail, keys)
    return notes
