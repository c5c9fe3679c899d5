"""Files built by chance, each of its format's parts but with values that disagree: strategies of hypothesis.

A strategy gives the files by name, the one to read first. Readers are tested alike::

    check_built(load_mesh, "obj_files")
"""

from __future__ import annotations

import base64
import importlib
import json
import math
import struct
import time
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import tomli_w
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from reader_budget import MEGABYTES, SECONDS, find_reader, limit_memory, place_of, run_child

Files = dict[str, bytes]

_ODD_NUMBERS = (
    *("nan", "-nan", "inf", "-inf", "1e39", "1e400", "-1e308", "1e-320", "-0", "0x10", "1_0", "1,5", "", "-", "x"),
    *("9" * 25, "-" + "9" * 4400, "2147483648", "4294967296", "9223372036854775808", "١", "1e", "+1", "00", "1 "),
)
_ODD_INTEGERS = (-1, 1, 2, 3, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32, 2**53, 2**63 - 1)
_ODD_FLOATS = (0.5, -1.0, 1e9, 1e30, 1e39, -1e300, 1e-320, 1e308)
_LINE_ENDS = ("\n", "\n", "\n", "\r\n", "\r")


def check_built(reader: Callable[[Path], Any], strategy: str, cases: int, module: str = "built_files") -> None:
    """Drives a reader with built files in a child process; each must give a good value or a ``TorchfaceError``.

    Time and memory are those of the budget for small files; a case is shrunk before it is shown.

    Args:
        reader: a function of a path, at the top level of its module.
        strategy: the name of a function that gives the files.
        cases: how many.
        module: where that function is.

    Raises:
        AssertionError: a case escaped; the message holds it.
    """
    job = {**place_of(reader), "strategy": strategy, "strategies": module, "cases": cases}
    outcome = run_child(_run, job, 120 + SECONDS * cases)
    assert sum(outcome.values()) >= min(cases, 10), outcome


