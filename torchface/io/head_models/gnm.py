"""Google's GNM Head, version 3: ``gnm_head.npz`` and, beside it, the landmarks ``head_sparse_68.txt``.

Source: google/GNM (Apache-2.0), whose reader names the arrays.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.io.head_models.array_files import ArrayFile
from torchface.io.head_models.head_model_file import HeadJoints, HeadModelFile, SurfacePlaces
from torchface.mesh import Annotations, Mesh

NAME = "GNM Head"
MARKS = ("template_vertex_positions", "vertex_identity_basis")
_EXPRESSIONS = ("expression_basis", "vertex_expression_basis")
_UNIT = 1000.0
_LANDMARKS = "head_sparse_68.txt"
_MAX_TEXT = 2**16


def read_gnm(path: Path, arrays: ArrayFile) -> HeadModelFile:
    """Reads the model's arrays."""
    count = arrays.check_vertices("template_vertex_positions")
    vertices = arrays.numbers("template_vertex_positions", count, 3) * _UNIT
    faces = arrays.indices("triangles", None, 3, below=count)
    identity = arrays.numbers("vertex_identity_basis", None, count, 3) * _UNIT
    key = arrays.first(_EXPRESSIONS)
    if key is None:
        raise arrays.error(_EXPRESSIONS[0], "(E,V,3)")
    expressions = arrays.numbers(key, None, count, 3) * _UNIT
    size = len(expressions)
    names = arrays.texts("expression_names", size) if "expression_names" in arrays else ()
    landmarks = _landmarks(path, vertices)
    regions: dict[str, Tensor] = {}
    if "vertex_groups" in arrays and "vertex_group_names" in arrays:
        groups = arrays.numbers("vertex_groups", None, count)
        regions = dict(zip(arrays.texts("vertex_group_names", len(groups)), groups > 0.5, strict=True))
    mirror = arrays.indices("mirror_indices", count, below=count) if "mirror_indices" in arrays else None
    uvs = uv_faces = None
    if "triangle_uvs" in arrays:
        corners = arrays.numbers("triangle_uvs", len(faces), 3, 2)
        uvs, rows = corners.flatten(0, 1).unique(dim=0, return_inverse=True)
        uv_faces = rows.reshape(-1, 3)
    annotations = Annotations(None if landmarks is None else landmarks.nearest(), regions, mirror)
    mesh = Mesh(vertices, faces, uvs, uv_faces, annotations=annotations)
    own = names or tuple(f"expression_{i:03}" for i in range(size))
    return HeadModelFile(NAME, mesh, identity, expressions, own, _joints(arrays, count), landmarks, "Apache-2.0")


def _joints(arrays: ArrayFile, count: int) -> HeadJoints | None:
    if "skinning_weights" not in arrays or "template_joint_positions" not in arrays:
        return None
    positions = arrays.numbers("template_joint_positions", None, 3) * _UNIT
    size = len(positions)
    weights = arrays.numbers("skinning_weights", size, count).T.contiguous()
    parents = arrays.indices("joint_parent_indices", size, below=size, least=-1).tolist()
    ordered = tuple(parent if parent < row else -1 for row, parent in enumerate(parents))
    names = arrays.texts("joint_names", size) if "joint_names" in arrays else tuple(f"joint_{i}" for i in range(size))
    regressor = arrays.numbers("joint_regressor", size, count) if "joint_regressor" in arrays else None
    if regressor is not None and not bool((regressor.sum(1) - 1).abs().max() < 1e-2):
        regressor = None
    return HeadJoints(names, ordered, positions, weights, regressor)


def _landmarks(path: Path, vertices: Tensor) -> SurfacePlaces | None:
    """From the text beside the model, or where the model's repository has it; its contour in iBUG's order."""
    beside = path.with_name(_LANDMARKS), path.parents[min(2, len(path.parents) - 1)] / "landmarks" / _LANDMARKS
    found = next((file for file in beside if file.is_file()), None)
    if found is None:
        return None
    try:
        rows = np.array([line.split() for line in read_file(found, _MAX_TEXT).decode().splitlines() if line.strip()])
        table = torch.from_numpy(rows.astype(np.float64))
    except ValueError as error:
        raise FileFormatError(f"{found}: found no table of numbers ({error}), expected 68 rows of 6") from error
    if table.shape != (68, 6):
        raise FileFormatError(f"{found}: found a table of {tuple(table.shape)}, expected 68 rows of 6")
    ids, shares = table[:, ::2].long(), table[:, 1::2].float()
    if not bool(torch.isfinite(table).all()) or int(ids.min()) < 0 or int(ids.max()) >= len(vertices):
        raise FileFormatError(f"{found}: found vertices beyond the model's {len(vertices)}")
    places = SurfacePlaces(torch.arange(68), ids, shares)
    across = places.on(vertices)[:17, 0].argsort()
    order = torch.cat([across, torch.arange(17, 68)])
    return SurfacePlaces(torch.arange(68), ids[order], shares[order])
