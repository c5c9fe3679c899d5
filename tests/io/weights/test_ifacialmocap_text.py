"""iFacialMocap's recordings: a line a frame."""

from pathlib import Path

import pytest
import torch
from mutation import check_reader
from recordings_of_phones import ifacialmocap, some_frames

from torchface import load_take
from torchface.errors import FileFormatError
from torchface.io.weights.ifacialmocap_text import load_ifacialmocap
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT


def test_a_recording_keeps_weights_and_rotations(tmp_path: Path) -> None:
    weights, rotations = some_frames()
    take = load_take(ifacialmocap(tmp_path / "take.txt", weights, rotations))
    assert take.weights.names == ARKIT
    assert take.fps == 60
    torch.testing.assert_close(take.weights.values[..., 0], weights)
    found = torch.stack([take.extras["columns"][name] for name in ROTATIONS], 1)
    torch.testing.assert_close(found.float(), rotations, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"\n \n", "found no line"),
        (b"jawOpen-5|\n\xff|", "line 2: found no UTF-8"),
        (b"wing-5|", "line 1: found none of ARKit's shapes"),
        (b"jawOpen-5|=head#1,2|", "line 1: found 2 angles"),
        (b"jawOpen-5|" * 2000, "line 1: found 20000 letters"),
    ],
)
def test_what_is_no_recording_is_refused(data: bytes, found: str, tmp_path: Path) -> None:
    (tmp_path / "take.txt").write_bytes(data)
    with pytest.raises(FileFormatError, match=rf"take\.txt: .*{found}"):
        load_ifacialmocap(tmp_path / "take.txt")
    (tmp_path / "take.txt").write_text("hello\n")
    with pytest.raises(FileFormatError, match=r"take\.txt: found the line 'hello'; expected Face Cap's"):
        load_take(tmp_path / "take.txt")


def test_a_mutated_recording_is_read_or_refused(tmp_path: Path) -> None:
    check_reader(load_take, [ifacialmocap(tmp_path / "take.txt", *some_frames(3))], ".txt")