def _run(job: dict[str, Any], folder: Path) -> dict[str, int]:
    from torchface.errors import TorchfaceError

    reader, outcome, limited = find_reader(job), {"read": 0, "refused": 0}, [False]

    @settings(
        max_examples=job["cases"],
        database=None,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(files=getattr(importlib.import_module(job["strategies"]), job["strategy"])())
    def check(files: Files) -> None:
        for name, data in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        path = folder / next(iter(files))
        start = time.process_time()
        try:
            value = reader(path.parent if path.parent != folder else path)
        except TorchfaceError:
            outcome["refused"] += 1
        else:
            check_sound(value)
            outcome["read"] += 1
        taken = time.process_time() - start
        for name in files:
            (folder / name).unlink()
        if not limited[0]:  # imports, thread pools and caches are paid for before the limits hold
            limit_memory(MEGABYTES)
            limited[0] = True
        else:
            assert taken <= SECONDS, f"the case took {taken:.1f} s, expected at most {SECONDS} s"

    check()
    return outcome


def check_sound(value: Any) -> None:
    """Fails where a value holds an infinite number somewhere; NaN may stand for what was not seen."""
    if isinstance(value, torch.Tensor):
        assert not value.is_floating_point() or not bool(torch.isinf(value).any()), value
    elif isinstance(value, float):
        assert not math.isinf(value)
    elif is_dataclass(value):
        for field in fields(value):
            check_sound(getattr(value, field.name))
    elif isinstance(value, dict):
        for inner in value.values():
            check_sound(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            check_sound(inner)


def seldom(odd: st.SearchStrategy[Any], mostly: st.SearchStrategy[Any], one_in: int = 12) -> st.SearchStrategy[Any]:
    """Mostly the one, once in so many times the other."""
    return st.integers(1, one_in).flatmap(lambda drawn: odd if drawn == one_in else mostly)


def numbers(low: int = -3, high: int = 9) -> st.SearchStrategy[str]:
    """A number as text, seldom an odd one."""
    usual = st.integers(low, high).map(str) | st.floats(low, high, width=16).map(str)
    return seldom(st.sampled_from(_ODD_NUMBERS), usual, 40)


def indices(high: int) -> st.SearchStrategy[str]:
    """A whole number as text, seldom an odd one."""
    return seldom(
        st.sampled_from(_ODD_NUMBERS) | st.integers(-high, 3 * high).map(str), st.integers(1, high).map(str), 40
    )


def counts(true: int) -> st.SearchStrategy[int]:
    """Mostly the true count."""
    return seldom(st.sampled_from(_ODD_INTEGERS) | st.integers(0, true + 3), st.just(true), 40)


def words(strategy: st.SearchStrategy[str], low: int, high: int | None = None) -> st.SearchStrategy[str]:
    """Some words of a line."""
    return st.lists(strategy, min_size=low, max_size=high or low).map(" ".join)


_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.sampled_from(_ODD_INTEGERS)
    | st.integers(-2, 9)
    | st.sampled_from(_ODD_FLOATS)
    | st.text(max_size=5)
    | st.sampled_from(["POSITION", "mm", "a.obj", "../a", "data:,", "\0", "VEC3", "nan"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def altered(draw: st.DrawFn, document: Any, most: int = 4) -> Any:
    """A document with up to so many of its values replaced, removed or said again."""
    document = json.loads(json.dumps(document))
    for _ in range(draw(st.integers(0, most))):
        parent, key = {"": document}, ""
        while (
            isinstance(value := parent[key], dict | list)
            and value
            and (parent[key] is document or draw(st.integers(0, 5)))
        ):
            parent, key = value, draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
        if parent.get("", None) is document if isinstance(parent, dict) else False:
            continue
        change = draw(st.sampled_from(["replace", "replace", "replace", "near", "remove", "again"]))
        value = parent[key]
        if change == "near" and isinstance(value, int | float):
            parent[key] = value + draw(st.integers(-2, 2))
        elif change == "remove":
            del parent[key]
        elif change == "again" and isinstance(parent, list):
            parent.append(value)
        else:
            parent[key] = draw(_JSON)
    return document


@st.composite
def obj_files(draw: st.DrawFn) -> Files:
    """Statements in any order, faces of every form, continued lines, material files that name each other's images."""
    corner = st.sampled_from(["{}", "{}/{}", "{}/{}/{}", "{}//{}", "-{}", "-{}/-{}", "{}/", "/"])
    corners = st.tuples(corner, indices(6), indices(6), indices(6)).map(lambda drawn: drawn[0].format(*drawn[1:]))
    other = st.sampled_from(
        [
            "g a",
            "o",
            "s 1",
            "# f 1",
            "usemtl a",
            "usemtl",
            "mtllib a.mtl",
            "mtllib ../a.mtl b.mtl",
            "mtllib case.obj",
            "vp 1",
            "\\",
            "f \\",
            "l 1 2",
            "call x",
            "v",
            "f",
            "vt",
            "\0",
        ]
    )
    width = draw(st.sampled_from([3, 3, 3, 4, 6, 7]))
    lines = draw(
        st.lists(
            st.one_of(
                words(numbers(), width).map("v ".__add__),
                words(numbers(), width).map("v ".__add__),
                words(numbers(), 2, 3).map("vt ".__add__),
                words(corners, 3, 6).map("f ".__add__),
                seldom(other | words(numbers(), 0, 8).map("v ".__add__), words(numbers(), 3).map("vn ".__add__), 4),
            ),
            max_size=30,
        )
    )
    start = draw(st.sampled_from(["", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" * 2 + "vt 0 0\n" * 6 + "f 1 2 3\n"]))
    end = draw(st.sampled_from(_LINE_ENDS))
    material = draw(
        st.lists(st.sampled_from(["newmtl a", "newmtl", "map_Kd a.png", "map_Kd a.mtl", "map_Kd ..", "Kd 1"]))
    )
    return {"case.obj": (start + end.join(lines) + end).encode(), "a.mtl": ("\n".join(material) + "\n").encode()}


@st.composite
def ply_files(draw: st.DrawFn) -> Files:
    """Elements and properties of all types, with lists, in text and both byte orders, and counts that are wrong."""
    kinds = {
        "char": "b",
        "uint8": "B",
        "short": "h",
        "ushort": "H",
        "int": "i",
        "uint32": "I",
        "float": "f",
        "double": "d",
    }
    form = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    elements = st.lists(st.sampled_from(["vertex", "face", "edge"]), min_size=1, max_size=4)
    names = draw(seldom(elements, st.sampled_from([["vertex", "face"], ["edge", "vertex", "face", "edge"]]), 4))
    head, body = ["ply", f"format {form} 1.0", "comment made"], b""
    for name in names:
        properties: list[tuple[str, str, str | None]] = []
        if name == "vertex":
            properties = [(axis, draw(st.sampled_from(["float", "double", "char", "int"])), None) for axis in "xyz"]
        more = st.tuples(
            st.sampled_from(["vertex_indices", "vertex_index", "red", "green", "blue", "s", "t", "a", "x"]),
            st.sampled_from(sorted(kinds)),
            st.none() | st.sampled_from(sorted(kinds)),
        )
        if name == "face":
            properties = [
                (
                    "vertex_indices",
                    draw(st.sampled_from(["int", "uint8", "float"])),
                    draw(st.sampled_from(["uint8", "int", "char", "float"])),
                )
            ]
        properties += draw(seldom(st.lists(more, max_size=3), st.just([]), 3))
        rows = draw(seldom(st.integers(0, 6), st.integers(6, 8) if name == "vertex" else st.integers(1, 4), 8))
        head.append(f"element {name} {draw(counts(rows))}")
        head += [f"property {k} {n}" if c is None else f"property list {c} {k} {n}" for n, k, c in properties]
        for _ in range(rows):
            for _, kind, count in properties:
                size = 1 if count is None else draw(st.integers(3, 4) if name == "face" else st.integers(0, 5))
                values = [draw(st.integers(0, 5)) for _ in range(size)]
                if count is not None:
                    body += _packed(draw(counts(size)), kinds[count], form)
                for value in values:
                    body += _packed(draw(seldom(st.sampled_from(_ODD_INTEGERS), st.just(value), 40)), kinds[kind], form)
    cut = draw(seldom(st.integers(0, len(body)), st.just(len(body)), 8))
    return {"case.ply": "\n".join([*head, "end_header", ""]).encode() + body[:cut]}


def _packed(value: int, kind: str, form: str) -> bytes:
    if form == "ascii":
        return f"{value} ".encode()
    order = "<" if "little" in form else ">"
    if kind in "fd":
        return struct.pack(order + kind, value)
    bits = 8 * struct.calcsize(kind)
    return struct.pack(order + kind.upper(), value % 2**bits)


@st.composite
def stl_files(draw: st.DrawFn) -> Files:
    """Triangles, binary with a count that may be wrong, or as text with words that may be missing."""
    triangles = draw(st.integers(0, 4))
    if draw(st.booleans()):
        raw = draw(st.binary(min_size=50 * triangles, max_size=50 * triangles))
        plain = struct.pack("<12fH", *range(12), 0) * triangles
        head = draw(st.sampled_from([b"", b"solid a"])).ljust(80)
        return {
            "case.stl": head + struct.pack("<I", draw(counts(triangles)) % 2**32) + draw(st.sampled_from([raw, plain]))
        }
    vertex = words(numbers(), 3).map("vertex ".__add__)
    lines = [
        line
        for _ in range(triangles)
        for line in ["facet normal 0 0 1", "outer loop", *(draw(vertex) for _ in range(3)), "endloop", "endfacet"]
    ]
    lines = draw(altered(["solid a", *lines, "endsolid"], 1))
    return {"case.stl": "\n".join(map(str, lines)).encode()}


@st.composite
def off_files(draw: st.DrawFn) -> Files:
    """Counts, vertices with colours or normals, faces of some corners, comments."""
    vertices, faces = draw(st.integers(0, 6)), draw(st.integers(0, 4))
    lines = [draw(words(numbers(), 3) | words(numbers(), 3, 6)) for _ in range(vertices)]
    for _ in range(faces):
        size = draw(st.integers(2, 5))
        ids = [draw(seldom(numbers(), st.integers(0, max(0, vertices - 1)).map(str), 20)) for _ in range(size)]
        lines.append(" ".join([str(draw(counts(size))), *ids]))
    head = draw(st.sampled_from(["OFF\n", "OFF ", "COFF\n", "NOFF\n", "off\n", "OFF BINARY\n", "# a\nOFF # b\n"]))
    text = f"{head}{draw(counts(vertices))} {draw(counts(faces))} {draw(numbers())}\n" + "\n".join(lines)
    return {"case.off": text.encode()}


_GLTF_BYTES = struct.pack("<12f", *range(12)) + struct.pack("<6H", 0, 1, 2, 1, 3, 2) + bytes(52)


@st.composite
def gltf_files(draw: st.DrawFn) -> Files:
    """A scene of two nodes, a skin, sparse morph targets, an animation and a texture, some of whose indices are off."""
    accessor = {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4}
    sparse = {
        "count": 2,
        "indices": {"bufferView": 1, "componentType": 5123},
        "values": {"bufferView": 0},
    }
    extras = {
        "torchface": {
            "version": 1,
            "vertices": 4,
            "landmarks": [0, 3],
            "mirror": [1, 0, 3, 2],
            "contacts": [[0, 1]],
            "regions": {"lip": [1, 2, 1]},
            "polygons": [[3, 2]],
            "triangles": [[1, 1], [0, 1]],
            "meshes": 1,
        },
        "targetNames": ["jawOpen", "blink"],
    }
    attributes = {"POSITION": 0, "TEXCOORD_0": 3, "COLOR_0": 0, "_VERTEX_ID": 4}
    kept = draw(st.sets(st.sampled_from(["TEXCOORD_0", "COLOR_0", "_VERTEX_ID"])))
    primitive = {
        "attributes": {name: index for name, index in attributes.items() if name == "POSITION" or name in kept},
        "indices": 1,
        "targets": [{"POSITION": 2}, {"POSITION": 0}],
        "material": 0,
        "mode": draw(st.sampled_from([4, 4, 4, 5, 6, 0])),
    }
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "children": [1]}, {"mesh": 0, "skin": 0, "rotation": [0, 0, 0, 1], "scale": [1, 2, 1]}],
        "skins": [{"joints": [1], "inverseBindMatrices": 0}],
        "meshes": [{"primitives": [primitive] * draw(st.integers(1, 2)), "weights": [0, 1], "extras": extras}],
        "accessors": [
            accessor,
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
            {**accessor, "sparse": sparse}
            if draw(st.booleans())
            else {"componentType": 5126, "type": "VEC3", "count": 4},
            {**accessor, "type": "VEC2"},
            {**accessor, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 0}}, "normalTexture": {"index": 0}}
        ],
        "textures": [{"source": 0}] if draw(st.booleans()) else [{}],
        "images": [{"bufferView": 1}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
                "samplers": [{"input": 4, "output": 4}],
            }
        ],
    }
    changed = draw(altered(document, 3))
    if not isinstance(changed, dict):
        return {"case.glb": json.dumps(changed).encode()}
    binary = draw(seldom(st.binary(max_size=112), st.just(_GLTF_BYTES), 6))
    if draw(st.booleans()):
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        changed["buffers"] = draw(altered([{"byteLength": len(binary), "uri": uri}], 1))
        return {"case.glb": json.dumps(changed).encode()}
    changed["buffers"] = draw(altered([{"byteLength": len(binary)}], 1))
    text = json.dumps(changed).encode()
    text += b" " * (-len(text) % 4)
    size = draw(counts(28 + len(text) + len(binary))) % 2**32
    chunks = struct.pack("<II", draw(counts(len(text))) % 2**32, 0x4E4F534A) + text
    chunks += struct.pack("<II", draw(counts(len(binary))) % 2**32, 0x004E4942) + binary
    return {"case.glb": b"glTF" + struct.pack("<II", draw(counts(2)) % 2**32, size) + chunks}


@st.composite
def rig_folders(draw: st.DrawFn) -> Files:
    """A neutral, shapes that may be of another topology, and notes that may disagree with them."""
    neutral = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n"
    files = {"rig/neutral.obj": neutral.encode()}
    for name in draw(st.lists(st.sampled_from(["jaw", "blink", "neutral2", "a"]), max_size=3)):
        files[f"rig/{name}.obj"] = draw(
            seldom(obj_files().map(lambda made: made["case.obj"]), st.just(neutral.encode()), 3)
        )
    notes = {
        "shapes": ["jaw", "blink"],
        "mesh": {"version": 1, "vertices": 4, "landmarks": [0], "mirror": [1, 0, 3, 2]},
    }
    if draw(st.booleans()):
        files["rig/rig.json"] = json.dumps(
            draw(altered({"format": "torchface.rig/1", "asset": {"version": "2.0"}, **notes}))
        ).encode()
    return files


@st.composite
def c3d_files(draw: st.DrawFn) -> Files:
    """Header, parameters of every type and points in integers or floats of three processors, with odd values."""
    processor = draw(st.sampled_from([84, 84, 85, 86]))
    order = ">" if processor == 86 else "<"
    points, analog, frames = draw(st.integers(0, 3)), draw(st.integers(0, 2)), draw(st.integers(0, 3))
    scale = draw(seldom(st.sampled_from([0.0, math.nan, math.inf, -math.inf, 1e38]), st.sampled_from([-1.0, 0.1])))
    real = seldom(st.sampled_from([math.nan, math.inf, -1.0, 0.0, 1e9, 1e38]), st.just(60.0))

    def short(value: int) -> bytes:
        return struct.pack(order + "H", value % 65536)

    def single(value: float) -> bytes:
        data = struct.pack(order + "f", value * (4 if processor == 85 and abs(value) < 1e37 else 1))
        return data[2:] + data[:2] if processor == 85 else data

    parameters = [
        ("POINT", "USED", 2, (), short(draw(counts(points)))),
        ("POINT", "SCALE", 4, (), single(scale)),
        ("POINT", "RATE", 4, (), single(draw(real))),
        ("POINT", "FRAMES", 2, (), short(draw(counts(frames)))),
        ("POINT", "DATA_START", draw(st.sampled_from([2, 2, 2, 4])), (), short(3)),
        ("POINT", "UNITS", -1, (2,), draw(st.sampled_from([b"mm", b"m ", b"\xff\xff"]))),
        ("POINT", "LABELS", -1, (2, points), b"ab" * points),
        ("POINT", "X_SCREEN", -1, (2,), draw(st.sampled_from([b"+X", b"-Z", b"+Y", b"  ", b"??"]))),
        ("POINT", "Y_SCREEN", -1, (2,), draw(st.sampled_from([b"+Y", b"+Z", b"+X"]))),
        ("TRIAL", "ACTUAL_START_FIELD", 2, (2,), short(1) + short(draw(counts(0)))),
        ("TRIAL", "ACTUAL_END_FIELD", 2, (2,), short(draw(counts(frames))) + short(0)),
    ]
    packed, groups = b"\1\x50\0\0"[:2] + b"\0" + bytes([processor]), {"POINT": 1, "TRIAL": 2}
    for name, number in groups.items():
        packed += struct.pack("bb", len(name), -number) + name.encode() + struct.pack(order + "H", 3) + b"\0"
    for group, name, kind, dimensions, data in draw(st.lists(st.sampled_from(parameters), unique=True, max_size=11)):
        dims = bytes(draw(counts(size)) % 256 for size in dimensions)
        kind = draw(seldom(st.sampled_from([-1, 1, 2, 4, 3]), st.just(kind), 30))
        body = struct.pack("b", kind) + bytes([len(dims)]) + dims + data + b"\0"
        offset = draw(seldom(st.integers(0, 300), st.just(2 + len(body)), 40))
        packed += struct.pack("bb", len(name), groups[group]) + name.encode() + struct.pack(order + "H", offset) + body
    packed = packed[:512].ljust(512, b"\0")
    header = b"\2\x50" + b"".join(map(short, (draw(counts(points)), draw(counts(analog)), 1, draw(counts(frames)), 0)))
    header += single(scale) + short(draw(counts(3))) + short(1) + single(draw(real))
    coordinate = seldom(st.sampled_from([math.nan, math.inf, -1.0, 3e38]), st.integers(0, 99).map(float))
    data = b""
    for _ in range(frames * (4 * points + analog)):
        value = draw(coordinate)
        data += single(value) if scale < 0 else short(int(value) if math.isfinite(value) else -1)
    return {"case.c3d": header.ljust(512, b"\0") + packed + data}


@st.composite
def trc_files(draw: st.DrawFn) -> Files:
    """The header's fields, labels and rows of numbers, with cells too many, too few, empty or odd."""
    markers, frames = draw(st.integers(0, 3)), draw(st.integers(0, 4))
    values = [
        draw(numbers(1, 99)),
        "60",
        str(draw(counts(frames))),
        str(draw(counts(markers))),
        draw(st.sampled_from(["mm", "m", "?"])),
    ]
    label = st.sampled_from(["a", "b", "", "a_2", "unlabeled1"])
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tcase.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        "\t".join(values),
        "Frame#\tTime\t" + "\t\t\t".join(draw(label) for _ in range(markers)),
        draw(st.sampled_from(["\t\tX1\tY1\tZ1", "", "\t"])),
    ]
    for row in range(frames):
        width = draw(seldom(st.integers(0, 12), st.just(3 * markers), 20))
        cells = [
            draw(seldom(numbers(), st.just(str(row + 1)))),
            str(row / 60),
            *(draw(numbers()) for _ in range(width)),
        ]
        lines.append("\t".join(cells))
    return {"case.trc": draw(st.sampled_from(_LINE_ENDS)).join(map(str, draw(altered(lines, 1)))).encode()}


