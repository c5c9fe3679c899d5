"""Samples for head models: meshes gathered on disk, aligned with each other, freed from colour casts."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchface import Mesh, load_mesh
from torchface.errors import FileFormatError, TopologyError
from torchface.files.content_keys import content_key
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.meshes.vertex_order import KEEP_ORDER
from torchface.geometry.sample_batches import Samples, blocks
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.io import MeshSequence, MeshSequenceWriter
from torchface.io.meshes.named_files import named_files
from torchface.mesh import other_topology
from torchface.progress import Progress
from torchface.registration.own_topology import check_own_topology
from torchface.rendering.clay_shading import sample_texture
from torchface.synthetic import draw_identities, neutral_head
from torchface.workflows.batch.batch_items import find_items
from torchface.workflows.register.register_scans import SCANS

from .generalised_procrustes import aligned, generalised_procrustes
from .rendered_people.complexion import complexion_colors, draw_complexions
from .sample_views import MovedSamples, SampleRange

_METHOD = "gathered heads/4"
_LEAST_EXTENT, _MOST_EXTENT = 0.4, 2.5  # of a head beside the template, of one topology
# Root mean square to the nearest other head, millimetres, and in medians of all heads': people's are up to 2.7 medians,
# that of a head made larger by a quarter is 4.9 to 6.6.
_FAR, _FAR_SHARE = 10.0, 4.0
_COMPARED = 1000  # vertices
_FACE, _LEAST_FACE, _MOST_FACE = 250.0, 0.4, 4.0  # millimetres across, and how much less or more a template shows


def check_triangles(source: Mesh, target: Mesh, name: str, owner: str = "the template") -> None:
    """Refuses a target of other triangles than the source's."""
    counts = [(len(mesh.vertices), len(mesh.faces)) for mesh in (target, source)]
    if counts[0] != counts[1]:
        found, expected = ("{} vertices and {} triangles".format(*count) for count in counts)
        raise TopologyError(f"{name}: found {found}, expected those of {owner}, {expected}")
    if target.fingerprint() != source.fingerprint():
        raise TopologyError(f"{name}: found {other_topology(target.fingerprint(), source, owner)}; {KEEP_ORDER}")


@dataclass(frozen=True, eq=False)
class Source:
    """Meshes that are read one by one."""

    names: list[str]
    read: Callable[[int], Mesh]  # gives the mesh of a number
    key: str  # changes when anything about them does


@dataclass(frozen=True, eq=False)
class Gathered:
    """Meshes of one topology on disk: positions, colours where all have some, and what they share."""

    names: list[str]
    template: Mesh
    shapes: MeshSequence
    colors: MeshSequence | None
    held_out: int


def performers(count: int, seed: int) -> Source:
    """Embedded performers, heads and complexions drawn by seed."""
    generator = torch.Generator().manual_seed(seed)
    identities, complexions = draw_identities(count, generator), draw_complexions(count, generator)

    def read(number: int) -> Mesh:
        mesh = neutral_head(identities[number], texture=False)
        return replace(mesh, colors=complexion_colors(complexions[number : number + 1])[0])

    return Source([f"performer {i}" for i in range(count)], read, content_key(_METHOD, performers=count, seed=seed))


