"""The frame that all faces share: learned from scans with landmarks, found on scans without."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.rigid_icp import Samples, ScanPoints, rigid_icp
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.landmarks.scans.cylinder import CylinderLayout, unwrap
from torchface.landmarks.scans.pose_search import find_pose, nose_candidates, protrusion, sample_surface
from torchface.landmarks.scans.uv_landmark_names import MIRRORED, UV_LANDMARK_NAMES
from torchface.mesh import Mesh

_AXIS_BEHIND_EYES = 70.0
_MAP = CylinderLayout(size=128, pitch=2.8)
_ABOVE_EYES, _BELOW_MOUTH, _HALF_ANGLE = 32.0, 22.0, 1.15
_ITERATIONS = 2
_LEAST_FIT = 0.5  # faces fit by 0.7 to 0.8 of 1, a ball of a head's size by 0.4
_LAST_REACHES = (8.0, 6.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0)


class FaceFrame(nn.Module):
    """Where faces are: the mean face of some annotated scans, and the search for it in any other scan.

    The frame has y up along the line from the mouth's to the eyes' corners, x to the viewer's right, z toward the
    viewer, its origin at half that line's height and 70 mm behind the eyes' corners; millimetres at the mean size.

    A scan may lie in any pose, upside down too, in millimetres and at most a fifth larger or smaller than the mean;
    what is needed is its nose and most of the face between brows and mouth.

    Args:
        points: how many points the mean face has.
        count: how many landmarks.
    """

    landmarks: Tensor
    surface: Tensor
    normals: Tensor
    nose: Tensor

    def __init__(self, points: int, count: int = len(UV_LANDMARK_NAMES)) -> None:
        super().__init__()
        self.register_buffer("landmarks", torch.zeros(count, 3, dtype=torch.float64))
        self.register_buffer("surface", torch.zeros(points, 3, dtype=torch.float64))
        self.register_buffer("normals", torch.zeros(points, 3, dtype=torch.float64))
        self.register_buffer("nose", torch.zeros(2, 3, dtype=torch.float64))

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor needs."""
        return {"points": len(self.surface), "count": len(self.landmarks)}

    @classmethod
    def fit(cls, scans: Sequence[Mesh], landmarks: Tensor) -> "FaceFrame":
        """Learns the mean face.

        Args:
            scans: of faces, in any pose.
            landmarks: the twelve on each, (M,12,3), in the scans' own spaces; NaN where one is not known.

        Raises:
            ShapeError: the numbers of scans and landmarks differ.
            ValueRangeError: a scan has fewer than three landmarks, or no surface round them.

        Source: thesis 3.2.2 needs one UV space; generalised Procrustes analysis (Gower 1975) gives it here.
        """
        if landmarks.shape != (len(scans), len(UV_LANDMARK_NAMES), 3) or not len(scans):
            raise ShapeError(
                f"landmarks: found {tuple(landmarks.shape)}, expected ({len(scans)},{len(UV_LANDMARK_NAMES)},3), "
                "one scan or more"
            )
        mean = _mean_landmarks(landmarks.double())
        poses = similarity_transform(landmarks.double(), mean.expand(len(scans), -1, -1))
        samples = [sample_surface(scan) for scan in scans]
        frame = cls(0)
        # Landmarks are placed by hand and few; once the mean face is known, its whole surface places a scan better.
        for _ in range(_ITERATIONS):
            frame = cls._of_poses(scans, landmarks.double(), poses)
            poses = _stack([frame._refined(sample, _row(poses, i)) for i, sample in enumerate(samples)])
        return cls._of_poses(scans, landmarks.double(), poses)

    @classmethod
    def _of_poses(cls, scans: Sequence[Mesh], landmarks: Tensor, poses: Similarity) -> "FaceFrame":
        mean = poses.apply(landmarks).nanmean(0)
        heads = [unwrap(scan, _row(poses, i), _MAP) for i, scan in enumerate(scans)]
        depth = torch.stack([head.radius.double().masked_fill(~head.mask, torch.nan) for head in heads])
        known = torch.isfinite(depth).double().mean(0) > 0.5
        radius = depth.nanmedian(0).values
        radius = torch.nanmean(torch.stack([radius, radius.flip(1)]), 0)  # faces are symmetric on average
        points = _MAP.points(_MAP.grid(), radius)
        angle = torch.atan2(points[..., 0], points[..., 2]).abs()
        eyes, mouth = mean[2:6].mean(0), mean[8:10].mean(0)
        height = points[..., 1]
        inside = known & known.flip(1) & (angle < _HALF_ANGLE)
        inside &= (height < eyes[1] + _ABOVE_EYES) & (height > mouth[1] - _BELOW_MOUTH)
        along_x, along_y = torch.gradient(points, dim=1)[0], torch.gradient(points, dim=0)[0]
        normals = torch.nn.functional.normalize(torch.linalg.cross(along_y, along_x), dim=-1)
        inside &= torch.isfinite(normals).all(-1)
        if int(inside.sum()) < 100:
            raise ValueRangeError("FaceFrame: found no common surface round the landmarks, expected faces")
        # A fixed shuffle: every slice of the points is spread over the face.
        order = torch.randperm(int(inside.sum()), generator=torch.Generator().manual_seed(0))
        frame = cls(int(inside.sum()))
        frame.landmarks.copy_(mean)
        frame.surface.copy_(points[inside][order])
        frame.normals.copy_(normals[inside][order])
        _, direction = protrusion(frame.surface, frame.normals, mean[:1])
        frame.nose.copy_(torch.cat([mean[:1], direction]))
        return frame

    def locate(self, scan: Mesh) -> Similarity:
        """The pose of a scan, from its space to this frame, a batch of one.

        Args:
            scan: in any pose, millimetres.

        Raises:
            ValueRangeError: no part of the scan looks like a face.
        """
        sample = sample_surface(scan)
        nose, direction = self.nose
        found = find_pose(Samples(self.surface, self.normals), nose, direction, sample, nose_candidates(sample))
        if float(found.fit[0]) < _LEAST_FIT:
            raise ValueRangeError(
                f"scan: found no face; at the likeliest place the mean face fits {float(found.fit[0]):.2f} of 1, "
                f"expected at least {_LEAST_FIT} (are the units millimetres?)"
            )
        return self._refined(sample, found.pose.inverse())

    def settle(self, scan: Mesh, pose: Similarity) -> Similarity:
        """A pose that is right to within some millimetres and degrees, made as good as :meth:`locate` makes it."""
        return self._refined(sample_surface(scan), pose)

    def forward(self, scan: Mesh) -> Similarity:
        """See :meth:`locate`."""
        return self.locate(scan)

    def _refined(self, sample: ScanPoints, pose: Similarity) -> Similarity:
        face = Samples(self.surface, self.normals)
        return rigid_icp(face, sample, pose.inverse(), _LAST_REACHES, scale=True).pose.inverse()


