"""Face Cap's recordings: weights, rotations and times as they were written."""

from pathlib import Path

import pytest
import torch
from mutation import check_reader
from recordings_of_phones import face_cap, some_frames

from torchface import load_take
from torchface.errors import FileFormatError
from torchface.io.weights.face_cap_text import FACE_CAP_ORDER, load_face_cap
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT


def test_a_recording_keeps_weights_rotations_and_times(tmp_path: Path) -> None:
    weights, rotations = some_frames(40)
    take = load_take(face_cap(tmp_path / "take.txt", weights, rotations))
    assert take.weights.names == ("eyeBlink_L", *ARKIT[1:])  # as the file spells them
    torch.testing.assert_close(take.weights.values[..., 0], weights)
    found = torch.stack([take.extras["columns"][name] for name in ROTATIONS], 1)
    torch.testing.assert_close(found.float(), rotations, atol=1e-4, rtol=0)
    assert take.fps == 60
    assert take.seconds is None
    assert sorted(FACE_CAP_ORDER) == sorted(ARKIT)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("info,a\n", "found no frame"),
        ("bs,wing\nk," + "0," * 11 + "1\n", "found the shapes wing, expected some of ARKit's"),
        ("bs,jawOpen,jawOpen\n", "line 1: found 2 shapes"),
        ("bs,jawOpen\nbs,jawOpen\n", "line 2: found 1 shapes"),
        ("k,0,1\n", "line 1: found 3 cells, expected the names of the shapes first"),
        ("bs,jawOpen\nk,0,1,2,3\n", "line 2: found 5 cells, expected 13"),
        ("bs,jawOpen\nk," + "0," * 11 + "wide\n", "line 2: found 'wide', expected a number"),
        ("bs,jawOpen\nk," + "0," * 11 + "nan\n", "line 2: found 'nan', expected a number"),
        ("bs,jawOpen\n" + ("k,5," + "0," * 10 + "1\n") * 2, "found one time"),
        ("bs,jaw" + "x" * 9000, "line 1: found 9006 bytes"),
    ],
)
def test_what_is_no_recording_is_refused(text: str, found: str, tmp_path: Path) -> None:
    path = tmp_path / "take.txt"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=rf"take\.txt: .*{found}"):
        load_face_cap(path)


def test_a_mutated_recording_is_read_or_refused(tmp_path: Path) -> None:
    check_reader(load_take, [face_cap(tmp_path / "take.txt", *some_frames(3))], ".txt")
