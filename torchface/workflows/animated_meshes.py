"""Meshes over time from any of their files: weights with their rig, an animated rig, a mesh sequence, meshes."""

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.files.whole_files import check_there, numbered_order, visible_files
from torchface.io import MeshSequence, load_animation, load_mesh, load_rig, load_take
from torchface.io.head_models.array_files import ArrayFile
from torchface.io.length_units import millimetres_per
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.io.rigs.ict_facekit import region
from torchface.io.tables.csv_table import TableReader
from torchface.io.tables.numbered_csv import is_numbered
from torchface.io.take_files import RECORDING_ENDINGS
from torchface.io.weights.json_recordings import is_weight_json
from torchface.io.weights.live_link_csv import is_live_link
from torchface.mesh import Mesh, submesh
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.workflows.weight_files import check_whole_frames

_FORMS = (
    "weights as .csv, an animated .glb or .usdc, a mesh sequence as .safetensors or .npz, a mesh, or a folder of meshes"
)

DEFAULT_FPS = 30.0
_SAME_RATE = 2e-3  # relative; 29.97 and 30 are the same
_KEPT = 8  # meshes
_MOST_COMPRESSED = 100  # times; measured positions become two to four times smaller, zeros a thousand times


@dataclass(frozen=True, eq=False)
class AnimatedMesh:
    """A mesh that moves."""

    path: Path  # where it came from
    neutral: Mesh  # its topology and annotations; at rest where it came with a rig, else as in its first frame
    count: int
    # Vertices (t,V,3) of the frames from one number up to another, without it; NaN where a frame has none.
    read: Callable[[int, int], Tensor]
    fps: float | None = None  # frames a second, where that is known
    weights: Track | None = None  # what moves it, where that is known
    rig: BlendshapeRig | None = None  # of its topology, where one came with it
    take: Take | None = None  # of the weights, where there is one, with the times of its frames
    numbered: bool = False  # whether its frames are numbered from a beginning that others may share
    missing: str = ""  # which frames of meshes are not there, for people to read; empty where none is known to be
    # Of the vertices, (t,V,3) in [0,1], read as read does, where meshes have them.
    colors: Callable[[int, int], Tensor] | None = None


def load_animated(
    path: Path, rig: Path | None = None, part: str | None = None, unit: str | None = None
) -> AnimatedMesh:
    """Reads meshes over time.

    Args:
        path: weights as ``.csv`` or what phones record (of which the rig makes meshes); a glTF or USD file with an
            animation of its shapes, or without, which is one frame; a mesh sequence as ``.safetensors``
            (:class:`torchface.io.MeshSequence`) or ``.npz`` (``vertices`` (T,V,3), ``faces`` (F,3)); a mesh; or a
            folder of meshes, a frame each, in the order of their names.
        rig: what weights move, or the rig whose topology the meshes have.
        part: keep this annotated region only, such as ``face``.
        unit: of meshes and ``.npz``, see :func:`torchface.io.load_mesh`; the other files say it.
    """
    loaded = None if rig is None else load_rig(rig)
    ending = path.suffix.lower()
    if path.is_dir():
        animated = _of_folder(path, loaded, unit)
    elif ending in MESH_ENDINGS:
        animated = meshes_over_time(path, [path], loaded, unit)
    elif ending == ".npz":
        animated = _of_arrays(path, loaded, unit)
    elif unit is not None:
        raise ValueRangeError(f"{path}: found --unit {unit}, expected it of markers and meshes alone, not of {ending}")
    elif ending in (".csv", *RECORDING_ENDINGS):
        animated = _of_weights(path, loaded)
    elif ending == ".safetensors":
        animated = _of_sequence(path, loaded)
    elif ending in SCENE_ENDINGS:
        animated = _of_scene(path, loaded)
    else:
        check_there(path)
        raise FileFormatError(f"{path}: found the ending {ending!r}, expected {_FORMS}")
    return animated if part is None else _kept(animated, region(animated.neutral, part))


