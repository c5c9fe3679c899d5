"""The network of face boxes as ONNX: images of any size to the likeliest faces in them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx
import torch

from torchface import __version__
from torchface.landmarks.images.box_network import BoxNetwork
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.exported_model import exported_model

_PARITY = 2e-3  # pixels, of sides of some tens
FACE_VALUES = ("x", "y", "side", "score", "cosine", "sine")
"""What the graph says of a face, in this order."""


def export_box_network(
    network: BoxNetwork, path: str | Path, facts: Mapping[str, object] | None = None, images: torch.Tensor | None = None
) -> ExportReport:
    """Writes a network of face boxes, and checks it.

    The graph takes ``images`` (B,3,H,W), red, green, blue in [0,1], 64 pixels a side at least and best a multiple of
    32, and gives ``faces`` (B,K,6), the likeliest first: x and y of the centre and side of the box, pixels, score in
    [0,1], cosine and sine of the roll angle, clockwise as the image is seen. What is no face has a score near 0.

    Args:
        network: with what it has learned.
        path: the file to write.
        facts: further metadata, such as licence and data.
        images: to check with; cloudy noise if absent.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    network = network.eval()
    if images is None:
        generator = torch.Generator().manual_seed(0)
        coarse = torch.rand(2, 3, 12, 16, generator=generator)
        images = torch.nn.functional.interpolate(coarse, size=(192, 256), mode="bicubic").clamp(0, 1)
    cases = []
    with torch.no_grad():
        for part in (images[:1], images, images[..., :160]):
            cases.append(({"images": part}, {"faces": network(part)}))
    return write_checked(
        box_network_model(network, facts), path, cases, {"faces": _PARITY}, {"faces": "pixels or of 1"}
    )


def box_network_model(network: BoxNetwork, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph."""
    return exported_model(
        network,
        {"images": torch.zeros(2, 3, 192, 256)},
        ["faces"],
        {
            "task": "face_boxes",
            "values": list(FACE_VALUES),
            "units": "pixels",
            "multiple": 32,
            "version": __version__,
            **(facts or {}),
        },
        {"images": ("batch", None, "height", "width")},
    )
