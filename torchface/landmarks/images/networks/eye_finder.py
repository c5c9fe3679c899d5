"""Lids, irises and what else is read off the eyes of a face whose landmarks are known."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import cut_crops
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.graph_session import graph_session
from torchface.landmarks.images.landmark_finder import LandmarkFinder, finder_name
from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS, eye_transforms, moved, picture_transforms
from torchface.landmarks.images.networks.eye_network import EyeFindings

LEAST = 6.0  # pixels of the image that a crop must be wide
HIDDEN, SEEN = 0.3, 0.8  # visibility up to which an eye does not count, and from which it counts fully

PLACES = tuple(sum(EYE_LANDMARKS, ()).index(number) for number in range(36, 48))
"""Rows of both eyes' lids, in the order of ``EYE_LANDMARKS``, that landmarks 36 to 47 are."""


@dataclass(frozen=True, eq=False)
class EyedFinder:
    """Finds landmarks, then looks at the eyes among them."""

    finder: LandmarkFinder  # finds all 68
    eyes: "EyeFinder"  # refines those of the lids, and reads irises

    @property
    def name(self) -> str:
        """What messages call it."""
        return finder_name(self.finder)

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        return self.eyes(image, self.finder(image, box, tilt))


@dataclass(frozen=True, eq=False)
class EyeFinder:
    """Reads the eyes of a face in an image."""

    network: Callable[[Tensor], EyeFindings]  # from crops (2,3,h,w) float32 in [0,1], red first, to what they show
    # width, height: pixels of the crops
    width: int
    height: int

    @torch.no_grad()
    def __call__(self, image: Tensor, face: FaceReading) -> FaceReading:
        """The face with its eyes, and landmarks 36 to 47 where both networks together put them.

        A face that is not there, or too small for its eyes to be seen, comes back as it is.
        """
        transforms = eye_transforms(face.landmarks.double(), self.width, self.height)
        scale = math.hypot(*transforms[0, 0, :2].tolist())  # NaN where there is no face
        if not 0 < scale * LEAST <= self.width:
            return face
        eyes = self.network(cut_crops(image, transforms, self.width, self.height).float() / 255)
        back = picture_transforms(transforms)
        points = moved(torch.cat([eyes.landmarks, eyes.iris[:, None]], 1).double(), back).float()
        lid_deviation = eyes.deviation[:, :6] / scale
        landmarks, deviation = merged_lids(
            face.landmarks, face.deviation, points[:, :6], lid_deviation, eyes.visibility
        )
        return replace(
            face, landmarks=landmarks, deviation=deviation, iris=points[:, 6], openness=eyes.openness,
            closed=eyes.closed, eye_visibility=eyes.visibility,
        )  # fmt: skip


def merged_lids(
    landmarks: Tensor, deviation: Tensor, lids: Tensor, lid_deviation: Tensor, visibility: Tensor
) -> tuple[Tensor, Tensor]:
    r"""A face's landmarks with those of its lids moved to where both networks together put them.

    .. math:: x = \frac{x_1 / \sigma_1^2 + v\, x_2 / \sigma_2^2}{1 / \sigma_1^2 + v / \sigma_2^2}, \qquad
        \frac{1}{\sigma^2} = \frac{1}{\sigma_1^2} + \frac{v}{\sigma_2^2}

    with v how far the eye counts: not at all where it is likely hidden, fully where it is likely seen. Sums, products
    and roots alone: it goes into graphs as it is.

    Args:
        landmarks: :math:`x_1`, iBUG's 68, (...,68,2) pixels.
        deviation: :math:`\sigma_1`, (...,68) pixels.
        lids: :math:`x_2` of the right and the left eye, (...,2,6,2) pixels, in the order of ``EYE_LANDMARKS``.
        lid_deviation: :math:`\sigma_2`, (...,2,6) pixels.
        visibility: probability that nothing hides each eye, (...,2).

    Returns:
        Landmarks (...,68,2) and their deviation (...,68).
    """
    if landmarks.shape[-2:] != (68, 2) or lids.shape[-3:] != (2, 6, 2) or visibility.shape[-1:] != (2,):
        raise ShapeError(
            f"merged_lids: found landmarks {tuple(landmarks.shape)}, lids {tuple(lids.shape)} and visibility "
            f"{tuple(visibility.shape)}, expected (...,68,2), (...,2,6,2) and (...,2)"
        )
    share = ((visibility - HIDDEN) / (SEEN - HIDDEN)).clamp(0, 1)[..., None]
    face_weight, eye_weight = (
        1 / deviation[..., 36:48].square(),
        (share / lid_deviation.square()).flatten(-2)[..., list(PLACES)],
    )
    total = face_weight + eye_weight
    places = (face_weight[..., None] * landmarks[..., 36:48, :] + eye_weight[..., None] * _ordered(lids)) / total[
        ..., None
    ]
    return (
        torch.cat([landmarks[..., :36, :], places, landmarks[..., 48:, :]], -2),
        torch.cat([deviation[..., :36], 1 / total.sqrt(), deviation[..., 48:]], -1),
    )


def _ordered(lids: Tensor) -> Tensor:
    """Landmarks 36 to 47 (...,12,2) of both eyes' lids (...,2,6,2)."""
    return lids.flatten(-3, -2)[..., list(PLACES), :]


def graph_eye_finder(content: bytes) -> EyeFinder:
    """The finder of an eye network's graph, in ONNX Runtime on one thread."""
    session = graph_session(content)
    _, _, height, width = session.get_inputs()[0].shape

    def network(crops: Tensor) -> EyeFindings:
        values = session.run(list(EyeFindings._fields), {"eyes": crops.contiguous().numpy()})
        return EyeFindings(*(torch.from_numpy(np.asarray(one)) for one in values))

    return EyeFinder(network, width, height)
