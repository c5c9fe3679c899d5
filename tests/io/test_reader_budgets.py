"""Files made to take memory or time are read or refused within the budget of every reader."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from reader_budget import check_budget, measure

from torchface.capture.action_units.shape_table import load_shape_table
from torchface.capture.retargeting import load_shape_rules
from torchface.errors import FileFormatError
from torchface.files.documents import read_json, read_toml
from torchface.files.models import read_record
from torchface.io import load_calibration, load_landmark_points, load_mesh, load_take
from torchface.io.landmarks.dlib_xml import load_dlib_faces

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("key", ["{} = 1", "[{}]", "[[{}]]", "a = {{{} = 1}}"])
def test_keys_of_thousands_of_parts_are_refused_before_they_are_parsed(key: str, tmp_path: Path) -> None:
    dotted = written(tmp_path / "deep.toml", key.format(" . ".join(["a", '"b"', "'c'", "d-1"] * 4000)))
    cost = check_budget(read_toml, dotted)
    assert "a key of more than 17 parts" in cost.refused
    assert cost.megabytes < 20
    assert cost.seconds < 0.5


def test_a_key_of_some_parts_and_dots_elsewhere_are_read(tmp_path: Path) -> None:
    text = "a.b.'c'.\"d\" = 1\nnumbers = [" + "1.5, " * 50 + ']\ntext = "www.' + "x" * 40 + '.org"\n'
    assert read_toml(written(tmp_path / "good.toml", text)).found["a"]["b"]["c"]["d"] == 1


@pytest.mark.parametrize("number", ["0x" + "f" * 5000, "0b" + "1" * 20000, "9" * 5000, str(2**63), str(-(2**70))])
@pytest.mark.parametrize("reader", [load_calibration, load_shape_table, load_shape_rules, read_record])
def test_whole_numbers_of_more_than_64_bits_are_refused(
    reader: Callable[[Path], object], number: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "model.toml", f"format = {number}\njawOpen = {number}\n")
    with pytest.raises(FileFormatError, match=r"model\.toml: not TOML"):
        reader(tmp_path if reader is read_record else path)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[" * 65 + "]" * 65, "nested 65 deep"),
        ('["]]]]", ' + '{"a":' * 64 + "1" + "}" * 64 + "]", "nested 65 deep"),
        ("[1, " + "7" * 25 + "]", "a whole number of 25 digits"),
        ("[" + "[]," * 2**20 + "[]]", "1048578 lists and tables"),
        ("[9223372036854775808]", "a whole number of 19 digits"),
        ("[" * 2**23, "more than 4194304 brackets"),
    ],
)
def test_json_is_measured_before_it_is_built(text: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=found):
        read_json(written(tmp_path / "odd.json", text), max_bytes=2**24)


def test_json_that_only_looks_deep_or_large_is_read(tmp_path: Path) -> None:
    rows = ["[[" * 100, 'a \\" {{{ \\\\', "7" * 30, 1.2345678901234567890123, -9223372036854775807, 1e300]
    text = json.dumps(rows).replace("1.2345678901234567", "1.2345678901234567890123")
    assert read_json(written(tmp_path / "good.json", text)).found == rows


def test_a_wide_table_is_read_in_time_that_grows_with_its_cells(tmp_path: Path) -> None:
    others = ",".join(f"a{i}" for i in range(30_000))
    landmarks = ",".join(f"x_{i},y_{i}" for i in range(10_000))
    text = f"frame,timestamp,{landmarks},{others}\n1,0.0" + ",1" * 50_000 + "\n"
    cost = check_budget(load_take, written(tmp_path / "wide.csv", text))
    assert cost.refused == ""


@pytest.mark.parametrize("cell", ["", "1", "ab"])
def test_a_row_without_end_is_refused(cell: str, tmp_path: Path) -> None:
    path = written(tmp_path / "long.csv", f"{cell}," * (2**22 // (len(cell) + 1) + 1))
    assert "found a row of more than" in check_budget(load_take, path).refused


def test_a_material_file_named_two_hundred_times_is_read_once(tmp_path: Path) -> None:
    written(tmp_path / "skin.mtl", "newmtl skin\n" * 80_000)
    names = ["skin.mtl", "./skin.mtl", ".//skin.mtl"]
    text = "".join(f"mtllib {names[i % 3]}\n" for i in range(200)) + TRIANGLE + "f 1 2 3\n"
    cost = check_budget(load_mesh, written(tmp_path / "mesh.obj", text))
    assert cost.seconds < 1


def test_hundreds_of_material_files_are_refused(tmp_path: Path) -> None:
    text = "".join(f"mtllib {i}.mtl\n" for i in range(200)) + TRIANGLE + "f 1 2 3\n"
    with pytest.raises(FileFormatError, match="more than 64 material files"):
        load_mesh(written(tmp_path / "mesh.obj", text))


@pytest.mark.parametrize(
    "lines",
    [
        "f 1 2 3\n" * 300_000,
        "v 0 0 0\n" * 300_000 + "f 1 2 3\n",
        "f" + " 1 2 3" * 150_000 + "\nf 1 2 3\n" * 3,
    ],
)
def test_words_of_a_large_obj_do_not_fill_the_memory(lines: str, tmp_path: Path) -> None:
    path = written(tmp_path / "mesh.obj", TRIANGLE + "vt 0 0\n" + lines)
    # Pages of libraries that a process touches with its first mesh, 16 MB and at times more, are not the text's: nor
    # are those that one of two processes takes alone.
    small = written(tmp_path / "small.obj", TRIANGLE + "f 1 2 3\n")
    cost = min((measure(load_mesh, path, good=small) for _ in range(2)), key=lambda cost: cost.megabytes)
    assert cost.refused == ""
    assert cost.megabytes < 20 * cost.file_megabytes + 80  # of one piece of the text


@pytest.mark.parametrize(
    ("name", "head", "line", "count", "end"),
    [
        ("mesh.ply", "ply\nformat ascii 1.0\nelement vertex 150000\nproperty float x\nproperty float y\n"
         "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n",
         "0 0 0\n", 150_000, "3 0 1 2\n"),
        ("mesh.stl", "solid\n", "vertex 0 1 0\nvertex 1 0 0\nvertex 0 0 0\n", 40_000, "endsolid\n"),
        ("mesh.off", "OFF\n150000 1 0\n", "0 0 0\n", 150_000, "3 0 1 2\n"),
        ("points.pts", "{\n", "1 1\n", 400_000, "}\n"),
    ],
)  # fmt: skip
def test_words_of_a_large_text_do_not_fill_the_memory(
    name: str, head: str, line: str, count: int, end: str, tmp_path: Path
) -> None:
    path = written(tmp_path / name, head + line * count + end)
    cost = measure(load_landmark_points if name.endswith("pts") else load_mesh, path)
    assert cost.refused == ""
    assert cost.megabytes < 20 * cost.file_megabytes + 40


def test_rows_of_no_use_in_a_ply_cost_little(tmp_path: Path) -> None:
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty char x\nproperty char y\nproperty char z\n"
        "element odd 400000\nproperty list uchar char a\nelement face 1\n"
        "property list uchar char vertex_indices\nend_header\n"
    )
    path = tmp_path / "mesh.ply"
    path.write_bytes(head.encode() + bytes(9) + b"\1\1" + bytes(399_999) + b"\3\0\1\2")
    assert check_budget(load_mesh, path).megabytes < 30


def test_parameters_of_a_c3d_that_share_their_data_are_refused(tmp_path: Path) -> None:
    parameter = bytes([1, 1, 97, 6, 0, 255, 2, 255, 255])  # text of 255 times 255 letters, the next one 9 bytes on
    header = b"\2\x50" + struct.pack("<4H", 1, 0, 1, 1)
    section = b"\1\x50\xff\x54" + parameter * (254 * 512 // 9)
    path = tmp_path / "take.c3d"
    path.write_bytes(header.ljust(512, b"\0") + section.ljust(255 * 512, b"\0") + bytes(512))
    assert "overlap" in check_budget(load_take, path).refused


def test_tags_without_end_are_refused(tmp_path: Path) -> None:
    assert "nested more than 32 deep" in check_budget(load_dlib_faces, written(tmp_path / "a.xml", "<a>" * 99)).refused


def test_a_line_of_megabytes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="a line of more than 1048576 bytes"):
        load_mesh(written(tmp_path / "mesh.obj", TRIANGLE + "f" + " 1 2 3" * 400_000 + "\n"))


def test_a_file_that_many_gltf_buffers_name_is_read_once(tmp_path: Path) -> None:
    size, count = 60 * 2**20, 12
    with (tmp_path / "zeros.bin").open("wb") as file:
        file.truncate(size)
    root = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": name, "byteLength": size} for name in ["zeros.bin", "./zeros.bin"] * (count // 2)],
        "bufferViews": [{"buffer": i, "byteLength": 36} for i in range(count)],
        "accessors": [{"bufferView": i, "componentType": 5126, "type": "VEC3", "count": 3} for i in range(count)],
        "meshes": [{"primitives": [{"attributes": {"POSITION": i}} for i in range(count)]}],
    }
    cost = check_budget(load_mesh, written(tmp_path / "mesh.gltf", json.dumps(root)))
    assert cost.refused == ""
    assert cost.megabytes < 1.5 * 60


def test_shapes_that_a_gltf_makes_of_nothing_stay_within_the_memory(tmp_path: Path) -> None:
    root = {
        "asset": {"version": "2.0"},
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 60_000}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 0}] * 80}]}],
    }
    check_budget(load_mesh, written(tmp_path / "rig.gltf", json.dumps(root)))


def test_lists_without_end_in_landmarks_are_refused(tmp_path: Path) -> None:
    check_budget(load_landmark_points, written(tmp_path / "odd.ljson", '{"a":[' + "[]," * 4_000_000 + "1]}"))
