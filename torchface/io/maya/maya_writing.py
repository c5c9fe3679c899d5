"""Rigs and their animations as Maya ASCII (``.ma``): a mesh, a blendShape node with named targets, animation curves."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import FileFormatError, TopologyError
from torchface.escaped_text import listed
from torchface.files.whole_files import replaced_file
from torchface.files.write_errors import unwritten
from torchface.io.gltf.primitive_writing import MIN_MOVE
from torchface.io.length_units import millimetres_per
from torchface.io.meshes.polygons import corners_of_polygons
from torchface.io.scenes.weight_keys import WeightKeys
from torchface.io.usd.usd_writing import free_name
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig

MAYA_ENDING = ".ma"

# Maya's names for rates; others have their number, as far as Maya has them.
_RATES = {
    **{float(rate): f"{rate}fps" for rate in (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 40, 75, 80, 100, 120, 125)},
    **{float(rate): f"{rate}fps" for rate in (150, 200, 240, 250, 300, 375, 400, 500, 600, 750, 1200, 2000)},
    **{15.0: "game", 24.0: "film", 25.0: "pal", 30.0: "ntsc", 48.0: "show", 50.0: "palf", 60.0: "ntscf"},
    **{24000 / 1001: "23.976fps", 30000 / 1001: "29.97fps", 48000 / 1001: "47.952fps", 60000 / 1001: "59.94fps"},
}
_SAME_RATE = 1e-4
_OTHER_RATE = 60.0
_FULL, _STEP = 6000, 1000  # an item's number is 5000 and a thousand times the weight at which it is on
_LINEAR = 2
_PER_STATEMENT, _PER_LINE = 500, 20
# What blendShape nodes and all nodes call their own attributes, which no alias may be called.
_ATTRIBUTES = re.findall(
    r"\w+",
    "weight w envelope en input ip inputGeometry ig groupId gi inputTarget it outputGeometry og origin or message msg "
    "caching cch frozen nodeState nds isHistoricallyInteresting ihi binMembership bnm topologyCheck tc sn pndr icon "
    "useTargetCompWeights supportNegativeWeights symmetryEdge targetOrigin parallelBlender paramWeights baseOrigin bo "
    "notes nts attributeAliasList aal originalGeometry orggeom weightList wl weights midLayerId mlid",
)


@dataclass(frozen=True)
class MayaTargets:
    """The targets of a rig's blendShape node."""

    aliases: tuple[str, ...]  # Maya's names of the shapes and then of the combinations
    combinations: tuple[str, ...]  # names of the combinations among the correctives
    # Of each target, where it leads by the number of the item, (V,3), millimetres.
    items: tuple[dict[int, NDArray[np.float64]], ...]
    drivers: tuple[tuple[int, ...], ...]  # of each combination, the targets whose weights are multiplied


def write_maya_rig(rig: BlendshapeRig, path: str | Path, keys: WeightKeys | None = None) -> None:
    """Writes a rig as Maya ASCII in centimetres, in the rig's order of vertices and polygons.

    Each shape is a target of one blendShape node, by an alias of its name; in-betweens are items of their shape's
    target, combinations targets that a combinationShape node drives with the product of the shapes' weights. An
    animation is an animCurveTU with linear tangents for each shape that moves. Maya's names have ASCII letters, digits
    and underscores: other signs become underscores, and the node's ``notes`` list what was renamed. The texture,
    vertex colours and annotations are left out.

    The file appears only when it is complete.
    """
    path = Path(path)
    if len(rig.neutral.faces) == 0:
        raise TopologyError(f"{path}: the mesh has no triangle; Maya's files need one")
    targets = _targets(rig, path)
    with replaced_file(path) as temporary:
        try:
            with temporary.open("w", encoding="utf-8", newline="\n") as file:
                file.writelines(_scene(rig, targets, keys))
        except OSError as error:
            raise unwritten(path, error) from error