def _mean_landmarks(landmarks: Tensor) -> Tensor:
    """Generalised Procrustes mean (L,3) of landmark sets (M,L,3), symmetric, in the frame, at the mean size."""
    known = torch.isfinite(landmarks).all(-1)
    if int(known.sum(1).min()) < 3:
        raise ValueRangeError(
            f"landmarks: a scan has {int(known.sum(1).min())} of {landmarks.shape[1]}, expected at least three"
        )
    mean = landmarks[int(known.sum(1).argmax())]
    if not torch.isfinite(mean).all():
        raise ValueRangeError("landmarks: found no scan with all twelve, expected at least one")
    turned = landmarks
    for _ in range(5):
        poses = similarity_transform(landmarks, mean.expand_as(landmarks))
        turned = poses.apply(landmarks)
        mean = turned.nanmean(0) / poses.scale.mean()
    return _into_frame(mean)


def _into_frame(mean: Tensor) -> Tensor:
    eyes, mouth = mean[2:6].mean(0), mean[8:10].mean(0)
    up = torch.nn.functional.normalize(eyes - mouth, dim=0)
    across = (mean[4:6].mean(0) - mean[2:4].mean(0)) + (mean[9] - mean[8])
    right = torch.nn.functional.normalize(across - up * (across @ up), dim=0)
    forward = torch.linalg.cross(right, up)
    origin = (eyes + mouth) / 2 + forward * ((eyes - mouth) @ forward / 2 - _AXIS_BEHIND_EYES)
    aligned = (mean - origin) @ torch.stack([right, up, forward]).T
    mirrored = aligned[list(MIRRORED)] * torch.tensor([-1.0, 1.0, 1.0], dtype=aligned.dtype)
    return (aligned + mirrored) / 2


def _row(poses: Similarity, row: int) -> Similarity:
    return poses[row : row + 1]


def _stack(poses: Sequence[Similarity]) -> Similarity:
    return Similarity(
        torch.cat([p.scale for p in poses]),
        torch.cat([p.rotation for p in poses]),
        torch.cat([p.translation for p in poses]),
    )
