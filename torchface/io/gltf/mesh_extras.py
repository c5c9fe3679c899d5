"""Extras in ``mesh.extras.torchface`` that glTF has no place for: polygons and annotations, as compact JSON."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.io.gltf.gltf_document import Document, shown
from torchface.io.meshes.polygons import corners_of_fans, corners_of_polygons, pad_polygons
from torchface.mesh import Annotations, Mesh

_VERSION = 1
_MOVED = 1e-3  # of a mesh's size: rows are others that lie further from where landmarks were written
Split = tuple[NDArray[np.int64], NDArray[np.int64]]


def write_extras(mesh: Mesh) -> dict[str, Any]:
    """The JSON of a mesh's polygons and annotations; lists of runs stand for polygon sizes and region masks."""
    extras: dict[str, Any] = {"version": _VERSION, "vertices": len(mesh.vertices)}
    if mesh.polygons is not None:
        sizes, _, _ = corners_of_polygons(mesh)
        start = np.flatnonzero(np.diff(sizes, prepend=-1))
        extras["polygons"] = np.stack([sizes[start], np.diff(start, append=len(sizes))], axis=1).tolist()
    annotations = mesh.annotations
    if annotations is not None:
        lists = {"landmarks": annotations.landmarks, "mirror": annotations.mirror, "contacts": annotations.contacts}
        extras.update({name: tensor.tolist() for name, tensor in lists.items() if tensor is not None})
        extras["regions"] = {name: _runs(mask.cpu().numpy()) for name, mask in annotations.regions.items()}
    return extras


def is_own_mesh(extras: object) -> bool:
    """Whether ``write_extras`` made a mesh's record: torchface wrote the mesh, not only annotations to another's."""
    return isinstance(extras, dict) and "vertices" in extras


def write_order(rows: Tensor, meshes: int) -> dict[str, Any]:
    """The JSON of what parts do to the order of triangles, as runs of rows that follow each other; none of one part."""
    ids = rows.numpy()
    start = np.flatnonzero(np.diff(ids, prepend=-2) != 1)
    extras: dict[str, Any] = {} if meshes == 1 else {"meshes": meshes}
    if len(start) > 1:
        extras["triangles"] = np.stack([ids[start], np.diff(start, append=len(ids))], axis=1).tolist()
    return extras


def read_mesh_count(document: Document, extras: object, location: str) -> int:
    """How many meshes of the scene are one mesh's parts, this one the first; 1 where the file does not say."""
    return document.integer(_record(document, extras, location), "meshes", location, 1)


def read_order(document: Document, extras: object, location: str, count: int) -> NDArray[np.int64] | None:
    """For each of ``count`` triangles its row in the mesh as authored; none where the file has them in that order."""
    record = _record(document, extras, location)
    if "triangles" not in record:
        return None
    runs = _integers(document, record, "triangles", location, (2,))
    start, length = runs[:, 0], runs[:, 1]
    if len(runs) == 0 or length.min() < 1 or length.max() > count or int(length.sum()) != count:
        return None
    begin = np.cumsum(length) - length
    rows = np.repeat(start - begin, length) + np.arange(count)
    return rows if np.array_equal(np.sort(rows), np.arange(count)) else None


def read_polygons(document: Document, extras: object, location: str, triangles: NDArray[np.int64]) -> Tensor | None:
    """The polygons (P,K) whose fans the triangles (F,3) are; none where they are not, as after an edit elsewhere."""
    record = _record(document, extras, location)
    if "polygons" not in record:
        return None
    runs = _integers(document, record, "polygons", location, (2,))
    sizes, counts = runs[:, 0], runs[:, 1]
    if len(runs) == 0 or sizes.min() < 3 or counts.min() < 1 or counts.max() > len(triangles):
        return None
    if sizes.max() > len(triangles) + 2 or int(((sizes - 2) * counts).sum()) != len(triangles):
        return None
    sizes = np.repeat(sizes, counts)
    owner = np.repeat(np.arange(len(sizes)), sizes - 2)
    inner = np.flatnonzero(owner[1:] == owner[:-1])
    apex = triangles[inner, 0] == triangles[inner + 1, 0]
    if not np.all(apex & (triangles[inner, 2] == triangles[inner + 1, 1])):
        return None
    return pad_polygons(str(document.path), sizes, corners_of_fans(sizes, triangles))


def read_annotations(document: Document, extras: object, location: str, count: int) -> Annotations | None:
    """The annotations of a mesh of ``count`` vertices; none where the file has none, or for another vertex count."""
    record = _record(document, extras, location)
    if record.get("vertices") != count:
        return None
    ids = {}
    for name, shape in (("landmarks", ()), ("mirror", ()), ("contacts", (2,))):
        if name in record:
            ids[name] = torch.from_numpy(_vertex_ids(document, record, name, location, shape, count))
    if "mirror" in ids and len(ids["mirror"]) != count:
        raise document.error(f"{location}.mirror", f"{len(ids['mirror'])} entries", f"one for each of {count} vertices")
    regions = document.record(record.get("regions"), f"{location}.regions")
    document.reserve(len(regions) * count, f"{location}.regions")
    masks = {name: _mask(document, regions, name, f"{location}.regions", count) for name in regions}
    if not ids and not masks:
        return None
    return Annotations(regions=masks, **ids)


