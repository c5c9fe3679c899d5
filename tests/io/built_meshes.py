"""Meshes and rigs built by chance, of parts that disagree: strategies of :func:`built_files.check_built`."""

import base64
import json
import struct

from built_files import LINE_ENDS, ODD_INTEGERS, Files, altered, counts, indices, numbers, seldom, words
from hypothesis import strategies as st


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
    end = draw(st.sampled_from(LINE_ENDS))
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
                    body += _packed(draw(seldom(st.sampled_from(ODD_INTEGERS), st.just(value), 40)), kinds[kind], form)
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
