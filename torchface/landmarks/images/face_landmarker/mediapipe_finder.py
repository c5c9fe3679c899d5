"""Landmarks, irises and blendshapes of a face by a Face Landmarker bundle."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_landmarker.landmarker_bundle import LandmarkerBundle, load_bundle
from torchface.landmarks.images.face_mesh_478 import BLENDSHAPE_POINTS, IRISES, landmarks_of_mesh
from torchface.landmarks.images.face_reading import FaceReading, box_side
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.shape_names import ARKIT

BLENDSHAPES = ("_neutral", *sorted((name for name in ARKIT if name != "tongueOut"), key=str.lower))
"""What the bundle's last network gives, in its order: ARKit's shapes by the alphabet, but ``tongueOut``."""

_MEASURED = {
    "eyeBlink": (0.345, 0.103, 0.48), "eyeSquint": (0.19, 0.31, 1.0), "jawOpen": (0.609, 0.009, 0.17),
    "mouthFunnel": (0.161, 0.017, 0.38), "mouthPucker": (0.587, 0.105, 0.37), "mouthLeft": (0.264, 0.004, 0.15),
    "mouthRight": (0.264, 0.004, 0.15), "mouthSmile": (0.718, 0.04, 0.23), "mouthStretch": (0.27, 0.033, 0.39),
    "mouthRollLower": (0.184, 0.014, 0.43), "mouthShrugLower": (0.407, 0.04, 0.31),
    "mouthLowerDown": (0.18, 0.03, 0.63), "mouthUpperUp": (0.51, 0.026, 0.27), "browInnerUp": (0.433, 0.149, 0.54),
    "browOuterUp": (0.357, 0.145, 0.6),
}  # fmt: skip
"""Slope and offset of the network's weights on true ones, and deviation of what that makes of them, in 472 rendered
pictures of 120 people; both sides together. Shapes that are not here have slopes below 0.15: they are not seen."""

_CROP = 256
_CORNER = 0.3  # of its pixels: where the crop's first one has its middle; a mirrored crop gives mirrored points by it
_ROUND = 1.5  # the crop's side, of the points' extent
_PRESENT = 0.5  # least presence of a face
_EYES = (33, 263)
# The crop's middle and side beside the box round iBUG's 68, of that box's side: medians over six clips.
_BELOW, _WIDER = 0.05, 1.46
_MISPLACED, _OTHER_SIZE, _OTHER_TURN = 0.08, 1.12, 0.15  # of the crop's side, its ratio, radians: then one more look
_DEVIATION = 0.01  # of the box's side; the networks give none of their own
_SHUT, _SHUT_WIDTH = 0.45, 0.08  # of the blink's weight


@dataclass(frozen=True, eq=False)
class FaceSquare:
    """A turned square of a picture: its middle (2,) and side, pixels, and tilt, radians clockwise as it is seen."""

    middle: Tensor
    side: float
    tilt: float

    @property
    def box(self) -> Tensor:
        """x, y, width, height of the square before it was turned, (4,)."""
        return torch.cat([self.middle - self.side / 2, self.middle.new_full((2,), self.side)])

    def fits(self, other: "FaceSquare") -> bool:
        """Whether a face looks much the same in the other square."""
        turn = math.remainder(self.tilt - other.tilt, 2 * math.pi)
        apart = float((self.middle - other.middle).norm()) / self.side
        ratio = max(self.side / other.side, other.side / self.side)
        return apart < _MISPLACED and ratio < _OTHER_SIZE and abs(turn) < _OTHER_TURN


@dataclass(frozen=True, eq=False)
class MeshFace:
    """A face's mesh."""

    points: Tensor  # (478,2) pixels of the picture
    presence: float  # how likely there is a face, in [0,1]

    @property
    def square(self) -> FaceSquare:
        """Where the networks look for the face next."""
        first, last = self.points[_EYES[0]], self.points[_EYES[1]]
        tilt = math.atan2(*(last - first).flip(0).tolist())
        upright = torch.tensor([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
        own = self.points @ upright
        low, high = own.amin(0), own.amax(0)
        return FaceSquare(upright @ ((low + high) / 2), _ROUND * float((high - low).amax()), tilt)


class FaceLandmarker:
    """The networks of a bundle, given or read from a file, on squares and pictures."""

    def __init__(self, bundle: LandmarkerBundle | str | Path) -> None:
        self.bundle = bundle if isinstance(bundle, LandmarkerBundle) else load_bundle(bundle)

    def look(self, image: Tensor, square: FaceSquare) -> MeshFace:
        """The mesh of the face in a square of a picture, uint8 (H,W) or (3,H,W), red first."""
        transform = crop_transform(square.box, square.tilt, _CROP, 1.0)
        crop = cut_crop(image, transform, _CROP).permute(1, 2, 0).numpy()
        found, logit = self.bundle.landmarks(crop[None].astype(np.float32) / 255)
        points = torch.from_numpy(found.reshape(-1, 3)[:, :2].copy())
        return MeshFace(from_crop(points - _CORNER, transform), 1 / (1 + math.exp(-float(logit.flat[0]))))

    def blendshapes(self, points: Tensor) -> Tensor:
        """Weights of ARKit's shapes (52,) for a mesh (478,2); NaN for ``tongueOut``, which the network lacks."""
        (found,) = self.bundle.blendshapes(points[torch.tensor(BLENDSHAPE_POINTS)].numpy()[None])
        weights = torch.full((len(ARKIT),), torch.nan)
        weights[torch.tensor([ARKIT.index(name) for name in BLENDSHAPES[1:]])] = torch.from_numpy(found[1:].copy())
        return weights


class MediaPipeFinder:
    """Finds landmarks, irises and blendshapes in a box, by a Face Landmarker bundle.

    It gives no deviation and no visibility of its own: every landmark has the confidence 0.8 and is visible.
    """

    def __init__(self, bundle: LandmarkerBundle | str | Path, name: str = "mediapipe") -> None:
        self.landmarker, self.name = FaceLandmarker(bundle), name

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        side = float(box_side(box))
        down = box.new_tensor([-math.sin(tilt), math.cos(tilt)])
        square = FaceSquare(box[:2] + box[2:] / 2 + _BELOW * side * down, _WIDER * side, tilt)
        face = self.landmarker.look(image, square)
        if face.presence >= _PRESENT and not square.fits(face.square):
            face = self.landmarker.look(image, face.square)
        return replace(reading_of(face, self.landmarker.blendshapes(face.points)), search_box=box)


def reading_of(face: MeshFace, weights: Tensor) -> FaceReading:
    """What iBUG's landmarks, irises and lids are of a mesh with blendshapes (52,)."""
    landmarks = landmarks_of_mesh(face.points)
    nothing = torch.zeros(COUNT)
    blink = weights[torch.tensor([ARKIT.index("eyeBlinkRight"), ARKIT.index("eyeBlinkLeft")])]
    presence, (expression, spread) = torch.tensor(face.presence), measured_expression(weights)
    reading = FaceReading(
        landmarks, nothing, nothing + 1, presence, iris=face.points[torch.tensor(IRISES)],
        openness=lid_openness(landmarks), closed=torch.sigmoid((blink - _SHUT) / _SHUT_WIDTH),
        eye_visibility=presence.expand(2), expression=expression, expression_deviation=spread,
    )  # fmt: skip
    return replace(reading, deviation=nothing + _DEVIATION * box_side(reading.search_box))


def measured_expression(weights: Tensor) -> tuple[Tensor, Tensor]:
    """The network's weights (...,52) without what it takes off and adds, and their deviations (52,).

    They differ from the true ones by noise alone; those that the network does not see are NaN, of infinite deviation.
    """
    parts = [_MEASURED.get(name.removesuffix("Left").removesuffix("Right"), _MEASURED.get(name)) for name in ARKIT]
    slope, offset, spread = torch.tensor([part or (torch.nan, 0.0, torch.inf) for part in parts]).T
    return (weights - offset) / slope, spread


def lid_openness(landmarks: Tensor) -> Tensor:
    """The lids' distance over that of the eye's corners, right eye first, (...,2), of iBUG's landmarks (...,68,2)."""
    rows = []
    for first in (36, 42):
        eye = landmarks[..., first : first + 6, :]
        gaps = (eye[..., 1:3, :] - eye[..., [5, 4], :]).norm(dim=-1).mean(-1)
        rows.append(gaps / (eye[..., 3, :] - eye[..., 0, :]).norm(dim=-1).clamp(min=1e-6))
    return torch.stack(rows, -1)
