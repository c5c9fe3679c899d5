"""From a character's file to the same file with ARKit's shapes on its face."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.capture.mouth_close_conventions import mouth_close_of
from torchface.errors import AlignmentError, FileFormatError, ValueRangeError
from torchface.files.job_lock import file_lock
from torchface.files.whole_files import all_or_none, check_ending, check_there
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.gltf.character_annotations import annotate_character
from torchface.io.gltf.character_scene import Block, Character, read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.morph_insertion import AddedTargets, document_with_targets, rename_targets, write_edited
from torchface.io.gltf.part_insertion import document_with_parts
from torchface.io.images.image_files import IMAGE_ENDINGS, encode_png
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.vrm.vrm_expressions import VRM_ENDING, MorphBind, add_expressions
from torchface.landmarks.surfaces.face_on_surface import NoFaceOnSurfaceError
from torchface.modeling.rigging.annotated_heads import annotations_on, on_face
from torchface.modeling.rigging.carried_shapes import CarriedShapes
from torchface.modeling.rigging.eyelid_closure import BLINKS
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.modeling.rigging.mouth_parts import tongue_out
from torchface.modeling.rigging.other_topology import shapes_on
from torchface.progress import Progress, silent
from torchface.registration import Registration, register
from torchface.rendering.compositing import save_rendered_image, sheet
from torchface.rendering.textured_surface import TexturedSurface
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.viz.figures.character_views import SHOWN, character_sheet
from torchface.workflows.rig.added_parts import AddedParts, added_parts
from torchface.workflows.rig.character_face import CharacterFace, find_character_face, textured
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
FACE_SPAN = 260.0
"""Of each picture of the face, millimetres at a head's size."""

_STILL_MM = 2e-3  # at a head's size; what moves less does not move
# Millimetres of a head's size between face and template, and the share of the face that is met: 0.1 at most and 0.84 at
# least on 13 characters, 2.1 and 0.42 on a box under a ball.
_FAR, _LEAST_MET = 1.0, 0.6
_OF_SCANS = ("the scan has neither", "the scan's triangles", "landmarks disagree")
"""Notes of a registration that say nothing of a character."""
_COARSE, _WIDE = 1500, 500.0  # triangles of a skin, millimetres of a shape's motion: what is warned of
_OTHER_UNIT = 3.0  # times a head's size
_TONGUE, _JAW, _CLOSE = "tongueOut", "jawOpen", "mouthClose"
_MOST_TRIANGLES = 500_000  # of a head: its shapes take some 6 GB
_CONVERT = {
    ".fbx": "install Blender, blender.org, and let it write one with skeleton and shape keys: "
    'blender --background --python-expr "import bpy; bpy.ops.wm.read_factory_settings(use_empty=True); '
    "bpy.ops.import_scene.fbx(filepath='{path}'); bpy.ops.export_scene.gltf(filepath='{stem}.glb')\"",
    ".gltf": "pack it: npx @gltf-transform/cli copy {path} {stem}.glb",
    **dict.fromkeys(IMAGE_ENDINGS, "of photographs: torchface fit {path} --out {stem}.glb"),
}


@dataclass(frozen=True, eq=False)
class CharacterReport:
    """What was found on a character and made for it.

    Args:
        made: names of the shapes that were made.
        present: of ARKit's names those that the character has, and how it calls them.
        expressions: of a VRM, those that were added.
        median_mm: between face and template, at a head's size.
        seconds: that finding the face took, and all.
        figure: pictures of the face before and after; None where there was nothing to make.
    """

    made: tuple[str, ...]
    present: dict[str, tuple[str, ...]]
    expressions: tuple[str, ...]
    median_mm: float
    seconds: tuple[float, float]
    figure: Path | None
    notes: tuple[str, ...] = field(default=())

    def lines(self) -> list[str]:
        """For people to read."""
        return list(self.notes)


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
        path: a ``.glb`` or ``.vrm``.
        out: the file to write, of the same ending.
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
        job = _Job(character, face, carried, rig, made, given, empty, shut)
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
        bare = f"a mesh alone gets them by: torchface arkit {path} --out {path.with_suffix('.glb')}"
        converted = bare if ending in MESH_ENDINGS else "export it as .glb"
        how = _CONVERT.get(ending, converted).format(path=path, stem=path.with_suffix(""))
        raise FileFormatError(
            f"{path}: found {ending!r}, expected a character's .glb, .vrm or USD ({how}), or --template for a scan"
        )


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
    notes = [*present_lines(present), "nothing to make: the file was copied", *found]
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
    return f"landmarks and regions added; template: {registration.record.figures()}"


