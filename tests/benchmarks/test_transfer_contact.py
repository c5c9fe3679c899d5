"""Claim: on 20 random heads lids and lips close as the template's do; transfer of 53 shapes takes seconds.

Lid contours are the rings of vertices that carry the template's eyelid landmarks; lip contours the three rings at the
edge where the lips meet. Gaps of lids are distances from each contour vertex to the other contour's line. Lips pass
through each other in the template's own shapes, so their gap is signed: along the normal between a vertex and
its nearest on the other lip, both fixed in the template's neutral. The opening is what stays open between the surfaces.
"""

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchface.geometry.meshes.deformation import deformation_gradients
from torchface.geometry.meshes.operators import border_vertices, components, edges, triangle_normals, vertex_normals
from torchface.io.rigs.ict_facekit import load_ict_facekit, load_identity_modes
from torchface.mesh import Mesh
from torchface.modeling.rigging.deformation_transfer import CONTACT_WEIGHT, transfer_with_report
from torchface.rig import BlendshapeRig

pytestmark = pytest.mark.real

SHAPES = ["eyeBlink_L", "eyeBlink_R", "mouthPress_L", "mouthPress_R", "mouthPucker", "jawOpen", "mouthClose"]
LIP_POSES = {
    "mouthPress": [0, 0, 1, 1, 0, 0, 0],
    "mouthPucker": [0, 0, 0, 0, 1, 0, 0],
    "0.3 (jawOpen+mouthClose)": [0, 0, 0, 0, 0, 0.3, 0.3],
}


def rings(mesh: Mesh, start: Tensor, count: int) -> list[Tensor]:
    """Vertices 0, 1, ... quads away from ``start``."""
    found, used = [start], torch.zeros(len(mesh.vertices), dtype=torch.bool)
    used[start] = True
    for _ in range(count):
        touched = mesh.polygons[torch.isin(mesh.polygons, found[-1]).any(1)].flatten()
        following = touched[touched >= 0].unique()
        following = following[~used[following]]
        used[following] = True
        found.append(following)
    return found


def openings(mesh: Mesh) -> list[Tensor]:
    """The borders of the face part: one vertex set a hole, smallest first (eyes, mouth, outer edge)."""
    border = border_vertices(mesh.faces, len(mesh.vertices))
    joined = edges(mesh.faces)
    joined = joined[border[joined].all(1)]
    label = components(torch.cat([joined, joined[:, :1]], dim=1), len(mesh.vertices))
    holes = [(label == k).nonzero()[:, 0] for k in label[border].unique()]
    return sorted(holes, key=len)


class Lid:
    """One eye's two lid contours, separated by what the blink moves down."""

    def __init__(self, rig: BlendshapeRig, hole: Tensor, blink: int) -> None:
        ring = rings(rig.neutral, hole, 2)[2]
        self.blink = blink
        falls = rig.deltas[blink, ring, 1] < -1
        self.upper, self.lower = ring[falls], ring[~falls]
        quads = rig.neutral.polygons
        side = torch.cat([quads, quads[:, :1]], dim=1)
        along = torch.cat([side[:, i : i + 2] for i in range(4)])
        along = along[(along >= 0).all(1)]
        self.lines = [along[torch.isin(along, part).all(1)] for part in (self.lower, self.upper)]
        at_rest, shut = self.gaps(rig.vertices), self.gaps(rig.vertices + rig.deltas[blink])
        # The corner point itself belongs to both lids and does not close.
        self.closes = shut < 0.6 * at_rest
        self.template = shut[self.closes]

    def gaps(self, at: Tensor) -> Tensor:
        return torch.cat(
            [to_lines(at[part], at[line]) for part, line in zip((self.upper, self.lower), self.lines, strict=True)]
        )

    def excess(self, at: Tensor) -> Tensor:
        return self.gaps(at)[self.closes] - self.template


def to_lines(points: Tensor, lines: Tensor) -> Tensor:
    """Distances (P,) of points (P,3) to the nearest of some segments (L,2,3)."""
    start, along = lines[:, 0], lines[:, 1] - lines[:, 0]
    share = ((points[:, None] - start) * along).sum(-1) / along.square().sum(-1)
    return (points[:, None] - start - share.clamp(0, 1)[..., None] * along).norm(dim=-1).amin(1)


class Lips:
    """Pairs of upper and lower lip vertices on the rings where the lips meet, fixed in the template's neutral."""

    def __init__(self, rig: BlendshapeRig, hole: Tensor) -> None:
        edge = torch.cat(rings(rig.neutral, hole, 7)[5:8])
        at, fall = rig.vertices, -rig.deltas[SHAPES.index("jawOpen"), :, 1]
        near = torch.cdist(at[edge], at[edge])
        normals = vertex_normals(at, rig.neutral.faces)
        opposed = (normals[edge] @ normals[edge].T < 0) & (near < 1.5)
        first, second = near.masked_fill(~opposed, torch.inf).min(1).indices, torch.arange(len(edge))
        kept = opposed.any(1)
        pairs = torch.stack([edge[second[kept]], edge[first[kept]]], dim=1)
        swap = fall[pairs[:, 0]] > fall[pairs[:, 1]]
        pairs = torch.where(swap[:, None], pairs.flip(1), pairs)
        # At the corners of the mouth there is no upper and lower lip.
        self.upper, self.lower = pairs[(fall[pairs[:, 1]] - fall[pairs[:, 0]]) > 2].unique(dim=0).T
        self.across = torch.nn.functional.normalize(normals[self.upper] - normals[self.lower], dim=-1)

    def gaps(self, at: Tensor) -> Tensor:
        return ((at[self.lower] - at[self.upper]) * self.across).sum(-1)