def maya_notes(rig: BlendshapeRig, keys: WeightKeys | None = None) -> list[str]:
    """What a ``.ma`` has no place for or calls otherwise, for people to read."""
    targets, notes = _targets(rig, Path("rig.ma")), []
    renamed = [f"{name!r} is {alias}" for name, alias in _renamed(rig, targets)]
    if renamed:
        notes.append(f".ma has other names for {len(renamed)} shapes: {listed(renamed)}")
    neutral = rig.neutral
    lost = {"the texture": neutral.texture, "vertex colours": neutral.colors, "annotations": neutral.annotations}
    if left := [what for what, value in lost.items() if value is not None]:
        notes.append(f".ma has no place for {' and '.join(left)}, left out")
    peaks = (
        []
        if rig.correctives is None
        else [definition.peak for definition in rig.correctives.definitions if definition.peak is not None]
    )
    if rounded := [peak for peak in peaks if abs(peak - round(peak, 3)) > 1e-6]:
        notes.append(f"Maya has in-betweens at thousandths: {len(rounded)} peaks are rounded")
    if keys is not None and abs(_rate(keys.fps)[0] / keys.fps - 1) > _SAME_RATE:
        notes.append(f"Maya has no rate of {keys.fps:g} frames a second: keys lie at their seconds at {_OTHER_RATE:g}")
    return notes


def _renamed(rig: BlendshapeRig, targets: MayaTargets) -> list[tuple[str, str]]:
    names = zip((*rig.names, *targets.combinations), targets.aliases, strict=True)
    return [(name, alias) for name, alias in names if name != alias]


def _rate(fps: float) -> tuple[float, str]:
    """Maya's rate nearest to one, where it is the same, and its name; else 60."""
    nearest = min(_RATES, key=lambda rate: abs(rate - fps))
    rate = nearest if abs(nearest / fps - 1) < _SAME_RATE else _OTHER_RATE
    return rate, _RATES[rate]


def _targets(rig: BlendshapeRig, path: Path) -> MayaTargets:
    items = [{_FULL: delta} for delta in _numpy(rig.deltas)]
    row, combinations, drivers = {name: i for i, name in enumerate(rig.names)}, [], []
    if (correctives := rig.correctives) is not None:
        for definition, delta in zip(correctives.definitions, _numpy(correctives.deltas), strict=True):
            if definition.peak is None:
                items.append({_FULL: delta})
                combinations.append(definition.name)
                drivers.append(tuple(row[driver] for driver in definition.drivers))
                continue
            own, number = items[row[definition.drivers[0]]], _FULL - _STEP + round(_STEP * definition.peak)
            if number in own or number == _FULL - _STEP:
                raise FileFormatError(
                    f"{path}: found two samples of {definition.drivers[0]!r} within a thousandth of "
                    f"{definition.peak:g}, expected in-betweens further apart"
                )
            own[number] = definition.peak * own[_FULL] + delta
    used = set(_ATTRIBUTES)
    aliases = tuple(free_name(_identifier(name), used) for name in (*rig.names, *combinations))
    return MayaTargets(aliases, tuple(combinations), tuple(items), tuple(drivers))


def _identifier(name: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name) or "shape"
    return f"_{plain}" if plain[0].isdigit() else plain


def _numpy(tensor: Tensor) -> NDArray[np.float64]:
    return tensor.detach().cpu().double().numpy()