def is_animation(path: Path) -> bool:
    """Whether :func:`load_animated` reads a file or folder, by ending, header, and what the folder holds.

    A folder is one where it holds meshes that are its frames: not scenes that move by themselves, nor a single mesh
    beside animations.
    """
    if path.is_dir():
        meshes = visible_files(path, (*MESH_ENDINGS, *SCENE_ENDINGS))
        if len(meshes) == 1 and any(map(_is_take, path.iterdir())):
            return False
        return bool(meshes) and not _moves(file for file in meshes if file.suffix.lower() in SCENE_ENDINGS)
    ending = path.suffix.lower()
    if ending == ".csv":
        header = TableReader(path).header
        return is_live_link(header) or (is_numbered(header) and not is_marker_header(header))
    if ending == ".json":
        return is_weight_json(path)
    if ending == ".npz":
        return {"vertices", "faces"} <= set(ArrayFile(path).names)
    return ending in (".safetensors", *RECORDING_ENDINGS, *MESH_ENDINGS, *SCENE_ENDINGS)


def known_rate(stated: float | None, fps: float | None) -> float:
    """Frames a second: as asked for, else as the file has them, else 30."""
    return fps or stated or DEFAULT_FPS


def rate_notes(path: Path, stated: float | None, fps: float | None) -> list[str]:
    """Says where a rate was assumed, or is another than the file's."""
    if fps is not None and stated is not None and abs(fps / stated - 1) > _SAME_RATE:
        return [f"warning: {path.name} has {stated:g} frames a second; {fps:g} are taken (--fps)"]
    if fps is not None or stated is not None:
        return []
    return [f"{path.name} has no frame rate; {DEFAULT_FPS:g} a second are assumed (--fps)"]


def _is_take(file: Path) -> bool:
    """Whether a file holds weights, markers or meshes over time, by ending and header."""
    try:
        ending = file.suffix.lower()
        if ending != ".csv":
            return ending in (".safetensors", ".c3d", ".trc")
        header = TableReader(file).header
        return is_numbered(header) or is_live_link(header)
    except FileFormatError:
        return False


def _moves(scenes: Iterable[Path]) -> bool:
    """Whether the first that can be read has an animation of its own; the others of a folder are taken to be alike."""
    for scene in scenes:
        with suppress(FileFormatError):
            return load_animation(scene) is not None
    return False


def _of_weights(path: Path, rig: BlendshapeRig | None) -> AnimatedMesh:
    if rig is None:
        raise NameMismatchError(f"{path}: found weights without a rig, expected the rig that they move (--rig)")
    take = load_take(path)
    if take.weights is None:
        raise ValueRangeError(f"{path}: found no weights, expected a take of them")
    check_whole_frames(path, take.weights)
    numbered = path.suffix.lower() == ".csv" and is_numbered(TableReader(path).header)
    return replace(moved_mesh(path, rig, take), numbered=numbered)


def moved_mesh(path: Path, rig: BlendshapeRig, take: Take) -> AnimatedMesh:
    """A rig that a take's weights move."""
    assert take.weights is not None
    try:
        weights = rig.weights_from(take.weights).to(rig.deltas)
    except NameMismatchError as error:
        raise NameMismatchError(f"{path}: {error}") from error

    def read(begin: int, end: int) -> Tensor:
        with torch.no_grad():
            return rig(weights[begin:end])

    own = Track(rig.names, weights[..., None])
    return AnimatedMesh(path, rig.neutral, len(weights), read, take.fps, own, rig, take)


def _of_scene(path: Path, rig: BlendshapeRig | None) -> AnimatedMesh:
    take = load_animation(path)
    if take is None or take.weights is None:
        return meshes_over_time(path, [path], rig)
    return moved_mesh(path, load_rig(path), take)


def _of_sequence(path: Path, rig: BlendshapeRig | None) -> AnimatedMesh:
    sequence = MeshSequence(path)
    if sequence.shape[2] != 3:
        raise FileFormatError(f"{path}: found {sequence.shape[2]} numbers a vertex, expected 3, positions")
    first = sequence.read(0, 1)[0].nan_to_num(0.0)
    neutral = _at_rest(path, Mesh(first, sequence.faces), rig)
    return AnimatedMesh(path, neutral, len(sequence), sequence.read, sequence.fps, rig=rig)


