"""ARKit's 52 shapes on the topology of any head model or rig."""

from dataclasses import dataclass, replace
from pathlib import Path
from shlex import join

import torch
from torch import Tensor

from torchface.errors import AlignmentError, FileFormatError, NoShapesError, ValueRangeError
from torchface.geometry.meshes.unit_check import LEAST_OF_A_HEAD, check_unit, extent
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.io import HeadModelFile, load_head_model_file, load_mesh, load_rig
from torchface.io.blender import BLENDER_ENDINGS
from torchface.io.head_models.head_model_files import HEAD_MODEL_ENDINGS, is_head_model_file
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.mesh import Mesh, submesh
from torchface.modeling import CarriedShapes, HeadModel, head_model_of, shapes_on
from torchface.modeling.rigging.annotated_heads import annotations_on, on_face
from torchface.modeling.rigging.eyelid_closure import BLINKS
from torchface.modeling.rigging.mouth_parts import tongue_out
from torchface.progress import Progress, silent
from torchface.registration import Registration, load_scan_landmarks, register
from torchface.registration.scan_preparation import Landmarks
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, recognised_shapes
from torchface.synthetic import performer
from torchface.workflows.arkit.seen_landmarks import seen_landmarks

TONGUE = "tongueOut"
_HEAD, _BODY = 330.0, 600.0
"""Millimetres: of a mesh taller than the second the uppermost first are the head."""
_MEDIAN_LIMIT, _STRETCH_LIMIT = 3.0, 1.0
_LEAST_TRIANGLES = 50
_EXTENTS, _SIZES = (LEAST_OF_A_HEAD, 8.0), (0.5, 2.0)
"""A source's extent in the template's, and its head's size, in which its unit is not doubted."""
_GIVE = "give the face's landmarks (--landmarks FILE, from torchface pick)"


@dataclass(frozen=True, eq=False)
class Source:
    """What is given ARKit's shapes."""

    path: Path  # of the file or folder
    neutral: Mesh  # its head at rest
    rig: BlendshapeRig | None = None  # its own shapes; None where it has none that are kept
    model: HeadModelFile | None = None  # the head model that it is; None of a rig or a mesh
    unit: str | None = None  # that the file was read in, where it was said


@dataclass(frozen=True, eq=False)
class ArkitRig:
    """A head with ARKit's shapes, and how it came to them."""

    rig: BlendshapeRig
    kept: tuple[str, ...]  # names that the source had itself
    made: tuple[str, ...]  # names that were made
    others: tuple[str, ...]  # the source's shapes that ARKit has not
    carried: CarriedShapes | None  # how they were made, the head brought to the template's size; None where nothing was
    notes: tuple[str, ...] = ()  # lines for people to read
    pose: Similarity | None = None  # that takes the template to the head, where it was registered

    def lines(self) -> list[str]:
        """For people to read."""
        have = [name for name in self.rig.names if name in ARKIT]
        lines = [f"{len(have)} of ARKit's 52 shapes on {len(self.rig.vertices):,} vertices: {len(self.made)} made"]
        lines[0] += f", {len(self.kept)} of its own kept" if self.kept else ""
        if self.others:
            lines.append(f"its other shapes follow: {len(self.others)}")
        if self.carried is not None:
            record = self.carried.registration.record
            lines.append(f"registered by {record.start}; {record.figures('the head')}")
        return [*lines, *self.notes]


def load_source(path: Path, unit: str | None = None) -> Source:
    """A head model of others, a rig, or a mesh without shapes."""
    if is_head_model_file(path):
        model = load_head_model_file(path)
        return Source(path, model.neutral, None, model)
    if path.is_file() and path.suffix.lower() in MESH_ENDINGS:
        return Source(path, load_mesh(path, unit), unit=unit)
    if path.is_file() and path.suffix.lower() not in SCENE_ENDINGS:
        known = ", ".join((*SCENE_ENDINGS, *MESH_ENDINGS, *HEAD_MODEL_ENDINGS))
        how = path.suffix.lower() in BLENDER_ENDINGS
        words = join(["torchface", "convert", str(path), str(path.with_suffix(".glb"))])
        convert = f" ({words} reads it with Blender)" if how else ""
        raise FileFormatError(f"{path}: found {path.suffix!r}{convert}, expected {known}, or a folder of OBJ files")
    try:
        rig = load_rig(path, unit)
    except NoShapesError:
        return Source(path, load_mesh(path, unit), unit=unit)
    return Source(path, rig.neutral, rig, unit=unit)


