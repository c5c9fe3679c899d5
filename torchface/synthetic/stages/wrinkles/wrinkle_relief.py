"""The form of folded skin: how each vertex moves in the skin's own frame when a line near it folds."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.mesh import Mesh
from torchface.synthetic.stages.wrinkles.dense_surface import tangent_directions, vertex_spacing
from torchface.synthetic.stages.wrinkles.wrinkle_lines import WrinkleLine

_REACH = 2.6  # widths of a line to either side beyond which skin stays
_BOTTOM = 0.32  # millimetres: half width of the sharp bottom of a valley
_SHARP = 0.45  # share of the depth that comes late and is sharp
_PULL = 0.38  # how far a valley's sides come together, as a share of its depth
_GAUGE_STEP = 2.0  # millimetres between places along a line where the compression is measured
_LEAST_HALF = 1.8  # millimetres to either side: a shorter gauge would measure the mesh
_LEAST_RELIEF = 1e-5  # millimetres
_SAME_WAY = 0.2  # cosine to the line's normal below which a vertex belongs to another layer


@dataclass(frozen=True, eq=False)
class WrinkleRelief:
    """What the lines do to a dense face, linear in how far each has folded and in the square of it."""

    # From folding and its square at the gauges, (2G,), to displacement in the skin's frame, (3V,): along the normal,
    # then along both tangents; millimetres.
    relief: sparse.csr_array
    before: sparse.csr_array  # barycentric places of the gauges' ends on one side of their lines, (G,V)
    behind: sparse.csr_array
    along: sparse.csr_array  # averages along each line, (G,G)
    trace: Tensor  # share of folding at rest, (G,)
    line: Tensor  # which line each gauge belongs to, (G,) int64


def wrinkle_relief(neutral: Mesh, lines: list[WrinkleLine]) -> WrinkleRelief:
    """The lines planted on a dense face (V vertices)."""
    skin = _Skin(neutral)
    parts, first = [], 0
    for number, line in enumerate(lines):  # a hundred lines, each a batch over its vertices
        part = _plant(skin, line, first, number)
        parts.append(part)
        first += len(part.trace)
    join = lambda values: np.concatenate(list(values))  # noqa: E731
    count = 3 * len(neutral.vertices)
    relief = sparse.csr_array(
        (join(p.value for p in parts), (join(p.row for p in parts), join(p.column for p in parts))),
        shape=(count, 2 * first),
    )
    return WrinkleRelief(
        relief.astype(np.float32),
        sparse.vstack([p.before for p in parts], format="csr"),
        sparse.vstack([p.behind for p in parts], format="csr"),
        sparse.block_diag([p.along for p in parts], format="csr"),
        torch.from_numpy(join(p.trace for p in parts)).float(),
        torch.from_numpy(join(np.full(len(p.trace), k) for k, p in enumerate(parts))),
    )


@dataclass(frozen=True, eq=False)
class _Planted:
    row: np.ndarray
    column: np.ndarray
    value: np.ndarray
    before: sparse.csr_array
    behind: sparse.csr_array
    along: sparse.csr_array
    trace: np.ndarray


class _Skin:
    def __init__(self, neutral: Mesh) -> None:
        self.vertices = neutral.vertices.double()
        self.normals = vertex_normals(self.vertices, neutral.faces)
        self.directions = tangent_directions(self.normals)
        self.spacing = vertex_spacing(neutral).double()
        self.faces = neutral.faces
        self.tree = cKDTree(self.vertices.numpy())


def _plant(skin: _Skin, line: WrinkleLine, first: int, number: int) -> _Planted:
    """One line, whose gauges are counted from ``first``."""
    points = line.points
    corner = skin.faces[line.triangle]
    normal = torch.nn.functional.normalize((skin.normals[corner] * line.barycentric[..., None]).sum(1), dim=1)
    course = torch.gradient(points, dim=0)[0]
    across = torch.nn.functional.normalize(torch.linalg.cross(normal, course), dim=1)
    stops, along = _gauges(points)
    # A fold with an overhang is made by what slides over it: there the gauge reaches out further.
    half = max(_LEAST_HALF, 1.3 * line.width)
    before = _on_skin(skin, points[stops] + half * (1 + 4 * line.overhang) * across[stops])
    behind = _on_skin(skin, points[stops] - half * (1 - line.overhang) * across[stops])

    vertex, nearest = _beside(skin, line, normal)
    signed = ((skin.vertices[vertex] - points[nearest]) * across[nearest]).sum(1)
    height, late, side = _profile(signed, line, skin.spacing[vertex])
    lateral = [side * (across[nearest] * way[vertex]).sum(1) for way in skin.directions]
    place = nearest.double() / (len(points) - 1)
    amount = _envelope(place, number) * line.depth
    position = place * (len(stops) - 1)
    low = position.long().clamp(max=len(stops) - 2)
    row, column, value = [], [], []
    for gauge, share in ((low, 1 - (position - low)), (low + 1, position - low)):
        forms = ((0, 0, height * (1 - _SHARP)), (0, 1, late * _SHARP), (1, 0, lateral[0]), (2, 0, lateral[1]))
        for axis, power, form in forms:
            row.append(vertex + axis * len(skin.vertices))
            column.append(2 * (gauge + first) + power)
            value.append(form * amount * share)
    rows, columns, values = torch.cat(row).numpy(), torch.cat(column).numpy(), torch.cat(value).numpy()
    seen = np.abs(values) > _LEAST_RELIEF
    trace = np.full(len(stops), line.trace)
    return _Planted(rows[seen], columns[seen], values[seen], before, behind, along, trace)


def _beside(skin: _Skin, line: WrinkleLine, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices that a line moves, (P,), and the point of the line next to each, (P,)."""
    reach = _REACH * line.width
    found = skin.tree.query_ball_point(line.points[::8].numpy(), reach + 1.0)
    near = np.unique(np.concatenate([np.asarray(some, np.int64) for some in found]))
    distance, nearest = cKDTree(line.points.numpy()).query(skin.vertices[near].numpy())
    same_layer = (skin.normals[near] * normal[nearest]).sum(1).numpy() > _SAME_WAY
    belongs = (distance < reach) & same_layer
    return torch.from_numpy(near[belongs]), torch.from_numpy(nearest[belongs])


