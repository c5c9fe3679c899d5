"""Who sits before the webcam: an embedded performer with looks of their own."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchface.synthetic.stages.face_pictures.head_kind import performer_kind
from torchface.synthetic.stages.face_pictures.looks import draw_looks
from torchface.synthetic.stages.face_pictures.people import Person


def draw_sitter(generator: torch.Generator) -> Person:
    """An embedded performer with hair, skin and clothes drawn at random, without glasses or hair over the eyes.

    Args:
        generator: of head and looks.
    """
    kind, looks = performer_kind(), draw_looks(generator)
    bare = replace(looks, glasses=None, hairdo=replace(looks.hairdo, curtain=0.0))
    return Person(kind, kind.draw(generator), bare)
