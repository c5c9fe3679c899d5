"""A rig of film size with planted correctives, and scans of a performance of it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from planted.planted_correctives import planted_correctives
from torchface import Attachment, BlendshapeRig, Mesh
from torchface.capture import MarkerSolver
from torchface.mesh import fan_triangulation
from torchface.synthetic.head.performer import performer
from torchface.synthetic.stages.subdivision import subdivision_operator
from torchface.synthetic.stages.weight_curves import perform

SHAPES, CORRECTIVES, VERTICES = 80, 400, 10_000
NOISE, UNEXPLAINED = 0.1, 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """A rig, every vertex of which is a marker, and what was seen of a performance."""

    rig: BlendshapeRig  # of 80 shapes, 400 correctives and 10,000 vertices
    weights: Tensor  # true, (T,80)
    face: Tensor  # true vertices, (T,V,3), millimetres
    seen: Tensor  # with noise, and with smooth motion that no shape explains, (T,V,3)

    def solver(self, **terms: float) -> MarkerSolver:
        every = torch.arange(len(self.rig.vertices))
        return MarkerSolver(self.rig, Attachment.from_vertices(self.rig.neutral, every), **terms)


def film_scene(frames: int) -> Scene:
    """The scene; always the same."""
    generator = torch.Generator().manual_seed(5)
    rig = _film_rig(generator)
    weights = _weights(rig, frames, generator)
    face = rig(weights)
    spots = rig.vertices[torch.randperm(len(rig.vertices), generator=generator)[:30]]
    fields = torch.exp(-torch.cdist(rig.vertices, spots).square() / (2 * 15.0**2))
    fields = fields[..., None] * torch.randn(30, 3, generator=generator)
    fields = UNEXPLAINED * fields / fields.square().sum(-1).mean().sqrt()
    phase = torch.rand(30, generator=generator) * 6.28
    sway = torch.sin(torch.arange(frames)[:, None] / 60 * 2 + phase) / 30**0.5
    seen = face + torch.einsum("tk,vkc->tvc", sway, fields * 30**0.5)
    return Scene(rig, weights, face, seen + NOISE * torch.randn(face.shape, generator=generator))


def _film_rig(generator: torch.Generator) -> BlendshapeRig:
    coarse = performer(texture=False)
    mesh = coarse.neutral
    operator, quads = subdivision_operator(mesh.polygons, len(mesh.vertices))
    stacked = torch.cat([coarse.vertices[None], coarse.deltas]).permute(1, 0, 2).flatten(1).double()
    fine = torch.from_numpy(operator @ stacked.numpy()).unflatten(1, (-1, 3)).permute(1, 0, 2).float()
    deltas, names = fine[1:], list(coarse.names)
    reach = deltas.norm(dim=-1)
    spots = fine[0][reach.amax(0).argsort(descending=True)[:6000][torch.randperm(6000, generator=generator)]]
    copies = []
    for number in range(SHAPES - len(names)):
        row = int(torch.randint(len(coarse.names), (), generator=generator))
        near = torch.exp(-(fine[0] - spots[number]).square().sum(-1) / (2 * 20.0**2))
        copies.append(deltas[row] * near[:, None] * 1.5)
        names.append(f"{coarse.names[row]}Local{number}")
    whole = BlendshapeRig(Mesh(fine[0], fan_triangulation(quads)), torch.cat([deltas, torch.stack(copies)]), names)
    kept = whole.deltas.norm(dim=-1).amax(0).argsort(descending=True)[:VERTICES]
    mask = torch.zeros(len(fine[0]), dtype=torch.bool)
    mask[kept] = True
    used = torch.zeros_like(mask)
    used[whole.neutral.faces[mask[whole.neutral.faces].all(1)].flatten()] = True
    part = whole.part(used)
    return BlendshapeRig(part.neutral, part.deltas, part.names, planted_correctives(part, CORRECTIVES))


def _weights(rig: BlendshapeRig, frames: int, generator: torch.Generator) -> Tensor:
    takes = [perform(frames, generator).weights for _ in range(2)]
    weights = torch.zeros(frames, SHAPES)
    for i, name in enumerate(rig.names):
        take = takes[1 if "Local" in name else 0]
        weights[:, i] = take.values[:, take.names.index(name.split("Local")[0]), 0]
    return weights
