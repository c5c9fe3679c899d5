"""Hair and cloth on a scan, which hide the skin: found by their colour; and ears that came out in pieces."""

from functools import cached_property

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.color_space import to_linear
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex, SurfacePoints
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.registration.scan_colors import ScanColors
from torchface.rendering.raycast import RayCaster

_AT_THE_EARS = (0, 1, 2, 14, 15, 16)
_FEATURE = 0.17
_GROWN, _BESIDE = 0.06, 0.13
_DARKEST, _BLACK = 1.5, 1e-4
_BRIGHTEST, _OTHER_HUE = 2.0, 0.6
# Of a face's hue, logarithms of red and blue over green: the largest robust deviation, and the least and largest
# medians. A real scan's deviations are 0.23 and 0.11, MeshLab's rainbow has 2 to 3.5.
_MOST_HUES, _HUES = 0.8, ((-0.2, 1.8), (-2.0, 0.7))
_SPREADS = 4.0
_SMOOTHING = 3
_NEAR = 4.0
_WHOLE_EAR = 0.6
_JAW_ENDS = (0, 16)
_EAR_REACH, _ASIDE, _BEFORE = 0.5, 0.12, 0.05
_THIN = 0.1
_LIFT = 0.05
_MARGIN = 0.1
_MIN_COUNT = 20


class Cover:
    """Finds which vertices of a template have a place on the scan that is not the person's skin.

    Skin is what has the colour of brows, nose, mouth and cheeks together, lit more or less. Only what lies away from
    the features of the face (further than some 25 mm from their landmarks) can be covered: beards, brows and lips
    have other colours too. All of it asks for the 68 landmarks on the template; nothing is covered without.
    """

    def __init__(self, template: Mesh, exposed: Tensor, surface: SurfaceIndex, colors: ScanColors | None) -> None:
        self._faces, self._surface, self._colors, self._exposed = template.faces.cpu(), surface, colors, exposed
        self._rest = vertices = template.vertices.detach().cpu().double()
        self._none = torch.zeros(len(vertices), dtype=torch.bool)
        self.false_colors = ""
        """What no skin has of the face's colours, in words: then they say nothing of hair; else empty."""
        self.ears = find_ears(template)
        self.features = ~self._none
        notes = template.annotations
        self.known = notes is not None and notes.landmarks is not None and len(notes.landmarks) == 68
        if not self.known:
            return
        assert notes is not None
        assert notes.landmarks is not None
        landmarks = vertices[notes.landmarks.cpu()]
        self._width = float((landmarks[0] - landmarks[16]).norm())
        kept = torch.ones(68, dtype=torch.bool)
        kept[list(_AT_THE_EARS)] = False
        gap, _ = cKDTree(landmarks[kept].numpy()).query(vertices.numpy())
        label = components(self._faces, len(vertices))
        self.skin = label == label.bincount().argmax()
        self.features = (torch.from_numpy(gap) < _FEATURE * self._width) | ~self.skin
        self.features &= ~torch.stack([*self.ears, self._none]).any(0)

    def hidden(self, current: Tensor, settled: bool) -> Tensor:
        """The covered vertices, (V,) bool, of (V,3) about where they belong; ears are judged once these have
        ``settled``."""
        if not self.known or (self._colors is None and not (settled and self.ears)):
            return self._none
        nearest = self._surface.among_nearest_samples(current[self._exposed])
        hidden = self._none if self._colors is None else self._by_color(nearest)
        if settled:
            hidden = hidden | self._broken_ears(current, nearest, hidden)
        return hidden

    def without_islands(self, seen: Tensor) -> Tensor:
        """The seen vertices (V,) that hang together with the features of the face: no specks amid hair."""
        if not self.known:
            return seen
        inside = self._faces[(seen | self.features)[self._faces].all(-1)]
        label = components(inside, len(seen))
        home = torch.zeros(len(seen), dtype=torch.bool)
        home[label[self.features & self.skin]] = True
        return seen & (home[label] | ~self.skin)

    def _by_color(self, found: SurfacePoints) -> Tensor:
        assert self._colors is not None
        light = to_linear(self._colors.at(found.triangle, found.barycentric).double()).clamp(min=_BLACK)
        red, green, blue = light.unbind(1)
        look = torch.stack([light.mean(1).log(), (red / green).log(), (blue / green).log()], dim=1)
        sample = look[self.features[self._exposed] & (found.distance < 3 * _NEAR)]
        if len(sample) < _MIN_COUNT:
            return self._none
        middle = sample.median(0).values
        scale = _SPREADS * 1.4826 * (sample - middle).abs().median(0).values
        self.false_colors = _false_colors(middle[1:], scale[1:] / _SPREADS)
        if self.false_colors:
            return self._none
        off = look - middle
        hue = (off[:, 1:] / torch.maximum(scale[1:], off.new_tensor(_OTHER_HUE))).norm(dim=1)
        other = (off[:, 0] < -scale[0].clamp(min=_DARKEST)) | (off[:, 0] > scale[0].clamp(min=_BRIGHTEST)) | (hue > 1)
        share = torch.zeros(len(self._none), dtype=torch.float64)
        share[self._exposed] = other.double()
        seen = torch.zeros_like(share)
        seen[self._exposed] = 1.0
        for _ in range(_SMOOTHING):  # rings of neighbours
            share, count = (self._graph.sum(values, itself=True) for values in (share * seen, seen))
            share = share / count.clamp(min=1)
        return self._grown((share > 0.5) & ~self.features)

    @cached_property
    def _graph(self) -> VertexGraph:
        return VertexGraph(self._faces, len(self._none))

    def beside(self, hidden: Tensor) -> Tensor:
        """What lies within some 20 mm of hidden vertices (V,) and may be hair or cloth too, (V,) bool."""
        return self._grown(hidden, _BESIDE)

    def _grown(self, mask: Tensor, reach: float = _GROWN) -> Tensor:
        """With what lies within some 9 mm, or another reach, where hair lifts the surface."""
        if not mask.any():
            return mask
        gap, _ = cKDTree(self._rest[mask].numpy()).query(self._rest.numpy())
        return (torch.from_numpy(gap) < reach * self._width) & ~self.features

    def _broken_ears(self, current: Tensor, found: SurfacePoints, hidden: Tensor) -> Tensor:
        """Ears of which the scan shows too little: whole, or they come out as flakes."""
        own = vertex_normals(current, self._faces)[self._exposed]
        met = (found.distance < _NEAR) & ((own * self._surface.normals_at(found)).sum(-1) > 0.5)
        met &= ~self._surface.on_border(found) & ~hidden[self._exposed]
        broken = self._none.clone()
        for ear in self.ears:
            here = ear[self._exposed]
            if here.any() and float(met[here].double().mean()) < _WHOLE_EAR:
                broken |= ear
        return broken


