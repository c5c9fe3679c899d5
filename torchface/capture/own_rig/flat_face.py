"""The face of a rig as somebody before it sees it, and what a film's frame shows there: a face laid flat."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import distort
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

_ABOVE, _INSIDE = 22.0, 2.0  # millimetres above the brows, and within the jaw's landmarks, that are laid flat
_OPENINGS = ((slice(36, 42), 3.0), (slice(42, 48), 3.0), (slice(60, 68), 1.0))  # landmarks, and millimetres around them
_SQUARELY, _FULLY = 0.3, 0.6  # cosines of the view from which skin begins to count, and counts fully
_BROAD = 8.0  # pixels
_EVEN, _LOCAL, _DARK, _CONTRAST = 12.0, 20.0, 3.0, 40.0  # millimetres, millimetres, grey levels, grey levels


@dataclass(frozen=True, eq=False)
class FlatFace:
    """The face of a rig as somebody before it sees it: H rows of W places on it, and what N shapes move them by."""

    rest: Tensor  # (H,W,3), millimetres
    basis: Tensor  # (N,H,W,3), millimetres
    acting: Callable[[Tensor], Tensor]  # places (H,W,3) at weights (N,), with the rig's correctives
    normals: Tensor  # unit, (H,W,3)
    counts: Tensor  # where there is skin: no eye, no inside of the mouth, (H,W) bool
    landmarks: Tensor  # their nearest places, row and column, (68,2) int64
    step: float  # millimetres a pixel

    @staticmethod
    def of(rig: BlendshapeRig, step: float) -> "FlatFace":
        """Of an upright rig in millimetres with iBUG's 68 landmarks."""
        vertices, faces = rig.vertices.detach().double(), rig.neutral.faces
        marks = vertices[rig.neutral.landmarks]
        jaw, brows = marks[:17], marks[17:27]
        x = torch.arange(float(jaw[:, 0].min()) + _INSIDE, float(jaw[:, 0].max()) - _INSIDE, step).double()
        y = torch.arange(float(brows[:, 1].max()) + _ABOVE, float(jaw[:, 1].min()) + _INSIDE, -step).double()
        ahead = torch.stack([*torch.meshgrid(x, y, indexing="xy"), vertices[:, 2].max().expand(len(y), len(x))], dim=-1)
        way = torch.tensor([0.0, 0.0, -1.0]).double().expand(ahead.numel() // 3, 3)
        hits = RayCaster(vertices, faces).cast(ahead.flatten(0, 1) - way, way)
        corners = faces[hits.triangle.clamp(min=0)].T.contiguous()
        shares = hits.barycentric.float().T[..., None].contiguous()

        def there(values: Tensor) -> Tensor:
            values = values.detach().float()
            by_corner = (values.index_select(0, at) * share for at, share in zip(corners, shares, strict=True))
            return torch.stack(tuple(by_corner)).sum(0).unflatten(0, ahead.shape[:2])

        skin = (hits.triangle >= 0).unflatten(0, ahead.shape[:2]).numpy().astype(np.uint8)
        for rows, around in _OPENINGS:
            cv2.fillConvexPoly(skin, _grown(marks[rows, :2], around, x, y), 0)
        normals = torch.nn.functional.normalize(there(vertex_normals(vertices, faces)), dim=-1)
        skin = cv2.erode(skin, np.ones((3, 3), np.uint8))
        basis = torch.stack([there(delta) for delta in rig.deltas])
        nearest = torch.stack([(marks[:, 1] - y[0]) / -step, (marks[:, 0] - x[0]) / step], dim=-1).round().long()
        nearest = nearest.clamp(min=0).minimum(torch.tensor(skin.shape) - 1)

        def acting(weights: Tensor) -> Tensor:
            return there(rig(weights[None])[0])

        return FlatFace(there(vertices), basis, acting, normals, torch.from_numpy(skin) > 0, nearest, step)

    def seen_in(
        self, frame: Tensor, weights: Tensor, pose: tuple[Tensor, Tensor], calibration: CameraCalibration
    ) -> tuple[np.ndarray, np.ndarray, Tensor]:
        """What a frame, uint8 (3,h,w), shows at the places, grey (H,W), with weights (N,) and a pose (3,3), (3,); how
        squarely, (H,W) in [0,1], 0 beyond the frame; and where, (H,W,2) pixels."""
        rotation, translation = pose
        places = self.acting(weights) @ rotation.T + translation
        image = places @ calibration.intrinsics.to(places).T
        at = image[..., :2] / image[..., 2:]
        at = distort(at, calibration) if calibration.distortion.any() else at
        towards = torch.nn.functional.normalize(-places, dim=-1)
        cosine = ((self.normals @ rotation.T) * towards).sum(-1)
        last = torch.tensor([frame.shape[2], frame.shape[1]]) - 1
        there = (places[..., 2] > 0) & ((at >= 0) & (at <= last)).all(-1)
        seen = ((cosine - _SQUARELY) / (_FULLY - _SQUARELY)).clamp(0, 1).where(there, 0.0)
        first, end = at.flatten(0, 1)[there.flatten()].aminmax(dim=0) if there.any() else (0 * last, last)
        (left, top), (right, bottom) = first.long().tolist(), (end.long() + 2).tolist()
        grey = cv2.cvtColor(frame[:, top:bottom, left:right].permute(1, 2, 0).contiguous().numpy(), cv2.COLOR_RGB2GRAY)
        x, y = at[..., 0].numpy() - left, at[..., 1].numpy() - top
        return cv2.remap(grey, x, y, cv2.INTER_LINEAR), seen.numpy(), at

    def landmarks_in(self, at: Tensor) -> Tensor:
        """Landmarks (68,2) where places are at (H,W,2)."""
        return at[self.landmarks[:, 0], self.landmarks[:, 1]]

    def even(self, picture: np.ndarray) -> np.ndarray:
        """A picture (H,W) of it without light that is alike all around, and of one contrast, uint8."""
        grey = picture.astype(np.float32)
        detail = grey - softened(grey, _EVEN / self.step)
        contrast = softened(np.abs(detail), _LOCAL / self.step) + _DARK
        return np.clip(128 + _CONTRAST * detail / contrast, 0, 255).astype(np.uint8)


def softened(picture: np.ndarray, deviation: float) -> np.ndarray:
    """A picture (H,W) blurred by a Gaussian of some standard deviation, pixels; a broad one at a quarter of its size,
    in a third of the time."""
    if deviation < _BROAD:
        return cv2.GaussianBlur(picture, (0, 0), deviation)
    height, width = picture.shape
    small = cv2.resize(picture, (-(-width // 4), -(-height // 4)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), deviation / 4), (width, height))


def _grown(outline: Tensor, by: float, x: Tensor, y: Tensor) -> np.ndarray:
    """The hull of landmarks (M,2), grown by some millimetres, in pixels of places x (W,) and y (H,) falling, int32."""
    hull = cv2.convexHull(outline.numpy().astype(np.float32))[:, 0]
    out = hull - hull.mean(0)
    hull = hull + by * out / np.linalg.norm(out, axis=1, keepdims=True)
    step = float(x[1] - x[0])
    return np.round(np.stack([hull[:, 0] - float(x[0]), float(y[0]) - hull[:, 1]], axis=1) / step).astype(np.int32)