def registered(folder: Path, unit: str | None = None) -> Source:
    """The meshes of a folder, by name; ``unit`` as ``load_mesh`` takes it."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise FileFormatError(f"{folder}: found {found}, expected a folder of registered meshes")
    if (folder / "vertex_indices.json").is_file():
        raise FileFormatError(
            f"{folder}: found ICT-FaceKit's FaceXModel, whose meshes are in centimetres and show expressions too; "
            f"expected registered heads at rest (take it by --ict {folder})"
        )
    paths = [item.path for item in find_items([folder], SCANS).items]
    files = {file.name: file for path in paths for file in (path, *named_files(path))}
    key = content_key(_METHOD, names=[path.name for path in paths], files=files, unit=unit)
    return Source([path.name for path in paths], lambda number: vertex_colored(load_mesh(paths[number], unit)), key)


def gather(source: Source, held_out: int, work: Path, template: Mesh | None, progress: Progress) -> Gathered:
    """Writes all meshes, the last kept for the test, into two files; where an earlier run has stopped, it goes on.

    The template says where the heads are to stand; the first mesh, upright, if absent.
    """
    first = source.read(0)
    name = source.names[0] if template is None else "template"
    template = upright(first) if template is None else template
    check_unit(name, template.vertices[template.faces.flatten()], _FACE, "a face", _LEAST_FACE, _MOST_FACE)
    size_of_template = extent(template.vertices[template.faces.flatten()])
    colored, size = first.colors is not None, len(template.vertices)
    files = (work / "shapes.safetensors", work / "colors.safetensors")
    count = len(source.names)
    shape, color = (_kept(path, source.key, count) for path in files)
    if shape is not None and (color is not None or not colored):
        return Gathered(source.names, template, shape, color, held_out)
    shapes, colors = (MeshSequenceWriter(path, count, size, template.faces, key=source.key) for path in files)
    with shapes, colors:
        for number in range(min(shapes.done, colors.done) if colored else shapes.done, count):
            mesh = first if number == 0 else source.read(number)
            check_triangles(template, mesh, source.names[number], name)
            used = mesh.vertices[mesh.faces.flatten()]
            check_unit(source.names[number], used, size_of_template, "a template", _LEAST_EXTENT, _MOST_EXTENT)
            check_own_topology(template, mesh, source.names[number], name)
            if colored and mesh.colors is None:
                progress(f"{source.names[number]} has no colours: the model will have none")
                colored = False
            if shapes.done == number:
                shapes.append(mesh.vertices)
            if colored and mesh.colors is not None and colors.done == number:
                colors.append(mesh.colors)
            progress("reading heads", number + 1, count)
    return Gathered(
        source.names, template, MeshSequence(files[0]), MeshSequence(files[1]) if colored else None, held_out
    )


def _kept(path: Path, key: str, count: int) -> MeshSequence | None:
    """What an earlier run has gathered of the same meshes; None where it has not, or it is damaged."""
    if not path.is_file():
        return None
    try:
        sequence = MeshSequence(path)
        if sequence.key != key or len(sequence) != count:
            return None
        fault = "" if sequence.is_whole() else f"{path}: found other meshes than were written"
    except FileFormatError as error:
        fault = str(error)
    if fault:
        warnings.warn(f"{fault}; they are gathered anew", stacklevel=3)
        return None
    return sequence


def upright(mesh: Mesh) -> Mesh:
    """The mesh as its 68 landmarks stand upright and face the viewer, about its own middle; as it is without them."""
    marked = mesh.annotations is not None and mesh.annotations.landmarks is not None
    if not marked or len(mesh.landmarks) != 68:
        return mesh
    marks = mesh.vertices[mesh.landmarks].double()
    across = torch.nn.functional.normalize(marks[45] - marks[36], dim=0)
    up = marks[27] - marks[8]
    up = torch.nn.functional.normalize(up - (up @ across) * across, dim=0)
    head_rotation = torch.stack([across, up, torch.linalg.cross(across, up)])
    vertices = mesh.vertices.double()
    return mesh.with_vertices(((vertices - vertices.mean(0)) @ head_rotation.T).to(mesh.vertices))


def aligned_samples(gathered: Gathered, scale: bool) -> tuple[Samples, Samples]:
    """The heads to learn from on their common mean, and those to test on aligned with it."""
    total, count = len(gathered.shapes), len(gathered.shapes) - gathered.held_out
    learn = SampleRange(gathered.shapes, 0, count)
    aligned_heads = generalised_procrustes(learn, scale, initial_mean=gathered.template.vertices)
    rest = SampleRange(gathered.shapes, count, total)
    poses = [
        similarity_transform(part.double(), aligned_heads.mean.expand(part.shape), scale=scale)
        for part in (rest.read(*block) for block in blocks(rest))
    ]
    learned, tested = aligned(learn, aligned_heads), MovedSamples(rest, _joined(poses)) if poses else rest
    _warn_of_far(learned, tested, gathered.names)
    return learned, tested


def _warn_of_far(learn: Samples, test: Samples, names: list[str]) -> None:
    """Warns of heads that no other is like: wrongly registered, of another size, or no people's."""
    step = max(1, learn.shape[1] // _COMPARED)
    some = torch.cat([part.read(*block)[:, ::step] for part in (learn, test) for block in blocks(part)])
    distances = torch.cdist(*2 * (some.flatten(1) / some.shape[1] ** 0.5,)).fill_diagonal_(torch.inf)
    nearest = distances.amin(1)
    median = float(nearest.median())
    far = (nearest > max(_FAR, _FAR_SHARE * median)).nonzero()[:, 0].tolist()
    if far:
        listed = ", ".join(f"{names[number]} {float(nearest[number]):.0f} mm" for number in far[:5])
        warnings.warn(
            f"{len(far)} of {len(names)} heads lie far from every other one after alignment: {listed} (root mean "
            f"square to the nearest; {median:.1f} mm is usual): look whether each is a head at rest, registered well "
            "and of its true size, or leave it out",
            stacklevel=2,
        )


def vertex_colored(mesh: Mesh) -> Mesh:
    """The mesh with colours a vertex: its own, or its texture's."""
    if mesh.colors is not None or mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        return mesh
    corner = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    corner[mesh.faces.flatten()] = mesh.uv_faces.flatten()
    return replace(mesh, colors=sample_texture(mesh.texture, mesh.uvs[corner].double()).float())


def _joined(poses: list[Similarity]) -> Similarity:
    return Similarity(*(torch.cat([getattr(p, name) for p in poses]) for name in ("scale", "rotation", "translation")))
