"""The animation of a rig's shapes in a glTF file, as a take."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.escaped_text import visible
from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.corrective_extras import scene_correctives
from torchface.io.gltf.gltf_document import Document, read_document, shown
from torchface.io.gltf.primitive_reading import read_target_names
from torchface.io.tables.frame_rates import FrameTimes, key_times
from torchface.number_checks import MAX_FPS, MIN_FPS
from torchface.take import Take, Track

_LINEAR, _STEP, _CUBIC = "LINEAR", "STEP", "CUBICSPLINE"
_FILM_STEP = 0.05  # seconds; keys as near as that are a film's frames, whatever lies between
_FILM_RATES = (30.0, 24.0, 25.0, 60.0)  # of curves between keys; the last where keys lie on none of them
_ON_FRAME = 1e-2  # of a frame
_SAMPLING_BYTES = 40  # of a value while curves are sampled


@dataclass(frozen=True, eq=False)
class _Curves:
    """What one channel gives the shapes of a mesh."""

    names: tuple[str, ...]
    way: str
    keys: np.ndarray  # (T,3,N): tangent before, value, tangent after; the tangents of a cubic alone

    def at(self, times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Values (F,N) at times (F,) between keys at (T,). Source: glTF 2.0, appendix C."""
        first = np.clip(np.searchsorted(times, wanted, "right") - 1, 0, len(times) - 2)
        step = (times[first + 1] - times[first])[:, None].astype(np.float32)
        past = (wanted - times[first])[:, None]
        t = np.divide(past, step, out=np.ones_like(past), where=step > 0)  # the last two keys may be of one frame
        t = np.clip(t, 0, 1).astype(np.float32)
        (_, start, leaving), (arriving, end, _) = self.keys[first].swapaxes(0, 1), self.keys[first + 1].swapaxes(0, 1)
        if self.way == _STEP:
            return np.where(t < 1, start, end)
        values = start + t * (end - start)
        if self.way == _CUBIC:  # Hermite's polynomial, as the straight line and what bends it
            values += t * (1 - t) * ((1 - t) * (step * leaving - end + start) - t * (step * arriving - end + start))
        return values


def read_gltf_weights(path: str | Path) -> Take | None:
    """The weights that a file's animations give its shapes; none where nothing moves shapes.

    Keys are frames. Where they are further apart than a film's and not joined by straight lines, their steps and
    cubic splines are sampled at 30, 24, 25 or 60 frames a second, the first of them whose frames meet all keys. Where
    no rate's frames do, they are sampled at 60, and the extremes at keys between two frames are not kept.

    Each mesh has the weights of the first animation that moves it: some programs write one animation of several objects
    as several, others write several takes of the same face. A ``UserWarning`` reports what is left out.

    Args:
        path: a ``.glb`` or ``.gltf``, as :func:`torchface.save_animation` or another program writes it.

    Returns:
        weights (T,N,1), by the names of the morph targets. Of several meshes with a shape of one name the first's
        weights count; correctives follow the others and are left out. Keys that come unevenly keep their times.
    """
    document = read_document(path)
    curves: list[_Curves] = []
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
            here, moving = _channel(document, animation, channel, mesh, location)
            if times is not None and (len(here) != len(times) or not np.allclose(here, times)):
                if first == which:
                    raise document.error(location, "keys at other times", "those of the first channel")
                left_out.append(_shown_name(animation, which))
                continue
            times, first = here, which if first is None else first
            moved.add(mesh)
            curves.append(moving)
        meshes |= moved
    if left_out:
        listed = ", ".join(dict.fromkeys(left_out[:5]))
        warnings.warn(f"{path}: left out: the character's other animations: {visible(listed)}", stacklevel=2)
    location = f"animations[{first}]"
    if times is None or not any(set(moving.names) - followers for moving in curves):
        return None
    stated = _stated_rate(document.objects("animations")[first or 0])
    frames = key_times(times, lambda found, expected: document.error(location, found, expected), stated)
    if any(moving.way != _LINEAR for moving in curves) and np.diff(times).max(initial=0) > _FILM_STEP:
        keys = times.astype(np.float64) - float(times[0])
        rate = next((one for one in _FILM_RATES if _meets(keys * one)), _FILM_RATES[-1])
        if _meets(keys * rate):
            keys = np.rint(keys * rate) / rate  # single precision may put a step a frame late
        count = int(np.ceil(keys[-1] * rate)) + 1
        document.reserve(_SAMPLING_BYTES * count * sum(len(moving.names) for moving in curves), location)
        frames, wanted = FrameTimes(rate, None), np.arange(count) / rate
        values = [moving.at(keys, wanted) for moving in curves]
    else:
        values = [moving.keys[:, 1] for moving in curves]
    weights: dict[str, np.ndarray] = {}
    for moving, columns in zip(curves, values, strict=True):
        for name, column in zip(moving.names, columns.T, strict=True):
            if name not in followers:
                weights.setdefault(name, column)
    stacked = np.stack(list(weights.values()), axis=1)
    track = Track(tuple(weights), torch.from_numpy(stacked)[..., None])
    return Take(frames.fps, weights=track, seconds=frames.seconds)


def turns_nodes(path: str | Path) -> bool:
    """Whether a file's animations turn nodes too, such as the head and the eyes."""
    document = read_document(path)
    for which, animation in enumerate(document.objects("animations")):
        for number, row in enumerate(document.array(animation, "channels", f"animations[{which}]")):
            location = f"animations[{which}].channels[{number}]"
            if document.record(document.record(row, location).get("target"), location).get("path") == "rotation":
                return True
    return False


def _meets(places: np.ndarray) -> bool:
    return bool(np.abs(places - np.rint(places)).max() <= _ON_FRAME)


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


def _stated_rate(animation: dict[str, Any]) -> float | None:
    """What torchface has written beside the keys."""
    extras = animation.get("extras")
    ours = extras.get("torchface") if isinstance(extras, dict) else None
    fps = ours.get("fps") if isinstance(ours, dict) else None
    return float(fps) if isinstance(fps, int | float) and MIN_FPS <= fps <= MAX_FPS else None


def _shown_name(animation: dict[str, Any], which: int) -> str:
    name = animation.get("name")
    return name[:40] if isinstance(name, str) and name else f"animations[{which}]"


def _channel(
    document: Document, animation: dict[str, Any], channel: dict[str, Any], mesh: int, location: str
) -> tuple[np.ndarray, _Curves]:
    """Times (T,) of the keys of one channel, and what they give."""
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
    if way not in (_LINEAR, _STEP, _CUBIC):
        raise document.error(f"{location}.interpolation", shown(way), f"{_LINEAR}, {_STEP} or {_CUBIC}")
    each = 3 if way == _CUBIC else 1  # a cubic key is tangent, value, tangent
    count = len(times) * len(names) * each
    values = read_floats(document, sampler.get("output"), f"{location}.output", ("SCALAR",), count)[:, 0]
    if len(times) == 0:
        raise document.error(f"{location}.input", "no key", "at least one")
    keys = np.broadcast_to(values.reshape(len(times), each, len(names)), (len(times), 3, len(names)))
    return times, _Curves(names, way, keys)
