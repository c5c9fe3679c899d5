"""Pieces of takes from rest to rest: found where they were planted."""

import itertools
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.expression_sequences import expression_sequences
from torchface.io import load_take

FPS = 60.0
NAMES = ("browInnerUp", "mouthSmileLeft", "eyeBlinkLeft")


def planted(*peaks: tuple[int, float], length: int, rest: float = 0.3) -> Tensor:
    """Bumps of 40 frames' standard deviation over a rest that is not neutral, and a blink between them."""
    frame = torch.arange(length, dtype=torch.float32)
    weights = torch.full((length, 3), rest)
    for place, height in peaks:
        weights[:, :2] += height * (-0.5 * ((frame - place) / 40) ** 2).exp()[:, None]
    weights[200:206, 2] = 1.0
    return weights


def test_pieces_lie_round_the_planted_expressions() -> None:
    pieces = expression_sequences(planted((150, 0.6), (450, 0.4), length=600), NAMES, FPS)
    assert [piece.start < centre < piece.stop for piece, centre in zip(pieces, (150, 450), strict=True)] == [True, True]
    assert pieces[0].stop == pieces[1].start
    assert abs(pieces[0].stop - 305) < 15


def test_what_is_still_holds_no_expression() -> None:
    assert expression_sequences(torch.full((300, 3), 0.2), NAMES, FPS) == ()


@pytest.mark.real
def test_real_takes_hold_pieces_that_do_not_overlap(performances: list[Path]) -> None:
    for path in performances:
        track = load_take(path).weights
        assert track is not None
        pieces = expression_sequences(track.values[..., 0], track.names, FPS)
        assert len(pieces) >= 2
        assert all(a.stop <= b.start for a, b in itertools.pairwise(pieces))
