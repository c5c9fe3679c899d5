"""Matches of a face's skin between photographs: optical flow, after a head has explained pose and expression."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.rasterization import interpolate
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.modeling.photographs.face_piece import FacePiece
from torchface.modeling.photographs.skin_mask import FacePlaces
from torchface.part_materials import part_material
from torchface.rendering.camera_visibility import PosedSurface

_SITES = 700  # of skin in a photograph
_SQUARE, _SEEN = 0.5, 0.4  # least cosines between skin and the camera that has a site, and that it is looked for in
_SKIN = ("skin", "lips", "brows")
_LEAST_SKIN = 0.5  # share of these parts at a site
_ANGLES = (8.0, 55.0)  # degrees between two cameras: nearer ones show no depth, beyond it skin looks another
_PARTNERS = 4  # photographs that one is matched with, those near to the angle that shows depth best
_BEST_ANGLE = 25.0
_NOISE = 1.0  # of a match, pixels, standard deviation
_AROUND, _CORRELATED = 8.0, 0.5  # pixels; least correlation of what is shown around a match
_NECK = 0.02  # beyond the face's outline, in distances of the eyes' outer corners
_LEAST_SIDE = 32  # pixels of what two photographs show
_RETURN = 1.0  # pixels by which a match that is followed back may miss
_MOST_APART = 1.0  # millimetres between two expressions whose skin is compared
_EXPRESSION = 0.25  # how much of what an expression moves skin by may be wrong
_ALIKE, _GRAIN, _CONTRAST = 8.0, 3.0, 40.0  # pixels over which light is; grey levels of noise, and wanted


@dataclass(frozen=True, eq=False)
class SkinMatches:
    """S sites of skin and O observations of them: each site is seen in the photograph that has it, and in others."""

    triangles: Tensor  # of the sites, (S,) int64
    barycentric: Tensor  # (S,3) float64
    site: Tensor  # of each observation, (O,) int64
    view: Tensor  # its photograph, (O,) int64
    pixels: Tensor  # in the photograph's piece, (O,2)
    deviation: Tensor  # of a coordinate, (O,) pixels of the piece
    own: Tensor  # whether the photograph is the one that has the site, (O,) bool

    def joined(self, other: "SkinMatches") -> "SkinMatches":
        """These and others of the same head."""
        both = {part.name: torch.cat([getattr(self, part.name), getattr(other, part.name)]) for part in fields(self)}
        both["site"][len(self.site) :] += len(self.triangles)
        return SkinMatches(**both)


def match_skin(
    posed: Sequence[Mesh], cameras: Sequence[Camera], pieces: Sequence[FacePiece], parts: Sequence[FaceParts] | None
) -> SkinMatches | None:
    """Where photographs of one head, posed as each shows it, show the same skin; none where no two can be compared.

    Args:
        posed: the head, one mesh a photograph, millimetres.
        cameras: of the pieces.
        pieces: the face in each photograph.
        parts: what the photographs show: sites are on skin, lips and brows; below the brows if absent.

    Source: Kroeger et al. 2016 (optical flow by dense inverse search).
    """
    shape = pieces[0].image.shape[1:]
    surfaces = PosedSurface.each(posed, len(posed))
    places = FacePlaces.of(posed[0])
    neck = (places.beyond > _NECK) & (places.place[:, 1] < 0.5 * places.chin[1])  # it turns beside the head
    skin, faces = skin_vertices(posed[0]) & ~neck, posed[0].faces.cpu()
    if parts is None:  # hair hangs over the forehead and beside the face
        skin &= (places.out < 1) & (places.place[:, 1] < places.brows)
    cosines = torch.stack([
        surface.shown_in(piece.image, camera).cosine
        for surface, piece, camera in zip(surfaces, pieces, cameras, strict=True)
    ])  # fmt: skip
    seen = cosines * skin
    grey = [_even(piece.image) for piece in pieces]
    noise = torch.tensor([_NOISE * max(1.0, piece.scale) for piece in pieces], dtype=torch.float64)
    found: list[tuple[Tensor, ...]] = []
    for one, (surface, camera) in enumerate(zip(surfaces, cameras, strict=True)):
        origins, ways = (rays.reshape(-1, 3) for rays in camera.rays())
        hits = surface.caster.cast(origins, ways)
        hit = hits.triangle >= 0
        corners, barycentric = faces[hits.triangle.clamp(min=0)], hits.barycentric.double()
        facing = torch.where(hit, seen[:, corners].amin(-1), 0.0)
        best = (facing[one] >= facing.amax(0)) & (facing[one] > _SQUARE)
        if parts is not None:
            share = parts[one].at(pieces[one].to_photograph(_grid(shape)), *_SKIN).nan_to_num(0.0)
            best &= share.flatten() > _LEAST_SKIN
        rows = best.nonzero()[:, 0]
        rows = rows[torch.linspace(0, len(rows) - 1, min(_SITES, len(rows))).long()] if len(rows) else rows
        for other in _partners(cameras, one, [_apart(surfaces[one], surface, skin) for surface in surfaces]):
            there = cameras[other].project(interpolate(surfaces[other].vertices, corners, barycentric))
            there = torch.where((facing[[one, other]] > _SEEN / 2).all(0)[:, None], there, torch.nan)
            match, sure = _followed(grey[one], grey[other], there.view(*shape, 2))
            kept = rows[(sure.flatten() & (facing[other] > _SEEN))[rows]]
            moved = interpolate(surfaces[one].vertices - surfaces[other].vertices, corners[kept], barycentric[kept])
            wrong = _EXPRESSION * _pixels_a_millimetre(cameras[other], surfaces[other].vertices) * moved.norm(dim=1)
            deviation = (noise[other] ** 2 + wrong.square()).sqrt()
            found.append((
                one * len(hit) + kept, hits.triangle[kept], barycentric[kept], torch.full_like(kept, other),
                match.view(-1, 2)[kept], deviation,
            ))  # fmt: skip
    if not sum(len(part[0]) for part in found):
        return None
    key, triangle, bary, view, pixels, deviation = (torch.cat(parts) for parts in zip(*found, strict=True))
    sites, site = key.unique(return_inverse=True)
    first = torch.zeros_like(sites).scatter_(0, site, torch.arange(len(site)))  # any of them: their places are one
    owner, pixel = sites // (shape[0] * shape[1]), sites % (shape[0] * shape[1])
    return SkinMatches(
        triangle[first],
        bary[first],
        torch.cat([torch.arange(len(sites)), site]),
        torch.cat([owner, view]),
        torch.cat([_grid(shape).view(-1, 2)[pixel], pixels]),
        torch.cat([noise[owner], deviation]),
        torch.cat([torch.ones(len(sites), dtype=torch.bool), torch.zeros(len(site), dtype=torch.bool)]),
    )


def skin_vertices(mesh: Mesh) -> Tensor:
    """Vertices that are of no other part, (V,) bool."""
    skin = torch.ones(len(mesh.vertices), dtype=torch.bool)
    for name, mask in mesh.regions.items():
        if part_material(name) is not None:
            skin &= ~mask.cpu()
    return skin


def _grid(shape: Sequence[int]) -> Tensor:
    """Pixels (H,W,2), x before y."""
    rows, columns = (torch.arange(size, dtype=torch.float64) for size in shape)
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def _apart(one: PosedSurface, other: PosedSurface, skin: Tensor) -> float:
    """How far expressions move the skin apart, root mean square, millimetres."""
    return float((one.vertices - other.vertices)[skin].square().sum(1).mean().sqrt())


def _partners(cameras: Sequence[Camera], one: int, apart: Sequence[float]) -> list[int]:
    """Photographs of nearly the same expression that see the head from elsewhere, but not from too far."""
    ahead = torch.stack([camera.rotation[2] for camera in cameras]).double()
    angle = torch.rad2deg(torch.arccos((ahead @ ahead[one]).clamp(-1, 1))).tolist()
    near = [k for k in range(len(cameras)) if _ANGLES[0] < angle[k] < _ANGLES[1] and apart[k] < _MOST_APART]
    return sorted(near, key=lambda k: abs(angle[k] - _BEST_ANGLE))[:_PARTNERS]


def _pixels_a_millimetre(camera: Camera, vertices: Tensor) -> float:
    depth = vertices.mean(0) @ camera.rotation[2].double() + camera.translation[2].double()
    return float(camera.intrinsics[0, 0] / depth)


def _even(image: Tensor) -> np.ndarray:
    """Grey levels (H,W) of a picture (3,H,W), free of its light: contrasts are alike everywhere."""
    grey = 255 * cv2.cvtColor(image.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    detail = grey - cv2.GaussianBlur(grey, (0, 0), _ALIKE)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), _ALIKE) + _GRAIN**2)
    return np.clip(128 + _CONTRAST * detail / contrast, 0, 255).astype(np.uint8)


def _followed(one: np.ndarray, other: np.ndarray, there: Tensor) -> tuple[Tensor, Tensor]:
    """Where a picture (H,W) shows what another shows in each of its pixels, (H,W,2), near a first guess, NaN for none;
    and whether that leads back, (H,W) bool."""
    whole = there.float().numpy()
    known = np.isfinite(whole).all(-1)
    match, sure = np.full_like(whole, np.nan), np.zeros_like(known)
    left, top, width, height = cv2.boundingRect(known.astype(np.uint8))
    if min(width, height) < _LEAST_SIDE:
        return torch.from_numpy(match).double(), torch.from_numpy(sure)
    box = slice(top, top + height), slice(left, left + width)
    guess, known = whole[box], known[box]
    warped = _looked_up(other, np.nan_to_num(guess, nan=-1e4), cv2.INTER_CUBIC)
    start, end = (np.where(known, picture, 128).astype(np.uint8) for picture in (one[box], warped))
    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    solver.setFinestScale(0)
    forth, back = (solver.calc(a, b, np.zeros((*a.shape, 2), np.float32)) for a, b in ((start, end), (end, start)))
    at = _grid(known.shape).float().numpy() + forth
    returned, match[box] = (_looked_up(field, at, cv2.INTER_LINEAR) for field in (back, guess))
    off = np.linalg.norm(forth + returned, axis=-1)
    shown = _looked_up(end, at, cv2.INTER_LINEAR)
    sure[box] = (off < _RETURN) & known & np.isfinite(match[box]).all(-1) & (_correlation(start, shown) > _CORRELATED)
    return torch.from_numpy(match).double(), torch.from_numpy(sure)


def _looked_up(picture: np.ndarray, at: np.ndarray, how: int) -> np.ndarray:
    """A picture (H,W,...) at places (H,W,2), x before y; black beyond it."""
    return cv2.remap(picture, at[..., 0].copy(), at[..., 1].copy(), how)


def _correlation(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Of grey levels (H,W) around each pixel, (H,W)."""
    a, b = (picture.astype(np.float32) for picture in (one, other))
    soft = [cv2.GaussianBlur(part, (0, 0), _AROUND) for part in (a, b, a * a, b * b, a * b)]
    spread = np.sqrt(np.maximum((soft[2] - soft[0] ** 2) * (soft[3] - soft[1] ** 2), 1.0))
    return (soft[4] - soft[0] * soft[1]) / spread