def row_extras(extras: object, positions: NDArray[np.float64], notes: Annotations) -> dict[str, Any]:
    """A mesh's extras with landmarks (68,), -1 those of other meshes, and regions (C,) of its rows at positions
    (C,3)."""
    kept = dict(extras) if isinstance(extras, dict) else {}
    ours = kept.get("torchface") if isinstance(kept.get("torchface"), dict) else {}
    rows: dict[str, Any] = {"count": len(positions)}
    if notes.landmarks is not None:
        at = notes.landmarks.numpy()
        rows |= {
            "landmarks": at.tolist(),
            "places": [[float(f"{x:.6g}") for x in row] for row in positions[at[at >= 0]]],
        }
    rows["regions"] = {name: _runs(mask.cpu().numpy()) for name, mask in notes.regions.items()}
    return {**kept, "torchface": {**(ours or {}), "version": _VERSION, "rows": rows}}


def read_row_annotations(
    document: Document, extras: object, location: str, vertices: NDArray[np.float64], split: Split
) -> Annotations | None:
    """What ``row_extras`` wrote, at the mesh's vertices (V,3); none where other rows are in these places now."""
    record = document.record(_record(document, extras, location).get("rows"), f"{location}.rows")
    location, (vertex_of, row_of), count = f"{location}.rows", split, len(split[0])
    if record.get("count") != count:
        return None
    landmarks = None
    if "landmarks" in record:
        at = _integers(document, record, "landmarks", location, ())
        rows = document.array(record, "places", location)
        absent = (np.inf, np.inf, np.inf)
        places = np.array(
            [document.numbers({"place": row}, "place", location, 3) or absent for row in rows], np.float64
        )
        known = at[at >= 0]
        if len(known) and int(known.max()) >= count:
            raise document.error(f"{location}.landmarks", f"row {known.max()}", f"-1 to {count - 1}")
        if len(places) != len(known):
            raise document.error(
                f"{location}.places", f"{len(places)} places", f"one for each of {len(known)} landmarks"
            )
        if len(known) and np.abs(vertices[vertex_of[known]] - places).max() > _MOVED * np.ptp(vertices, axis=0).max():
            return None
        landmarks = torch.from_numpy(np.where(at < 0, -1, vertex_of[at]))
    regions = document.record(record.get("regions"), f"{location}.regions")
    document.reserve(len(regions) * count, f"{location}.regions")
    masks = {name: _mask(document, regions, name, f"{location}.regions", count)[row_of] for name in regions}
    return Annotations(landmarks, masks)


def _record(document: Document, extras: object, location: str) -> dict[str, Any]:
    """Another version's record is left alone."""
    record = document.record(extras, location)
    return record if record.get("version") == _VERSION else {}


def _runs(mask: NDArray[np.bool_]) -> list[int]:
    """A mask as the lengths of its runs, the first one of False."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    edges = edges[edges < len(mask)]
    return np.diff(edges, prepend=0, append=len(mask)).tolist()


def _mask(document: Document, regions: dict[str, Any], name: str, location: str, count: int) -> Tensor:
    runs = _integers(document, regions, name, location, ())
    if len(runs) and (runs.min() < 0 or runs.max() > count or int(runs.sum()) != count):
        raise document.error(f"{location}.{name[:40]}", f"runs of {int(runs.sum())} vertices", f"{count}")
    values = np.arange(len(runs)) % 2 == 1
    mask = np.repeat(values, runs)
    if len(mask) != count:
        raise document.error(f"{location}.{name[:40]}", f"runs of {len(mask)} vertices", f"{count}")
    return torch.from_numpy(mask)


def _vertex_ids(
    document: Document, record: dict[str, Any], name: str, location: str, shape: tuple[int, ...], count: int
) -> NDArray[np.int64]:
    ids = _integers(document, record, name, location, shape)
    if ids.size and (ids.min() < 0 or ids.max() >= count):
        raise document.error(f"{location}.{name}", f"vertices {ids.min()} to {ids.max()}", f"0 to {count - 1}")
    return ids


def _integers(
    document: Document, record: dict[str, Any], name: str, location: str, shape: tuple[int, ...]
) -> NDArray[np.int64]:
    """A list of integers, or of rows of them; each within 53 bits."""
    rows = document.array(record, name, location)
    flat = [x for row in rows for x in row] if shape and all(isinstance(row, list) for row in rows) else rows
    whole = all(type(x) is int and abs(x) < 2**53 for x in flat)
    if not whole or (shape and not all(isinstance(row, list) and len(row) == shape[0] for row in rows)):
        raise document.error(
            f"{location}.{name[:40]}", shown(rows), "a list of integers" if not shape else "pairs of integers"
        )
    return np.array(flat, np.int64).reshape(-1, *shape)
