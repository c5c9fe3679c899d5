"""A rig as a folder of OBJ files: the neutral, a file a shape, and what OBJ has no place for in ``rig.json``."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import AlignmentError, FileFormatError, NameMismatchError
from torchface.files.documents import read_json, write_json
from torchface.files.whole_files import all_or_none, check_writable, made_folder, read_file, visible_files
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.meshes.vertex_order import check_vertex_order
from torchface.io.gltf.corrective_extras import all_targets, read_correctives, rig_of_targets, write_correctives
from torchface.io.gltf.gltf_document import Document
from torchface.io.gltf.mesh_extras import read_annotations, write_extras
from torchface.io.images.image_files import save_normal_map
from torchface.io.meshes.obj import face_bytes, read_obj, read_obj_vertices, write_obj, write_obj_shapes
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig

NEUTRAL, NOTES = "neutral", "rig.json"
_MAX_NOTES = 2**26
_LARGEST = 3.0  # times the neutral's extent; an open mouth adds a sixth
_ASIDE, _STEADY = 0.25, 0.01  # of the neutral's extent; a head that moves forward goes less far


def load_obj_folder(folder: str | Path, unit: str = "mm", neutral: str | None = None) -> BlendshapeRig:
    r"""A rig of OBJ files with the same faces.

    Shapes come in the order of ``rig.json``, which ``save_obj_folder`` writes; others follow, sorted by name.

    Args:
        folder: one neutral, and a file for each shape.
        unit: of all the files.
        neutral: the neutral's file name without ``.obj``; if absent the one file with "neutral" in its name.

    Raises:
        FileFormatError: no neutral or several, no shape, or a broken file.
        TopologyError: a shape has other vertices or faces than the neutral.
        AlignmentError: a shape's vertices stand in another order than the neutral's, or it lies beside it.
        ValueRangeError: a shape is in another unit than the neutral.

    Example:
        >>> from pathlib import Path
        >>> Path("rig").mkdir()
        >>> for name, x in (("neutral", 0), ("jawOpen", 1)):
        ...     _ = Path(f"rig/{name}.obj").write_text(f"v {x} 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\n")
        >>> load_obj_folder("rig", unit="cm").deltas[0, 0].tolist()
        [10.0, 0.0, 0.0]
    """
    folder = Path(folder)
    files = {path.stem: path for path in visible_files(folder, [".obj"])}
    notes = _read_notes(folder)
    if neutral is None and notes is not None and NEUTRAL in files:
        neutral = NEUTRAL
    candidates = [name for name in files if "neutral" in name.lower()] if neutral is None else [neutral]
    if len(candidates) != 1 or candidates[0] not in files:
        raise FileFormatError(
            f"{folder}: found {len(files)} OBJ files, of them neutral: {', '.join(candidates) or 'none'}; expected one "
            "neutral, with that word in its name (in Python, name it by neutral=), and a file for each shape"
        )
    rest = files.pop(candidates[0])
    if not files:
        raise FileFormatError(f"{folder}: found only the neutral {rest.name}, expected a file for each shape")
    mesh, topology = read_obj(rest, unit), face_bytes(read_file(rest))
    names = list(files)
    if notes is not None:
        listed = [name for name in notes.array(notes.root, "shapes", "document") if isinstance(name, str)]
        names = list(dict.fromkeys([*(name for name in listed if name in files), *files]))
        mesh = replace(mesh, annotations=read_annotations(notes, notes.root.get("mesh"), "mesh", len(mesh.vertices)))
    deltas = [read_obj_vertices(files[name], mesh, topology, unit) - mesh.vertices for name in names]
    if notes is None:  # by others, who exported each by itself
        for name, delta in zip(names, deltas, strict=True):
            _check_place(files[name], mesh, delta)
        return BlendshapeRig(mesh, torch.stack(deltas), tuple(names))
    return rig_of_targets(notes, mesh, torch.stack(deltas), names, read_correctives(notes, notes.root, "document"))


def _check_place(path: Path, neutral: Mesh, delta: Tensor) -> None:
    """Refuses a shape in another unit than the neutral, beside it, or with its vertices in another order."""
    rest, used = neutral.vertices.double(), neutral.faces.unique()
    shape, across = rest + delta, extent(rest[used])
    if not across > 0:
        return
    check_unit(str(path), shape[used], across, "the neutral", 1 / _LARGEST, _LARGEST, alone=True)
    moved = delta[used].double()
    aside = moved.median(0).values
    together = float(((moved - aside).norm(dim=-1) < _STEADY * across).double().mean())
    if float(aside.norm()) > _ASIDE * across and together > 0.5:
        way = ", ".join(f"{x:.0f}" for x in aside.tolist())
        raise AlignmentError(
            f"{path}: found that {together:.0%} of its vertices lie ({way}) mm beside the neutral's, expected the "
            "shape in the neutral's place; move it there before it is exported"
        )
    check_vertex_order(str(path), rest, shape, neutral.faces, "the neutral")


def save_obj_folder(rig: BlendshapeRig, folder: str | Path, detail: DetailMaps | None = None) -> None:
    """Writes ``neutral.obj`` and an OBJ a shape, in millimetres, vertices and polygons in the rig's own order.

    Landmarks, regions, the mirror map, the order of the shapes and when correctives act are in ``rig.json``; a
    corrective's OBJ is the neutral with its delta alone. The texture lies beside the
    neutral, detail maps are called ``<shape>_normals.png``. ``load_obj_folder`` gives the same rig.
    """
    folder = Path(folder)
    _check_names(rig, folder)
    missing = [] if detail is None else [name for name in detail.names if name not in rig.names]
    if missing:
        raise NameMismatchError(f"detail: the rig has no shape {', '.join(map(repr, missing[:5]))}")
    check_writable(folder=folder)
    with made_folder(folder), all_or_none():
        _write(rig, folder, detail)


def _write(rig: BlendshapeRig, folder: Path, detail: DetailMaps | None) -> None:
    mesh = rig.neutral.to("cpu")
    stem = write_obj(mesh, folder / f"{NEUTRAL}.obj")
    deltas, names = all_targets(rig)
    moved = ((name, mesh.vertices + delta.cpu()) for name, delta in zip(names, deltas, strict=True))
    write_obj_shapes(mesh, moved, folder, stem)
    notes = write_extras(mesh)
    notes.pop("polygons", None)  # the OBJ files have them
    correctives = () if rig.correctives is None else rig.correctives.definitions
    document = {"shapes": list(names), "mesh": notes, **write_correctives(correctives)}
    write_json(folder / NOTES, document, indent=None)
    if detail is not None:
        maps: list[tuple[str, Any]] = list(zip(detail.names, detail.maps, strict=True))
        maps += [] if detail.neutral is None else [(NEUTRAL, detail.neutral)]
        for name, normals in maps:
            save_normal_map(normals, folder / f"{name}_normals.png")


def _check_names(rig: BlendshapeRig, folder: Path) -> None:
    """Refuses shapes whose names make no files, and a folder in which other shapes would mix with these."""
    names = (*rig.names, *(() if rig.correctives is None else rig.correctives.names))
    for name in names:
        if not name or Path(name).name != name or name.startswith(".") or "\0" in name or name.lower() == NEUTRAL:
            raise NameMismatchError(f"{folder}: found a shape {name!r}, expected file names; write a .glb instead")
    there = [path.name for path in visible_files(folder, [".obj"])] if folder.is_dir() else []
    others = [name for name in there if name[:-4] not in (NEUTRAL, *names)]
    if others:
        raise FileFormatError(
            f"{folder}: found OBJ files of another rig ({', '.join(others[:3])}), expected an empty or a new folder"
        )


def _read_notes(folder: Path) -> Document | None:
    path = folder / NOTES
    if not path.is_file():
        return None
    root = read_json(path, max_bytes=_MAX_NOTES)
    root.table(expected="a rig's notes")
    return Document(path, root.found)
