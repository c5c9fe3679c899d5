"""A cut to another face is found by its look and its landmarks; hands, turns and cuts to the same face are not."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchface.capture.own_rig.another_face import AnotherFace, FilmLooks, other_faces

NUMBERS = 300
BOX = torch.tensor([100.0, 100, 50, 50])
LOST = torch.full((12, NUMBERS), torch.nan), torch.full((12, 68, 2), torch.nan)


def person(seed: int, frames: int = 30) -> tuple[Tensor, Tensor]:
    """Looks and landmarks of somebody whose look and expression change slowly."""
    generator = torch.Generator().manual_seed(seed)
    look, turned = torch.randn(2, NUMBERS, generator=generator)
    place = 0.02 * torch.randn(68, 2, generator=generator)
    t = torch.linspace(0, 6, frames)[:, None]
    looks = look + 0.2 * t.sin() * turned + 0.02 * torch.randn(frames, NUMBERS, generator=generator)
    relative = place + 0.01 * t.sin()[..., None] + 0.003 * torch.randn(frames, 68, 2, generator=generator)
    return normalize(looks, dim=1), relative


def film(*spans: tuple[Tensor, Tensor], cut: float = 0.5) -> list[AnotherFace]:
    """Spans of pictures that change by so much where one goes over to the next, and hardly at all within."""
    looks, relative = (torch.cat(parts) for parts in zip(*spans, strict=True))
    changes = torch.cat([torch.tensor([cut] + [0.002] * len(part))[: len(part)] for part, _ in spans])
    return other_faces(FilmLooks(looks, changes), relative, torch.ones(len(looks), 68), BOX.expand(len(looks), 4))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_another_face_is_found_and_the_first_one_again(seed: int) -> None:
    first, other = person(10 * seed), person(10 * seed + 1)
    found = film(first, other, first)
    assert [(span.first, span.last) for span in found] == [(30, 59)]
    assert found[0].likeness < 0.5
    assert found[0].apart > 0.01


def test_one_face_is_one_face() -> None:
    looks, relative = person(4)
    assert film((looks, relative)) == []
    assert film((looks[:15], relative[:15]), (looks[20:], relative[20:])) == []  # a jump cut
    assert film((looks, relative), LOST, (looks, relative)) == []
    hand = normalize(torch.randn(1, NUMBERS, generator=torch.Generator().manual_seed(0)), dim=1)
    share = torch.tensor([0.2, 0.5, 0.8, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0.8, 0.5, 0.2])[:, None]
    hidden = normalize((1 - 0.7 * share) * looks[:15] + 0.7 * share * hand, dim=1)
    assert film((looks, relative), (hidden, relative[:15]), (looks, relative)) == []


def test_a_hand_before_the_face_is_no_cut() -> None:
    """The face looks otherwise from one frame to the next, its landmarks lie elsewhere; most of the picture stays."""
    first, other = person(7), person(8)
    assert [(span.first, span.last) for span in film(first, other)] == [(30, 59)]
    assert film(first, other, cut=0.015) == []
    looks, relative = (torch.cat(parts) for parts in zip(first, other, strict=True))
    changes = torch.full((60,), 0.002)
    changes[29:32] = torch.tensor([0.053, 0.05, 0.026])  # a hand that takes three frames
    assert other_faces(FilmLooks(looks, changes), relative, torch.ones(60, 68), BOX.expand(60, 4)) == []


def test_spans_between_cuts_and_losses_are_judged() -> None:
    first, other = person(5), person(6)
    assert [(span.first, span.last) for span in film(first, LOST, other)] == [(42, 71)]
    assert film(first, (other[0][:6], other[1][:6]), first) == []  # too short to know
    assert film((first[0][:0], first[1][:0])) == []
