"""A mesh or a posed rig from whatever file it lies in."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, NoShapesError, TorchfaceError, ValueRangeError
from torchface.io import load_mesh, load_rig
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import SCENE_ENDINGS, load_animation
from torchface.io.rigs.ict_facekit import region
from torchface.mesh import Mesh, submesh
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping, near_names
from torchface.workflows.weight_files import load_weight_take, without_shape

_FEW, _ALIKE = 5, 0.5
"""Shapes that move a head; of the largest head's size, what another has at least."""

_HEADS, _BODY, _TALLEST = (80, 700), 0.45, 2500.0
"""Millimetres: the largest extent of a face or head; a body's least width of its height, and its height."""


@dataclass(frozen=True, eq=False)
class Posed:
    """A mesh in a pose, and the same at rest (the mesh itself where it came without shapes)."""

    mesh: Mesh
    neutral: Mesh
    faults: tuple[str, ...] = ()  # what of a take is not shown, for people to read


def pose_weights(words: Sequence[str], option: str = "--weights") -> dict[str, float]:
    """``["jawOpen=0.5"]`` as a dictionary, also of several in one text; errors name the option that they are of."""
    weights = {}
    # Names may have blanks: a weight ends at the first one behind its "=".
    for word in [part for text in words for part in re.findall(r"\S[^=]*=\S+|\S+", text) or [text]]:
        name, equals, number = word.partition("=")
        try:
            weights[name] = float(number)
        except ValueError:
            raise ValueRangeError(f"{option}: found {word!r}, expected NAME=NUMBER such as jawOpen=0.5") from None
        if not equals or not name or not abs(weights[name]) <= 10:
            raise ValueRangeError(f"{option}: found {word!r}, expected NAME=NUMBER with a number from -10 to 10")
    return weights


def load_posed(
    path: Path, weights: dict[str, float], take: Path | None = None, frame: int = 0, part: str | None = None
) -> Posed:
    """Reads a mesh or a rig, or a part of it, and poses it by weights or by a frame of a take or of an animated
    rig's file."""
    if weights or take is not None:
        if path.suffix.lower() in MESH_ENDINGS:
            raise NameMismatchError(f"{path}: found a mesh without shapes; a pose needs a rig (.glb or a folder)")
        rig: BlendshapeRig | None = load_rig(path, part=part)
    else:
        neutral, rig = load_neutral(path, part=part)
    if rig is None:
        return Posed(neutral, neutral)
    if take is None:
        return Posed(posed_mesh(rig, weights), rig.neutral)
    track = load_weight_take(take).weights
    assert track is not None
    if not 0 <= frame < len(track):
        raise ValueRangeError(f"{take}: found {len(track)} frames, expected frame {frame} among them")
    shown = track.frames(slice(frame, frame + 1))
    mesh = rig.neutral.with_vertices(rig(rig.weights_from(shown).to(rig.deltas))[0])
    return Posed(mesh, rig.neutral, tuple(f"warning: {path} {lost} {take}" for lost in without_shape(rig, shown)))


def is_animated(path: Path) -> bool:
    """Whether a file has an animation of its shapes."""
    with suppress(TorchfaceError):  # what is wrong with an animation is no matter of a mesh at rest
        return path.suffix.lower() in SCENE_ENDINGS and load_animation(path) is not None
    return False


def pose_row(rig: BlendshapeRig, weights: Mapping[str, float], option: str = "--weights") -> Tensor:
    """Weights (N,) of a rig by name, in any of the spellings that ``torchface.shape_names`` reads."""
    names = tuple(weights)
    matrix = mapping(names, rig.names)
    unknown = [name for name, used in zip(names, matrix.any(0), strict=True) if not used]
    if unknown:
        hint = near_names(unknown, rig.names)
        raise NameMismatchError(f"{option}: found {', '.join(unknown)}; expected shapes of the rig: {hint}")
    return (matrix @ torch.tensor([weights[name] for name in names])).to(rig.deltas)


def posed_mesh(rig: BlendshapeRig, weights: Mapping[str, float], option: str = "--weights") -> Mesh:
    """The rig's mesh in a pose; see :func:`pose_row`."""
    with torch.no_grad():
        return rig.neutral.with_vertices(rig(pose_row(rig, weights, option)[None])[0])


def load_neutral(path: Path, unit: str | None = None, part: str | None = None) -> tuple[Mesh, BlendshapeRig | None]:
    """The mesh at rest of whatever holds a rig or a mesh, or a part of it, and the rig where there are shapes."""
    if path.suffix.lower() not in MESH_ENDINGS:
        try:
            rig = load_rig(path, unit, part)
            return rig.neutral, rig
        except NoShapesError:
            pass
    mesh = load_mesh(path, unit)
    return mesh if part is None else submesh(mesh, region(mesh, part)).mesh, None


def several_heads(rig: BlendshapeRig) -> str:
    """Which parts of a rig are heads beside each other, with the number of shapes that move each; empty of one."""
    notes = rig.neutral.annotations
    found: list[tuple[float, str, int, Tensor, Tensor]] = []
    for name, rows in ({} if notes is None else notes.regions).items():
        moving = int((rig.deltas[:, rows] != 0).any(2).any(1).sum())
        if moving >= _FEW:
            points = rig.vertices[rows].detach()
            low, high = points.amin(0), points.amax(0)
            found.append((float((high - low).max()), name, moving, low, high))
    heads: list[tuple[float, str, int, Tensor, Tensor]] = []
    for one in sorted(found, key=lambda one: -one[0]):
        size, _, _, low, high = one
        # Whatever lies above or below, such as a neck, is of the same person.
        apart = all(bool(((low > other[4]) | (high < other[3]))[[0, 2]].any()) for other in heads)
        if apart and (not heads or size >= _ALIKE * heads[0][0]):
            heads.append(one)
    if len(heads) < 2:
        return ""
    listed = ", ".join(f"{name} ({moving} shapes)" for _, name, moving, *_ in heads)
    return (
        f"{len(heads)}: {listed}; they are one rig here, a shape that both have moves both; --part {heads[0][1]} keeps "
        "one"
    )


def size_faults(mesh: Mesh) -> list[str]:
    """What to say of a mesh that is too small or too large for a head in millimetres, unless it is a body."""
    width, height, depth = (mesh.vertices.amax(0) - mesh.vertices.amin(0)).tolist()
    largest, body = max(width, height, depth), min(width, depth) < _BODY * height
    if _HEADS[0] <= largest <= _HEADS[1] or (body and largest < _TALLEST):
        return []
    return [f"{largest:,.4g} mm, expected {_HEADS[0]} to {_HEADS[1]} of a head: the file may be in another unit"]
