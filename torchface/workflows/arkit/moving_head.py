"""Animations of a head as meshes of one topology: parameters, vertices, face anchors, point caches, mesh sequences."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.documents import Value, read_json
from torchface.io.head_models.array_files import ONLY, ArrayFile
from torchface.io.usd.usd_reading import read_usd_points
from torchface.io.usd.usd_writing import USD_ENDINGS
from torchface.workflows.animated_meshes import load_animated
from torchface.workflows.arkit.arkit_rig import Source
from torchface.workflows.arkit.head_parameters import HeadParameters, has_parameters, read_parameters, stated_rate

MAX_JSON = 2**30
"""Bytes of a file of anchors or weights."""
_VERTICES = ("vertices", "verts", "vertex_positions", ONLY)
_MOST_FRAMES = 2**18


@dataclass(frozen=True, eq=False)
class MovingHead:
    """An animation as meshes of one topology."""

    count: int
    # vertices (t,V,3), millimetres, of the frames from one number up to another, without it
    read: Callable[[int, int], Tensor]
    fps: float | None = None  # frames a second, where that is known
    person: Tensor | None = None  # the head at rest that moves (V,3); None for the source's own
    parameters: HeadParameters | None = None  # that move it, where it came as such
    notes: tuple[str, ...] = ()  # lines for people to read


def load_moving_head(path: Path, head: Source) -> MovingHead:
    """An animation of a head as meshes.

    Args:
        path: parameters or vertices of frames (``.npz``, ``.npy``, ``.safetensors``), face anchors (``.json``), a
            point cache in USD, as Audio2Face exports it, or what ``load_animated`` reads.
    """
    if path.suffix.lower() == ".json":
        return _face_anchors(path, len(head.neutral.vertices))
    if path.is_file() and path.suffix.lower() in (".npz", ".npy", ".safetensors", ".pkl", ".pickle"):
        arrays = ArrayFile(path)
        if has_parameters(arrays):
            return _by_parameters(path, arrays, head)
        key = arrays.first(_VERTICES)
        if key is not None and "faces" not in arrays:
            return _of_array(arrays, key, len(head.neutral.vertices))
        if path.suffix.lower() != ".safetensors":
            raise arrays.error("vertices", "those of frames, or expression parameters such as exp")
    own = head.neutral
    if path.suffix.lower() in USD_ENDINGS and (cache := read_usd_points(path, len(own.vertices))) is not None:
        points, times = cache
        fps = (len(times) - 1) / float(times[-1] - times[0])
        return MovingHead(len(points), lambda begin, end: points[begin:end], fps)
    animated = load_animated(path)
    found, wanted = ((len(mesh.vertices), len(mesh.faces)) for mesh in (animated.neutral, own))
    if found != wanted:
        raise FileFormatError(
            f"{path}: found meshes of {found[0]} vertices and {found[1]} triangles, expected those of {head.path}, "
            f"{wanted[0]} and {wanted[1]}"
        )
    if not torch.equal(animated.neutral.faces, own.faces):
        row = int((animated.neutral.faces != own.faces).any(1).nonzero()[0])
        raise FileFormatError(
            f"{path}: found triangle {row} of vertices {animated.neutral.faces[row].tolist()}, expected "
            f"{own.faces[row].tolist()}, as in {head.path}: its vertices have another order, or its triangles do"
        )
    notes = (f"warning: {path.name}: {animated.missing}",) if animated.missing else ()
    return MovingHead(animated.count, animated.read, animated.fps, notes=notes)


def _by_parameters(path: Path, arrays: ArrayFile, head: Source) -> MovingHead:
    model = head.model
    if model is None:
        raise FileFormatError(
            f"{path}: found expression parameters for {head.path}, a rig, expected their head model as SOURCE"
        )
    parameters = read_parameters(arrays, model)
    person = model.neutral.vertices if parameters.person is None else model.person(parameters.person)

    def read(begin: int, end: int) -> Tensor:
        turned = None if parameters.rotations is None else parameters.rotations[begin:end]
        return model.posed(person, parameters.expressions[begin:end], turned)

    unread = f"left out of {path.name}: {', '.join(parameters.unread[:8])}"
    notes = (unread,) if parameters.unread else ()
    moved = None if parameters.person is None else person
    return MovingHead(len(parameters), read, parameters.fps, moved, parameters, notes)


def _of_array(arrays: ArrayFile, key: str, vertices: int) -> MovingHead:
    shape = arrays.shape(key)
    flat = shape == (vertices, 3) or (len(shape) == 2 and shape[1] == 3 * vertices)
    if (not flat and (len(shape) != 3 or shape[1:] != (vertices, 3))) or not shape[0]:
        raise arrays.error(key, f"(T,{vertices},3) vertices of the head")
    meshes = arrays.numbers(key, *shape).reshape(-1, vertices, 3)
    return MovingHead(len(meshes), lambda begin, end: meshes[begin:end], stated_rate(arrays))


def _face_anchors(path: Path, vertices: int) -> MovingHead:
    """Frames of ARKit's face anchors whose apps wrote ``vertices``, in metres: 1,220 of them."""
    document = read_json(path, max_bytes=MAX_JSON)
    frames = document["frames"] if isinstance(document.found, dict) else document
    rows = frames.rows(1, _MOST_FRAMES, "frames of face anchors with vertices, or Audio2Face's weights")
    meshes = torch.stack([_anchor_vertices(row, vertices) for row in rows])
    named = [row["timestamp"] if row["timestamp"] else row["time"] for row in rows]
    if not all(named):
        return MovingHead(len(meshes), lambda begin, end: meshes[begin:end])
    times = torch.tensor([one.number("seconds") for one in named], dtype=torch.float64)
    steps = times.diff()
    if len(steps) and not float(steps.min()) > 0:
        row = int(steps.argmin())
        raise named[row + 1].error(f"more than the {times[row]:g} s of the frame before")
    usual = float(steps.median()) if len(steps) else 0.0
    lost = int((steps / usual).round().sum()) - len(steps) if len(steps) else 0
    note = f"warning: {path.name}: {lost} of {len(rows) + lost} frames are missing, by the times" if lost else ""
    fps = (len(steps) + lost) / float(times[-1] - times[0]) if len(steps) else None
    return MovingHead(len(meshes), lambda begin, end: meshes[begin:end], fps, notes=(note,) if note else ())


def _anchor_vertices(row: Value, count: int) -> Tensor:
    found = row["geometry"]["vertices"] if row["geometry"] else row["vertices"]
    if isinstance(found.found, list) and len(found.found) not in (count, 3 * count):
        few = f"found {found.key} of {len(found.found)}, expected the head's {count} vertices"
        raise FileFormatError(f"{found.source}: {few}")
    nested = isinstance(found.found, list) and bool(found.found) and isinstance(found.found[0], list)
    values = found.tensor(count, 3) if nested else found.tensor(3 * count, expected=f"{count} vertices of 3 numbers")
    return values.reshape(count, 3).float()
