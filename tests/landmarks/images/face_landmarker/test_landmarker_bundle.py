"""Bundles are hostile files: whatever is wrong with one ends in a message, before memory is taken."""

import io
import zipfile
from pathlib import Path

import pytest

from torchface.errors import FileFormatError, MissingExtraError
from torchface.landmarks.images.face_landmarker import landmarker_bundle
from torchface.landmarks.images.face_landmarker.landmarker_bundle import load_bundle

NAMES = ("face_detector.tflite", "face_landmarks_detector.tflite", "face_blendshapes.tflite")


def bundle(path: Path, entries: dict[str, bytes], packed: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", packed) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return path


def test_what_is_no_bundle_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.task"
    with pytest.raises(FileFormatError, match="found no such file"):
        load_bundle(path)
    path.write_bytes(b"GIF89a and more")
    with pytest.raises(FileFormatError, match="found a damaged zip"):
        load_bundle(path)
    with pytest.raises(FileFormatError, match=r"found 0 entries face_detector\.tflite among readme, expected one"):
        load_bundle(bundle(path, {"readme": b"x"}))
    with pytest.raises(FileFormatError, match="found 70 entries, expected at most 64"):
        load_bundle(bundle(path, {str(number): b"" for number in range(70)}))
    with pytest.raises(FileFormatError, match="found 0 bytes, expected 1 to"):
        load_bundle(bundle(path, dict.fromkeys(NAMES, b"")))
    with pytest.raises(FileFormatError, match="encrypted or packed by other means"):
        load_bundle(bundle(path, dict.fromkeys(NAMES, b"abc"), zipfile.ZIP_LZMA))


def test_bombs_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bundle(tmp_path / "bomb.task", dict.fromkeys(NAMES, bytes(70_000_000)), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 300_000
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(FileFormatError, match="found 70000000 bytes, expected 1 to 67108864"):
        load_bundle(path)


def test_a_size_that_lies_is_found_out(tmp_path: Path) -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in NAMES:
            archive.writestr(name, bytes(100_000))
    lying = content.getvalue().replace((100_000).to_bytes(4, "little"), (400).to_bytes(4, "little"))
    (tmp_path / "lies.task").write_bytes(lying)
    with pytest.raises(FileFormatError, match="found a damaged zip"):
        load_bundle(tmp_path / "lies.task")


def test_a_flipped_byte_fails_the_checksum(tmp_path: Path) -> None:
    path = bundle(tmp_path / "flipped.task", dict.fromkeys(NAMES, b"TFL3" * 500))
    content = bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"found a damaged zip \(Bad CRC-32"):
        load_bundle(path)


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("ai_edge_litert")
    path = bundle(tmp_path / "none.task", dict.fromkeys(NAMES, b"this is no flat buffer of a network"))
    with pytest.raises(FileFormatError, match=r"face_detector\.tflite: found no TensorFlow Lite network"):
        load_bundle(path)


def test_without_litert_the_message_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(MissingExtraError, match=r"needs ai-edge-litert, which is not installed .*pip install"):
        load_bundle(bundle(tmp_path / "one.task", dict.fromkeys(NAMES, b"abc")))


@pytest.mark.real
def test_networks_in_each_others_places_are_refused(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ai_edge_litert")
    whole = data / "peers" / "face_landmarker.task"
    with zipfile.ZipFile(whole) as archive:
        parts = {name: archive.read(name) for name in NAMES}
    swapped = {NAMES[0]: parts[NAMES[2]], NAMES[1]: parts[NAMES[1]], NAMES[2]: parts[NAMES[0]]}
    with pytest.raises(FileFormatError, match=r"found shapes .*\(1, 146, 2\).* expected input \(1, 128, 128, 3\)"):
        load_bundle(bundle(tmp_path / "swapped.task", swapped))
    (tmp_path / "short.task").write_bytes(whole.read_bytes()[:2_000_000])
    with pytest.raises(FileFormatError, match="found a damaged zip"):
        load_bundle(tmp_path / "short.task")
    parts[NAMES[0]] = parts[NAMES[0]][:100_000]
    with pytest.raises(FileFormatError, match=r"face_detector\.tflite: found"):
        load_bundle(bundle(tmp_path / "cut.task", parts))
    monkeypatch.setattr(landmarker_bundle, "_MAX_TENSORS", 2**20)
    with pytest.raises(FileFormatError, match=r"found tensors of \d+ bytes, expected at most 1048576"):
        load_bundle(whole)
