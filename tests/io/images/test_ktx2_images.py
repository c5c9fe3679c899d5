"""KTX2 images, of Face Cap's character as three.js ships it."""

import random
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from planted.glb_files import unpacked
from torchface.errors import FileFormatError
from torchface.io import load_mesh
from torchface.io.images.image_samples import decode_samples

pytestmark = pytest.mark.real
pytest.importorskip("opengl_basisu", reason="opengl-basisu is not installed")


@pytest.fixture(scope="module")
def packed(data: Path) -> bytes:
    root, binary = unpacked(data / "characters" / "facecap.glb")
    view = root["bufferViews"][root["images"][0]["bufferView"]]
    start = view.get("byteOffset", 0)
    return binary[start : start + view["byteLength"]]


def test_the_largest_level_is_read_with_its_first_row_on_top(packed: bytes) -> None:
    image = decode_samples(packed, "face").colors()
    assert image.shape == (3, 1024, 1024)
    shade = image.mean(0)
    assert float(shade[900:1000, 300:330].mean()) < 0.62  # skin; beside it the teeth's white
    assert float(shade[560:860, 20:180].mean()) > 0.9
    cheek = image[:, 700:780, 330:400].mean((1, 2))
    assert float(cheek[0] - cheek[1]) > 0.02  # the blush
    assert decode_samples(packed, "face").array.shape[2] == 3  # it has no opacity


def test_damaged_images_are_refused(packed: bytes) -> None:
    draw = random.Random(0)
    for cut in (12, 40, 79, 200, len(packed) // 2):
        with pytest.raises(FileFormatError, match=r"no readable image|pixels"):
            decode_samples(packed[:cut], "cut")
    wide = packed[:20] + (2**30).to_bytes(4, "little") + packed[24:]
    with pytest.raises(FileFormatError, match="1073741824 x 1024 pixels"):
        decode_samples(wide, "wide")
    for _ in range(100):
        mutated = bytearray(packed)
        for at in draw.choices(range(300), k=3):
            mutated[at] = draw.randrange(256)
        with suppress(FileFormatError):
            decode_samples(bytes(mutated), "mutated")


def test_a_character_keeps_its_picture_and_without_the_package_says_so(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = data / "characters" / "facecap.glb"
    texture = load_mesh(path).texture
    assert float(texture.std()) > 0.1
    monkeypatch.setitem(sys.modules, "opengl_basisu", None)
    with pytest.warns(UserWarning, match=r"needs opengl-basisu, .* the surface goes without it"):
        load_mesh(path)