@st.composite
def csv_files(draw: st.DrawFn) -> Files:
    """Headers of every kind of table, with columns too many, missing or twice, and rows that may not fit them."""
    from torchface.shape_names import ARKIT

    label = st.sampled_from(["jaw", "blink", "nose", "HeadYaw", "timecode", "é", "a b"])
    names = draw(st.lists(label, min_size=1, max_size=4))
    kind = draw(st.sampled_from(["weights", "markers", "openface", "live"]))
    header = {
        "weights": ["frame", "time", *names],
        "markers": ["frame", "time", *(f"{name}_{axis}" for name in names for axis in "xyz")],
        "openface": ["frame", "timestamp", "confidence", "success", *(f"{a}_{n}" for n in names for a in "xy"), "gaze"],
        "live": ["Timecode", "BlendshapeCount", *ARKIT, *names],
    }[kind]
    header = [str(name) for name in draw(altered(header, 1))] if draw(st.integers(0, 3)) == 0 else header
    rows = [header]
    for row in range(draw(st.integers(0, 4))):
        width = draw(seldom(st.integers(0, 9), st.just(len(header)), 20))
        time_code = draw(st.sampled_from(["10:00:00:0{}.000", "23:59:59;0{}.5", "0:0:0:{}"])).format(row)
        first = [time_code, draw(numbers(0, 61))] if kind == "live" else [str(row), str(row / 60)]
        first = [draw(seldom(numbers(), st.just(cell), 20)) for cell in first]
        rows.append([*first, *(draw(numbers()) for _ in range(width - 2))][:width])
    cell = draw(st.sampled_from(["{}", "{}", '"{}"', " {}"]))
    text = draw(st.sampled_from(_LINE_ENDS)).join(",".join(cell.format(value) for value in row) for row in rows)
    return {"case.csv": draw(st.sampled_from([b"", b"", b"\xef\xbb\xbf"])) + text.encode()}