def _profile(signed: Tensor, line: WrinkleLine, spacing: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Height early and late in folding and motion across, as shares of the depth, at signed distances (P,).

    A wide valley between round ridges comes first, as much above the skin as below; its sharp bottom follows. A mesh
    shows no form narrower than its edges, so the bottom is as wide as they need and less deep.
    """
    wide = 0.45 * line.width
    bell = lambda x, size: (-0.5 * (x / size).square()).exp()  # noqa: E731
    ridges = bell(signed.abs() - 2 * wide, wide)
    height = -bell(signed, wide) + 0.5 * ridges
    bottom = (_BOTTOM**2 + (0.8 * spacing).square()).sqrt()
    rounded = (signed.square() + (0.4 * bottom).square()).sqrt() - 0.4 * bottom
    late = -(-rounded / bottom).exp() * (_BOTTOM / bottom).sqrt() + 0.25 * ridges
    side = -_PULL * signed / wide * bell(signed, wide)
    if line.overhang:
        ridge = bell(signed - 2.2 * wide, 1.3 * wide)
        height = height + line.overhang * ridge
        side = side - line.overhang * ridge
    return height, late, side


def _envelope(place: Tensor, number: int) -> Tensor:
    """How deep a line is along its length, (P,): it fades out at both ends and is uneven between."""
    ends = (place * (1 - place) * 4).clamp(min=0).sqrt()
    phase = 2.399963 * number
    uneven = 0.78 + 0.22 * (2 * torch.pi * (1.7 * place) + phase).sin() * (2 * torch.pi * 3.1 * place + 2 * phase).cos()
    return ends * uneven


def _gauges(points: Tensor) -> tuple[Tensor, sparse.csr_array]:
    """Rows of the points where compression is measured, and the average along the line that smooths it."""
    length = 0.25 * (len(points) - 1)
    count = max(2, round(length / _GAUGE_STEP) + 1)
    stops = torch.linspace(0, len(points) - 1, count).round().long()
    apart = (stops[:, None] - stops).double() * 0.25
    weight = (-0.5 * (apart / 2.5).square()).exp()
    return stops, sparse.csr_array((weight / weight.sum(1, keepdim=True)).numpy())


def _on_skin(skin: _Skin, places: Tensor) -> sparse.csr_array:
    """Places near the skin as weights of its vertices, (G,V): the nearest ones, by distance."""
    distance, vertex = skin.tree.query(places.numpy(), k=4)
    weight = 1 / (distance**2 + 1e-3)
    weight /= weight.sum(1, keepdims=True)
    row = np.repeat(np.arange(len(places)), 4)
    return sparse.csr_array((weight.ravel(), (row, vertex.ravel())), shape=(len(places), len(skin.vertices)))
