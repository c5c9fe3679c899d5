"""A marker stage: any rig, moved by any weights, seen through the flaws of a real capture.

Noise, gaps, labels that swap, markers that stand off the skin, a helmet that slips; what was true comes back beside it.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track

_VISIBLE_FROM = 75.0

__all__ = ["LabelSwap", "Recording", "StageFlaws", "place_markers", "record"]


def place_markers(rig: BlendshapeRig, count: int = 100) -> Attachment:
    """Markers spread over the skin that moves, denser where it moves more, as a make-up artist would set them.

    The spots are vertices of the largest connected part that some shape moves by at least a millimetre, that
    face the viewer and that nothing hides. The next spot is always the one farthest from those set, distance
    weighted by the square root of how far the vertex moves; the result is deterministic.

    Args:
        rig: any rig; a region ``face`` in its annotations narrows the choice, and lid rims and contact vertices are
            left out, where annotated.
        count: how many, M.

    Returns:
        An attachment (M,) with labels ``M001``, ...

    Raises:
        ValueRangeError: fewer than ``count`` vertices qualify.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = place_markers(rig, 20)
        >>> sites.labels[:2]
        ('M001', 'M002')
    """
    mesh = rig.neutral
    vertices = mesh.vertices.double().cpu()
    faces = mesh.faces.cpu()
    amplitude = rig.deltas.double().norm(dim=-1).amax(0).cpu()
    part = components(faces, len(vertices))
    skin = part == part[faces.flatten()].mode().values
    allowed = skin & (amplitude > 1.0)
    normals = vertex_normals(vertices, faces)
    allowed &= normals[:, 2] > math.cos(math.radians(_VISIBLE_FROM))
    # Lashes and the video over the eye, parts of their own, hide no marker.
    allowed &= ~RayCaster(vertices, faces[skin[faces[:, 0]]]).occluded(
        vertices + 0.1 * normals, torch.tensor([0.0, 0, 1]).double().expand_as(vertices)
    )
    if mesh.annotations is not None:
        if "face" in mesh.annotations.regions:
            allowed &= mesh.annotations.regions["face"].cpu()
        if mesh.annotations.contacts is not None:
            allowed[mesh.annotations.contacts.flatten().cpu()] = False
    candidates = allowed.nonzero()[:, 0]
    if len(candidates) < count:
        raise ValueRangeError(f"place_markers: {len(candidates)} vertices are visible and move, expected {count}")
    importance = amplitude[candidates].sqrt()
    chosen = [int(importance.argmax())]
    nearest = torch.full((len(candidates),), torch.inf, dtype=torch.float64)
    for _ in range(count - 1):  # each choice depends on the one before
        nearest = torch.minimum(nearest, (vertices[candidates] - vertices[candidates[chosen[-1]]]).norm(dim=1))
        chosen.append(int((nearest * importance).argmax()))
    return Attachment.from_vertices(mesh, candidates[chosen], [f"M{i + 1:03d}" for i in range(count)])


@dataclass(frozen=True)
class StageFlaws:
    """What goes wrong on the stage.

    Args:
        noise: standard deviation of each coordinate, millimetres.
        missing: share of samples that are not seen, at random.
        gaps: stretches in which a marker is not seen, a minute of take and marker.
        gap_seconds: longest such stretch.
        swaps: stretches in which two labels are exchanged, a minute of take; every second pair are neighbours.
        swap_seconds: longest such stretch.
        slip_translation: amplitude of the helmet's slow drift along each axis, millimetres.
        slip_rotation: amplitude of its drift about each axis, degrees.
        standoff: distance of marker centres from the skin along its normal, millimetres.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> still = rig.vertices.new_zeros(100, len(rig.names))
        >>> taken = record(rig, sites, still, torch.Generator().manual_seed(0), StageFlaws(missing=0.1))
        >>> round(taken.take.markers.values[..., 0].isnan().double().mean().item(), 1)
        0.1
    """

    noise: float = 0.3
    missing: float = 0.0
    gaps: float = 0.0
    gap_seconds: float = 0.5
    swaps: float = 0.0
    swap_seconds: float = 1.0
    slip_translation: float = 0.0
    slip_rotation: float = 0.0
    standoff: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueRangeError(f"stage flaws: {name} is {value}, expected a finite number of at least 0")
        if self.missing > 1:
            raise ValueRangeError(f"stage flaws: missing is {self.missing}, expected a share of at most 1")


@dataclass(frozen=True)
class LabelSwap:
    """Two markers whose labels are exchanged from ``first`` frame to before ``last``.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> still = rig.vertices.new_zeros(100, len(rig.names))
        >>> taken = record(rig, sites, still, torch.Generator().manual_seed(0), StageFlaws(swaps=0.5))
        >>> all(swap.first < swap.last for swap in taken.swaps)
        True
    """

    markers: tuple[int, int]
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Recording:
    """A take as the stage delivers it, and the truth behind it.

    Args:
        take: markers (T,M,3) with their flaws, NaN where not seen.
        markers: where the marker centres were in rig space, (T,M,3), without noise and slip.
        weights: what moved the rig, (T,N), in the order of the rig's names.
        rotation: the helmet's slip, (T,3,3), about ``pivot``.
        translation: the helmet's slip, (T,3), millimetres.
        pivot: (3,), the mean of the markers at rest.
        swaps: which labels were exchanged when.
    """

    take: Take
    markers: Tensor
    weights: Tensor
    rotation: Tensor
    translation: Tensor
    pivot: Tensor
    swaps: tuple[LabelSwap, ...]


def record(
    rig: BlendshapeRig,
    attachment: Attachment,
    weights: Tensor,
    generator: torch.Generator,
    flaws: StageFlaws = StageFlaws(),
    fps: float = 60.0,
) -> Recording:
    """Records markers on a moving rig.

    Args:
        rig: whose skin carries the markers.
        attachment: where, M markers.
        weights: (T,N), in the order of the rig's names.
        generator: where the randomness comes from.
        flaws: what goes wrong.
        fps: frames a second.

    Raises:
        ShapeError: ``weights`` is not (T,N).
        TopologyError: the attachment belongs to another mesh.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> still = rig.vertices.new_zeros(60, len(rig.names))
        >>> taken = record(rig, sites, still, torch.Generator().manual_seed(0), StageFlaws(noise=0.3))
        >>> round((taken.take.markers.values - taken.markers).std().item(), 1)
        0.3
    """
    if weights.ndim != 2 or weights.shape[1] != len(rig.names):
        raise ShapeError(f"weights: found {tuple(weights.shape)}, expected (T,{len(rig.names)})")
    attachment.check(rig.neutral)
    frames = len(weights)
    markers = _marker_centres(rig, attachment, weights.to(rig.deltas), flaws.standoff)
    pivot = _marker_centres(rig, attachment, torch.zeros_like(weights[:1]).to(rig.deltas), 0.0)[0].mean(0)
    rotation, translation = _slip(frames, fps, flaws, generator)
    seen = (markers - pivot) @ rotation.transpose(1, 2).to(markers) + pivot + translation[:, None].to(markers)
    seen = seen + flaws.noise * torch.randn(seen.shape, generator=generator)
    swaps = _draw_swaps(torch.cdist(markers[0], markers[0]), frames, fps, flaws, generator)
    for swap in swaps:
        a, b = swap.markers
        stretch = slice(swap.first, swap.last)
        seen[stretch, [a, b]] = seen[stretch, [b, a]]
    seen[_unseen(frames, markers.shape[1], fps, flaws, generator)] = torch.nan
    take = Take(fps, markers=Track(attachment.labels or (), seen))
    return Recording(take, markers, weights, rotation, translation, pivot, swaps)


def _marker_centres(rig: BlendshapeRig, attachment: Attachment, weights: Tensor, standoff: float) -> Tensor:
    """Points on the skin (T,M,3), lifted along the moving normal; only the triangles round the markers are moved."""
    faces = rig.neutral.faces
    on_marker = torch.zeros(len(rig.vertices), dtype=torch.bool)
    on_marker[faces[attachment.triangles].flatten()] = True
    ring = on_marker[faces].any(-1)
    used, local = faces[ring].unique(return_inverse=True)
    row = torch.full((len(faces),), -1, dtype=torch.int64)
    row[ring] = torch.arange(int(ring.sum()))
    here = Attachment(row[attachment.triangles], attachment.barycentric, attachment.labels)
    vertices = rig.vertices[used] + torch.einsum("tn,nvc->tvc", weights, rig.deltas[:, used])
    if rig.activation is not None and rig.corrective_deltas is not None:
        more = rig.corrective_deltas[:, used]
        vertices = vertices + torch.einsum("tn,nvc->tvc", rig.activation(weights), more)
    points = here.on(local, vertices)
    if standoff == 0:
        return points
    normals = here.on(local, vertex_normals(vertices, local))
    return points + standoff * torch.nn.functional.normalize(normals, dim=-1)


def _slip(frames: int, fps: float, flaws: StageFlaws, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Slow smooth motion whose largest excursion along each axis is the amplitude asked for."""
    rate = 0.03 + 0.12 * torch.rand(6, 4, generator=generator)
    phase = 2 * math.pi * torch.rand(6, 4, generator=generator)
    seconds = torch.arange(frames) / fps
    curves = torch.sin(2 * math.pi * rate * seconds[:, None, None] + phase).sum(-1)
    curves = curves / curves.abs().amax(0).clamp(min=1e-9)
    angle = torch.deg2rad(torch.tensor(flaws.slip_rotation)) * curves[:, :3]
    skew = torch.zeros(frames, 3, 3)
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -angle[:, 2], angle[:, 1], -angle[:, 0]
    rotation = torch.linalg.matrix_exp(skew - skew.transpose(1, 2))
    return rotation, flaws.slip_translation * curves[:, 3:]


