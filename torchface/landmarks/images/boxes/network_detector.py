"""The network of face boxes as a detector: any image in, boxes and roll angles out."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.landmarks.images.boxes.box_network import INPUT_SIZE, BoxNetwork
from torchface.landmarks.images.boxes.face_box import FaceBoxes, check_image, interleaved, sorted_boxes
from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.landmarks.images.graph_session import graph_session

_MULTIPLE = 32  # pixels: the stride of the network's coarsest level
_LEAST_SCORE = 0.4  # of a face


class NetworkDetector:
    """Faces at every roll angle, from 16 pixels in the copy of an image that the network is shown.

    Args:
        network: what finds them; or its graph, see :func:`graph_boxes`.
        least_score: faces of lower score are none.
        longest: the image is made smaller until its longer side has so many pixels.

    Raises:
        ValueRangeError: no such score or length.

    Example:
        >>> from torchface import zoo
        >>> detector = NetworkDetector(zoo.get_model("face_boxes"))
        >>> len(detector(torch.full((3, 120, 160), 128, dtype=torch.uint8)).boxes)
        0
    """

    def __init__(
        self, network: BoxNetwork | Callable[[Tensor], Tensor], least_score: float = _LEAST_SCORE,
        longest: int = INPUT_SIZE,
    ) -> None:  # fmt: skip
        if not (0 < least_score < 1 and longest >= 64):
            raise ValueRangeError(
                f"NetworkDetector: found score {least_score}, longest {longest}; expected (0,1), from 64"
            )
        self.network: Callable[[Tensor], Tensor] = network
        self.least_score, self.longest = least_score, longest
        if isinstance(network, BoxNetwork):
            self.network = without_normalisation(network).float()  # images are
            self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.inference_mode()
    def __call__(self, image: Tensor) -> FaceBoxes:
        check_image(image)
        picture, ratio = _network_picture(image, self.longest)
        faces = self.network(picture)[0].clone()
        faces = faces[faces[:, 3] >= self.least_score]
        middle = (faces[:, :2] + 0.5) * ratio - 0.5
        side = faces[:, 2:3] * ratio.mean()
        boxes = torch.cat([middle - side / 2, side, side], 1)
        return sorted_boxes(boxes, faces[:, 3], torch.atan2(faces[:, 5], faces[:, 4]))


def graph_boxes(content: bytes) -> Callable[[Tensor], Tensor]:
    """A network of face boxes as its graph, in ONNX Runtime on one thread: a sixth of PyTorch's time on a CPU."""
    session = graph_session(content)

    def network(pictures: Tensor) -> Tensor:
        (faces,) = session.run(["faces"], {"images": pictures.contiguous().numpy()})
        return torch.from_numpy(np.asarray(faces))

    return network


def _network_picture(image: Tensor, longest: int) -> tuple[Tensor, Tensor]:
    """What the network is shown of an image: (1,3,h,w) in [0,1], its last rows and columns repeated until they are as
    many as it asks for; and pixels of the image a pixel of it, (2,), x and y."""
    height, width = image.shape[-2:]
    scale = min(1.0, longest / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    # Between two pixels OpenCV interpolates four times as fast as it averages; below half the size it would skip some.
    how = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR
    beyond = [max(2, -(-side // _MULTIPLE)) * _MULTIPLE - side for side in size]
    shown = cv2.resize(interleaved(image), size, interpolation=how)
    shown = cv2.copyMakeBorder(shown, 0, beyond[1], 0, beyond[0], cv2.BORDER_REPLICATE)
    picture = torch.from_numpy(np.atleast_3d(shown)).permute(2, 0, 1).float() / 255
    return picture.expand(3, -1, -1)[None], torch.tensor([width / size[0], height / size[1]])
