"""ONNX export of the networks that read images: landmarks, eyes, parts of faces, face boxes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn

from torchface.landmarks import BoxNetwork, EyeFindings, EyeNetwork, LandmarkNetwork, NetworkLandmarks
from torchface.landmarks.images.boxes.box_network import COPIES, enlarged
from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.landmarks.images.networks.part_network import PART_MARGIN, PART_SIZE, PARTS, PartNetwork
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.exported_model import check_model, exported_model, half_stored, rename_values

ImageNetwork = LandmarkNetwork | EyeNetwork | PartNetwork | BoxNetwork

FACE_VALUES = ("x", "y", "side", "score", "cosine", "sine")
"""What the graph of face boxes gives for a face, in this order."""

_PIXELS = {"landmarks", "iris", "deviation", "faces", "points", "point_deviation"}


@dataclass(frozen=True)
class _Form:
    """The graph of a network."""

    images: str
    sizes: tuple[str | None, ...]  # names of the input's axes that may have any size
    example: Tensor  # an input, 2 images or more
    parity: Mapping[str, float]  # by output, how far ONNX Runtime may be from PyTorch
    metadata: Mapping[str, object]


def _form(network: ImageNetwork) -> _Form:
    if isinstance(network, LandmarkNetwork):
        facts = {"landmarks": "iBUG 68", "image": "red, green, blue, 0 to 1", "crop": str(network.margin)}
        parity = {name: 0.1 if name in _PIXELS else 0.01 for name in _given(network)}
        shape = (network.size, network.size)
        return _Form("image", ("batch",), _cloudy(*shape), parity, facts | {"units": "pixels of the crop"})
    if isinstance(network, EyeNetwork):
        facts = {
            "eyes": "red, green, blue, 0 to 1; left eyes mirrored",
            "landmarks": "outer corner, two of the upper lid, inner corner, two of the lower lid",
            "units": "pixels of the crop",
        }
        parity = {name: 0.1 if name in _PIXELS else 0.01 for name in EyeFindings._fields}
        return _Form("eyes", ("batch",), _cloudy(network.height, network.width), parity, facts)
    if isinstance(network, PartNetwork):
        facts = {"faces": "red, green, blue, 0 to 1", "shares": ", ".join(PARTS), "crop": str(PART_MARGIN)}
        return _Form("faces", ("batch",), _cloudy(PART_SIZE, PART_SIZE), {"shares": 0.02}, facts)
    given = {"values": list(FACE_VALUES), "units": "pixels", "multiple": 32}
    return _Form("images", ("batch", None, "height", "width"), _cloudy(192, 256), {"faces": 2e-3}, given)


def export_network(network: ImageNetwork, path: str | Path, facts: Mapping[str, object] | None = None) -> ExportReport:
    """Writes a network that reads images as ONNX, and checks it.

    The graph of a ``LandmarkNetwork`` takes ``image`` (B,3,S,S): faces' boxes enlarged by the metadata's ``crop`` and
    turned upright. It gives ``landmarks`` (B,68,2) and ``deviation`` (B,68), pixels of the crop, ``visibility`` (B,68)
    and ``presence`` (B,) in [0,1]; where the network has further points, also ``points`` (B,P,2) and
    ``point_deviation`` (B,P), likewise pixels, ``expression`` (B,52) and ``expression_deviation`` (B,52).

    That of an ``EyeNetwork`` takes ``eyes`` (B,3,h,w): crops as ``eye_transforms`` cuts them, left eyes mirrored. It
    gives ``landmarks`` (B,6,2), ``iris`` (B,2) and ``deviation`` (B,7), pixels of the crop, ``openness`` (B,), and
    ``closed`` and ``visibility`` (B,) in [0,1].

    That of a ``PartNetwork`` takes ``faces`` (B,3,128,128), boxes enlarged by ``crop``, and gives the ``shares``
    (B,10,128,128) of the parts that the metadata name.

    That of a ``BoxNetwork`` takes ``images`` (B,3,H,W), 64 pixels a side at least and best a multiple of 32. It gives
    ``faces`` (B,K,6), the likeliest first: x and y of the centre and side of the box, pixels, score in [0,1], cosine
    and sine of the roll angle, clockwise as the image is seen. What is no face has a score near 0.

    Images are red, green, blue in [0,1]. Weights of the first three are stored in half precision.
    """
    form, cases = _form(network.eval()), []
    smaller = form.example[..., : form.example.shape[-1] - 64] if "width" in form.sizes else form.example
    for images in (form.example[:1], form.example, smaller):
        with torch.no_grad():
            found = network(images)
        named = {next(iter(form.parity)): found} if isinstance(found, Tensor) else found._asdict()
        cases.append(({form.images: images}, named))
    units = {name: "pixels" if name in _PIXELS else "of 1" for name in form.parity}
    units |= {
        name: "pixels (above 1 a share)" for name in form.parity if name.endswith("deviation") and name in _PIXELS
    }
    return write_checked(network_model(network, facts), path, cases, form.parity, units)


def network_model(network: ImageNetwork, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph; see :func:`export_network`."""
    form = _form(network)
    names = {
        LandmarkNetwork: "landmark_network", EyeNetwork: "eye_network", PartNetwork: "face_parts",
        BoxNetwork: "face_boxes",
    }  # fmt: skip
    task = names[type(network)]
    fused = without_normalisation(network)
    metadata = {"task": task, **form.metadata, **(facts or {})}
    if isinstance(fused, BoxNetwork):
        return _box_model(fused, form, metadata)
    module = _Given(fused, _given(fused)) if isinstance(fused, LandmarkNetwork) else fused
    model = exported_model(
        module,
        {form.images: form.example},
        list(form.parity),
        metadata,
        {form.images: form.sizes},
    )
    return half_stored(model, halves(module))