def _scene(rig: BlendshapeRig, targets: MayaTargets, keys: WeightKeys | None) -> Iterator[str]:
    rate, unit = _rate(24.0 if keys is None else keys.fps)
    yield "//Maya ASCII 2018 scene\n//Codeset: UTF-8\n"
    yield 'requires maya "2018";\n'
    yield f"currentUnit -l centimeter -a degree -t {unit};\n"
    yield 'fileInfo "application" "torchface";\n'
    yield 'createNode transform -n "face";\n'
    yield 'createNode mesh -n "faceShape" -p "face";\n\tsetAttr -k off ".v";\n'
    yield 'createNode mesh -n "faceShapeOrig" -p "face";\n\tsetAttr -k off ".v";\n\tsetAttr ".io" yes;\n'
    yield from _mesh(rig.neutral)
    yield from _blend_shape(rig, targets)
    yield 'createNode objectSet -n "shapesSet";\n\tsetAttr ".ihi" 0;\n\tsetAttr ".vo" yes;\n'
    yield 'createNode groupId -n "shapesGroupId";\n\tsetAttr ".ihi" 0;\n'
    yield 'createNode groupParts -n "shapesGroupParts";\n\tsetAttr ".ihi" 0;\n'
    yield '\tsetAttr ".ic" -type "componentList" 1 "vtx[*]";\n'
    links = [
        ("faceShapeOrig.w", "shapesGroupParts.ig"),
        ("shapesGroupId.id", "shapesGroupParts.gi"),
        ("shapesGroupParts.og", "shapes.ip[0].ig"),
        ("shapesGroupId.id", "shapes.ip[0].gi"),
        ("shapes.og[0]", "faceShape.i"),
        ("shapesGroupId.id", "faceShape.iog.og[0].gid"),
        ("shapesSet.mwc", "faceShape.iog.og[0].gco"),
        ("shapes.msg", "shapesSet.ub[0]"),
    ]
    count = len(rig.names)
    for place, drivers in enumerate(targets.drivers, start=count):
        node = f"combination_{targets.aliases[place]}"
        yield f'createNode combinationShape -n "{node}";\n\tsetAttr ".combinationMethod" 0;\n'
        links += [(f"shapes.w[{driver}]", f"{node}.inputWeight[{i}]") for i, driver in enumerate(drivers)]
        links.append((f"{node}.outputWeight", f"shapes.w[{place}]"))
    if keys is not None:
        times, weights = _numpy(keys.seconds) * rate, _numpy(keys.weights)
        for place, alias in enumerate(targets.aliases[:count]):
            curve = np.stack([times, weights[:, place]], 1)
            if not curve[:, 1].any():
                continue
            curve = curve if keys.kept is None else curve[keys.kept[:, place].numpy()]
            yield f'createNode animCurveTU -n "shapes_{alias}";\n\tsetAttr ".tan" {_LINEAR};\n\tsetAttr ".wgt" no;\n'
            yield from _array(".ktv", curve)
            links.append((f"shapes_{alias}.o", f"shapes.w[{place}]"))
    for source, target in links:
        yield f'connectAttr "{source}" "{target}";\n'
    yield 'connectAttr "shapesGroupId.msg" "shapesSet.gn" -na;\n'
    yield 'connectAttr "faceShape.iog.og[0]" "shapesSet.dsm" -na;\n'
    yield 'connectAttr "faceShape.iog" ":initialShadingGroup.dsm" -na;\n'
    yield "// End\n"


def _mesh(mesh: Mesh) -> Iterator[str]:
    sizes, corners, uv_corners = corners_of_polygons(mesh)
    starts = np.cumsum(sizes) - sizes
    following = np.arange(len(corners)) + 1
    following[starts + sizes - 1] = starts
    ends = np.stack([corners, corners[following]], 1)
    edges, which = np.unique(np.sort(ends, 1), axis=0, return_inverse=True)
    which = which.reshape(-1)
    which = np.where(ends[:, 0] <= ends[:, 1], which, -which - 1)  # against its edge
    if mesh.uvs is not None:
        yield '\tsetAttr ".uvst[0].uvsn" -type "string" "map1";\n\tsetAttr ".cuvs" -type "string" "map1";\n'
        yield from _array(".uvst[0].uvsp", _numpy(mesh.uvs), ' -type "float2"')
    yield from _array(".vt", _numpy(mesh.vertices) / millimetres_per("cm"))
    yield from _array(".ed", np.concatenate([edges, np.ones_like(edges[:, :1])], 1))
    for begin in range(0, len(sizes), _PER_STATEMENT):
        part = slice(begin, begin + _PER_STATEMENT)
        where = _span(begin, len(sizes[part]))
        yield f'\tsetAttr -s {len(sizes)} -ch {len(corners)} ".fc{where}" -type "polyFaces"'
        for start, size in zip(starts[part].tolist(), sizes[part].tolist(), strict=True):  # a polygon has its own size
            own = slice(start, start + size)
            yield f"\n\t\tf {size} {_joined(which[own])}"
            if len(uv_corners):
                yield f" mu 0 {size} {_joined(uv_corners[own])}"
        yield ";\n"


