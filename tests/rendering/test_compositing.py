"""Texts in pictures: letters of other alphabets are drawn as they are."""

import pytest
import torch

from torchface.rendering.compositing import caption, text_font


@pytest.mark.parametrize("letters", ["äöüßÄÖÜ", "éèñçåøłčő", "αβγδΩ", "Жябл"])
def test_letters_with_accents_and_of_other_alphabets_are_no_boxes(letters: str) -> None:
    font = text_font(16)
    drawn = {bytes(font.getmask(letter)) for letter in letters}
    assert len(drawn) == len(letters)
    assert bytes(font.getmask("\uffff")) not in drawn  # what is drawn for a sign that the font lacks
    image = torch.zeros(3, 10, 200)
    assert not torch.equal(caption(image, letters[0]), caption(image, "\uffff"))
