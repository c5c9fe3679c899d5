"""What is written into a character's file, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.capture.mouth_close_conventions import mouth_close_of
from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.gltf.character_scene import Block, Character
from torchface.io.gltf.morph_insertion import AddedTargets
from torchface.io.vrm.vrm_expressions import MorphBind
from torchface.landmarks.surfaces.face_on_surface import MISFIT
from torchface.modeling.rigging.carried_shapes import CarriedShapes
from torchface.modeling.rigging.eyelid_closure import BLINKS
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.rendering.textured_surface import TexturedSurface
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.viz.figures.character_views import SHOWN, character_sheet
from torchface.workflows.rig.added_parts import AddedParts
from torchface.workflows.rig.character_face import CharacterFace
from torchface.workflows.rig.present_shapes import PresentShape, present_lines, present_motion

FACE_SPAN = 260.0
"""Of each picture of the face, millimetres at a head's size."""

_STILL_MM = 2e-3  # at a head's size; what moves less does not move
_OF_SCANS = ("the scan has neither", "the scan's triangles", "landmarks disagree")
"""Notes of a registration that say nothing of a character."""
_COARSE, _WIDE = 1500, 500.0  # triangles of a skin, millimetres of a shape's motion: what is warned of
_OTHER_UNIT = 3.0  # times a head's size
_TONGUE, _JAW, _CLOSE = "tongueOut", "jawOpen", "mouthClose"


@dataclass(frozen=True, eq=False)
class CharacterJob:
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
            f"its landmarks lie {found.misfit:.0%} of the eyes' distance from a head's "
            f"(at most {MISFIT:.0%} is taken for a face)"
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
        lines.append(f"template: {record.figures('the head')}")
        remarks = (remark for remark in record.remarks if not remark.removeprefix("note: ").startswith(_OF_SCANS))
        lines += [f"  {_of_the_head(remark)}" for remark in remarks]
        lines += [f"parts: {note}" for note in (() if self.parts is None else self.parts.notes)]
        if any(name in self.made for name in (*BLINKS, _JAW)):
            cut = self.parts is not None and self.parts.lips_cut
            lines += [f"  {note}" for note in self.carried.notes(lips_cut=cut, shut=self.shut)]
        lines += present_lines(there, self.empty)
        lines += self._doubts(there)
        missing = [name for name in ARKIT if name not in self.made and name not in there]
        tongue = " (it has no tongue of its own; --inner-mouth gives one to a mouth without teeth)"
        why = tongue if missing == [_TONGUE] else ""
        lines.append(f"made: {len(self.made)} shapes" + (f"; not made: {', '.join(missing)}{why}" if missing else ""))
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


def _of_the_head(note: str) -> str:
    """A note of a registration, in which the scan is a character's head: small parts of it still move."""
    return note.replace("the scan", "the head").replace("were left out", "were left out of the fit alone")


def _place(point: Tensor) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point.tolist()) + ")"
