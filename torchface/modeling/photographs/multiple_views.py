"""Bundle adjustment of a head: its form and the cameras move until photographs show the same skin at the same place."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.rotations import cross_matrix, rotation_matrix
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.modeling.photographs.face_piece import FacePiece
from torchface.modeling.photographs.skin_matches import SkinMatches, match_skin, skin_vertices
from torchface.part_materials import EYEBALL, part_material

_ROUNDS, _STEPS = 3, 3  # matches are looked for anew; Gauss-Newton with them
# Of what is not known of a head: millimetres over which it is alike, and how large it is, wide and fine.
_SMOOTH = ((30.0, 3.0), (12.0, 1.0))
_ALONG = 0.3  # as much along the skin, where landmarks say what is where
_KNOTS, _MODES, _LEAST_VARIANCE = 300, 150, 1e-2
_FAR, _OFF = 3.0, 2.0  # deviations, and medians of all, beyond which a match hardly counts
_LIDS = 1.25  # radii of an eyeball about its middle, where lids end
_EXACT = 1e-6  # deviation of a focal length's logarithm that is taken as known
# Of a result that counts: how many match, how far they are off (pixels), and beside before; what flow errs by is beyond
# doubt. By pictures and films of rendered people and of a real scan: below 0.36 heads came nearer to the truth, but for
# one person's and one pair of photographs; above 0.4 they went away from it.
# Eleven pairs of rendered people at -24 and 0 degrees end 0.44 and more off, pictures of one head at most 0.29.
_LEAST_MATCHES, _MOST_OFF, _GAIN = 150, 0.42, 0.38
_LITTLE, _LITTLE_GAIN = 0.38, 0.8


@dataclass(frozen=True, eq=False)
class HeldMarks:
    """Landmarks that keep features in their places on the head."""

    vertices: Tensor  # of the head, (L,) int64
    pixels: Tensor  # where each photograph shows these, (I,L,2); NaN for missing
    deviation: float  # of a coordinate, pixels of a photograph

    def matches(self, mesh: Mesh, pieces: Sequence[FacePiece]) -> SkinMatches:
        """As observations of the vertices."""
        sites = Attachment.from_vertices(mesh, self.vertices)
        view, site = torch.isfinite(self.pixels).all(-1).nonzero().unbind(1)
        pixels = torch.stack([piece.from_photograph(of) for piece, of in zip(pieces, self.pixels, strict=True)])
        scales = torch.tensor([piece.scale for piece in pieces], dtype=torch.float64)
        return SkinMatches(
            sites.triangles, sites.barycentric.double(), site, view, pixels[view, site],
            self.deviation * scales[view], torch.ones_like(view, dtype=torch.bool),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SkinAgreement:
    """What photographs of the same skin moved a head by."""

    moved: Tensor  # of each vertex at rest, (V,3) millimetres
    cameras: tuple[Camera, ...]
    matches: int  # places of skin that two photographs show
    before: float  # how far from each other photographs showed the head's places, median, pixels of a piece
    after: float


@dataclass(frozen=True, eq=False)
class ShownHead:
    """A head, as photographs show it."""

    posed: Sequence[Mesh]  # with the expression of each photograph, millimetres
    cameras: Sequence[Camera]  # of the photographs
    modes: Tensor  # ways in which heads differ, of unit deviation, (K,V,3)
    focal_deviation: float = 0.0  # of a focal length's logarithm; 0 takes it as exact
    shared_focal: bool = True  # one factor for all photographs

    def moved(self, field: Tensor) -> "ShownHead":
        """The head with its vertices moved by (V,3)."""
        posed = [mesh.with_vertices(mesh.vertices + field.to(mesh.vertices)) for mesh in self.posed]
        return replace(self, posed=posed)


def agreed_skin(
    head: ShownHead, pieces: Sequence[FacePiece], marks: HeldMarks, parts: Sequence[FaceParts] | None = None
) -> SkinAgreement | None:
    r"""Moves a head and its cameras until photographs show its skin at the same places; none where they do not.

    .. math:: \min_{a,u,P} \sum_{s,i} \rho\bigl(\lVert P_i(x_s + \sum_k a_k m_{ks} + u_s) - q_{si} \rVert
              / \sigma_{si} \bigr) + \lVert a \rVert^2 + \lVert u \rVert^2_{GP}

    Places q of skin s are found by optical flow from the photograph that shows it best, three times, each from the head
    found before.

    Args:
        head: as landmarks have found it, with its cameras.
        pieces: the face in each photograph.
        marks: landmarks, which keep features in their places on the head.
        parts: what each photograph shows.

    Returns:
        None where there are fewer than 150 matches, or they agree little better after than before.
    """
    forms = Forms.of(head.posed[0], head.modes)
    cameras = tuple(piece.camera(camera) for piece, camera in zip(pieces, head.cameras, strict=True))
    lenses = torch.zeros(1 if head.shared_focal else len(cameras), dtype=torch.float64)
    state = _State(torch.zeros(forms.count, dtype=torch.float64), cameras, lenses)
    held = marks.matches(head.posed[0], pieces)
    sites, before, after = 0, torch.nan, torch.nan
    for number in range(_ROUNDS):
        posed = head.moved(forms.field(state.forms)).posed
        matches = match_skin(posed, state.cameras, pieces, parts)
        if matches is None or int((~matches.own).sum()) < _LEAST_MATCHES:
            return None
        sites = len(matches.triangles)
        problem = _Bundle.of(matches.joined(held), head, forms)
        before = before if number else problem.disagreement(state)
        for _ in range(_STEPS):
            state = problem.step(state)
        after = problem.disagreement(state)
    coarse = sum(max(1.0, piece.scale) for piece in pieces) / len(pieces)
    if not after < min(_MOST_OFF * coarse, max(_GAIN * before, min(_LITTLE, _LITTLE_GAIN * before))):
        return None
    back = zip(pieces, state.cameras, head.cameras, strict=True)
    seen = tuple(piece.whole(camera, like) for piece, camera, like in back)
    moved = behind_lids(head.posed[0], forms.field(state.forms))
    return SkinAgreement(moved, seen, sites, before, after)


def behind_lids(mesh: Mesh, field: Tensor) -> Tensor:
    """Displacements (V,3) that bend no annotated eyeball: each follows its lids, and back to where none is inside."""
    rest, field = mesh.vertices.detach().cpu().double(), field.clone()
    skin = skin_vertices(mesh)
    for region, mask in mesh.regions.items():
        ball = mask.cpu()
        if part_material(region) is not EYEBALL or not bool(ball.any()):
            continue
        middle = rest[ball].mean(0)
        off = (rest - middle).norm(dim=1)
        lids = skin & (off < _LIDS * off[ball].amax()) & (rest[:, 2] > middle[2])
        if bool(lids.any()):
            way = field[lids].mean(0)
            nearer = off[lids] - (rest[lids] + field[lids] - middle - way).norm(dim=1)
            field[ball] = way - nearer.amax().clamp(min=0) * way.new_tensor([0.0, 0.0, 1.0])
    return field


@dataclass(frozen=True, eq=False)
class Forms:
    """Ways in which a head may move: K modes, and M smooth functions out of its skin and along it."""

    modes: Tensor  # (K,V,3) float64
    smooth: Tensor  # (V,M)
    ways: Tensor  # that each of these moves a vertex, (V,3,3)

    @staticmethod
    def of(mesh: Mesh, modes: Tensor) -> "Forms":
        """Those of a head, smooth around the skin of its face."""
        rest = mesh.vertices.detach().cpu().double()
        skin = skin_vertices(mesh).nonzero()[:, 0]
        front = skin[rest[skin, 2] > rest[skin, 2].quantile(0.3)]
        chosen = [int(front[rest[front, 2].argmax()])]  # the furthest from those before, again and again
        apart = torch.full((len(front),), torch.inf, dtype=torch.float64)
        while len(chosen) < min(_KNOTS, len(front)):
            apart = torch.minimum(apart, (rest[front] - rest[chosen[-1]]).norm(dim=1))
            chosen.append(int(front[apart.argmax()]))
        at = rest[chosen]
        values, vectors = torch.linalg.eigh(_alike(at, at))
        values, vectors = values.flip(0)[:_MODES], vectors.flip(1)[:, :_MODES]
        kept = values > _LEAST_VARIANCE
        near = torch.exp(-torch.cdist(rest, at).square() / (2 * _SMOOTH[-1][0] ** 2))
        out = torch.nn.functional.normalize(near @ vertex_normals(rest, mesh.faces.cpu())[chosen], dim=1)
        right = torch.nn.functional.normalize(torch.linalg.cross(out.new_tensor([[0.0, 1.0, 0.0]]), out), dim=1)
        ways = torch.stack([out, _ALONG * right, _ALONG * torch.linalg.cross(out, right)], dim=1)
        return Forms(modes.double(), _alike(rest, at) @ (vectors[:, kept] / values[kept].sqrt()), ways)

    @property
    def count(self) -> int:
        """Of coefficients, K + 3M."""
        return len(self.modes) + 3 * self.smooth.shape[1]

    def field(self, x: Tensor) -> Tensor:
        """How coefficients (K+3M,) move the vertices, (V,3)."""
        k = len(self.modes)
        return (
            torch.tensordot(x[:k], self.modes, dims=1) + ((self.smooth @ x[k:].view(-1, 3))[:, None] @ self.ways)[:, 0]
        )


@dataclass(frozen=True, eq=False)
class _State:
    """Where the adjustment stands."""

    forms: Tensor  # coefficients of the forms, (K+3M,)
    cameras: tuple[Camera, ...]  # of the pieces
    longer: Tensor  # logarithms of focal lengths beside those at first, (1,) or (I,)


@dataclass(frozen=True, eq=False)
class _Bundle:
    """O observations of places of a head."""

    matches: SkinMatches
    places: Tensor  # as their photographs show them, before forms move them, (O,3)
    forms: Tensor  # what a unit of each coefficient adds there, (O,3,K+3M)
    head: ShownHead

    @staticmethod
    def of(matches: SkinMatches, head: ShownHead, forms: Forms) -> "_Bundle":
        corners = head.posed[0].faces.cpu()[matches.triangles][matches.site]
        shares = matches.barycentric[matches.site]
        posed = torch.stack([mesh.vertices.detach().cpu().double() for mesh in head.posed])
        places = (posed[matches.view[:, None], corners] * shares[..., None]).sum(1)
        modes = (forms.modes[:, corners] * shares[None, :, :, None]).sum(2).permute(1, 2, 0)
        smooth = (forms.smooth[corners] * shares[..., None]).sum(1)
        ways = (forms.ways[corners] * shares[..., None, None]).sum(1)
        smooth = torch.einsum("om,oji->oimj", smooth, ways).flatten(2)
        return _Bundle(matches, places, torch.cat([modes, smooth], dim=2), head)

    def _at(self, state: _State) -> Tensor:
        return self.places + self.forms @ state.forms

    def disagreement(self, state: _State) -> float:
        """The median distance between where a photograph shows a place and where the head has it, pixels."""
        matches, at, off = self.matches, self._at(state), torch.zeros(len(self.places), dtype=torch.float64)
        for view, camera in enumerate(state.cameras):
            rows = matches.view == view
            off[rows] = (camera.project(at[rows]) - matches.pixels[rows]).norm(dim=1)
        return float(off[~matches.own].median())

    def step(self, state: _State) -> _State:
        """One of Gauss-Newton, for the forms, the cameras' poses and the focal lengths."""
        forms, views = len(state.forms), len(state.cameras)
        lenses = forms + 6 * views
        count = lenses + len(state.longer)
        H = torch.zeros(count, count, dtype=torch.float64)
        prior = torch.full((count,), 1e-9, dtype=torch.float64)
        prior[:forms], prior[lenses:] = 1.0, 1 / max(self.head.focal_deviation, _EXACT) ** 2
        H.diagonal().add_(prior)
        g = prior * torch.cat([state.forms, prior.new_zeros(6 * views), state.longer])
        at, far = self._at(state), _OFF * self.disagreement(state)
        for view, camera in enumerate(state.cameras):
            rows = (self.matches.view == view).nonzero()[:, 0]
            rotation, intrinsics = camera.rotation.double(), camera.intrinsics.double()
            rotated = at[rows] @ rotation.T
            pixels, by_place = pixel_jacobian(rotated + camera.translation.double(), intrinsics)
            off, deviation = pixels - self.matches.pixels[rows], self.matches.deviation[rows, None]
            wide = (_FAR * deviation).clamp(min=far)
            weight = 1 / (deviation * (1 + (off.norm(dim=1, keepdim=True) / wide).square()).sqrt())
            by_world = by_place @ rotation
            of_lens = (pixels - intrinsics[:2, 2])[..., None]
            by_rotation = by_place @ -cross_matrix(rotated)
            J = (
                torch.cat([by_world @ self.forms[rows], by_rotation, by_place, of_lens], dim=-1) * weight[..., None]
            ).flatten(0, 1)
            first, lens = forms + 6 * view, lenses if self.head.shared_focal else lenses + view
            into = torch.cat([torch.arange(forms), torch.arange(first, first + 6), torch.tensor([lens])])
            H[into[:, None], into] += J.T @ J
            g[into] += J.T @ (off * weight).flatten()
        step = -torch.linalg.solve(H, g)
        each = zip(state.cameras, step[forms:lenses].view(views, 6), step[lenses:].expand(views), strict=True)
        cameras = tuple(_moved(*one) for one in each)
        return _State(state.forms + step[:forms], cameras, state.longer + step[lenses:])


def _moved(camera: Camera, by: Tensor, longer: Tensor) -> Camera:
    """A camera rotated and moved by (6,), its focal length's logarithm larger by a number."""
    intrinsics = camera.intrinsics.double().clone()
    intrinsics[0, 0], intrinsics[1, 1] = (intrinsics[i, i] * longer.exp() for i in (0, 1))
    rotation = rotation_matrix(by[None, :3])[0] @ camera.rotation.double()
    return replace(camera, intrinsics=intrinsics, rotation=rotation, translation=camera.translation.double() + by[3:])


def _alike(one: Tensor, other: Tensor) -> Tensor:
    """The covariance (P,Q) of what is not known of a head at places (P,3) and (Q,3), square millimetres."""
    squared = torch.cdist(one, other).square()
    return sum(size**2 * torch.exp(-squared / (2 * length**2)) for length, size in _SMOOTH)  # type: ignore[return-value]