def _box_model(network: BoxNetwork, form: _Form, metadata: Mapping[str, object]) -> onnx.ModelProto:
    """What says the cells of one copy is exported once: exported with each copy's sizes the whole takes a minute."""
    images, cells = {form.images: form.example}, {"cells": network.cells(form.example).detach()}
    part = exported_model(_Method(network, "cells"), images, list(cells), {}, {form.images: form.sizes}).graph
    count = {"cells": ("batch", "count")}
    model = exported_model(_Method(network, "likeliest"), cells, list(form.parity), metadata, count)
    rename_values(model.graph, lambda name: name if name in form.parity else f"all.{name}")
    kept, said, shown = {one.name: one.name for one in part.initializer}, list[str](), form.images
    nodes = list[onnx.NodeProto]()
    for half in range(COPIES):
        if half:
            nodes += [helper.make_node("AveragePool", [shown], [f"{half}.copy"], kernel_shape=[2, 2], strides=[2, 2])]
            shown = f"{half}.copy"
        copy, named = onnx.GraphProto(), {**kept, form.images: shown}
        copy.CopyFrom(part)
        rename_values(copy, partial(_renamed, named, f"{half}."))
        scale, offset, scaled, faces = (f"{half}.{name}" for name in ("scale", "offset", "scaled", "faces"))
        moved = enlarged(torch.zeros(6), 2**half)
        for name, value in {scale: enlarged(torch.ones(6), 2**half) - moved, offset: moved}.items():
            part.initializer.append(numpy_helper.from_array(value.numpy(), name))
        nodes += [*copy.node, helper.make_node("Mul", [f"{half}.cells", scale], [scaled])]
        nodes += [helper.make_node("Add", [scaled, offset], [faces])]
        said.append(faces)
    nodes += [helper.make_node("Concat", said, ["all.cells"], axis=1), *model.graph.node]
    del model.graph.node[:], model.graph.input[:]
    model.graph.node.extend(nodes)
    model.graph.input.extend(part.input)
    model.graph.initializer.extend(part.initializer)
    check_model(model)
    return model


def _renamed(known: Mapping[str, str], prefix: str, name: str) -> str:
    return known.get(name, prefix + name)


class _Method(nn.Module):
    """A method of a network as a module."""

    def __init__(self, network: nn.Module, name: str) -> None:
        super().__init__()
        self.network, self.name = network, name

    def forward(self, given: Tensor) -> Tensor:
        return getattr(self.network, self.name)(given)  # type: ignore[no-any-return]


def _given(network: LandmarkNetwork) -> tuple[str, ...]:
    """What a network finds: without further points the 68 alone."""
    return NetworkLandmarks._fields if network.points else NetworkLandmarks._fields[:4]


class _Given(nn.Module):
    """A landmark network with no more outputs than it has something to say of."""

    def __init__(self, network: LandmarkNetwork, names: tuple[str, ...]) -> None:
        super().__init__()
        self.network, self.names = network, names

    def forward(self, crops: Tensor) -> tuple[Tensor, ...]:
        found = self.network(crops)
        return tuple(getattr(found, name) for name in self.names)


def halves(network: nn.Module, prefix: str = "") -> set[str]:
    """Names of the weights that are stored in half precision: all but biases."""
    return {prefix + name for name, value in network.named_parameters() if value.ndim > 1 and not name.endswith("bias")}


def _cloudy(height: int, width: int) -> Tensor:
    """Two smooth random images."""
    coarse = torch.rand(2, 3, height // 8, width // 8, generator=torch.Generator().manual_seed(0))
    return nn.functional.interpolate(coarse, (height, width), mode="bilinear")
