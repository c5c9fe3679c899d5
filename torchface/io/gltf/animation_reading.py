"""The animation of a rig's shapes in a glTF file, as a take."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.container import Document, read_document
from torchface.io.gltf.corrective_extras import scene_correctives
from torchface.io.gltf.primitive_reading import read_target_names
from torchface.io.tables.frame_rates import rate_of_keys
from torchface.take import Take, Track

_CUBIC = "CUBICSPLINE"


def read_gltf_weights(path: str | Path) -> Take | None:
    """The weights that a file's first animation gives its shapes, one frame a key; none where nothing moves shapes.

    Args:
        path: a ``.glb`` or ``.gltf`` whose keys are a film's frames, as :func:`torchface.save_animation` writes them.

    Returns:
        weights (T,N,1), by the names of the morph targets. Of several meshes with a shape of one name the first's
        weights count; correctives follow the others and are left out. Frames that come unevenly have their times in
        ``extras["seconds"]``, from 0.

    Raises:
        FileFormatError: not glTF 2, broken, or keys that are no frames: out of order, or with gaps of ten frames.

    Example:
        >>> from torchface.io import save_mesh
        >>> from torchface.synthetic import neutral_head
        >>> save_mesh(neutral_head(texture=False), "still.glb")
        >>> read_gltf_weights("still.glb") is None
        True
    """
    document = read_document(path)
    animations = document.objects("animations")
    place = "animations[0]"
    channels = document.array(animations[0], "channels", place) if animations else []
    weights: dict[str, np.ndarray] = {}
    times: np.ndarray | None = None
    meshes: set[int] = set()
    followers = {corrective.name for corrective in scene_correctives(document)}
    for number, row in enumerate(channels):
        channel = document.record(row, f"{place}.channels[{number}]")
        target = document.record(channel.get("target"), f"{place}.channels[{number}].target")
        if target.get("path") != "weights":
            continue
        node = document.item("nodes", target.get("node"), f"{place}.channels[{number}].target.node")
        mesh = document.integer(node, "mesh", f"{place}.channels[{number}].target.node")
        if mesh in meshes:
            continue  # another node shows it again, and the first's weights count
        meshes.add(mesh)
        here, names, values = _channel(document, animations[0], channel, mesh, f"{place}.channels[{number}]")
        if times is not None and (len(here) != len(times) or not np.allclose(here, times)):
            raise document.error(f"{place}.channels[{number}]", "keys at other times", "those of the first channel")
        times = here
        for name, column in zip(names, values.T, strict=True):
            if name not in followers:
                weights.setdefault(name, column)
    if times is None or not weights:
        return None
    stacked = np.stack(list(weights.values()), axis=1)
    rate, seconds = rate_of_keys(times, lambda found, expected: document.error(place, found, expected))
    extras = {} if seconds is None else {"seconds": seconds}
    return Take(rate, weights=Track(tuple(weights), torch.from_numpy(stacked.copy())[..., None]), extras=extras)


def _channel(
    document: Document, animation: dict[str, Any], channel: dict[str, Any], mesh: int, place: str
) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """Times (T,), names and values (T,N) of one channel."""
    samplers = document.array(animation, "samplers", "animations[0]")
    index = document.integer(channel, "sampler", place)
    if index >= len(samplers):
        raise document.error(f"{place}.sampler", index, f"less than {len(samplers)}")
    sampler = document.record(samplers[index], f"{place}.sampler")
    names = read_target_names(document, mesh)
    if not names:
        raise document.error(f"{place}.target.node", "a mesh without morph targets", "one with them")
    times = read_floats(document, sampler.get("input"), f"{place}.input", ("SCALAR",))[:, 0]
    each = 3 if sampler.get("interpolation") == _CUBIC else 1  # a cubic key is tangent, value, tangent
    count = len(times) * len(names) * each
    values = read_floats(document, sampler.get("output"), f"{place}.output", ("SCALAR",), count)[:, 0]
    values = values.reshape(len(times), each, len(names))[:, each // 2]
    if len(times) == 0:
        raise document.error(f"{place}.input", "no key", "at least one")
    return times, names, values