def _of_arrays(path: Path, rig: BlendshapeRig | None, unit: str | None) -> AnimatedMesh:
    # What becomes so much larger is none, and would fill the memory.
    arrays = ArrayFile(path, 2**20 + _MOST_COMPRESSED * (path.stat().st_size if path.is_file() else 0))
    vertices = arrays.numbers("vertices", None, None, 3, finite=False) * millimetres_per(unit or "mm")
    if min(vertices.shape) == 0:
        raise arrays.error("vertices", "frames (T,V,3)")
    faces = arrays.indices("faces", None, 3, below=vertices.shape[1])
    neutral = _at_rest(path, Mesh(vertices[0].nan_to_num(0.0), faces), rig)
    return AnimatedMesh(path, neutral, len(vertices), lambda begin, end: vertices[begin:end], rig=rig)


def _of_folder(folder: Path, rig: BlendshapeRig | None, unit: str | None) -> AnimatedMesh:
    files = sorted(visible_files(folder, (*MESH_ENDINGS, *SCENE_ENDINGS)), key=numbered_order)
    if not files:
        raise FileFormatError(f"{folder}: found no mesh, expected files ending in {', '.join(MESH_ENDINGS)} or .glb")
    return meshes_over_time(folder, files, rig, unit)


def _missing(files: list[Path]) -> str:
    """Where the numbers that end names leap further than they mostly do; empty where they do not."""
    ends = [re.search(r"(\d{1,18})$", file.stem) for file in files]
    numbers = [int(end[1]) for end in ends if end is not None]
    steps = [after - before for before, after in pairwise(numbers)]
    if len(numbers) < len(files) or len(steps) < 2 or min(steps) < 1:
        return ""
    usual = sorted(steps)[(len(steps) - 1) // 2]
    leaps = [(files[row].name, files[row + 1].name) for row, step in enumerate(steps) if step > usual]
    lost = sum(step // usual - 1 for step in steps if step > usual)
    return f"{lost} of {len(files) + lost} frames are missing, first from {' to '.join(leaps[0])}" if leaps else ""


def meshes_over_time(path: Path, files: list[Path], rig: BlendshapeRig | None, unit: str | None = None) -> AnimatedMesh:
    """Meshes of one topology, a file a frame."""
    first = load_mesh(files[0], unit)

    @lru_cache(maxsize=_KEPT)  # vertices and colours of a frame are asked for after one another
    def one(file: Path) -> Mesh:
        mesh = load_mesh(file, unit)
        mesh.require_topology(first, file, files[0].name)
        return mesh

    def read(begin: int, end: int) -> Tensor:
        return torch.stack([one(file).vertices for file in files[begin:end]])  # a file a frame

    def colors(begin: int, end: int) -> Tensor:
        found = [one(file).colors for file in files[begin:end]]
        if any(row is None for row in found):
            raise FileFormatError(f"{path}: found meshes without vertex colours beside {files[0].name}, which has some")
        return torch.stack([row for row in found if row is not None])

    shades = None if first.colors is None else colors
    neutral, missing = _at_rest(path, first, rig), _missing(files)
    return AnimatedMesh(path, neutral, len(files), read, rig=rig, missing=missing, colors=shades)


def _at_rest(path: Path, mesh: Mesh, rig: BlendshapeRig | None) -> Mesh:
    """The rig's neutral where there is a rig; it must have the mesh's topology."""
    if rig is None:
        return mesh
    mesh.require_topology(rig.neutral, path, "the rig")
    return rig.neutral


def _kept(whole: AnimatedMesh, keep: Tensor) -> AnimatedMesh:
    piece = submesh(whole.neutral, keep)
    rig = None if whole.rig is None else whole.rig.part(keep)

    def read(begin: int, end: int) -> Tensor:
        return whole.read(begin, end)[:, piece.vertex_ids]

    return replace(whole, neutral=piece.mesh, read=read, rig=rig, colors=None)