def make_arkit(
    source: Source,
    template: Path | None = None,
    landmarks: Path | None = None,
    everything: bool = False,
    progress: Progress | None = None,
) -> ArkitRig:
    """Gives a source those of ARKit's 52 shapes that it lacks, or all, on its own vertices.

    They are those of a template, else the embedded performer. Landmarks are given, else the source's own, else found by
    its shape.
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
    carried, notes, neutral, pose = None, [], source.neutral, None
    if wanted:
        given = _template(template)
        given = given.select([n for n in given.names if n in ARKIT])
        head = _sized(source, given.neutral, landmarks, progress)
        registration = _registered(source, given.neutral, head, progress)
        carried = shapes_on(given, head.whole, registration=registration, progress=progress)
        pose = head.back(registration.pose)
        sized = replace(head.whole, annotations=annotations_on(carried.rig, carried.template, registration.pose))
        neutral = replace(source.neutral, annotations=sized.annotations)
        made = {name: carried.rig.deltas[row] for row, name in enumerate(carried.rig.names) if name in wanted}
        if TONGUE in wanted and TONGUE not in made:
            made |= _tongue(sized, carried)
        shapes = {name: delta * head.size for name, delta in made.items()} | shapes
        notes += head.notes()
        notes += carried.notes() if {*BLINKS, "jawOpen"} & set(made) else []
        if missing := [name for name in wanted if name not in made]:
            notes.append(
                f"left out: {', '.join(missing)}" + (": the head has no tongue of its own" if TONGUE in missing else "")
            )
    elif not is_annotated(neutral):
        neutral, notes, pose = _only_annotated(source, shapes, template, landmarks, progress)
    order = [name for name in (*ARKIT, *others) if name in shapes]
    deltas = torch.stack([shapes[name].to(neutral.vertices) for name in order])
    rig = BlendshapeRig(neutral, deltas, order)
    return ArkitRig(rig, kept, tuple(n for n in order if n in wanted), others, carried, tuple(notes), pose)


def _template(path: Path | None) -> BlendshapeRig:
    if path is None:
        return performer(texture=False)
    rig = load_rig(path).with_arkit_names()
    if not any(name in ARKIT for name in rig.names):
        raise ValueRangeError(f"{path}: found no shape of ARKit's names, expected a template with some of the 52")
    return rig


@dataclass(frozen=True, eq=False)
class _SizedHead:
    """A source at the template's size."""

    whole: Mesh
    scan: Mesh  # what the template is registered to
    size: float
    landmarks: Landmarks | None  # template vertices and where they lie on it

    def back(self, pose: Similarity) -> Similarity:
        """A pose on it as one on the source."""
        return Similarity(pose.scale * self.size, pose.rotation, pose.translation * self.size)

    def notes(self) -> list[str]:
        """For people to read."""
        if _SIZES[0] < self.size < _SIZES[1]:
            return []
        return [f"note: the head has {self.size:.3g} times the template's size: is its unit right (--unit)?"]


def _sized(source: Source, template: Mesh, path: Path | None, progress: Progress) -> _SizedHead:
    """The source at the template's size, by its landmarks or by the face that is seen on it."""
    mesh, beside = source.neutral, extent(template.vertices[template.faces.flatten()])
    if len(mesh.faces) < _LEAST_TRIANGLES:
        raise AlignmentError(
            f"{source.path}: found {len(mesh.faces)} triangles, expected a head of at least {_LEAST_TRIANGLES}"
        )
    points = mesh.vertices[mesh.faces.flatten()]
    if source.path.suffix.lower() in MESH_ENDINGS:  # which do not hold a unit
        most = _EXTENTS[1] if source.unit is not None else torch.inf
        check_unit(str(source.path), points, beside, "a template", _EXTENTS[0], most)
    marks = _landmarks(source, template, path)
    if marks is None and template.annotations is not None:
        marks = seen_landmarks(mesh, template, progress)
        if marks is None:
            try:
                check_unit(str(source.path), points, beside, "a template", *_EXTENTS)
            except ValueRangeError as error:
                raise AlignmentError(
                    f"{error}; no face is seen in pictures of it, by which its size would be known"
                ) from error
    if marks is None:
        return _SizedHead(mesh, head_of(mesh), 1.0, None)
    ids, places = marks[0].cpu(), marks[1].double().cpu()
    known = torch.isfinite(places).all(-1)
    own = template.vertices.double().cpu()
    if int(known.sum()) < 3:
        return _SizedHead(mesh, head_of(mesh), 1.0, marks)
    pose = similarity_transform(own[ids[known]][None], places[known][None])
    size = float(pose.scale[0])
    whole = mesh.with_vertices((mesh.vertices.double() / size).to(mesh.vertices))
    upright = pose.inverse().apply(mesh.vertices.double().cpu())[0]
    scan = whole
    if float(upright[:, 1].max() - upright[:, 1].min()) > _BODY:
        scan = submesh(whole, upright[:, 1] > own[:, 1].max() - _HEAD).mesh
    return _SizedHead(whole, scan, size, (ids, places / size))