@st.composite
def dlib_files(draw: st.DrawFn) -> Files:
    """Tags of dlib's XML within each other in any order, their attributes missing or odd."""

    def tag(
        name: str, attributes: dict[str, st.SearchStrategy[str]], inner: st.SearchStrategy[str]
    ) -> st.SearchStrategy[str]:
        pairs = [
            seldom(st.just(""), value.map(lambda v, k=key: f" {k}='{v}'"), 30) for key, value in attributes.items()
        ]  # type: ignore[misc]
        return st.tuples(st.tuples(*pairs).map("".join), inner).map(lambda made: f"<{name}{made[0]}>{made[1]}</{name}>")

    number, part_name = numbers(), seldom(numbers(), st.integers(0, 5).map(str), 20)
    part = tag("part", {"name": part_name, "x": number, "y": number}, st.just(""))
    box = tag(
        "box",
        {"top": number, "left": number, "width": number, "height": number, "ignore": st.sampled_from(["0", "1", ""])},
        st.lists(part, max_size=4).map("".join),
    )
    image = tag(
        "image",
        {"file": st.sampled_from(["a.png", "../a", ""])},
        st.lists(seldom(part, box, 10), max_size=3).map("".join),
    )
    strange = st.sampled_from(
        ["<image file='a'/>", "</box>", "<box/>", "<!ENTITY a 'b'>", "&a;", "<dataset>", "<?xml?>", "<!--a-->"]
    )
    text = "".join(draw(st.lists(seldom(strange | box | part, image, 8), max_size=4)))
    return {"case.xml": f"<dataset><images>{text}</images></dataset>".encode()}


