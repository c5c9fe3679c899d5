"""ARKit's 52 shapes on the topology of any head model or rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import AlignmentError, NoShapesError, ValueRangeError
from torchface.io import load_mesh, load_rig
from torchface.io.head_models.head_model_file import HeadModelFile
from torchface.io.head_models.head_model_files import is_head_model_file, load_head_model_file
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.mesh import Annotations, Mesh, submesh
from torchface.modeling import HeadModel
from torchface.modeling.morphable.published_models import head_model_of
from torchface.modeling.rigging.loose_parts import tongue_out
from torchface.modeling.rigging.other_topology import CarriedShapes, shapes_on
from torchface.progress import Progress, silent
from torchface.registration import register
from torchface.registration.landmark_files import load_scan_landmarks
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, recognised_shapes
from torchface.synthetic import performer
from torchface.workflows.arkit.seen_landmarks import seen_landmarks

TONGUE = "tongueOut"
_HEAD, _BODY = 330.0, 600.0
"""Millimetres: of a mesh taller than the second the uppermost first are the head."""
_MEDIAN_LIMIT, _STRETCH_LIMIT = 3.0, 1.0
_BESIDE = 4.0


@dataclass(frozen=True, eq=False)
class Source:
    """What is given ARKit's shapes.

    Args:
        path: of the file or folder.
        neutral: its head at rest.
        rig: its own shapes; None where it has none that are kept.
        model: the head model that it is; None of a rig or a mesh.
    """

    path: Path
    neutral: Mesh
    rig: BlendshapeRig | None = None
    model: HeadModelFile | None = None


@dataclass(frozen=True, eq=False)
class ArkitRig:
    """A head with ARKit's shapes, and how it came to them.

    Args:
        rig: on the source's own vertices.
        kept: names that the source had itself.
        made: names that were made.
        others: the source's shapes that ARKit has not.
        carried: how they were made; None where nothing was.
        notes: lines for people to read.
    """

    rig: BlendshapeRig
    kept: tuple[str, ...]
    made: tuple[str, ...]
    others: tuple[str, ...]
    carried: CarriedShapes | None
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """For people to read."""
        have = [name for name in self.rig.names if name in ARKIT]
        lines = [f"{len(have)} of ARKit's 52 shapes on {len(self.rig.vertices):,} vertices: {len(self.made)} made"]
        lines[0] += f", {len(self.kept)} of its own kept" if self.kept else ""
        if self.others:
            lines.append(f"its other shapes follow: {len(self.others)}")
        if self.carried is not None:
            record = self.carried.registration.record
            lines.append(f"registered by {record.start}; {record.figures()}")
        return [*lines, *self.notes]


def load_source(path: Path, unit: str | None = None) -> Source:
    """A head model of others, a rig, or a mesh without shapes.

    Raises:
        FileFormatError: it is none of these.
    """
    if is_head_model_file(path):
        model = load_head_model_file(path)
        return Source(path, model.neutral, None, model)
    if path.is_file() and path.suffix.lower() in MESH_ENDINGS:
        return Source(path, load_mesh(path, unit))
    try:
        rig = load_rig(path, unit)
    except NoShapesError:
        return Source(path, load_mesh(path, unit))
    return Source(path, rig.neutral, rig)


def make_arkit(
    source: Source,
    template: Path | None = None,
    landmarks: Path | None = None,
    everything: bool = False,
    progress: Progress | None = None,
) -> ArkitRig:
    """Gives a source those of ARKit's 52 shapes that it lacks, on its own vertices.

    Args:
        source: see :func:`load_source`.
        template: a rig with ARKit's shapes; the embedded performer if absent.
        landmarks: of the source, see ``load_scan_landmarks``; its own if absent, else found by its shape.
        everything: make all of them, also those that it has.
        progress: called with each step and how far it is.

    Raises:
        AlignmentError: the template does not come to lie on the source.
        ValueRangeError: the template has none of ARKit's shapes.
    """
    progress = progress or silent
    rig = None if source.rig is None else source.rig.linear("torchface arkit")
    own = {} if rig is None else recognised_shapes(rig.names)
    kept = () if everything else tuple(own)
    used = {row for shape in own.values() for row in shape.rows}
    wanted = [name for name in ARKIT if name not in kept]
    shapes: dict[str, Tensor] = {}
    others: tuple[str, ...] = ()
    if rig is not None:
        shapes = {name: rig.deltas[list(own[name].rows)].sum(0) for name in kept}
        left = {name: rig.deltas[row] for row, name in enumerate(rig.names) if row not in used}
        others = tuple(left)
        shapes |= left
    carried, notes, neutral = None, [], source.neutral
    if wanted:
        given = _template(template)
        carried = _carried(source, given.select([n for n in given.names if n in ARKIT]), landmarks, progress)
        neutral = annotated(source.neutral, carried)
        made = {name: carried.rig.deltas[row] for row, name in enumerate(carried.rig.names) if name in wanted}
        if TONGUE in wanted and TONGUE not in made:
            made |= _tongue(neutral, carried)
        shapes = made | shapes
        if missing := [name for name in wanted if name not in made]:
            notes.append(
                f"left out: {', '.join(missing)}" + (": the head has no tongue of its own" if TONGUE in missing else "")
            )
    order = [name for name in (*ARKIT, *others) if name in shapes]
    deltas = torch.stack([shapes[name].to(neutral.vertices) for name in order])
    rig = BlendshapeRig(neutral, deltas, order)
    return ArkitRig(rig, kept, tuple(n for n in order if n in wanted), others, carried, tuple(notes))


def _template(path: Path | None) -> BlendshapeRig:
    if path is None:
        return performer(texture=False)
    rig = load_rig(path).with_arkit_names()
    if not any(name in ARKIT for name in rig.names):
        raise ValueRangeError(f"{path}: found no shape of ARKit's names, expected a template with some of the 52")
    return rig


def _carried(source: Source, template: BlendshapeRig, landmarks: Path | None, progress: Progress) -> CarriedShapes:
    scan = head_of(source.neutral)
    marks = _landmarks(source, template.neutral, landmarks)
    if marks is None and template.neutral.annotations is not None:
        marks = seen_landmarks(scan, template.neutral, progress)
    try:
        registration = register(template.neutral, scan, marks, texture_size=0, progress=progress)
    except AlignmentError as error:
        raise AlignmentError(
            f"{source.path}: {error}; give the face's landmarks (--landmarks FILE, from torchface pick)"
        ) from error
    record = registration.record
    if not (record.median_distance < _MEDIAN_LIMIT and record.stretch < _STRETCH_LIMIT):
        raise AlignmentError(
            f"{source.path}: found a head {record.median_distance:.1f} mm from the registered template (median), whose "
            f"edges are stretched by {record.stretch:.0%}, expected less than {_MEDIAN_LIMIT:g} mm and "
            f"{_STRETCH_LIMIT:.0%}; give the face's landmarks (--landmarks FILE, from torchface pick)"
        )
    return shapes_on(template, source.neutral, registration=registration, progress=progress)


def head_of(mesh: Mesh) -> Mesh:
    """The head of a mesh that has a whole body; the mesh itself else."""
    height = mesh.vertices[:, 1]
    if float(height.max() - height.min()) < _BODY:
        return mesh
    return submesh(mesh, height > height.max() - _HEAD).mesh


def _landmarks(source: Source, template: Mesh, path: Path | None) -> tuple[Tensor, Tensor] | None:
    """Template vertices and where they lie on the source: from a file, the model's places, or the same 68 vertices."""
    if path is not None:
        return load_scan_landmarks(path, template, source.path)
    ids = None if template.annotations is None else template.annotations.landmarks
    if ids is None or len(ids) != 68:
        return None
    if source.model is not None and source.model.landmarks is not None:
        places = source.model.landmarks
        return ids[places.rows], places.on(source.neutral.vertices).double()
    notes = source.neutral.annotations
    if notes is not None and notes.landmarks is not None and len(notes.landmarks) == 68:
        return ids, source.neutral.vertices[notes.landmarks].double()
    return None