def _registered(template: BlendshapeRig, face: CharacterFace, path: Path, progress: Progress) -> Registration:
    """The template on the head; refused where its face does not come to lie on it."""
    registration = register(template.neutral, face.skin, face.landmarks, texture_size=0, progress=progress)
    region = template.neutral.annotations.regions["face"]  # type: ignore[union-attr]
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


@dataclass(frozen=True, eq=False)
class _Job:
    """A character, its face, and the shapes that were made for it."""

    character: Character
    face: CharacterFace
    carried: CarriedShapes
    rig: BlendshapeRig
    made: tuple[str, ...]
    parts: AddedParts | None
    empty: tuple[str, ...]
    shut: tuple[bool, bool]

    def targets(self) -> list[AddedTargets]:
        """The new morph targets of the meshes that move, in their own axes and unit."""
        if not self.made:
            return []
        deltas = self.rig.select(self.made).deltas.double()
        rest = self.face.head.vertices.double()
        turned = _normal_changes(rest, self.face.head.faces, deltas)
        added = []
        for number, block in enumerate(self.character.blocks):
            here = (self.character.block[self.face.rows] == number).nonzero()[:, 0]
            if not len(here) or not bool((deltas[:, here].norm(dim=-1) > _STILL_MM).any()):
                continue
            rows = self.face.rows[here]
            back = torch.linalg.inv(self.character.linear[rows])
            moved = self.face.found.pose.apply_vectors(deltas[:, here])
            own = torch.einsum("vij,nvj->nvi", back, moved)
            own[deltas[:, here].norm(dim=-1) <= _STILL_MM] = 0.0
            rotated = turned[:, here] @ self.face.found.pose.rotation[0].T.double()
            scale = torch.linalg.det(self.character.linear[rows]).abs().clamp(min=1e-30).pow(1 / 3)
            normals = torch.einsum("vji,nvj->nvi", self.character.linear[rows] / scale[:, None, None], rotated)
            shape = (len(self.made), block.rows.stop - block.rows.start, 3)
            positions, normal_rows = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
            at = (rows - block.rows.start).numpy()
            positions[:, at], normal_rows[:, at] = own.numpy(), normals.numpy()
            added.append(AddedTargets(block.mesh, block.primitives, positions, normal_rows))
        return added

    def binds(self, present: dict[str, PresentShape], added: list[AddedTargets]) -> dict[str, tuple[MorphBind, ...]]:
        """What each of ARKit's expressions of a VRM drives: shapes that were there, and new ones."""
        bound = {name: shape.binds for name, shape in present.items()}
        meshes = {one.mesh for one in added}
        blocks = {(block.node, block.mesh): block for block in self.character.blocks if block.mesh in meshes}
        for row, name in enumerate(self.made):
            bound[name] = tuple(MorphBind(node, mesh, self._row(block, row)) for (node, mesh), block in blocks.items())
        return {name: bound[name] for name in ARKIT if name in bound}

    def _row(self, block: Block, row: int) -> int:
        """The number that a made shape has among a block's targets: that of its name, else behind those there were."""
        name = self.made[row]
        before = sum(one not in block.names for one in self.made[:row])
        return block.names.index(name) if name in block.names else len(block.names) + before

    def views(self, surface: TexturedSurface, present: dict[str, PresentShape]) -> Tensor:
        """The face at rest and with shapes on, those that were there among them."""
        upright = surface.moved(self.face.found.pose.inverse())
        shapes = {}
        for name in {name for names in SHOWN.values() for name in names}:
            moved = torch.zeros_like(upright.vertices)
            if name in self.made:
                moved[self.face.rows] = self.rig.select([name]).deltas[0].double()
            elif name in present:
                moved = present_motion(self.character, self.face, present[name])
            shapes[name] = moved
        landmarks = self.face.found.pose.inverse().apply(self.face.found.points[17:68])[0]
        middle = landmarks[torch.isfinite(landmarks).all(-1)].mean(0)
        return character_sheet(upright, shapes, middle, FACE_SPAN)

    def notes(
        self, there: dict[str, PresentShape], expressions: tuple[str, ...], seconds: tuple[float, float]
    ) -> list[str]:
        """For people to read."""
        found, record, character = self.face.found, self.carried.registration.record, self.character
        where = f"bone {character.head_bone!r} and " if character.head is not None else ""
        lines = [
            f"face: found by {where}{len(found.views)} views in {seconds[0]:.1f} s; presence {found.presence:.2f}, "
            f"its points {found.misfit:.2f} distances of the eyes from a head's"
        ]
        if len(found.others):
            lines.append(
                f"  note: {1 + len(found.others)} faces were seen; the one at {_place(found.middle)} was taken"
            )
            lines.append(f"    the others are at {', '.join(map(_place, found.others))}, in the file's unit")
        size = 1000 * float(found.pose.scale[0])
        if not 1 / _OTHER_UNIT < size < _OTHER_UNIT:
            lines.append(
                f"  note: {size:.3g} times a head's size, as other programs take it: a .glb's numbers are metres"
            )
        if (count := len(self.face.skin.faces)) < _COARSE:
            lines.append(f"  warning: its skin has {count:,} triangles, expected {_COARSE:,} for lids and lips to shut")
        lines.append(f"template: {record.figures()}")
        lines += [f"  note: {note}" for note in record.notes if not note.startswith(_OF_SCANS)]
        lines += [f"parts: {note}" for note in (() if self.parts is None else self.parts.notes)]
        if any(name in self.made for name in (*BLINKS, _JAW)):
            cut = self.parts is not None and self.parts.lips_cut
            lines += [f"  {note}" for note in self.carried.notes(lips_cut=cut, shut=self.shut)]
        lines += present_lines(there)
        lines += self._doubts(there)
        missing = [name for name in ARKIT if name not in self.made and name not in there]
        why = " (it has no tongue of its own; --inner-mouth gives it one)" if missing == [_TONGUE] else ""
        lines.append(f"made: {len(self.made)} shapes" + (f"; not made: {', '.join(missing)}{why}" if missing else ""))
        if self.empty:
            lines.append(f"  note: {', '.join(self.empty)}: the file's own moves nothing and counts as missing")
        if expressions:
            lines.append(f"expressions added to the VRM: {len(expressions)}")
        return [*lines, f"in all {seconds[1]:.1f} s"]

    def _doubts(self, there: dict[str, PresentShape]) -> list[str]:
        """Which of the character's own shapes move nothing, and whether its ``mouthClose`` opens the jaw itself."""
        motion = {name: present_motion(self.character, self.face, shape) for name, shape in there.items()}
        still = [name for name, moved in motion.items() if not bool((moved.norm(dim=-1) > _STILL_MM).any())]
        lines = [f"  note: {', '.join(still)}: there, but nothing moves by it"] if still else []
        far = {name: float(moved.norm(dim=-1).max()) for name, moved in motion.items()}
        lines += [
            f"  warning: its {name} moves by {size:.3g} mm at a head's size"
            for name, size in far.items()
            if size > _WIDE
        ]
        if _JAW in motion and _CLOSE in motion and not {_JAW, _CLOSE} & set(still):
            deltas = torch.stack([motion[_JAW], motion[_CLOSE]]).float()
            own = BlendshapeRig.from_tensors(self.face.vertices.float(), self.character.faces, deltas, (_JAW, _CLOSE))
            try:
                convention = mouth_close_of(own)
            except ValueRangeError as error:
                return [*lines, f"  note: {error}"]
            if convention is not None and convention.opens_jaw:
                lines.append(
                    f"  note: its {_CLOSE} opens the jaw itself, as Audio2Face's does; ARKit's leaves that to {_JAW}"
                )
        return lines


def _normal_changes(rest: Tensor, faces: Tensor, deltas: Tensor) -> Tensor:
    """How each vertex's normal changes in shapes (N,V,3), those in one place as one."""
    joined = joined_vertices(rest, faces)
    before = vertex_normals(joined.vertices, joined.faces)
    kept = torch.zeros(len(joined.vertices), dtype=torch.int64)
    kept[joined.of] = torch.arange(len(joined.of))
    changes = torch.stack([vertex_normals(joined.vertices + one[kept], joined.faces) - before for one in deltas])
    return changes[:, joined.of]


def _place(point: Tensor) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point.tolist()) + ")"
