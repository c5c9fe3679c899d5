"""Head models in the layouts in which others publish theirs, made of the embedded performer's head."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, neutral_head, performer

PEOPLE = 8


def head() -> BlendshapeRig:
    """The performer, whose shapes the expressions of the models are made of."""
    return performer(texture=False)


def identity_modes() -> Tensor:
    """How some performers differ from the first, (K,V,3), millimetres."""
    drawn = draw_identities(PEOPLE, torch.Generator().manual_seed(3))
    rest = head().vertices
    return torch.stack([neutral_head(one, texture=False).vertices - rest for one in drawn]) / PEOPLE**0.5


def expression_basis(rig: BlendshapeRig) -> Tensor:
    """Orthogonal directions in which the performer's shapes lie, (E,V,3), millimetres."""
    _, size, directions = torch.linalg.svd(rig.deltas.flatten(1).double(), full_matrices=False)
    return (size[:, None] / len(size) ** 0.5 * directions).float().unflatten(1, rig.vertices.shape)


def codes(rig: BlendshapeRig, basis: Tensor, weights: Tensor) -> Tensor:
    """The expression parameters (T,E) of weights (T,N)."""
    moved = (weights @ rig.deltas.flatten(1)).double()
    flat = basis.flatten(1).double()
    return torch.linalg.solve(flat @ flat.T, flat @ moved.T).T.float()


def flame_arrays(rig: BlendshapeRig, shapes: int = 300) -> dict[str, Any]:
    """FLAME's arrays in metres: root, neck, jaw and eyes; the jaw turns the chin."""
    regions = rig.neutral.annotations.regions  # type: ignore[union-attr]
    vertices = rig.vertices.numpy() / 1000
    count = len(vertices)
    identity = identity_modes()
    basis = torch.zeros(shapes + len(rig.names), count, 3)
    basis[: len(identity)] = identity
    basis[shapes:] = expression_basis(rig)
    opened = rig.deltas[rig.index(["jawOpen"])[0]].norm(dim=1)
    weights = torch.zeros(count, 5)
    weights[:, 2] = (opened / opened.max() * 1.2).clamp(max=1)
    for row, side in ((3, "left"), (4, "right")):
        weights[regions[f"eyeball_{side}"]] = torch.eye(5)[row]
    weights[:, 1] = 1 - weights.sum(1)
    regressor = np.zeros((5, count))
    for row, name in enumerate(("neck", "neck", "ear_left", "eyeball_left", "eyeball_right")):
        mask = regions[name] | regions["ear_right"] if row == 2 else regions[name]
        regressor[row, mask.numpy()] = 1 / int(mask.sum())
    faces, inner = rig.neutral.faces, rig.neutral.landmarks[17:]
    triangle = torch.stack([(faces == one).any(1).nonzero()[0, 0] for one in inner])
    return {
        "v_template": vertices,
        "shapedirs": basis.permute(1, 2, 0).numpy() / 1000,
        "f": rig.neutral.faces.numpy().astype(np.uint32),
        "J_regressor": regressor,
        "weights": weights.numpy(),
        "posedirs": np.zeros((count, 3, 36), np.float32),
        "lmk_face_idx": triangle.numpy(),
        "lmk_b_coords": (faces[triangle] == inner[:, None]).float().numpy(),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]]),
    }


def gnm_arrays(rig: BlendshapeRig) -> dict[str, Any]:
    """GNM Head's arrays in metres."""
    vertices = rig.vertices.numpy() / 1000
    count, notes = len(vertices), rig.neutral.annotations
    assert notes is not None
    basis = expression_basis(rig).numpy() / 1000
    return {
        "version": np.array("3.0"),
        "variant": np.array("head"),
        "template_vertex_positions": vertices,
        "template_joint_positions": np.zeros((2, 3)),
        "joint_names": np.array(["neck", "head"]),
        "joint_parent_indices": np.array([-1, 0]),
        "skinning_weights": np.stack([np.zeros(count), np.ones(count)]),
        "vertex_identity_basis": identity_modes().numpy() / 1000,
        "expression_basis": basis,
        "expression_names": np.array([f"lower_face_region_{i:03}" for i in range(len(basis))]),
        "triangles": rig.neutral.faces.numpy(),
        "triangle_uvs": rig.neutral.uvs[rig.neutral.uv_faces].numpy(),  # type: ignore[index]
        "vertex_groups": np.stack([mask.numpy() for mask in notes.regions.values()]).astype(np.float32),
        "vertex_group_names": np.array(list(notes.regions)),
        "mirror_indices": notes.mirror.numpy(),  # type: ignore[union-attr]
    }


