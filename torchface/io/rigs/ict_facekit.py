"""ICT-FaceKit's ``FaceXModel`` folder as its users download it: neutral, expressions, identity modes, in centimetres.

Source: ICT-VGL/ICT-FaceKit (MIT); Li et al. 2020, Learning Formation of Physically-Based Face Attributes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError
from torchface.files.documents import read_json
from torchface.files.whole_files import read_file
from torchface.io.meshes.obj import face_bytes, read_obj, read_obj_vertices
from torchface.mesh import Annotations, Mesh
from torchface.rig import BlendshapeRig

NEUTRAL = "generic_neutral_mesh"
_INDICES = "vertex_indices.json"
_MAX_INDICES = 2**24
_UNIT = "cm"
_VERTICES = 26_719
_LAST_VERTEX = {
    "face": 9408,
    "head_and_neck": 11247,
    "mouth_socket": 13293,
    "eye_socket_left": 13677,
    "eye_socket_right": 14061,
    "gums_and_tongue": 17038,
    "teeth": 21450,
    "eyeball_left": 23020,
    "eyeball_right": 24590,
    "lacrimal_fluid_left": 24794,
    "lacrimal_fluid_right": 24998,
    "eye_blend_left": 25022,
    "eye_blend_right": 25046,
    "eye_occlusion_left": 25198,
    "eye_occlusion_right": 25350,
    "eyelashes_left": 26034,
    "eyelashes_right": 26718,
}
"""The parts follow each other; each begins where the one before ends."""
_NARROW_FACE = 6705


@dataclass(frozen=True, eq=False)
class IdentityModes:
    """The head as a linear model of identity.

    .. math:: A_0(c) = \\bar A + \\sum_k c_k M_k, \\quad c_k \\sim N(0,1)

    Args:
        neutral: the mean head.
        deltas: the modes :math:`M_k`, (K,V,3), millimetres at one standard deviation.
        names: one a mode.

    Example:
        >>> mean = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> modes = IdentityModes(mean, torch.ones(2, 3, 3), ("wide", "tall"))
        >>> modes.head(torch.tensor([1.0, 0.5])).vertices[0].tolist()
        [2.5, 1.5, 1.5]
    """

    neutral: Mesh
    deltas: Tensor
    names: tuple[str, ...]

    def head(self, coefficients: Tensor) -> Mesh:
        """The head at ``coefficients`` (K,), in standard deviations.

        Raises:
            ShapeError: not one coefficient a mode.
        """
        if coefficients.shape != (len(self.names),):
            raise ShapeError(f"coefficients: found {tuple(coefficients.shape)}, expected ({len(self.names)},)")
        offsets = torch.tensordot(coefficients.to(self.deltas), self.deltas, dims=1)
        return self.neutral.with_vertices(self.neutral.vertices + offsets)

    def random_head(self, seed: int | torch.Generator) -> Mesh:
        """A head drawn from N(0,1) in every mode."""
        generator = torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed
        return self.head(torch.randn(len(self.names), generator=generator))


def is_ict_folder(folder: str | Path) -> bool:
    """Whether the folder is a ``FaceXModel``."""
    return (Path(folder) / _INDICES).is_file() and (Path(folder) / f"{NEUTRAL}.obj").is_file()


def load_ict_facekit(
    folder: str | Path, shapes: Sequence[str] | None = None, part: str | None = None, unit: str | None = None
) -> BlendshapeRig:
    """The expression rig: 26,719 vertices in 17 parts, quads, 68 landmarks, a mirror map, one region mask a part.

    Args:
        folder: the ``FaceXModel`` folder.
        shapes: names in the order wanted (``cheekRaiser_L`` and other files of the folder too); the 53 ``expressions``
            of ``vertex_indices.json`` if absent.
        part: keep this region only, such as ``"face"`` (vertices 0 to 9408).
        unit: the files' unit; centimetres if absent.

    Raises:
        FileFormatError: a file is missing or broken.
        NameMismatchError: the folder has no shape, or the head no part, of that name.
        TopologyError: a shape has other vertices or faces than the neutral.
    """
    folder, unit = Path(folder), unit or _UNIT
    indices = _read_indices(folder)
    neutral, topology = _read_neutral(folder, indices, unit)
    names = tuple(indices["expressions"] if shapes is None else shapes)
    rig = BlendshapeRig(neutral, _read_deltas(folder, names, neutral, topology, unit), names)
    return rig if part is None else rig.part(region(neutral, part))


def load_identity_modes(
    folder: str | Path, count: int | None = None, part: str | None = None, unit: str | None = None
) -> IdentityModes:
    """The identity modes ``identity000`` and on, as many as the folder has or ``count``.

    Raises:
        FileFormatError: a file is missing or broken, or there is no identity mode.
        NameMismatchError: fewer modes than ``count``, or no such part.
        TopologyError: a mode has other vertices or faces than the neutral.
    """
    folder, unit = Path(folder), unit or _UNIT
    neutral, topology = _read_neutral(folder, _read_indices(folder), unit)
    names = tuple(sorted(path.stem for path in folder.glob("identity[0-9][0-9][0-9].obj")))
    if not names:
        raise FileFormatError(f"{folder}: found no identity mode, expected identity000.obj and on")
    if count is not None and not 0 < count <= len(names):
        raise NameMismatchError(f"{folder}: found {len(names)} identity modes, expected at least {count}")
    names = names[:count]
    modes = IdentityModes(neutral, _read_deltas(folder, names, neutral, topology, unit), names)
    if part is None:
        return modes
    piece = BlendshapeRig(modes.neutral, modes.deltas, modes.names).part(region(neutral, part))
    return IdentityModes(piece.neutral, piece.deltas, names)


def region(mesh: Mesh, name: str) -> Tensor:
    """The mask (V,) of a region that the mesh is annotated with."""
    regions = mesh.regions
    if name not in regions:
        raise NameMismatchError(f"part: found {name!r}, expected one of {', '.join(regions) or 'none at all'}")
    return regions[name]


def _read_neutral(folder: Path, indices: dict[str, list], unit: str) -> tuple[Mesh, bytes | None]:
    path = folder / f"{NEUTRAL}.obj"
    mesh = read_obj(path, unit)
    count = len(mesh.vertices)
    landmarks = torch.tensor(indices["idx_to_landmark_verts"], dtype=torch.int64)
    if len(landmarks) and int(landmarks.max()) >= count:
        raise FileFormatError(
            f"{folder / _INDICES}: found landmark vertex {int(landmarks.max())}, expected less than {count}"
        )
    parts = _parts(count)
    regions = {**parts, "narrow_face": torch.arange(count) <= _NARROW_FACE} if parts else {}
    mirror = mirror_by_parts(mesh.vertices, parts) if parts else None
    annotations = Annotations(landmarks, regions, mirror)
    return replace(mesh, annotations=annotations), face_bytes(read_file(path))


def _parts(count: int) -> dict[str, Tensor]:
    """One mask a part; a head of another vertex count is not ICT's topology and has none."""
    if count != _VERTICES:
        return {}
    ids = torch.arange(count)
    parts, first = {}, 0
    for name, last in _LAST_VERTEX.items():
        parts[name] = (ids >= first) & (ids <= last)
        first = last + 1
    return parts


