"""The encoder of frames: aligned with the neutral, split into a smooth part and detail, compared by patches."""

from dataclasses import dataclass

from torch import Tensor

from torchface.enhancement.detail.detail_encodings import DetailKind, DisplacementDetail, GradientDetail
from torchface.enhancement.detail.low_pass import LowPass
from torchface.enhancement.detail.sparse_operator import SparseOperator
from torchface.enhancement.detail.surface_frames import PatchGradients, SurfaceFrames
from torchface.errors import AlignmentError, TopologyError
from torchface.geometry.similarity import Similarity, similarity_transform

_SCALES = (0.5, 2.0)
_MOST_RESIDUAL = 0.35  # of the head's size: beyond, vertices are not where they should be


@dataclass(frozen=True, eq=False)
class Encoder:
    """The steps that turn frames into smooth parts, features and details."""

    alignment: "FrameAlignment"  # aligns frames with the neutral
    low_pass: LowPass  # smooths their displacements
    frames: SurfaceFrames  # turns the vertices' frames with their smooth part
    gradients: PatchGradients
    detail: DisplacementDetail | GradientDetail  # encodes what the smooth part lacks


def make_encoder(neutral: Tensor, faces: Tensor, patches: Tensor, wavelength: float, detail: DetailKind) -> Encoder:
    """Of a neutral (V,3) and its faces (F,3), in patches (F,); ``wavelength`` in millimetres."""
    frames = SurfaceFrames(neutral, faces)
    gradients = frames.patch_gradients(patches, faces, neutral)
    by_vertex = detail == "displacements"
    return Encoder(
        FrameAlignment(neutral, gradients.means),
        LowPass(neutral, faces, wavelength),
        frames,
        gradients,
        DisplacementDetail(neutral, faces, frames) if by_vertex else GradientDetail(neutral, faces),
    )


class FrameAlignment:
    """Frames aligned with the neutral by the means over patches: Horn's alignment, translation and rotation."""

    def __init__(self, neutral: Tensor, means: SparseOperator) -> None:
        self.neutral, self._means = neutral, means
        self._points = means(neutral.double())

    def aligned(self, frames: Tensor, name: str) -> tuple[Tensor, Similarity]:
        """Displacements (B,V,3) from the neutral of frames aligned with it, and the similarity of that, of scale 1."""
        count, vertices, _ = frames.shape
        # The first vertex goes to the origin before any rounding to means.
        begin = frames[:, :1].detach()
        near = (frames - begin).permute(1, 0, 2).reshape(vertices, 3 * count)
        points = self._means(near).view(-1, count, 3).transpose(0, 1).double()
        target = self._points.to(points).expand_as(points)
        self._check(points.detach(), target, name)
        pose = similarity_transform(points, target, scale=False)
        rotation = pose.rotation
        translation = pose.translation - (rotation @ begin.double().transpose(1, 2))[..., 0]
        turned = (frames - begin) @ rotation.transpose(1, 2).to(frames) + pose.translation.to(frames)[:, None]
        return turned - self.neutral.to(frames), Similarity(pose.scale, rotation, translation)

    def _check(self, points: Tensor, target: Tensor, name: str) -> None:
        fitted = similarity_transform(points, target)
        size = (target - target.mean(1, keepdim=True)).square().sum((-1, -2)).sqrt()
        extent = (points - points.mean(1, keepdim=True)).square().sum((-1, -2)).sqrt()
        residual = (fitted.apply(points) - target).square().sum((-1, -2)).sqrt() / size
        worst = int(residual.argmax())
        if float(residual[worst]) > _MOST_RESIDUAL:
            raise TopologyError(
                f"{name}: frame {worst} lies {100 * float(residual[worst]):.0f} % of the head's size away from the "
                f"neutral, expected at most {100 * _MOST_RESIDUAL:.0f} %: its vertices are in another order, or it is "
                "another mesh"
            )
        ratio = extent / size
        odd = ((ratio < _SCALES[0]) | (ratio > _SCALES[1])).nonzero()[:, 0]
        if len(odd):
            raise AlignmentError(
                f"{name}: frame {int(odd[0])} is {float(ratio[odd[0]]):.3g} times as large as the neutral, expected "
                f"{_SCALES[0]} to {_SCALES[1]}: the unit is not millimetres"
            )