def _blend_shape(rig: BlendshapeRig, targets: MayaTargets) -> Iterator[str]:
    count = len(targets.aliases)
    yield 'createNode blendShape -n "shapes";\n'
    yield '\taddAttr -ci true -h true -sn "aal" -ln "attributeAliasList" -dt "attributeAlias";\n'
    if renamed := _renamed(rig, targets):
        yield '\taddAttr -ci true -sn "nts" -ln "notes" -dt "string";\n'
        listed = "\n".join(f"{alias} = {name}" for name, alias in renamed)
        yield f'\tsetAttr ".nts" -type "string" "{_escaped(listed)}";\n'
    yield from _array(".w", np.zeros((count, 1)))
    for place, items in enumerate(targets.items):
        for number, delta in sorted(items.items()):
            moved = np.flatnonzero(np.einsum("ij,ij->i", delta, delta) >= MIN_MOVE * MIN_MOVE)
            moved = moved if len(moved) else np.zeros(1, np.int64)  # an item without a point is none
            points = np.ones((len(moved), 4))
            points[:, :3] = delta[moved] / millimetres_per("cm")
            where = f".it[0].itg[{place}].iti[{number}]"
            yield f'\tsetAttr "{where}.ipt" -type "pointArray" {len(moved)}{"".join(_lines(points))};\n'
            breaks = np.flatnonzero(np.diff(moved) > 1)
            spans = list(zip(moved[[0, *(breaks + 1)]].tolist(), moved[[*breaks, -1]].tolist(), strict=True))
            listed = " ".join(f'"vtx{_span(low, high - low + 1)}"' for low, high in spans)
            yield f'\tsetAttr "{where}.ict" -type "componentList" {len(spans)} {listed};\n'
    named = ",".join(f'"{alias}","weight[{place}]"' for place, alias in enumerate(targets.aliases))
    yield f'\tsetAttr ".aal" -type "attributeAlias" {{{named}}};\n'


def _array(name: str, rows: NDArray[np.float64] | NDArray[np.int64], kind: str = "") -> Iterator[str]:
    """Statements that set an array, some rows each."""
    for begin in range(0, len(rows), _PER_STATEMENT):
        part = rows[begin : begin + _PER_STATEMENT]
        yield f'\tsetAttr -s {len(rows)} "{name}{_span(begin, len(part))}"{kind}{"".join(_lines(part))};\n'


def _span(begin: int, count: int) -> str:
    return f"[{begin}]" if count == 1 else f"[{begin}:{begin + count - 1}]"


def _lines(rows: NDArray[np.float64] | NDArray[np.int64]) -> Iterator[str]:
    for begin in range(0, len(rows), _PER_LINE):
        yield f"\n\t\t{_joined(rows[begin : begin + _PER_LINE])}"


def _joined(numbers: NDArray[np.float64] | NDArray[np.int64]) -> str:
    values: Sequence[float] | Iterable[int] = numbers.ravel().tolist()
    return " ".join(f"{value:.9g}" for value in values)


def _escaped(text: str) -> str:
    """A text between quotation marks in MEL."""
    signs = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r", "\t": "\\t"}
    return "".join(signs.get(sign, sign if sign.isprintable() else "?") for sign in text)
