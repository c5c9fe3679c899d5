"""Weights of wrinkle maps as ONNX: of a rig's vertices, or of its blendshape weights."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement.wrinkle_maps.wrinkle_weights import RigWrinkles, WrinkleWeights
from torchface.onnx.checked_export import ExportReport, export_checked

OUTPUT = "map_weights"
_PARITY = 1e-4


def export_wrinkle_weights(
    wrinkles: WrinkleWeights | RigWrinkles, poses: Tensor, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes the graph of a rig's wrinkle weights, and checks it.

    It takes ``vertices`` (B,V,3), millimetres, of the rig in any rigid place, or for ``RigWrinkles`` ``weights``
    (B,N), and gives ``map_weights`` (B,R,M) in [0,1]. The metadata holds ``regions`` and, for the latter, ``shapes``,
    as JSON.

    Args:
        wrinkles: what to write.
        poses: to check it with, vertices (T,V,3) or weights (T,N).
        path: the file to write.
        facts: further metadata, such as names of the maps.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    if isinstance(wrinkles, RigWrinkles):
        learned, name = wrinkles.wrinkles, "weights"
        about: dict[str, object] = {"units": "weights in [0,1]", "shapes": list(wrinkles.names)}
    else:
        learned, name, about = wrinkles, "vertices", {"units": "millimetres"}
    about |= {"task": "wrinkle_weights", "regions": list(learned.region_names)}
    with torch.no_grad():
        cases = [({name: some}, {OUTPUT: wrinkles(some)}) for some in (poses[:1], torch.cat([poses[:1], poses]))]
    units = {OUTPUT: "of the range"}
    return export_checked(wrinkles, path, cases, {OUTPUT: _PARITY}, units, about | dict(facts or {}))
