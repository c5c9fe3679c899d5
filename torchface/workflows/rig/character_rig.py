"""From a character's file to the same file with ARKit's shapes on its face."""

from __future__ import annotations

import copy
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any

import torch

from torchface.errors import AlignmentError, FileFormatError, TorchfaceError, ValueRangeError
from torchface.files.job_lock import file_lock
from torchface.files.whole_files import all_or_none, check_ending, check_there
from torchface.geometry.meshes.unit_check import extent, likely_unit
from torchface.io.gltf.character_annotations import annotate_character
from torchface.io.gltf.character_scene import Character, read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.morph_insertion import document_with_targets, rename_targets, write_edited
from torchface.io.gltf.part_insertion import document_with_parts
from torchface.io.images.image_files import IMAGE_ENDINGS, encode_png
from torchface.io.mesh_files import MESH_ENDINGS, load_mesh
from torchface.io.vrm.vrm_expressions import VRM_ENDING, add_expressions
from torchface.landmarks.surfaces.face_on_surface import NoFaceOnSurfaceError
from torchface.modeling import CarriedShapes, shapes_on
from torchface.modeling.rigging.annotated_heads import annotations_on, on_face
from torchface.modeling.rigging.mouth_parts import tongue_out
from torchface.progress import Progress, silent
from torchface.registration import Registration, register
from torchface.rendering.compositing import save_rendered_image, sheet
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.workflows.rig.added_parts import added_parts
from torchface.workflows.rig.character_face import CharacterFace, find_character_face, textured
from torchface.workflows.rig.character_job import CharacterJob
from torchface.workflows.rig.present_shapes import (
    PresentShape,
    moving_parts,
    present_lines,
    present_motion,
    present_shapes,
    spelled,
)
from torchface.workflows.rig.shut_eyes import eyes_shut_at_rest, with_shut_eyes

CHARACTER_ENDINGS = (".glb", VRM_ENDING)
"""Files of characters that are read and written."""
PICTURE_ENDING = "_face.png"
"""Ends the name of the picture that lies beside a character's rig."""
# Millimetres of a head's size between face and template, and the share of the face that is met: 0.1 at most and 0.84 at
# least on 13 characters, 2.1 and 0.42 on a box under a ball.
_FAR, _LEAST_MET = 1.0, 0.6
_TONGUE, _JAW = "tongueOut", "jawOpen"
_MOST_TRIANGLES = 500_000  # of a head: its shapes take some 6 GB
_CONVERT = {
    ".fbx": "install Blender, blender.org, and let it write one with skeleton and shape keys: "
    'blender --background --python-expr "import bpy; bpy.ops.wm.read_factory_settings(use_empty=True); '
    "bpy.ops.import_scene.fbx(filepath='{path}'); bpy.ops.export_scene.gltf(filepath='{stem}.glb')\"",
    ".gltf": "pack it: npx @gltf-transform/cli copy {quoted} {made}",
    **dict.fromkeys(IMAGE_ENDINGS, "of photographs: torchface fit {quoted} --out {made}"),
}


@dataclass(frozen=True, eq=False)
class CharacterReport:
    """What was found on a character and made for it; ``made`` and ``present`` by ARKit's names, ``expressions`` a
    VRM's."""

    made: tuple[str, ...]
    present: dict[str, tuple[str, ...]]
    expressions: tuple[str, ...]
    median_mm: float
    seconds: tuple[float, float]
    figure: Path | None
    notes: tuple[str, ...] = field(default=())

    def verdict(self) -> str:
        """Whether the character is to be used, in a line."""
        warned = sum(note.lstrip().startswith("warning") for note in self.notes)
        there = f"{len(self.present)} of ARKit's shapes were there"
        found = f"{len(self.made)} made, {there}" if self.made else f"{there}, none is made"
        if not warned:
            return f"result: good, {found}"
        return f"result: partly usable, {found}; {warned} {'warnings' if warned > 1 else 'warning'} below"

    def lines(self) -> list[str]:
        """For people to read."""
        return [self.verdict(), *self.notes]


