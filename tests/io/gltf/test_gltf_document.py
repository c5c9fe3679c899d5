import io
import json
import re
import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_samples import Builder, square
from mutation import check_reader
from PIL import Image
from rig_samples import sheet_rig, sheet_take

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io import load_mesh, load_rig, save_animation, save_rig

Damage = Callable[[Builder], Any]


def accessor(build: Builder, which: str) -> dict[str, Any]:
    primitive = build.root["meshes"][0]["primitives"][0]
    places = {
        "position": primitive["attributes"]["POSITION"],
        "indices": primitive["indices"],
        "target": primitive["targets"][0]["POSITION"],
    }
    return build.root["accessors"][places[which]]


def all_targets(build: Builder) -> None:
    """A hundred thousand targets without data would unpack to gigabytes over a large mesh."""
    positions = np.zeros((20_000, 3), np.float32)
    primitive = build.root["meshes"][0]["primitives"][0]
    primitive["attributes"]["POSITION"] = build.accessor(positions)
    primitive["targets"] = [{}] * 100_000
    del build.root["meshes"][0]["extras"]


def instances(build: Builder) -> None:
    build.root["nodes"] = [{"mesh": 0} for _ in range(5000)]
    build.root["scenes"] = [{"nodes": list(range(5000))}]


def chain(build: Builder) -> None:
    """Scales that multiply along a chain of nodes until they overflow."""
    build.root["nodes"] = [{"children": [i + 1], "scale": [1e20] * 3} for i in range(40)] + [{"mesh": 0}]


DAMAGES: dict[str, tuple[Damage, str]] = {
    "count of gigabytes": (
        lambda b: accessor(b, "position").update(count=2**31),
        r"accessors\[0\].count: found data that unpacks to 25769803776 bytes, expected at most \d+",
    ),
    "count of gigabytes, without data": (
        lambda b: accessor(b, "position").update(count=2**40, bufferView=None),
        "found data that unpacks to",
    ),
    "count beyond the buffer": (
        lambda b: accessor(b, "position").update(count=5),
        r"accessors\[0\]: found 5 elements up to byte 60, expected at most the 48 bytes",
    ),
    "another count in a target": (
        lambda b: accessor(b, "target").update(count=3),
        r"accessors\[2\].count: found 3, expected 4, as the primitive's other attributes",
    ),
    "negative count": (lambda b: accessor(b, "position").update(count=-1), "found -1, expected a non-negative integer"),
    "a view beyond the buffer": (
        lambda b: b.root["bufferViews"][0].update(byteLength=10**9),
        r"bufferViews\[0\]: found bytes 0 to 1000000000, expected at most the buffer's \d+",
    ),
    "an index of no accessor": (
        lambda b: b.root["meshes"][0]["primitives"][0].update(indices=99),
        r"primitives\[0\].indices: found 99, expected an index into the 4 accessors",
    ),
    "a corner of no vertex": (
        lambda b: b.root["meshes"][0]["primitives"][0].update(indices=b.accessor(np.array([0, 1, 9], np.uint8))),
        "indices: found 9, expected less than the 4 vertices",
    ),
    "signed indices": (lambda b: accessor(b, "indices").update(componentType=5122), "5122, expected unsigned integers"),
    "a stride below the element": (
        lambda b: b.root["bufferViews"][0].update(byteStride=4),
        "byteStride: found 4, expected at least the 12 bytes",
    ),
    "NaN": (
        lambda b: b.root["meshes"][0]["primitives"][0]["targets"][0].update(
            POSITION=b.accessor(np.full((4, 3), np.nan, np.float32))
        ),
        r"targets\[0\].POSITION: found NaN or infinity in 4 of 4 rows",
    ),
    "a sparse row of no vertex": (
        lambda b: accessor(b, "target").update(
            sparse={
                "count": 1,
                "indices": {"bufferView": b.view(b"\x09"), "componentType": 5121},
                "values": {"bufferView": b.view(bytes(12))},
            }
        ),
        "sparse.indices: found 9, expected less than 4",
    ),
    "nodes in a cycle": (
        lambda b: b.root.update(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]),
        "found a cycle or a second parent, expected a tree of nodes",
    ),
    "nodes in a cycle, no scene": (
        lambda b: b.root.update(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}], scenes=[]),
        "nodes: found a cycle, expected a tree",
    ),
    "scales that overflow": (chain, "found a transform that overflows"),
    "too many instances": (instances, "more than 4096 meshes in the scene"),
    "targets of gigabytes": (all_targets, r"targets: found data that unpacks to 24000240000 bytes|unpacks to"),
    "a broken rotation": (lambda b: b.root["nodes"][0].update(rotation=[0, 0, 0, 0]), "expected a unit quaternion"),
    "a scale of text": (lambda b: b.root["nodes"][0].update(scale=["1", 1, 1]), "expected 3 finite numbers"),
    "names of another number": (
        lambda b: b.root["meshes"][0]["extras"].update(targetNames=["a"]),
        "found 1 names, 1 of them different, expected one for each of 2 morph targets",
    ),
    "a name twice": (
        lambda b: b.root["meshes"][0]["extras"].update(targetNames=["a", "a"]),
        "found 2 names, 1 of them different",
    ),
    "names that are none": (
        lambda b: b.root["meshes"][0]["extras"].update(targetNames=[1, 2]),
        r"found \[1, 2\], expected a list of names",
    ),
    "primitives of different targets": (
        lambda b: b.root["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "indices": 1}),
        r"found primitives of \[2, 0\] morph targets",
    ),
    "no positions": (
        lambda b: b.root["meshes"][0]["primitives"][0].update(attributes={}),
        "attributes: found no POSITION",
    ),
    "a compression": (lambda b: b.root.update(extensionsRequired=["XYZ_mesh_compression"]), "'XYZ_mesh_compression'"),
    "another version": (lambda b: b.root.update(asset={"version": "1.0"}), "asset.version: found '1.0'"),
    "an array that is none": (lambda b: b.root.update(meshes={"a": 1}), "found {'a': 1}, expected an array"),
    "polygons of gigabytes": (
        lambda b: b.root["meshes"][0]["extras"].update(
            torchface={"version": 1, "regions": {"all": [0, 10**15]}, "vertices": 4},
        ),
        None,  # without vertex ids the annotations are not looked at
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_document_is_refused_by_name(damage: str, tmp_path: Path) -> None:
    build = square(["a", "b"])
    change, message = DAMAGES[damage]
    change(build)
    path = build.save(tmp_path / "face.gltf")
    if message is None:
        assert load_rig(path).names == ("a", "b")
        return
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileFormatError, match=message) as caught:
        load_rig(path)
    assert str(caught.value).startswith(str(path))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * 1024


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("../secret.bin", "expected a file in the folder of the document"),
        ("%2e%2e/secret.bin", "expected a file in the folder of the document"),
        ("/etc/hostname", "expected a file in the folder of the document"),
        ("file:///etc/hostname", "expected a file in the folder of the document"),
        ("https://example.org/face.bin", "expected a file in the folder of the document"),
        ("missing.bin", "missing.bin: found no such file"),
        ("nul%00.bin", "nul"),
        ("data:,plain", "expected base64 data"),
        ("data:application/octet-stream;base64,@@@@", "broken base64"),
        ("data:application/octet-stream;base64,AAAA", r"buffers\[0\]: found 3 bytes \(truncated\)"),
        (7, "found 7, expected a URI"),
    ],
)
def test_buffers_come_from_the_document_or_its_folder_only(uri: object, message: str, tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(10_000))
    (tmp_path / "inside").mkdir()
    build = square(["a", "b"])
    path = tmp_path / "inside" / "face.gltf"
    path.write_text(json.dumps({**build.root, "buffers": [{"byteLength": len(build.data), "uri": uri}]}))
    with pytest.raises(FileFormatError, match=message):
        load_rig(path)


