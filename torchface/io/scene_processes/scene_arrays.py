"""A scene as a process hands it over: records in ``scene.json``, their arrays in ``arrays.npz``.

``scene.json`` holds ``metres_per_unit``, ``up`` (``"Y"`` or ``"Z"``), ``bytes`` of the files read, ``left_out``, what
of the file no rig can hold, in words, ``meshes`` and ``animation``. A mesh has its ``name``, the ``place`` for errors,
the ``matrix`` of 16 numbers from its points to the scene (for rows), ``notes`` (JSON of
``torchface.io.gltf.mesh_extras`` and ``corrective_extras``) and ``shapes``, with a ``name`` each and ``between``, its
in-betweens, with a ``name`` and a ``weight``. Mesh 0's arrays are ``0/points`` (V,3), ``0/counts`` (P,), ``0/corners``
(C,), and where it has them ``0/uvs``, ``0/uv_corners``, ``0/colors``, in light, ``0/texture``, an encoded image, or
``0/looks``, which of the mesh's ``looks`` each face has (a look's ``image`` is the number of an array ``image/0``, or
none, its ``color`` in light), and for each shape ``0/shape/0/offsets``, with ``0/shape/0/rows``, the points that they
belong to, if these are not all, and ``0/shape/0/between/0``, offsets of the same points. ``animation`` has ``names``,
and the arrays ``animation/times`` (T,), seconds, and ``animation/weights`` (T,N).
"""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.color_space import to_srgb
from torchface.correctives.corrective_shapes import Corrective
from torchface.errors import FileFormatError
from torchface.escaped_text import visible
from torchface.files.documents import parse_json
from torchface.io.gltf.corrective_extras import read_correctives, rig_of_targets
from torchface.io.gltf.gltf_document import Document
from torchface.io.gltf.mesh_extras import is_own_mesh, read_annotations, read_row_annotations
from torchface.io.images.image_files import decode_image
from torchface.io.images.texture_atlas import MAX_TEXELS, Look, with_used_looks
from torchface.io.length_units import millimetres_per
from torchface.io.meshes.polygons import pad_polygons
from torchface.io.scenes.scene_pieces import Piece, all_names, join_deltas, join_meshes, joined_size
from torchface.io.tables.frame_rates import key_times
from torchface.mesh import Mesh, fan_triangulation
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track

_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE = 2**28, 32
_LARGEST = 2**33
_AXES = {"Y": np.eye(3), "Z": np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])}  # for rows: z becomes y, y becomes -z
_METRES_PER_UNIT = (1e-6, 1e6)
_KEY, _SAME_PEAK = "\0", 1e-6


@dataclass(frozen=True)
class Scene:
    """What a process found in a file; nothing of it is trusted."""

    path: Path  # the file, for errors
    record: dict[str, Any]  # of scene.json
    arrays: Mapping[str, NDArray[Any]]  # of arrays.npz

    def warn_of_left_out(self) -> None:
        """Reports by ``UserWarning`` what the process left out."""
        for what in self.record["left_out"]:
            warnings.warn(f"{self.path}: left out: {visible(what)}", stacklevel=3)