def rig_character(
    path: Path, out: Path, progress: Progress | None = None, *, inner_mouth: bool = False, eyes: bool = False
) -> CharacterReport:
    """Puts ARKit's shapes on the face of a character; everything else of its file stays as it is.

    The face is found by its bone's name and by looking at the character from around. The embedded performer is
    registered to it, his shapes are transferred to it and carried over to the character's own vertices. Shapes that the
    character has, under whatever program's names, are kept and not made again. A VRM gets an expression for each.

    A picture of the face beside ``out``, ``NAME_face.png``, shows it before and after; where there is no face, what was
    seen.

    Args:
        inner_mouth: give it a bag, teeth, gums and a tongue where it has none; lips in one piece are cut apart.
        eyes: give it eyeballs where it has none; eyes in one piece with the skin are cut out.
    """
    check_character(path)
    check_ending(out, path.suffix.lower())
    progress, begin = progress or silent, time.perf_counter()
    with file_lock(out):
        progress("reading the character")
        document = read_document(path)
        character = read_character(document)
        present, empty = present_shapes(character)
        missing = [name for name in ARKIT if name not in present]
        if not (missing or inner_mouth or eyes):
            return _copied(character, present, out, begin, progress)
        surface = textured(character)
        figure = out.with_name(f"{out.stem}{PICTURE_ENDING}")
        try:
            face = find_character_face(character, surface, progress)
        except NoFaceOnSurfaceError as error:
            save_rendered_image(sheet(list(error.views)[:24], min(8, len(error.views))), figure)
            raise AlignmentError(f"{path}: {error}; what was seen is in {figure}") from error
        if len(face.head.faces) > _MOST_TRIANGLES:
            raise ValueRangeError(
                f"{path}: found {len(face.head.faces):,} triangles on the head, expected at most {_MOST_TRIANGLES:,}; "
                f"make it coarser: npx @gltf-transform/cli simplify {path} coarse.glb --ratio 0.1 --error 0.001"
            )
        found_after = time.perf_counter() - begin
        template = performer(texture=False)
        shut = eyes_shut_at_rest(face, template.neutral)
        template = with_shut_eyes(template, shut) if any(shut) else template
        registration = _registered(template, face, path, progress)
        given, bare = None, character
        if inner_mouth or eyes:
            progress("adding parts")
            given = added_parts(character, face, template, registration, (inner_mouth, eyes))
            if given.blocks:
                document = document_with_parts(character, given.blocks, encode_png(given.page))
                character = read_character(document)
                surface, face = textured(character), face.on(character)
        carried = shapes_on(
            template,
            face.head,
            face.landmarks,
            registration=registration,
            movable=face.movable,
            followed=given.followed_on(character, face) if given is not None and given.followed else None,
            progress=progress,
        )
        rig = _with_tongue(carried)
        if given is not None and given.blocks and present:
            moving = moving_parts(character, face, rig, present, given.blocks)
            document = document_with_parts(bare, moving, encode_png(given.page))
            character = read_character(document)
        made = tuple(name for name in missing if name in rig.names)
        job = CharacterJob(character, face, carried, rig, made, given, empty, shut)
        progress("writing the character")
        added = job.targets()
        root, data = (
            document_with_targets(document, added, made, empty) if added else (copy.deepcopy(document.root), b"")
        )
        rename_targets(root, spelled(present))
        expressions = add_expressions(document, root, job.binds(present, added))
        annotate_character(root, character, face.rows, annotations_on(rig, carried.template, carried.registration.pose))
        with all_or_none():
            write_edited(document, root, data, out)
            save_rendered_image(job.views(surface, present), figure)
    seconds = (found_after, time.perf_counter() - begin)
    names = {name: shape.names for name, shape in present.items()}
    notes = tuple(job.notes(present, expressions, seconds))
    median = float(carried.registration.record.median_distance)
    return CharacterReport(made, names, expressions, median, seconds, figure, notes)


