"""What meshoptimizer has packed is read as the plain file is; broken data is refused."""

from pathlib import Path

import meshopt
import numpy as np
import pytest
import torch

from planted.glb_files import packed, unpacked
from torchface.errors import FileFormatError
from torchface.io import load_rig, save_rig
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A rig as it is written, and with its vertices packed."""
    folder = tmp_path_factory.mktemp("meshopt")
    plain, small = folder / "plain.glb", folder / "packed.glb"
    save_rig(performer(texture=False).select(["jawOpen"]), plain)
    root, binary = unpacked(plain)
    root["buffers"].append({"byteLength": len(binary), "extensions": {"EXT_meshopt_compression": {"fallback": True}}})
    root["extensionsUsed"] = root["extensionsRequired"] = ["EXT_meshopt_compression"]
    for accessor in root["accessors"]:
        if accessor.get("type") != "VEC3" or "bufferView" not in accessor:
            continue
        view = root["bufferViews"][accessor["bufferView"]]
        start = view["byteOffset"]
        rows = np.frombuffer(binary[start : start + 12 * accessor["count"]], np.float32).reshape(-1, 3)
        data = meshopt.encode_gltf_buffer(rows, "ATTRIBUTES")
        binary += b"\0" * (-len(binary) % 4)
        view["extensions"] = {
            "EXT_meshopt_compression": {
                "buffer": 0,
                "byteOffset": len(binary),
                "byteLength": len(data),
                "byteStride": 12,
                "count": len(rows),
                "mode": "ATTRIBUTES",
            }
        }
        view["buffer"] = 1
        binary += data
    binary += b"\0" * (-len(binary) % 4)
    root["buffers"][0]["byteLength"] = len(binary)
    small.write_bytes(packed(root, binary))
    return plain, small


def test_packed_vertices_are_those_of_the_plain_file(files: tuple[Path, Path]) -> None:
    plain, small = (load_rig(path) for path in files)
    assert torch.equal(small.vertices, plain.vertices)
    assert torch.equal(small.deltas, plain.deltas)


def test_broken_packed_data_is_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    root, binary = unpacked(files[1])
    view = next(v for v in root["bufferViews"] if "extensions" in v)["extensions"]["EXT_meshopt_compression"]
    at = view["byteOffset"]
    (tmp_path / "broken.glb").write_bytes(packed(root, binary[:at] + b"\xff" * 24 + binary[at + 24 :]))
    with pytest.raises(FileFormatError, match="meshopt"):
        load_rig(tmp_path / "broken.glb")