def load_scene(path: Path, folder: Path) -> Scene:
    """What a process left in ``folder`` of the file ``path``."""
    refused = folder / "refused.json"
    if refused.exists():
        found, expected = json.loads(refused.read_text())
        raise FileFormatError(f"{path}: found {found}, expected {expected}")
    with np.load(folder / "arrays.npz", allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return Scene(path, json.loads((folder / "scene.json").read_text()), arrays)


def scene_rig(scene: Scene, unit: str | None = None) -> BlendshapeRig | None:
    """All meshes together as a rig, in millimetres by ``unit`` or the file's own, y up; none where nothing has a
    shape."""
    pieces = pieces_of(scene, unit)
    names = all_names(pieces)
    if not names:
        return None
    definitions, renamed = _definitions(scene, names)
    document = Document(scene.path, {})
    named = [renamed.get(name, name) for name in names]
    return rig_of_targets(document, _mesh(scene, pieces), join_deltas(pieces), named, definitions)


def scene_mesh(scene: Scene, unit: str | None = None) -> Mesh:
    """All meshes together at rest; see :func:`scene_rig`."""
    return _mesh(scene, pieces_of(scene, unit))


def pieces_of(scene: Scene, unit: str | None = None) -> list[Piece]:
    """Each mesh of a scene in its place; see :func:`scene_rig`."""
    pieces = [_piece(scene, number, unit) for number in range(len(scene.record["meshes"]))]
    _reserve(scene, joined_size(pieces))
    return pieces


def _mesh(scene: Scene, pieces: list[Piece]) -> Mesh:
    """All meshes as one, with the images and colours of their materials as its texture."""
    mesh, records = join_meshes(pieces, None), scene.record["meshes"]
    kinds: dict[tuple[str | None, tuple[float, ...]], int] = {}
    rows = []
    for number, (record, piece) in enumerate(zip(records, pieces, strict=True)):
        own = f"{number}/texture" if f"{number}/texture" in scene.arrays else None
        listed: list[tuple[str | None, tuple[float, ...]]] = [(own, (1.0,) * 3)]
        of = torch.zeros(len(piece.faces), dtype=torch.int64)
        if "looks" in record:
            named = [(look["image"], look["color"] or (1.0,) * 3) for look in record["looks"]]
            listed = [(None if image is None else f"image/{image}", tuple(color)) for image, color in named]
            counts = torch.from_numpy(scene.arrays[f"{number}/counts"])
            of = torch.from_numpy(scene.arrays[f"{number}/looks"]).repeat_interleave(counts - 2)
        rows.append(torch.tensor([kinds.setdefault(kind, len(kinds)) for kind in listed])[of])
    images: dict[str, Tensor] = {}
    for name in dict.fromkeys(name for name, _ in kinds if name is not None):
        images[name] = decode_image(scene.arrays[name].tobytes(), f"{scene.path}: its texture")
        if sum(image[0].numel() for image in images.values()) > MAX_TEXELS:
            raise FileFormatError(f"{scene.path}: found images of more than {MAX_TEXELS:,} texels, expected fewer")
    looks = [
        Look(None if name is None else images[name], to_srgb(torch.tensor(color).clamp(0, 1))) for name, color in kinds
    ]
    ours = any(is_own_mesh(_notes(record)) for record in records)
    return with_used_looks(mesh, torch.cat(rows), looks, images_only=ours or mesh.colors is not None)


def _definitions(scene: Scene, names: Sequence[str]) -> tuple[list[Corrective], dict[str, str]]:
    """The scene's correctives, and what the keys of in-betweens among ``names`` are called.

    Those that torchface noted come first, in their order, in-betweens that are shapes of their own among them; one that
    nobody noted has its name in the file, or its shape's before it where that is taken.
    """
    noted = _noted_correctives(scene)
    definitions = [known for known in noted if not known.is_in_between or known.name in names]
    taken = {name for name in names if _KEY not in name} | {known.name for known in noted}
    renamed: dict[str, str] = {}
    between = [(shape["name"], step) for mesh in _named_meshes(scene) for shape in mesh for step in shape["between"]]
    for driver, step in between:
        key, peak = _key(driver, step["weight"]), step["weight"]
        if key in renamed:
            continue
        same = [other for other in noted if other.drivers == (driver,) and abs((other.peak or 0.0) - peak) < _SAME_PEAK]
        if same:
            renamed[key] = same[0].name
            definitions.append(same[0])
            continue
        free = next(name for name in _names_to_try(driver, step["name"]) if name not in taken)
        taken.add(free)
        renamed[key] = free
        definitions.append(Corrective(free, (driver,), peak))
    return sorted(definitions, key=lambda known: noted.index(known) if known in noted else len(noted)), renamed


def _names_to_try(driver: str, name: str) -> Iterator[str]:
    yield name
    yield f"{driver}_{name}"
    for number in count(2):
        yield f"{driver}_{name}_{number}"


def _key(driver: str, peak: float) -> str:
    """What an in-between is called until all meshes are together: no name has such a sign in it."""
    return f"{driver}{_KEY}{peak:.6f}"


def _noted_correctives(scene: Scene) -> tuple[Corrective, ...]:
    """Those that torchface noted at the first mesh with any."""
    for mesh in scene.record["meshes"]:
        if (notes := _notes(mesh)).get("correctives"):
            return read_correctives(Document(scene.path, {}), notes, mesh["place"])
    return ()


def _named_meshes(scene: Scene) -> list[list[dict[str, Any]]]:
    """The shapes of each mesh, under the names that they have in the rig."""
    named = []
    for mesh in scene.record["meshes"]:
        names = _names(mesh, [shape["name"] for shape in mesh["shapes"]])
        named.append([shape | {"name": name} for shape, name in zip(mesh["shapes"], names, strict=True)])
    return named


def scene_weights(scene: Scene) -> Take | None:
    """The animation of the scene's shapes; see ``torchface.io.load_animation``."""
    if scene.record.get("animation") is None:
        return None
    renamed: dict[str, str] = {}
    for mesh in scene.record["meshes"]:
        tokens = [shape["name"] for shape in mesh["shapes"]]
        for token, name in zip(tokens, _names(mesh, tokens), strict=True):
            renamed.setdefault(token, name)
    names = scene.record["animation"]["names"]
    followers = {corrective.name for corrective in _noted_correctives(scene)}
    columns = [column for column, name in enumerate(names) if renamed.get(name, name) not in followers]
    columns = [column for column in columns if names[column] in renamed]
    if not columns:
        return None
    times, weights = scene.arrays["animation/times"], scene.arrays["animation/weights"][:, columns]
    if not np.isfinite(times).all() or not np.isfinite(weights).all():
        raise FileFormatError(f"{scene.path}: animation: found NaN or infinity, expected numbers")

    def error(found: str, expected: str) -> FileFormatError:
        return FileFormatError(f"{scene.path}: animation: found {found}, expected {expected}")

    keys = key_times(times - times[0], error)
    track = Track(tuple(renamed[names[column]] for column in columns), torch.from_numpy(weights.copy())[..., None])
    return Take(keys.fps, weights=track, seconds=keys.seconds)


def _piece(scene: Scene, number: int, unit: str | None) -> Piece:
    record = scene.record["meshes"][number]
    arrays = {name.partition("/")[2]: array for name, array in scene.arrays.items() if name.startswith(f"{number}/")}
    points, location = arrays["points"], f"{scene.path}: {record['place']}"
    linear, translation = mesh_transform(scene, record, unit)
    shapes, names = record["shapes"], list(_names(record, [shape["name"] for shape in record["shapes"]]))
    _reserve(scene, 12 * len(points) * sum(1 + len(shape["between"]) for shape in shapes))
    vertices = _finite(points @ linear + translation, f"{location}: points")
    deltas = np.zeros((sum(1 + len(shape["between"]) for shape in shapes), len(points), 3), np.float32)
    for number, shape in enumerate(shapes):  # each has rows of its own
        where = f"{location}: {shape['name'][:40]}"
        rows = arrays.get(f"shape/{number}/rows")
        _place_offsets(arrays[f"shape/{number}/offsets"], rows, deltas[number], linear, where)
        for step, between in enumerate(shape["between"]):
            if not 0 < between["weight"] < 1:
                position = f"an in-between at the weight {between['weight']:g}"
                raise FileFormatError(f"{where}: found {position}, expected one between 0 and 1")
            target = deltas[len(names)]
            _place_offsets(arrays[f"shape/{number}/between/{step}"], rows, target, linear, where)
            target -= np.float32(between["weight"]) * deltas[number]  # the rig moves as far without it
            names.append(_key(names[number], between["weight"]))
    sizes, polygons = arrays["counts"], pad_polygons(location, arrays["counts"], arrays["corners"])
    faces, uvs, uv_faces = fan_triangulation(polygons), None, None
    if "uvs" in arrays:
        uvs = torch.from_numpy(_finite(arrays["uvs"], f"{location}: texture coordinates"))
        uv_faces = fan_triangulation(pad_polygons(location, sizes, arrays["uv_corners"]))
    colors = None
    if "colors" in arrays:
        light = _finite(arrays["colors"], f"{location}: colours").clip(0, 1)
        colors = to_srgb(torch.from_numpy(light))
    notes = _notes(record)
    document, every = Document(scene.path, {}), np.arange(len(points))
    return Piece(
        record["name"],
        torch.from_numpy(vertices),
        faces,
        uvs,
        uv_faces,
        colors,
        polygons if polygons.shape[1] > 3 else None,
        read_annotations(document, notes, record["place"], len(points))
        or read_row_annotations(document, notes, record["place"], vertices / 1000, (every, every)),
        torch.from_numpy(deltas),
        tuple(names),
    )


def mesh_transform(
    scene: Scene, record: dict[str, Any], unit: str | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From points to millimetres, y up: rows times (3,3), plus (3,)."""
    per_unit, up = scene.record["metres_per_unit"], scene.record["up"]
    low, high = _METRES_PER_UNIT
    if not low <= per_unit <= high:
        raise FileFormatError(f"{scene.path}: found metersPerUnit = {per_unit}, expected {low} to {high}")
    if up not in _AXES:
        raise FileFormatError(f"{scene.path}: found upAxis = {up!r:.20}, expected Y or Z")
    scale = per_unit * millimetres_per("m") if unit is None else millimetres_per(unit)
    matrix = np.array(record["matrix"], np.float64).reshape(4, 4)
    return matrix[:3, :3] @ _AXES[up] * scale, matrix[3, :3] @ _AXES[up] * scale


def _place_offsets(
    offsets: NDArray[np.float32],
    rows: NDArray[np.int64] | None,
    target: NDArray[np.float32],
    linear: NDArray[np.float64],
    location: str,
) -> None:
    """Writes a shape's offsets to their rows of ``target`` (V,3), millimetres."""
    if rows is None and len(offsets) not in (0, len(target)):
        expected = f"one for each of {len(target)} points"
        raise FileFormatError(f"{location}: found {len(offsets)} offsets, expected {expected}")
    if rows is not None and len(rows) != len(offsets):
        raise FileFormatError(f"{location}: found {len(offsets)} offsets for {len(rows)} points, expected one each")
    if rows is not None and len(rows) and not 0 <= rows.min() <= rows.max() < len(target):
        span = f"{rows.min()} to {rows.max()}"
        raise FileFormatError(f"{location}: found offsets of the points {span}, expected 0 to {len(target) - 1}")
    if len(offsets):
        target[slice(None) if rows is None else rows] = _finite(offsets @ linear, f"{location}: offsets")


def _names(record: dict[str, Any], tokens: list[str]) -> tuple[str, ...]:
    """The shapes' names: where the file's tokens could not hold them, as they were noted beside."""
    noted = _notes(record).get("shapes")
    if not isinstance(noted, list) or not all(isinstance(name, str) for name in noted):
        return tuple(tokens)
    return tuple(noted) if len(noted) == len(set(noted)) == len(tokens) else tuple(tokens)


def _notes(record: dict[str, Any]) -> dict[str, Any]:
    """What torchface noted of the mesh; nothing where another program has changed it beyond reading."""
    if record["notes"] is None:
        return {}
    try:
        document = parse_json(record["notes"].encode())
    except (ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _finite(values: NDArray[Any], location: str) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        rows = values.astype(np.float32)
    if not np.isfinite(rows).all():
        bad = int((~np.isfinite(rows)).any(-1).sum())
        raise FileFormatError(
            f"{location}: found NaN or infinity in {bad} of {len(rows)} rows, expected finite numbers"
        )
    return rows


def _reserve(scene: Scene, size: int) -> None:
    limit = min(_LARGEST, max(_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE * scene.record["bytes"]))
    if size > limit:
        raise FileFormatError(f"{scene.path}: found shapes that unpack to {size} bytes, expected at most {limit}")