def gnm_landmarks(rig: BlendshapeRig, path: Path) -> None:
    """GNM's text of the 68, part of its contour in another order."""
    ids = rig.neutral.landmarks[[0, 1, 6, 5, 4, 3, 2, *range(7, 68)]].tolist()
    path.write_text("".join(f"{i} 0.5 {i} 0.25 {i} 0.25\n" for i in ids))


def mhr_arrays(rig: BlendshapeRig) -> dict[str, Any]:
    """A level of detail of MHR in centimetres: 45 ways to differ, 72 expressions."""
    identity = torch.zeros(45, *rig.vertices.shape)
    identity[:PEOPLE] = identity_modes()
    expressions = torch.zeros(72, *rig.vertices.shape)
    expressions[24] = rig.deltas[rig.index(["jawOpen"])[0]]
    return {
        "schema_version": np.array(1),
        "lod": np.array(3),
        "base_shape": rig.vertices.numpy() / 10,
        "shape_vectors": torch.cat([identity, expressions]).numpy() / 10,
        "faces": rig.neutral.faces.numpy().astype(np.int32),
    }


def write_basel(rig: BlendshapeRig, path: Path) -> None:
    """The Basel Face Model's HDF5 in millimetres."""
    import h5py

    with h5py.File(path, "w") as file:
        for kind, modes in (("shape", identity_modes()), ("expression", expression_basis(rig))):
            flat = modes.flatten(1).double()
            deviation = flat.norm(dim=1)
            file[f"{kind}/model/pcaBasis"] = (flat / deviation[:, None]).T.float().numpy()
            file[f"{kind}/model/pcaVariance"] = deviation.square().float().numpy()
            file[f"{kind}/model/mean"] = (rig.vertices * (kind == "shape")).flatten().numpy()
            file[f"{kind}/representer/cells"] = rig.neutral.faces.T.numpy().astype(np.int32)
        file["color/model/mean"] = np.full(rig.vertices.numel(), 0.5, np.float32)
        nose, left, right = (rig.vertices[rig.neutral.landmarks[row]].tolist() for row in (30, 45, 36))
        named = {"center.nose.tip": nose, "left.eye.corner_outer": left, "right.eye.corner_outer": right}
        text = str([{"id": name, "coordinates": at} for name, at in named.items()]).replace("'", '"')
        file["metadata/landmarks/json"] = np.frombuffer(text.encode(), np.uint8)


def write_eos(rig: BlendshapeRig, path: Path) -> None:
    """A model of eos, version 4: shape, colour, blendshapes, the 68 landmarks by number."""
    faces, count = rig.neutral.faces.numpy(), len(rig.vertices)

    def matrix(values: Tensor) -> bytes:  # column by column
        return struct.pack("<ii", *values.shape) + values.T.contiguous().float().numpy().astype("<f4").tobytes()

    def triangles(rows: np.ndarray) -> bytes:
        return struct.pack("<Q", len(rows)) + rows.astype("<i4").tobytes()

    def model(mean: Tensor, modes: Tensor) -> bytes:
        flat = modes.flatten(1).double()
        deviation = flat.norm(dim=1)
        basis = (flat / deviation[:, None]).T
        return matrix(mean.reshape(-1, 1)) + matrix(basis) + matrix(deviation.square()[:, None]) + triangles(faces)

    pieces = [struct.pack("<I", 4), model(rig.vertices, identity_modes())]
    pieces.append(model(torch.full((count, 3), 0.5), torch.eye(3 * count)[:1].reshape(1, count, 3)))
    basis = expression_basis(rig)
    pieces.append(struct.pack("<BiQ", 0, 1, len(basis)))
    for row, delta in enumerate(basis):
        name = f"shape_{row}".encode()
        pieces.append(struct.pack("<Q", len(name)) + name + matrix(delta.reshape(-1, 1)))
    pieces.append(struct.pack("<BQ", 0, 68))
    for row, vertex in enumerate(rig.neutral.landmarks.tolist()):
        name = str(row + 1).encode()
        pieces.append(struct.pack("<Q", len(name)) + name + struct.pack("<i", vertex))
    pieces.append(struct.pack("<QQ", 0, 0))
    path.write_bytes(b"".join(pieces))
