"""FLAME (2020, 2023, 2023 Open): arrays of the names that its own readers use, out of its pickle.

Source: MPI's FLAME and smplx, whose readers name the arrays; Li et al. 2017.
"""

from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.head_models.array_files import ArrayFile
from torchface.io.head_models.head_model_file import HeadJoints, HeadModelFile, SurfacePlaces
from torchface.mesh import Annotations, Mesh

NAME = "FLAME"
MARKS = ("v_template", "shapedirs")
_UNIT = 1000.0
_IDENTITY = 300
_JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")
_WEIGHTS, _FACES = ("weights", "lbs_weights"), ("f", "faces", "faces_tensor")
_EXPRESSIONS = ("expressiondirs", "exprdirs", "expression_dirs")
_EMBEDDINGS = ("flame_static_embedding.npz", "landmark_embedding.npz", "flame_landmark_embedding.npz")
_EMBEDDED = (
    ("full_lmk_faces_idx", "full_lmk_bary_coords"),
    ("static_lmk_faces_idx", "static_lmk_bary_coords"),
    ("lmk_face_idx", "lmk_b_coords"),
    ("lmk_faces_idx", "lmk_bary_coords"),
)
_INNER = 51  # of iBUG's 68 without the contour


def read_flame(path: Path, arrays: ArrayFile) -> HeadModelFile:
    """Reads the model's arrays; landmarks of an embedding beside the file or in it."""
    count = arrays.check_vertices("v_template")
    vertices = arrays.numbers("v_template", count, 3) * _UNIT
    key = arrays.first(_FACES)
    if key is None:
        raise arrays.error(_FACES[0], "(F,3)")
    faces = arrays.indices(key, None, 3, below=count)
    basis = arrays.numbers("shapedirs", count, 3, None).permute(2, 0, 1) * _UNIT
    key = arrays.first(_EXPRESSIONS)
    if key is not None:
        identity, expressions = basis, arrays.numbers(key, count, 3, None).permute(2, 0, 1) * _UNIT
    else:
        identity, expressions = basis[:_IDENTITY], basis[_IDENTITY:]
    landmarks = _embedding(path, arrays, faces)
    joints = _joints(arrays, count)
    regions = eyeballs(joints)
    annotations = Annotations(regions=regions)
    if landmarks is not None and len(landmarks.rows) == 68:
        annotations = Annotations(landmarks.nearest(), regions)
    names = tuple(f"exp_{i:03}" for i in range(len(expressions)))
    mesh = Mesh(vertices, faces, annotations=annotations)
    licence = "as its authors say: CC-BY-4.0 for FLAME 2023 Open, research alone for others"
    return HeadModelFile(NAME, mesh, identity.contiguous(), expressions.contiguous(), names, joints, landmarks, licence)


def eyeballs(joints: HeadJoints | None) -> dict[str, Tensor]:
    """Regions of the eyeballs by the joints that turn them."""
    if joints is None:
        return {}
    rows = {side: joints.index(f"{side}_eye") for side in ("left", "right")}
    return {f"eyeball_{side}": joints.weights[:, row] > 0.5 for side, row in rows.items() if row is not None}


def _joints(arrays: ArrayFile, count: int) -> HeadJoints | None:
    key = arrays.first(_WEIGHTS)
    if key is None or "J_regressor" not in arrays:
        return None
    weights = arrays.numbers(key, count, None)
    size = weights.shape[1]
    regressor = arrays.numbers("J_regressor", size, count)
    vertices = arrays.numbers("v_template", count, 3) * _UNIT
    parents: tuple[int, ...] = (-1, 0, 1, 1, 1)[:size]
    if "kintree_table" in arrays:
        # The root's parent is -1, or 2³²-1 where it was stored without a sign.
        table = arrays.numbers("kintree_table", 2, size, finite=False)[0].tolist()
        parents = tuple(int(one) if 0 <= one < row else -1 for row, one in enumerate(table))
    if size > len(parents):
        raise arrays.error(key, f"(V,J) with at most {len(_JOINTS)} joints where no kintree_table is")
    names = _JOINTS if size == len(_JOINTS) else tuple(f"joint_{i}" for i in range(size))
    correctives = None
    if "posedirs" in arrays:
        correctives = arrays.numbers("posedirs", count, 3, 9 * (size - 1)).permute(2, 0, 1).contiguous() * _UNIT
    return HeadJoints(names, parents, regressor @ vertices, weights, regressor, correctives)


def _embedding(path: Path, arrays: ArrayFile, faces: Tensor) -> SurfacePlaces | None:
    for source in [arrays, *(ArrayFile(path.with_name(n)) for n in _EMBEDDINGS if path.with_name(n).is_file())]:
        for key, shares in _EMBEDDED:
            if key in source and shares in source:
                return _places(source, key, shares, faces)
    return None


def _places(source: ArrayFile, key: str, shares: str, faces: Tensor) -> SurfacePlaces:
    shape = source.shape(key)
    size = shape[-1] if shape else 0
    if size not in (_INNER, 68) or len(shape) > 2:
        raise source.error(key, f"the triangles of {_INNER} or 68 landmarks")
    triangles = source.indices(key, *shape, below=len(faces)).reshape(-1)
    weights = source.numbers(shares, *shape, 3).reshape(-1, 3)
    if len(triangles) != size or not bool(((weights.sum(1) - 1).abs() < 1e-2).all()):
        raise FileFormatError(
            f"{source.path}: found {shares} that do not add up to 1, expected barycentric coordinates"
        )
    return SurfacePlaces(torch.arange(68 - size, 68), faces[triangles], weights)