def annotated(neutral: Mesh, carried: CarriedShapes) -> Mesh:
    """A head with the template's landmarks and regions where it has none of its own, so that other commands know it."""
    own = neutral.annotations or Annotations()
    template = carried.template.neutral.annotations
    if template is None or not carried.places.any():
        return neutral
    on_head = carried.registration.mesh.vertices.double()
    landmarks, regions = own.landmarks, dict(own.regions)
    vertices = neutral.vertices.double().cpu()
    if (landmarks is None or len(landmarks) != 68) and template.landmarks is not None:
        landmarks = torch.from_numpy(cKDTree(vertices).query(on_head[template.landmarks])[1])
    distance, nearest = cKDTree(on_head).query(vertices)
    scale = float(carried.registration.pose.scale[0])
    near = torch.from_numpy(distance) < _BESIDE * scale
    for name, mask in template.regions.items():
        if name not in regions:
            regions[name] = mask.cpu()[torch.from_numpy(nearest)] & near
    return replace(neutral, annotations=Annotations(landmarks, regions, own.mirror, own.contacts))


def _tongue(neutral: Mesh, carried: CarriedShapes) -> dict[str, Tensor]:
    notes = neutral.annotations
    mask = carried.tongue
    if notes is not None and not mask.any():
        mask = next((region for name, region in notes.regions.items() if name.lower() == "tongue"), mask)
    if not mask.any() or notes is None or notes.landmarks is None or len(notes.landmarks) != 68:
        return {}
    pose = carried.registration.pose
    upright = pose.inverse().apply(neutral.vertices.double())[0]
    delta = tongue_out(upright, mask, upright[notes.landmarks[48:]])
    return {TONGUE: pose.apply_vectors(delta[None])[0]}


def published_head(path: Path, components: int | None = None, progress: Progress | None = None) -> HeadModel:
    """A head model of others with ARKit's shapes as its rig, ready for `fit`, `track`, `register` and `rig`.

    Args:
        path: see ``load_head_model_file``.
        components: of its shape, of the largest deviations; all if absent.
        progress: called with each step and how far it is.

    Raises:
        FileFormatError: no head model.
        AlignmentError: the template does not come to lie on it.
    """
    model = load_head_model_file(path)
    made = make_arkit(Source(path, model.neutral, None, model), progress=progress)
    return head_model_of(model, made.rig, components)