def _draw_swaps(
    distances: Tensor, frames: int, fps: float, flaws: StageFlaws, generator: torch.Generator
) -> tuple[LabelSwap, ...]:
    count = round(flaws.swaps * frames / fps / 60)
    swaps: list[LabelSwap] = []
    for i in range(count):
        first = int(torch.randint(frames, (1,), generator=generator))
        length = 1 + int(torch.rand((), generator=generator) * flaws.swap_seconds * fps)
        a = int(torch.randint(len(distances), (1,), generator=generator))
        order = distances[a].argsort()[1:]
        reach = min(3, len(order)) if i % 2 else len(order)
        b = int(order[int(torch.randint(reach, (1,), generator=generator))])
        swaps.append(LabelSwap((a, b), first, min(first + length, frames)))
    return tuple(swaps)


def _unseen(frames: int, markers: int, fps: float, flaws: StageFlaws, generator: torch.Generator) -> Tensor:
    mask = torch.rand(frames, markers, generator=generator) < flaws.missing
    count = round(flaws.gaps * frames / fps / 60 * markers)
    marker = torch.randint(markers, (count,), generator=generator)
    first = torch.randint(frames, (count,), generator=generator)
    length = 1 + (torch.rand(count, generator=generator) * flaws.gap_seconds * fps).long()
    frame = torch.arange(frames)[:, None]
    inside = (frame >= first) & (frame < first + length)
    mask |= (inside.float() @ torch.nn.functional.one_hot(marker, markers).float()) > 0
    return mask
