"""Files of rendered pictures: damaged ones are named and made again."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from train.rendered_files import Rendering, rendered_files


def numbered(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    return {"number": torch.arange(first, first + count)[:, None] + seed}


RENDERING = Rendering(numbered, "numbers/1", "numbers", "numbers", 4)


def test_damaged_files_are_named_and_rendered_again(tmp_path: Path) -> None:
    paths = rendered_files(RENDERING, tmp_path, 20, 0, None, 1, None)
    whole = [path.read_bytes() for path in paths]
    paths[0].write_bytes(b"")
    paths[1].write_bytes(whole[1][:-3])
    save_file({"number": torch.zeros(3, 1, dtype=torch.int64)}, paths[2])
    paths[3].write_bytes((2**62).to_bytes(8, "little") + b"{" * 64)
    before = paths[4].stat().st_mtime_ns
    with pytest.warns(UserWarning, match="rendered again") as said:
        assert rendered_files(RENDERING, tmp_path, 20, 0, None, 1, None) == paths
    assert [path.read_bytes() for path in paths] == whole
    assert paths[4].stat().st_mtime_ns == before
    assert [next(path for path in paths if path.name in str(one.message)) for one in said] == paths[:4]
    assert load_file(paths[4])["number"].flatten().tolist() == [16, 17, 18, 19]