def test_a_link_out_of_the_folder_is_no_way_round(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(square().data)
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "link.bin").symlink_to(tmp_path / "secret.bin")
    build = square(["a", "b"])
    path = tmp_path / "inside" / "face.gltf"
    path.write_text(json.dumps({**build.root, "buffers": [{"byteLength": len(build.data), "uri": "link.bin"}]}))
    with pytest.raises(FileFormatError, match="expected a file in the folder"):
        load_rig(path)


def test_a_glb_without_morph_targets_is_a_mesh_but_no_rig(tmp_path: Path) -> None:
    build = square()
    del build.root["meshes"][0]["primitives"][0]["targets"]
    path = build.save(tmp_path / "face.gltf")
    assert len(load_mesh(path).vertices) == 4
    with pytest.raises(FileFormatError, match=r"face.gltf: found no morph target in its one mesh.*torchface rig"):
        load_rig(path)


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.999])
def test_a_truncated_glb_says_so(keep: float, tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    data = (tmp_path / "rig.glb").read_bytes()
    (tmp_path / "cut.glb").write_bytes(data[: int(keep * len(data))])
    expected = rf"cut.glb: found {int(keep * len(data))} bytes \(truncated\), expected the {len(data)}"
    with pytest.raises(FileFormatError, match=expected):
        load_rig(tmp_path / "cut.glb")
    # The header adjusted to the cut: now a chunk is too short.
    short = data[:8] + struct.pack("<I", int(keep * len(data))) + data[12 : int(keep * len(data))]
    (tmp_path / "cut.glb").write_bytes(short)
    with pytest.raises(FileFormatError, match=r"bytes in a chunk \(truncated\)"):
        load_rig(tmp_path / "cut.glb")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file"),
        (b"PK\x03\x04 a zip", "found neither 'glTF' nor JSON"),
        (b"glTF\x02", r"found 5 bytes \(truncated\)"),
        (struct.pack("<4sIIII", b"glTF", 1, 20, 0, 0), "container version 1, expected 2"),
        (struct.pack("<4sIIII", b"glTF", 2, 20, 0, 0x4E4F534A), "broken JSON"),
        (b"{", "broken JSON"),
        (b'{"asset":' * 100_000, "broken JSON"),
        (b"[" * 100_000, "found neither"),
        (b"{}", "JSON without 'asset'"),
        (b'{"asset": {"version": "2.0"}}', "found no triangle in its scene"),
        (b'{"asset": {"version": 2.0}}', "asset.version: found 2.0"),
        (b'{"asset": {"version": "2.0"}, "meshes": [7]}', r"meshes\[0\]: found 7, expected an object"),
    ],
)
def test_what_is_no_gltf_is_told(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "face.glb"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_an_unknown_suffix_and_an_unknown_unit(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"none.glb: found no such file"):
        load_rig(tmp_path / "none.glb")
    (tmp_path / "rig.fbx").write_bytes(b"x")
    with pytest.raises(FileFormatError, match=r"rig.fbx: found a file that is no .glb, .gltf, .vrm, .usd"):
        load_rig(tmp_path / "rig.fbx")
    with pytest.raises(FileFormatError, match=r"found the ending '.fbx', expected .obj, .ply"):
        load_mesh(tmp_path / "rig.fbx")
    path = square(["a", "b"]).save(tmp_path / "face.gltf")
    with pytest.raises(ValueRangeError, match="unit: found 'inch', expected one of 'mm', 'cm', 'm'"):
        load_rig(path, unit="inch")
    with pytest.raises(NameMismatchError, match="part: found 'nose', expected one of none at all"):
        load_rig(path, part="nose")


def test_a_picture_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    """A PNG of 60,000 x 60,000 grey pixels compresses to some megabytes at most; here its header alone says so."""
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    idat = b"IDAT" + zlib.compress(bytes(1000))
    png += struct.pack(">I", len(idat) - 4) + idat + struct.pack(">I", zlib.crc32(idat))
    build = square(["a", "b"])
    build.root["meshes"][0]["primitives"][0]["material"] = 0
    build.root |= {
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": build.view(png), "mimeType": "image/png"}],
    }
    with pytest.raises(FileFormatError, match=r"images\[0\]: (found an image of 60000 x 60000|no readable image)"):
        load_rig(build.save(tmp_path / "face.gltf"))


def test_annotations_outside_the_mesh_are_refused(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    data = (tmp_path / "rig.glb").read_bytes()
    for found, planted, message in (
        (rb'"landmarks":\[3,17,0\]', b'"landmarks":[3,99,0]', "landmarks: found vertices 0 to 99, expected 0 to 29"),
        (rb'"contacts":\[\[0,5', b'"contacts":[[0,"a"', "contacts: found"),
        (rb'"lower":\[0,12,18\]', b'"lower":[0,12,99]', "regions.lower: found runs of 111 vertices, expected 30"),
    ):
        changed = re.sub(found, planted, data)
        assert changed != data
        length = struct.unpack_from("<I", data, 12)[0] + len(changed) - len(data)
        changed = changed[:8] + struct.pack("<II", len(changed), length) + changed[16:]
        (tmp_path / "bad.glb").write_bytes(changed)
        with pytest.raises(FileFormatError, match=message):
            load_rig(tmp_path / "bad.glb")


def test_a_mutated_glb_is_read_or_refused(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    save_animation(sheet_rig(), sheet_take(), tmp_path / "take.glb")
    report = check_reader(load_rig, [tmp_path / "rig.glb", tmp_path / "take.glb"], ".glb")
    assert report.read > 0
    assert report.refused > report.cases / 4


def test_a_mutated_gltf_with_its_buffer_inside_is_read_or_refused(tmp_path: Path) -> None:
    seeds = [square(["a", "b"]).save(tmp_path / "square.gltf")]
    build = square(["a", "b"])
    picture = io.BytesIO()
    Image.new("RGB", (4, 4), "red").save(picture, "PNG")
    indices = {"bufferView": build.view(b"\1\3"), "componentType": 5121}
    sparse = {"count": 2, "indices": indices, "values": {"bufferView": build.view(bytes(24))}}
    primitive = build.root["meshes"][0]["primitives"][0]
    primitive["targets"][0]["POSITION"] = build.bare(componentType=5126, count=4, type="VEC3", sparse=sparse)
    primitive["attributes"]["TEXCOORD_0"] = build.accessor(np.zeros((4, 2), np.uint8), normalized=True)
    primitive["attributes"]["_VERTEX_ID"] = build.accessor(np.arange(4, dtype=np.float32))
    primitive["material"] = 0
    build.root["meshes"][0]["extras"]["torchface"] = {
        **{"version": 1, "vertices": 4, "polygons": [[4, 1]], "landmarks": [0, 3], "mirror": [1, 0, 3, 2]},
        **{"contacts": [[0, 1]], "regions": {"all": [0, 4], "half": [2, 2]}},
    }
    build.root |= {
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": build.view(picture.getvalue())}],
        "nodes": [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "rotation": [0, 0, 0, 1]}],
    }
    seeds.append(build.save(tmp_path / "full.gltf"))
    report = check_reader(load_rig, seeds, ".gltf")
    assert report.read > 0
    assert report.refused > report.cases / 4
