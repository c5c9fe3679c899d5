"""Takes on disk: what another run has left there is read where it is whole and of the same, else made again."""

import json
import warnings
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.files.checkpoints import write_checkpoint
from train.take_store import StoredTake, TakeStore

TAKE = StoredTake(("jawOpen", "mouthLeft"), 30.0, torch.rand(5, 2, generator=torch.Generator().manual_seed(0)), True)


def letters(document: object) -> Tensor:
    return torch.tensor(list(json.dumps(document).encode()), dtype=torch.uint8)


FOREIGN = [
    {"weights": torch.zeros(3, 2)},
    {"weights": torch.zeros(3, 2), "facts": torch.zeros(3, dtype=torch.uint8)},
    {"weights": torch.zeros(3, 2), "facts": letters([1])},
    {"weights": torch.zeros(3, 2), "facts": letters({"names": ["a"], "fps": 30, "solved": False})},
    {"weights": torch.zeros(3), "facts": letters({"names": [], "fps": 30, "solved": False})},
]


@pytest.mark.parametrize("damage", [b"", b"cut", b"flip", *range(len(FOREIGN))])
def test_a_damaged_or_foreign_take_is_made_again(tmp_path: Path, damage: bytes | int) -> None:
    TakeStore(tmp_path, 1).stored("key", lambda: TAKE)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    if isinstance(damage, int):
        write_checkpoint(path, FOREIGN[damage], "key")
    else:
        path.write_bytes({b"": b"", b"cut": whole[:-3], b"flip": whole[:-1] + bytes([whole[-1] ^ 1])}[damage])
    store = TakeStore(tmp_path, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = store.stored("key", lambda: TAKE)
    torch.testing.assert_close(found.weights.float(), TAKE.weights)
    made: list[StoredTake] = []
    TakeStore(tmp_path, 1).stored("key", lambda: made.append(TAKE) or TAKE)
    assert not made
    torch.testing.assert_close(store.takes()[0].float(), TAKE.weights)