def check_character(path: Path) -> None:
    """Raises ``FileFormatError`` for files that are no ``.glb`` or ``.vrm``, with the way to make one."""
    ending = path.suffix.lower()
    if path.is_dir():
        raise FileFormatError(f"{path}: found a folder, expected a character's .glb, .vrm or USD")
    if ending not in CHARACTER_ENDINGS:
        if ending not in _CONVERT:
            check_there(path)
        converted = _by_arkit(path) if ending in MESH_ENDINGS else "export it as .glb"
        # The output is named without the input's folder, which may be closed.
        names = {"quoted": quote(str(path)), "made": quote(f"{path.stem}.glb")}
        how = _CONVERT[ending].format(path=path, stem=path.stem, **names) if ending in _CONVERT else converted
        raise FileFormatError(
            f"{path}: found {ending!r}, expected a character's .glb, .vrm or USD ({how}), or --template for a scan"
        )


def _by_arkit(path: Path) -> str:
    """The command that gives a mesh ARKit's shapes, with the unit that its size says where it is not the format's."""
    unit = None
    with suppress(TorchfaceError):  # what is wrong with the mesh that command says
        unit = likely_unit(load_mesh(path).vertices, extent(performer(texture=False).vertices))
    words = f"torchface arkit {quote(str(path))}" + (f" --unit {unit}" if unit else "")
    return f"a head mesh alone gets ARKit's shapes by: {words} --out {quote(path.stem + '.glb')}"


def _copied(
    character: Character, present: dict[str, PresentShape], out: Path, begin: float, progress: Progress
) -> CharacterReport:
    """Writes a character that has all of ARKit's shapes: names, a VRM's expressions and landmarks alone are new."""
    document = character.document
    root = copy.deepcopy(document.root)
    rename_targets(root, spelled(present))
    expressions = add_expressions(document, root, {name: shape.binds for name, shape in present.items()})
    known = any(document.first_extras(key) is not None for key in ("landmarks", "rows"))
    found = [] if known else [_landmarks_added(root, character, present, progress)]
    write_edited(document, root, b"", out)
    notes = [*present_lines(present, ()), "nothing to make: the file was copied", *found]
    if expressions:
        notes.append(f"expressions added to the VRM: {len(expressions)}")
    names = {name: shape.names for name, shape in present.items()}
    seconds = time.perf_counter() - begin
    return CharacterReport((), names, expressions, 0.0, (0.0, seconds), None, tuple(notes))


def _landmarks_added(
    root: dict[str, Any], character: Character, present: dict[str, PresentShape], progress: Progress
) -> str:
    """Adds landmarks and regions to a character's file; a line for people to read."""
    template = performer(texture=False)
    try:
        face = find_character_face(character, textured(character), progress)
        registration = _registered(template, face, character.document.path, progress)
    except AlignmentError as error:
        return f"  note: no landmarks were added, which track --rig needs: {error}"
    deltas = torch.stack([present_motion(character, face, shape)[face.rows] for shape in present.values()])
    own = BlendshapeRig(face.head, deltas.float(), tuple(present))
    annotate_character(
        root, character, face.rows, annotations_on(own, on_face(template, registration), registration.pose)
    )
    return f"landmarks and regions added; template: {registration.record.figures('the head')}"


def _registered(template: BlendshapeRig, face: CharacterFace, path: Path, progress: Progress) -> Registration:
    """The template on the head; refused where its face does not come to lie on it."""
    registration = register(template.neutral, face.skin, face.landmarks, texture_size=0, progress=progress)
    region = template.neutral.regions["face"]
    met = float(registration.matched[region].double().mean())
    far = float(registration.distance[region].median())
    if not (met >= _LEAST_MET and far <= _FAR):
        raise AlignmentError(
            f"{path}: the template lies {far:.1f} mm from the face (median, at a head's size; expected at most "
            f"{_FAR:g}) and meets {met:.0%} of it (expected at least {_LEAST_MET:.0%}): is it a face?"
        )
    return registration


def _with_tongue(carried: CarriedShapes) -> BlendshapeRig:
    """The head's shapes, with ``tongueOut`` where the head has a tongue of its own."""
    rig = carried.rig
    if not bool(carried.tongue.any()):
        return rig
    lips = carried.registration.mesh.vertices[carried.registration.mesh.landmarks[48:68]]
    jaw = rig.deltas[rig.names.index(_JAW)] if _JAW in rig.names else None
    out = tongue_out(rig.vertices, carried.tongue, lips, jaw)
    return BlendshapeRig(rig.neutral, torch.cat([rig.deltas, out[None].to(rig.deltas)]), (*rig.names, _TONGUE))