def _read_deltas(folder: Path, names: Sequence[str], neutral: Mesh, topology: bytes | None, unit: str) -> Tensor:
    deltas = torch.empty(len(names), *neutral.vertices.shape)
    at_rest = neutral.vertices.numpy()
    for row, name in zip(deltas.numpy(), names, strict=True):  # one file each
        path = folder / f"{name}.obj"
        if Path(name).name != name or not path.is_file():
            have = sorted(file.stem for file in folder.glob("*.obj"))
            raise NameMismatchError(f"{folder}: found no shape {name!r}; its files are {', '.join(have[:60])}")
        np.subtract(read_obj_vertices(path, neutral, topology, unit).numpy(), at_rest, out=row)
    return deltas


def _read_indices(folder: Path) -> dict[str, list]:
    if is_ict_folder(folder / "FaceXModel"):
        raise FileFormatError(f"{folder}: found ICT-FaceKit's repository, expected {folder / 'FaceXModel'}")
    document = read_json(folder / _INDICES, max_bytes=_MAX_INDICES)
    document["expressions"].texts()
    document["idx_to_landmark_verts"].tensor(None, dtype=torch.int64, expected="a list of vertex ids")
    return document.found


_MAX_DISTANCE = 1.0
_MAX_UNMATCHED = 1000


def mirror_by_parts(vertices: Tensor, parts: dict[str, Tensor]) -> Tensor | None:
    """The mirror map (V,) of a head whose parts lie apart, left ones named ``..._left`` and right ones ``..._right``;
    None where a vertex would be more than 1 mm from its image, or the map is not its own inverse.

    Left and right parts go by the order of their vertices where that fits, else, as parts on the midline, by nearest
    place; vertices that lie on each other are matched one to one so that the map is its own inverse.
    """
    points = vertices.double().numpy()
    flipped = points * [-1, 1, 1]
    twin = np.full(len(points), -1, np.int64)
    for name, mask in parts.items():
        other = name.removesuffix("_left") + "_right" if name.endswith("_left") else name
        if name.endswith("_right"):
            continue
        a, b = np.flatnonzero(mask.numpy()), np.flatnonzero(parts[other].numpy())
        image = _images(flipped[a], points[b])
        if image is None:
            return None
        twin[a], twin[b[image]] = b[image], a
    whole = bool((twin >= 0).all()) and np.array_equal(twin[twin], np.arange(len(twin)))
    if not whole or np.linalg.norm(flipped - points[twin], axis=1).max() > _MAX_DISTANCE:
        return None
    return torch.from_numpy(twin)


def _images(flipped: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """For each flipped point its place among ``points``, each taken once."""
    if len(flipped) != len(points):
        return None
    if np.linalg.norm(flipped - points, axis=1).max() <= _MAX_DISTANCE:
        return np.arange(len(points))
    forward, backward = cKDTree(points).query(flipped)[1], cKDTree(flipped).query(points)[1]
    mutual = backward[forward] == np.arange(len(points))
    left, right = np.flatnonzero(~mutual), np.setdiff1d(np.arange(len(points)), forward[mutual])
    if len(left) > _MAX_UNMATCHED:
        return None
    from scipy.optimize import linear_sum_assignment  # takes its time

    rows, columns = linear_sum_assignment(cdist(flipped[left], points[right]))
    forward[left[rows]] = right[columns]
    return forward