@st.composite
def pts_files(draw: st.DrawFn) -> Files:
    """A head, a count and points between braces."""
    points = draw(st.integers(0, 5))
    rows = [draw(words(numbers(), 2) | seldom(words(numbers(), 0, 4), words(numbers(), 2), 6)) for _ in range(points)]
    lines = ["version: 1", f"n_points: {draw(counts(points))}", "{", *rows, "}"]
    return {"case.pts": draw(st.sampled_from(_LINE_ENDS)).join(map(str, draw(altered(lines, 1)))).encode()}


def _documents(name: str, document: Any) -> st.SearchStrategy[Files]:
    """JSON, or TOML by the name's ending, with values replaced."""

    def packed(made: Any) -> bytes:
        if name.endswith(".toml"):
            made = _without_none(made) if isinstance(made, dict) else {"a": _without_none(made)}
            return tomli_w.dumps(made).encode("utf-8", "replace")
        return json.dumps(made).encode()

    return altered(document).map(lambda made: {name: packed(made)})


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_none(inner) for key, inner in value.items() if inner is not None}
    return [_without_none(inner) for inner in value if inner is not None] if isinstance(value, list) else value


def ljson_files() -> st.SearchStrategy[Files]:
    """LJSON of three versions."""
    points = {"points": [[1, 2], [3, 4], [None, None]], "connectivity": [[0, 1]]}
    labels = [{"label": "nose", "mask": [0, 1]}, {"label": "chin", "mask": [2]}]
    first = {"version": 1, "groups": [{"label": "nose", "landmarks": [{"point": [1, 2]}, {"point": [3, 4]}]}]}
    second = {"version": 2, "landmarks": points, "labels": labels}
    third = {"version": 3, "groups": {"LJSON": {"landmarks": points, "labels": labels}}}
    return st.sampled_from([first, second, third]).flatmap(lambda made: _documents("case.ljson", made))


