"""Correctives for a rig that has none, of a known truth: smooth, local, where shapes overlap."""

import torch
from torch import Tensor

from torchface import BlendshapeRig, Corrective, Correctives

_IN_BETWEENS, _TRIPLES = 0.1, 0.15
_PEAKS = (0.35, 0.5, 0.65)
_DRAWS = 20  # a corrective


def planted_correctives(rig: BlendshapeRig, count: int, size: float = 0.3, seed: int = 0) -> Correctives:
    r"""Correctives that move each vertex by a share of how far all their drivers do.

    .. math:: D_c = s \, \Big( \prod_{i \in c} \lVert A_i - A_0 \rVert \Big)^{1/|c|} u_c

    with a direction :math:`u_c` each: smooth and local as the shapes are, and 0 wherever one of them is. A tenth are
    in-betweens, a seventh products of three shapes, the others of two; of drivers that are drawn, those that overlap
    most are taken.

    Args:
        rig: N shapes; its own correctives do not count.
        count: C, how many.
        size: :math:`s`.
        seed: of the draw.
    """
    generator = torch.Generator().manual_seed(seed)
    reach = rig.deltas.detach().norm(dim=-1)
    shapes = len(rig.names)
    betweens = min(round(_IN_BETWEENS * count), shapes)
    triples = round(_TRIPLES * count) if shapes > 2 else 0
    groups: list[tuple[int, ...]] = [(i,) for i in torch.randperm(shapes, generator=generator)[:betweens].tolist()]
    for drivers, wanted in ((3, triples), (2, count - betweens - triples)):
        groups += _overlapping(reach, drivers, wanted, generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    definitions, deltas = [], []
    for number, group in enumerate(groups):
        names = tuple(rig.names[i] for i in group)
        peak = _PEAKS[number % len(_PEAKS)] if len(group) == 1 else None
        definitions.append(Corrective(f"corrective_{number:03d}", names, peak))
        far = reach[list(group)].prod(0) ** (1 / len(group))
        deltas.append(size * far[:, None] * directions[number].to(reach))
    return Correctives(torch.stack(deltas), tuple(definitions))


def _overlapping(reach: Tensor, drivers: int, count: int, generator: torch.Generator) -> list[tuple[int, ...]]:
    """Of groups of shapes that are drawn, those that move a vertex farthest together."""
    drawn = torch.rand(_DRAWS * max(count, 1), len(reach), generator=generator).argsort(1)[:, :drivers]
    groups = drawn.sort(1).values.unique(dim=0)
    # A thousand vertices tell how far shapes overlap.
    some = reach[:, :: max(1, reach.shape[1] // 1000)]
    together = torch.stack([some[group].prod(0).amax() for group in groups])
    order = together.argsort(descending=True)[:count]
    return [tuple(groups[i].tolist()) for i in order if together[i] > 0]