def _registered(source: Source, template: Mesh, head: _SizedHead, progress: Progress) -> Registration:
    try:
        registration = register(template, head.scan, head.landmarks, texture_size=0, progress=progress)
    except AlignmentError as error:
        found = str(error).removesuffix("; give landmarks")
        unseen = "; no face is seen in pictures of it either" if head.landmarks is None else ""
        raise AlignmentError(f"{source.path}: {found}{unseen}; {_GIVE}") from error
    record = registration.record
    if not (record.median_distance < _MEDIAN_LIMIT and record.stretch < _STRETCH_LIMIT):
        raise AlignmentError(
            f"{source.path}: found a head {record.median_distance:.1f} mm from the registered template (median), whose "
            f"edges are stretched by {record.stretch:.0%}, expected less than {_MEDIAN_LIMIT:g} mm and "
            f"{_STRETCH_LIMIT:.0%}; {_GIVE}"
        )
    return registration


def is_annotated(mesh: Mesh) -> bool:
    """Whether a head has the 68 landmarks, and regions."""
    notes = mesh.annotations
    return notes is not None and notes.landmarks is not None and len(notes.landmarks) == 68 and bool(notes.regions)


def _only_annotated(
    source: Source, shapes: dict[str, Tensor], path: Path | None, landmarks: Path | None, progress: Progress
) -> tuple[Mesh, list[str], Similarity | None]:
    """A head that has all shapes with landmarks and regions; where none are found, as it is, and a note."""
    template = _template(path)
    try:
        head = _sized(source, template.neutral, landmarks, progress)
        registration = _registered(source, template.neutral, head, progress)
    except (AlignmentError, ValueRangeError) as error:
        return source.neutral, [f"note: the rig has no landmarks and regions, which `track --rig` needs: {error}"], None
    own = BlendshapeRig(head.whole, torch.stack(list(shapes.values())) / head.size, tuple(shapes))
    notes = annotations_on(own, on_face(template, registration), registration.pose)
    lines = [
        f"landmarks and regions: registered by {registration.record.start}; {registration.record.figures('the head')}",
        *head.notes(),
    ]
    return replace(source.neutral, annotations=notes), lines, head.back(registration.pose)


def head_of(mesh: Mesh) -> Mesh:
    """The head of a mesh that has a whole body; the mesh itself else."""
    height = mesh.vertices[:, 1]
    if float(height.max() - height.min()) < _BODY:
        return mesh
    head = submesh(mesh, height > height.max() - _HEAD).mesh
    return head if len(head.faces) >= _LEAST_TRIANGLES else mesh


def _landmarks(source: Source, template: Mesh, path: Path | None) -> tuple[Tensor, Tensor] | None:
    """Template vertices and where they lie on the source: from a file, the model's places, or the same 68 vertices."""
    if path is not None:
        return load_scan_landmarks(path, template, source.path, source.unit)
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


def _tongue(neutral: Mesh, carried: CarriedShapes) -> dict[str, Tensor]:
    notes = neutral.annotations
    mask = carried.tongue
    if notes is not None and not mask.any():
        mask = next((region.double() for name, region in notes.regions.items() if name.lower() == "tongue"), mask)
    if not mask.any() or notes is None or notes.landmarks is None or len(notes.landmarks) != 68:
        return {}
    pose = carried.registration.pose
    upright = pose.inverse().apply(neutral.vertices.double())[0]
    jaw = carried.rig.names.index("jawOpen") if "jawOpen" in carried.rig.names else None
    opening = None if jaw is None else pose.inverse().apply_vectors(carried.rig.deltas[jaw][None].double())[0]
    delta = tongue_out(upright, mask, upright[notes.landmarks[48:]], opening)
    return {TONGUE: pose.apply_vectors(delta[None])[0]}


def published_head(path: Path, components: int | None = None, progress: Progress | None = None) -> HeadModel:
    """A head model of others with ARKit's shapes as its rig and some or all components of its shape, ready for use."""
    model = load_head_model_file(path)
    made = make_arkit(Source(path, model.neutral, None, model), progress=progress)
    return head_model_of(model, made.rig, components)