def _false_colors(middle: Tensor, spread: Tensor) -> str:
    """What no skin has of a face's hues, their median and robust deviation (2,) each; empty if nothing."""
    found = f"red over green {middle[0].exp():.2g}, blue over green {middle[1].exp():.2g}, deviations of "
    found += f"{spread[0]:.2g} and {spread[1]:.2g}"
    usual = all(low <= float(at) <= high for at, (low, high) in zip(middle, _HUES, strict=True))
    return "" if usual and float(spread.max()) <= _MOST_HUES else found


def find_ears(template: Mesh) -> list[Tensor]:
    """Masks (V,) of the ears, one each; none without 68 landmarks, or where the template has no ears.

    A vertex belongs to one where a ray into the sheet leaves it after a few millimetres; lengths go by the distance
    between the jaw's ends, about 150 mm on an adult.
    """
    notes = template.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != 68:
        return []
    vertices, faces = template.vertices.detach().cpu().double(), template.faces.cpu()
    landmarks = vertices[notes.landmarks.cpu()]
    width = float((landmarks[_JAW_ENDS[0]] - landmarks[_JAW_ENDS[1]]).norm())
    middle = landmarks[list(_JAW_ENDS)].mean(0)
    normals = vertex_normals(vertices, faces)
    caster = RayCaster(vertices, faces)
    part = components(faces, len(vertices))
    largest = part == part.bincount().argmax()
    ears = []
    for end in _JAW_ENDS:  # the two sides
        at = landmarks[end]
        outward = torch.sign(at[0] - middle[0])
        near = (vertices - at).norm(dim=-1) < _EAR_REACH * width
        near &= (vertices[:, 0] - at[0]) * outward > -_ASIDE * width
        near &= vertices[:, 2] - at[2] < _BEFORE * width
        near &= largest
        ids = near.nonzero()[:, 0]
        hits = caster.cast(vertices[ids] - _LIFT * normals[ids], -normals[ids])
        thin = torch.zeros_like(near)
        thin[ids] = hits.distance < _THIN * width
        sheet = _largest(thin, faces)
        ear = torch.zeros_like(near)
        if sheet.any():
            gap, _ = cKDTree(vertices[sheet].numpy()).query(vertices[ids].numpy())
            ear[ids] = torch.from_numpy(gap) < _MARGIN * width
        if int(ear.sum()) >= _MIN_COUNT:
            ears.append(ear)
    return ears


def _largest(mask: Tensor, faces: Tensor) -> Tensor:
    """The largest connected piece of a mask (V,)."""
    inside = faces[mask[faces].all(-1)]
    if not len(inside):
        return torch.zeros_like(mask)
    label = components(inside, len(mask))
    kept = torch.zeros_like(mask)
    kept[inside.flatten()] = True
    count = label[kept].bincount()
    return kept & (label == count.argmax())
