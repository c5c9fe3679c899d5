"""The meshes of a scene put together as one rig."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

from torchface.mesh import Annotations, Mesh


@dataclass(frozen=True)
class Piece:
    """A mesh of a scene, in millimetres and the scene's place."""

    name: str  # of the node or prim; the region that it becomes
    vertices: Tensor  # (V,3)
    faces: Tensor
    uvs: Tensor | None  # (U,2)
    uv_faces: Tensor | None  # (F,3)
    colors: Tensor | None  # (V,3)
    polygons: Tensor | None  # (P,K), padded with -1
    annotations: Annotations | None
    deltas: Tensor  # (N,V,3)
    names: tuple[str, ...]  # of its N shapes


def all_names(pieces: Sequence[Piece]) -> tuple[str, ...]:
    """The names of all shapes, each once."""
    return tuple(dict.fromkeys(name for piece in pieces for name in piece.names))


def joined_size(pieces: Sequence[Piece]) -> int:
    """Bytes that shapes and regions take when pieces are joined; none for a single one."""
    total = sum(len(piece.vertices) for piece in pieces)
    return 0 if len(pieces) == 1 else (12 * len(all_names(pieces)) + len(pieces)) * total


def join_deltas(pieces: Sequence[Piece]) -> Tensor:
    """The deltas of all shapes of ``all_names`` over all vertices; a piece that lacks a shape does not move by it."""
    if len(pieces) == 1:
        return pieces[0].deltas
    row = {name: i for i, name in enumerate(all_names(pieces))}
    deltas = torch.zeros(len(row), sum(len(piece.vertices) for piece in pieces), 3)
    first = 0
    for piece in pieces:
        deltas[[row[name] for name in piece.names], first : first + len(piece.vertices)] = piece.deltas
        first += len(piece.vertices)
    return deltas


def join_meshes(pieces: Sequence[Piece], texture: Tensor | None) -> Mesh:
    """One mesh of all; of several, each piece becomes a region."""
    if len(pieces) == 1:
        only, notes = pieces[0], pieces[0].annotations
        if notes is not None and notes.landmarks is not None and bool((notes.landmarks < 0).any()):
            notes = replace(notes, landmarks=None)
        return Mesh(only.vertices, only.faces, only.uvs, only.uv_faces, only.colors, texture, only.polygons, notes)
    counts = [len(piece.vertices) for piece in pieces]
    faces = torch.cat([piece.faces + first for piece, first in zip(pieces, _starts(counts), strict=True)])
    uvs = uv_faces = colors = None
    if any(piece.uvs is not None for piece in pieces):
        sets = [torch.zeros(1, 2) if piece.uvs is None else piece.uvs for piece in pieces]
        rows = [torch.zeros_like(piece.faces) if piece.uv_faces is None else piece.uv_faces for piece in pieces]
        uvs = torch.cat(sets)
        uv_faces = torch.cat([row + first for row, first in zip(rows, _starts(list(map(len, sets))), strict=True)])
    if any(piece.colors is not None for piece in pieces):
        colors = torch.cat([torch.ones_like(p.vertices) if p.colors is None else p.colors for p in pieces])
    regions: dict[str, Tensor] = {}
    owner = torch.repeat_interleave(torch.arange(len(pieces)), torch.tensor(counts))
    for i, piece in enumerate(pieces):
        own = {} if piece.annotations is None else piece.annotations.regions
        for name, mask in {piece.name: torch.ones(counts[i], dtype=torch.bool), **own}.items():
            regions.setdefault(name, torch.zeros(len(owner), dtype=torch.bool))[owner == i] |= mask
    vertices = torch.cat([piece.vertices for piece in pieces])
    annotations = Annotations(_join_landmarks(pieces, counts), regions)
    return Mesh(vertices, faces, uvs, uv_faces, colors, texture, _join_polygons(pieces, counts), annotations)


def _join_landmarks(pieces: Sequence[Piece], counts: list[int]) -> Tensor | None:
    """Landmarks of which each piece knows its own, -1 those of others; none where some are of no piece."""
    joined: Tensor | None = None
    for piece, first in zip(pieces, _starts(counts), strict=True):
        marks = None if piece.annotations is None else piece.annotations.landmarks
        if marks is not None:
            joined = torch.full_like(marks, -1) if joined is None else joined
            if len(marks) == len(joined):
                joined = torch.where((joined < 0) & (marks >= 0), marks + first, joined)
    return None if joined is None or bool((joined < 0).any()) else joined


def _join_polygons(pieces: Sequence[Piece], counts: list[int]) -> Tensor | None:
    """All polygons, (P,K), triangles of pieces without any among them; none where no piece has some."""
    if all(piece.polygons is None for piece in pieces):
        return None
    polygons = [piece.faces if piece.polygons is None else piece.polygons for piece in pieces]
    widest = max(rows.shape[1] for rows in polygons)
    padded = []
    for rows, first in zip(polygons, _starts(counts), strict=True):
        moved = torch.where(rows < 0, rows, rows + first)
        padded.append(torch.nn.functional.pad(moved, (0, widest - rows.shape[1]), value=-1))
    return torch.cat(padded)


def _starts(counts: list[int]) -> list[int]:
    return [0, *accumulate(counts[:-1])]