def posed(rig: BlendshapeRig, weights: list[float]) -> Tensor:
    return rig(torch.tensor([weights], dtype=rig.deltas.dtype))[0]


def flipped(template: BlendshapeRig, rig: BlendshapeRig, shape: int) -> int:
    """Triangles whose normal in the shape opposes both the one at rest and the one that the template's gradient gives.

    A lid may turn by more than a right angle in the template's blink; a sliver in its corner may also turn by less.
    """
    faces = rig.neutral.faces
    gradients = deformation_gradients(template.vertices, template.vertices + template.deltas[shape], faces)
    cofactors = torch.linalg.inv(gradients).transpose(-1, -2)
    wanted = (cofactors @ triangle_normals(rig.vertices, faces)[..., None])[..., 0]
    wanted = wanted * torch.linalg.det(gradients).sign()[:, None]
    found = triangle_normals(rig.vertices + rig.deltas[shape], faces)
    at_rest = triangle_normals(rig.vertices, faces)
    return int((((wanted * found).sum(-1) < 0) & ((at_rest * found).sum(-1) < 0)).sum())


@pytest.fixture(scope="module")
def template(ict_folder: Path) -> BlendshapeRig:
    return load_ict_facekit(ict_folder, SHAPES, part="face").double()


def test_lids_and_lips_of_twenty_random_heads(template: BlendshapeRig, ict_folder: Path) -> None:
    modes = load_identity_modes(ict_folder, part="face")
    eyes = sorted(openings(template.neutral)[:2], key=lambda hole: -float(template.vertices[hole, 0].mean()))
    lids = [Lid(template, hole, blink) for blink, hole in enumerate(eyes)]
    lips = Lips(template, openings(template.neutral)[2])
    table: dict[float, list[list[float]]] = {0.0: [], CONTACT_WEIGHT: []}
    flips: dict[float, list[int]] = {0.0: [], CONTACT_WEIGHT: []}
    for seed in range(20):
        generator = np.random.default_rng(seed)
        head = modes.head(torch.from_numpy(generator.standard_normal(len(modes.names))).float())
        head = head.with_vertices(head.vertices.double())
        for weight in table:
            rig = transfer_with_report(template, head, contact_weight=weight).rig
            row = [float(lid.excess(rig.vertices + rig.deltas[lid.blink]).max()) for lid in lids]
            for weights in LIP_POSES.values():
                change = lips.gaps(posed(rig, weights)) - lips.gaps(rig.vertices)
                expected = lips.gaps(posed(template, weights)) - lips.gaps(template.vertices)
                row.append(float((change - expected).max()))
            table[weight].append(row)
            flips[weight].append(sum(flipped(template, rig, lid.blink) for lid in lids))
    heading = ["lids, left", "lids, right", *LIP_POSES]
    print(f"\nexcess over the template's gap, mm: 20 heads ({len(lips.upper)} pairs of lip vertices)")
    print(f"{'':28s}{'without contact':>32s}{'with contact':>32s}")
    print(f"{'':28s}" + f"{'mean of heads':>20s}{'worst':>12s}" * 2)
    without, with_contact = (np.array(table[weight]) for weight in table)
    for column, name in enumerate(heading):
        cells = [f"{rows[:, column].mean():20.3f}{rows[:, column].max():12.3f}" for rows in (without, with_contact)]
        print(f"{name:28s}{''.join(cells)}")
    newly = max(b - a for a, b in zip(flips[0.0], flips[CONTACT_WEIGHT], strict=True))
    print(f"triangles flipped in the blinks: {sum(flips[0.0])} without, {sum(flips[CONTACT_WEIGHT])} with contact")
    assert with_contact[:, :2].max() <= 0.2
    assert with_contact[:, 2:].max() <= 0.3
    assert without[:, :2].max() > 1.0
    assert newly <= 0


@pytest.mark.parametrize(("part", "limit"), [("face", 2.0), (None, 6.0)])
def test_all_shapes_in_seconds(part: str | None, limit: float, ict_folder: Path) -> None:
    rig = load_ict_facekit(ict_folder, part=part)
    head = load_identity_modes(ict_folder, part=part).random_head(0)
    wall, processor = [], []
    for _ in range(3):
        start, worked = time.perf_counter(), time.process_time()
        transfer_with_report(rig, head)
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - worked)
    print(
        f"\n{len(rig.names)} shapes on {len(rig.vertices)} vertices: {min(wall):.2f} s, "
        f"{min(processor):.2f} s of processor time (limit {limit:.0f} s)"
    )
    # What others do on the machine lengthens the wait, not the work.
    assert min(min(wall), min(processor)) <= limit