def landmark_files() -> st.SearchStrategy[Files]:
    """Picked vertices."""
    picks = {"format": "torchface.landmarks/1", "fingerprint": "8-ab", "labels": ["a", "b"], "vertices": [3, 4]}
    return _documents("case.json", picks)


def correspondence_files() -> st.SearchStrategy[Files]:
    """Pairs of vertex and point."""
    pairs = {
        "format": "torchface.correspondences/1",
        "labels": ["a", "b"],
        "vertices": [3, 4],
        "points": [[0, 1, 2.5]] * 2,
    }
    return _documents("case.json", pairs)


def attachment_files() -> st.SearchStrategy[Files]:
    """Markers on triangles."""
    document = {
        "format": "torchface.attachment/1",
        "triangles": [0, 1],
        "barycentric": [[0.2, 0.3, 0.5]] * 2,
        "labels": ["a", "b"],
        "residual": [[0, 0, 1.5]] * 2,
        "fingerprint": "8-ab",
    }
    return _documents("case.json", document)


def annotation_files() -> st.SearchStrategy[Files]:
    """Landmarks of scans."""
    scan = {"points": {"nose": [0, 1, 2]}, "lines": {"lips": [[0, 1, 2], [3, 4, 5]]}}
    return _documents("case.json", {"format": "torchface.scan-annotations/1", "unit": "mm", "scans": {"a.obj": scan}})


