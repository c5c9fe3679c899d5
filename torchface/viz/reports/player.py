"""Data of the player in a page, as scripts that a page opened from disk may load."""

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.files.whole_files import all_or_none, write_file
from torchface.geometry.meshes.uv_seams import split_at_seams
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import vertex_openness
from torchface.rendering.compositing import heat_colors, to_pillow
from torchface.rig import BlendshapeRig
from torchface.viz.figures.face_views import clay_colors, framing
from torchface.viz.figures.region_colors import as_seen

_MAX_FRAMES, _MAX_RATE = 6000, 60.0
# A hundredth of a millimetre: markers as 16-bit numbers, and the shortest move that is worth a number.
_MARKER_UNIT, _MIN_MOVE = 0.01, 0.01
_NOT_SEEN = -32768
# What lies behind lips and lids at rest would stay black when they open.
_MIN_OPENNESS = 0.3


@dataclass(frozen=True, eq=False)
class Played:
    """A rig and the weights (T,N) that move it, with the name that the page gives it."""

    title: str
    rig: BlendshapeRig
    weights: Tensor


@dataclass(frozen=True)
class Panel:
    """One of the faces side by side."""

    title: str
    take: int | None = None  # which of the player's; the one that the viewer of the page has chosen if absent
    error: bool = False  # coloured by the distance to the first take's face
    markers: bool = False
    yaw: float = 0.0  # from where it is seen, degrees


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers over a face: points (T,M,3), NaN for not seen; coloured by errors (T,M) up to ``maximum``, if given."""

    points: Tensor
    errors: Tensor | None = None
    maximum: float = 1.0


@dataclass(frozen=True, eq=False)
class Player:
    """What is played."""

    takes: Sequence[Played]  # rigs of one mesh, with weights of as many frames and shapes of the same names
    panels: Sequence[Panel]  # from left to right
    fps: float
    choices: Sequence[int] = (0,)  # rows of takes between which the viewer of the page chooses; the first to begin with
    reference: int | None = None  # row of takes whose curves lie under the others'
    curves: Sequence[str] = ()
    markers: Markers | None = None  # over the panels that ask for them
    maximum: float = 2.0  # distance at the end of the colours, millimetres
    start: int = 0


def write_player(player: Player, folder: Path) -> str:
    """Writes ``player.js`` and the data into a folder; gives the HTML that plays it, for ``Section.markup``.

    Long takes and high frame rates are thinned to 60 frames a second and 6,000 frames.
    """
    first = player.takes[0]
    for take in player.takes:
        if take.weights.shape != first.weights.shape or take.rig.deltas.shape != first.rig.deltas.shape:
            raise ShapeError(
                f"player: found weights {tuple(take.weights.shape)} of deltas {tuple(take.rig.deltas.shape)}, expected "
                f"{tuple(first.weights.shape)} and {tuple(first.rig.deltas.shape)} as in the first take"
            )
    frames = len(first.weights)
    step = max(1, round(player.fps / _MAX_RATE), math.ceil(frames / _MAX_FRAMES))
    rigs = list({id(take.rig): take.rig for take in player.takes}.values())
    thinned = [take.weights[::step] for take in player.takes]
    data: dict[str, Any] = {
        "fps": player.fps / step,
        "step": step,
        "frames": len(thinned[0]),
        "start": player.start // step,
        "shapes": first.rig.names,
        "curves": [first.rig.names.index(shape) for shape in player.curves],
        "rigs": [_rig(rig) for rig in rigs],
        "takes": [
            {
                "title": take.title,
                "rig": next(i for i, rig in enumerate(rigs) if rig is take.rig),
                "weights": _packed((weights.clamp(0, 1) * 65535).round(), np.uint16),
            }
            for take, weights in zip(player.takes, thinned, strict=True)
        ],
        "panels": [vars(panel) for panel in player.panels],
        "choices": list(player.choices),
        "chosen": player.choices[0],
        "reference": player.reference,
        "error_maximum": player.maximum,
        "heat": _packed(255 * heat_colors(torch.arange(256) / 255, 1.0), np.uint8),
        "markers": None if player.markers is None else _markers(player.markers, step),
        **_appearance(first.rig.neutral),
    }
    script = files("torchface.viz.reports").joinpath("player.js").read_bytes()
    with all_or_none():
        write_file(folder / "player.js", script)
        content = f'torchfacePlayer("performance",{json.dumps(data, allow_nan=False)});\n'
        write_file(folder / "performance.js", content.encode())
    return '<div id="performance"></div>\n<script src="player.js"></script>\n<script src="performance.js"></script>\n'


def _rig(rig: BlendshapeRig) -> dict[str, Any]:
    """Rest and moves; of a shape only the vertices that it moves."""
    rig = rig.linear("player")
    deltas = rig.deltas.detach().cpu().float()
    scale = max(float(deltas.abs().max()), 1e-6) / 32767
    moved = deltas.norm(dim=-1) > _MIN_MOVE
    shape, vertex = moved.nonzero().unbind(1)
    return {
        "vertices": _packed(rig.vertices.detach().cpu(), np.float32),
        "starts": _packed(torch.nn.functional.pad(moved.sum(1).cumsum(0), (1, 0)), np.uint32),
        "ids": _packed(vertex, np.uint32),
        "deltas": _packed((deltas[shape, vertex] / scale).round(), np.int16),
        "scale": scale,
    }


def _markers(markers: Markers, step: int) -> dict[str, Any]:
    points = (markers.points[::step].detach().cpu().double() / _MARKER_UNIT).round().clamp(_NOT_SEEN + 1, 32767)
    errors = None if markers.errors is None else markers.errors[::step].nan_to_num(0.0) / markers.maximum
    return {
        "points": _packed(points.nan_to_num(_NOT_SEEN), np.int16),
        "heat": None if errors is None else _packed((255 * errors.clamp(0, 1)).round(), np.uint8),
        "count": points.shape[1],
        "scale": _MARKER_UNIT,
        "maximum": markers.maximum,
    }


def _appearance(mesh: Mesh) -> dict[str, Any]:
    """The framing, and what covers the mesh: texture with a corner a pair of vertex and texture point, or colours."""
    mesh = as_seen(mesh)
    faces = mesh.faces.cpu()
    uvs = texture = None
    uv_faces = None if mesh.texture is None or mesh.uv_faces is None else mesh.uv_faces.cpu().numpy()
    split = split_at_seams(len(mesh.vertices), faces.numpy(), uv_faces)
    if mesh.texture is not None and mesh.uvs is not None and split.uv_of is not None:
        uvs = _packed(mesh.uvs.cpu()[split.uv_of], np.float32)
        content = BytesIO()
        to_pillow(mesh.texture).save(content, "JPEG", quality=88)
        texture = "data:image/jpeg;base64," + base64.b64encode(content.getvalue()).decode()
    colors = clay_colors(mesh) if mesh.colors is None else mesh.colors
    openness = vertex_openness(mesh)
    centre, span = framing(mesh)
    return {
        "faces": _packed(faces, np.uint32),
        "corner_vertex": _packed(torch.from_numpy(split.vertex_of), np.uint32),
        "corner_faces": _packed(torch.from_numpy(split.triangles), np.uint32),
        "uvs": uvs,
        "texture": texture,
        "colors": _packed((255 * colors.clamp(0, 1)).round(), np.uint8),
        "openness": _packed((255 * openness.clamp(min=_MIN_OPENNESS)).round(), np.uint8),
        "centre": centre.tolist(),
        "span": span,
    }


def _packed(values: Tensor, kind: type[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(values.numpy().astype(kind)).tobytes()).decode()
