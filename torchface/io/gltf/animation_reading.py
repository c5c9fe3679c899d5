"""The animation of a rig's shapes in a glTF file, as a take."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.escaped_text import visible
from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.corrective_extras import scene_correctives
from torchface.io.gltf.gltf_document import Document, read_document
from torchface.io.gltf.primitive_reading import read_target_names
from torchface.io.tables.frame_rates import key_times
from torchface.take import Take, Track

_LINEAR, _CUBIC = "LINEAR", "CUBICSPLINE"
# Of the median; keys further apart are poses, which a program blends by curves that are not read.
_LONGEST_STEP = 10.0


def read_gltf_weights(path: str | Path) -> Take | None:
    """The weights that a file's animations give its shapes, one frame a key; none where nothing moves shapes.

    Each mesh has the weights of the first animation that moves it: some programs write one animation of several objects
    as several, others write several takes of the same face. A ``UserWarning`` reports what is left out.

    Args:
        path: a ``.glb`` or ``.gltf`` whose keys are a film's frames, as :func:`torchface.save_animation` writes them.

    Returns:
        weights (T,N,1), by the names of the morph targets. Of several meshes with a shape of one name the first's
        weights count; correctives follow the others and are left out. Keys that come unevenly keep their times.
    """
    document = read_document(path)
    weights: dict[str, np.ndarray] = {}
    times: np.ndarray | None = None
    meshes: set[int] = set()
    first: int | None = None
    left_out: list[str] = []
    followers = {corrective.name for corrective in scene_correctives(document)}
    for which, animation in enumerate(document.objects("animations")):
        moved: set[int] = set()
        for location, channel, mesh in _weight_channels(document, animation, which):
            if mesh in moved:
                continue  # another node shows it again, and the first's weights count
            if mesh in meshes:
                left_out.append(_shown_name(animation, which))
                continue
            here, names, values = _channel(document, animation, channel, mesh, location)
            if times is not None and (len(here) != len(times) or not np.allclose(here, times)):
                if first == which:
                    raise document.error(location, "keys at other times", "those of the first channel")
                left_out.append(_shown_name(animation, which))
                continue
            times, first = here, which if first is None else first
            moved.add(mesh)
            for name, column in zip(names, values.T, strict=True):
                if name not in followers:
                    weights.setdefault(name, column)
        meshes |= moved
    if left_out:
        listed = ", ".join(dict.fromkeys(left_out[:5]))
        warnings.warn(
            f"{path}: left out: animations of other times or of the same mesh: {visible(listed)}", stacklevel=2
        )
    if times is None or not weights:
        return None
    stacked = np.stack(list(weights.values()), axis=1)
    location = f"animations[{first}]"
    keys = key_times(times, lambda found, expected: document.error(location, found, expected))
    track = Track(tuple(weights), torch.from_numpy(stacked.copy())[..., None])
    return Take(keys.fps, weights=track, seconds=keys.seconds)


def _weight_channels(
    document: Document, animation: dict[str, Any], which: int
) -> Iterator[tuple[str, dict[str, Any], int]]:
    """The channels of an animation that move shapes: their places in words, themselves, and the meshes."""
    for number, row in enumerate(document.array(animation, "channels", f"animations[{which}]")):
        location = f"animations[{which}].channels[{number}]"
        channel = document.record(row, location)
        target = document.record(channel.get("target"), f"{location}.target")
        if target.get("path") == "weights":
            node = document.item("nodes", target.get("node"), f"{location}.target.node")
            yield location, channel, document.integer(node, "mesh", f"{location}.target.node")


def _shown_name(animation: dict[str, Any], which: int) -> str:
    name = animation.get("name")
    return name[:40] if isinstance(name, str) and name else f"animations[{which}]"


def _channel(
    document: Document, animation: dict[str, Any], channel: dict[str, Any], mesh: int, location: str
) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """Times (T,), names and values (T,N) of one channel."""
    samplers = document.array(animation, "samplers", location)
    index = document.integer(channel, "sampler", location)
    if index >= len(samplers):
        raise document.error(f"{location}.sampler", index, f"less than {len(samplers)}")
    sampler = document.record(samplers[index], f"{location}.sampler")
    names = read_target_names(document, mesh)
    if not names:
        raise document.error(f"{location}.target.node", "a mesh without morph targets", "one with them")
    times = read_floats(document, sampler.get("input"), f"{location}.input", ("SCALAR",))[:, 0]
    way = sampler.get("interpolation", _LINEAR)
    steps = np.diff(times.astype(np.float64))
    if way != _LINEAR and len(steps) and steps.max() > _LONGEST_STEP * np.median(steps):
        found = f"{visible(str(way)[:40])} keys up to {steps.max():.4g} s apart, most {np.median(steps):.4g}"
        raise document.error(location, found, "frames, or straight lines between keys: bake the animation")
    each = 3 if way == _CUBIC else 1  # a cubic key is tangent, value, tangent
    count = len(times) * len(names) * each
    values = read_floats(document, sampler.get("output"), f"{location}.output", ("SCALAR",), count)[:, 0]
    values = values.reshape(len(times), each, len(names))[:, each // 2]
    if len(times) == 0:
        raise document.error(f"{location}.input", "no key", "at least one")
    return times, names, values