def camera_files() -> st.SearchStrategy[Files]:
    """A calibration."""
    document = {
        "format": "torchface.camera/1",
        "width": 640,
        "height": 480,
        "focal": [600.0, 600.0],
        "skew": 0.0,
        "center": [320.0, 240.0],
        "distortion": {"k1": 0.1, "p1": 0.0},
        "error": 0.2,
    }
    return _documents("case.toml", document)


def shape_rule_files() -> st.SearchStrategy[Files]:
    """Rules of retargeting."""
    return _documents(
        "case.toml", {"jaw": {"sum": {"a": 0.5, "b": 1}, "gain": 2.0, "upper": 0.8}, "c": {"product": ["a", "b"]}}
    )


def shape_table_files() -> st.SearchStrategy[Files]:
    """Shapes of action units."""
    return _documents(
        "case.toml",
        {"format": "torchface.action_unit_shapes/1", "units": {"AU1": {"browInnerUp": 0.5}, "AU2": {"a": 1.0}}},
    )


def model_files() -> st.SearchStrategy[Files]:
    """The description of a saved model."""
    document = {
        "format": 1,
        "kind": "a",
        "licence": "MIT",
        "data": "b",
        "sha256": "0" * 64,
        "size": 100,
        "metrics": {"error": 0.5},
        "settings": {"steps": 10},
        "config": {"width": 64, "names": ["a", "b"]},
    }
    return _documents("model/model.toml", document)


def action_label_files() -> st.SearchStrategy[Files]:
    """What a person says of a painted face."""
    document = {
        "format": "torchface.action_labels/1",
        "frames": 100,
        "neutral": 3,
        "helmet": [1, 2],
        "markers": [[3, 4], [5, 6]],
        "regions": {"brow": [0, 0, 10, 10]},
        "performed": [{"units": ["AU1"], "first": 5, "last": 9}],
    }
    return _documents("case.toml", document)
