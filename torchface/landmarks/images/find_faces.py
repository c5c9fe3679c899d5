"""Searches of an image for faces: all of them, and some of which one of a number must be there."""

from torch import Tensor

from torchface.landmarks.images.boxes.face_box import FaceBoxes, FaceDetector, NoFaceError, check_image
from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.number_checks import as_tensor


def find_faces(image: Tensor, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first; none is no error.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: the zoo's ``face_boxes``, checked by its ``landmark_network``, if absent: faces at every roll angle.

    Raises:
        ShapeError: no such image.

    Example:
        >>> import torch
        >>> len(find_faces(torch.full((120, 160), 128, dtype=torch.uint8)).boxes)
        0
    """
    image = as_tensor("image", image, "(H,W) or (3,H,W) of uint8")
    check_image(image)
    return (detector or shipped_detector())(image)


def find_some_faces(image: Tensor, number: int = 0, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first, one of this number, from 0, among them; see :func:`find_faces`."""
    faces = find_faces(image, detector)
    if not 0 <= number < len(faces):
        found = "no face" if not len(faces) else f"{len(faces)} {'face' if len(faces) == 1 else 'faces'}"
        raise NoFaceError(
            f"image of {image.shape[-1]} x {image.shape[-2]}: found {found}, expected "
            + ("one at least" if number == 0 else f"more than {number}")
        )
    return faces
