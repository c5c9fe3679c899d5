"""Annotated photographs for a network that goes on learning: its own readings stand for what nobody has annotated."""

from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import TensorDataset

from torchface.errors import ValueRangeError
from torchface.io import load_image
from torchface.landmarks import LandmarkNetwork
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.ibug_68 import COUNT, INNER, box_around

from .annotated_faces import annotated_landmarks
from .rendered_people.face_picture import SIZE

_AROUND = 1.85  # of the box that a picture holds, as rendered pictures do
_LEAST_TESTED = 10
TESTED = 5
"""Of so many pictures one is kept for the test, where there are ten or more."""


def annotated_pictures(path: Path, network: LandmarkNetwork) -> tuple[TensorDataset, TensorDataset]:
    """Pictures to learn from and to test on, as :meth:`LandmarkNetwork.fit` takes them; few are tested on all.

    What an annotation does not say, further points of the face and its expression, is what the network reads before:
    so it keeps them while it learns the 68.
    """
    rows = [_picture(image, landmarks, network) for image, landmarks in annotated_landmarks(path)]
    if len(rows) < 2:
        raise ValueRangeError(f"--data: found {len(rows)} annotated face in {path}, expected two at least")
    kept = [i for i in range(len(rows)) if len(rows) < _LEAST_TESTED or i % TESTED != TESTED - 1]
    tested = [i for i in range(len(rows)) if len(rows) < _LEAST_TESTED or i not in kept]
    learned, test = ([torch.stack(part) for part in zip(*(rows[i] for i in of), strict=True)] for of in (kept, tested))
    return TensorDataset(*learned), TensorDataset(*test)


@torch.no_grad()
def inner_error(network: LandmarkNetwork, pictures: TensorDataset) -> float:
    """Mean error of brows, eyes, nose and mouth, percent of the distance of the eyes' outer corners."""
    errors = []
    for row in range(len(pictures)):
        rgba, landmarks, *_ = pictures[row]
        transform = crop_transform(box_around(landmarks), 0.0, network.size, network.margin)
        crop = cut_crop(rgba[:3], transform, network.size)
        found = from_crop(network(crop[None].float() / 255).landmarks[0], transform)
        eyes = (landmarks[36] - landmarks[45]).norm()
        errors.append((found - landmarks)[INNER].norm(dim=-1).mean() / eyes)
    return 100 * float(torch.stack(errors).mean())


@torch.no_grad()
def _picture(path: Path, landmarks: Tensor, network: LandmarkNetwork) -> tuple[Tensor, ...]:
    """Red, green, blue and alpha (opaque), landmarks, what is visible, and what the network reads beside them."""
    image = load_image(path)
    image = image[:3] if len(image) >= 3 else image[:1].expand(3, -1, -1)
    pixels = (image * 255).round().to(torch.uint8) if image.is_floating_point() else image
    transform = crop_transform(box_around(landmarks), 0.0, SIZE, _AROUND)
    picture = cut_crop(pixels.contiguous(), transform, SIZE)
    linear = transform[:, :2].to(landmarks)
    marks = landmarks @ linear.T + transform[:, 2].to(landmarks)
    rgba = torch.cat([picture, torch.full_like(picture[:1], 255)])
    row = rgba, marks.float(), torch.ones(COUNT, dtype=torch.bool)
    if network.dense is None:
        return row
    own = crop_transform(box_around(marks), 0.0, network.size, network.margin)
    found = network(cut_crop(picture, own, network.size)[None].float() / 255)
    points = from_crop(found.points[0], own).float()
    return *row, points, torch.ones(len(points), dtype=torch.bool), found.expression[0].float()
