"""A performer made by code: head, identities, expressions, skin; and the character that is shown of it."""

from torchface.synthetic.head.drawn_identities import draw_identities
from torchface.synthetic.head.embedded_character import Character, character
from torchface.synthetic.head.identity import IDENTITY, IdentityParameter
from torchface.synthetic.head.neutral_head import neutral_head
from torchface.synthetic.head.performer import performer
from torchface.synthetic.head.skin_maps import Look

__all__ = [
    "IDENTITY",
    "Character",
    "IdentityParameter",
    "Look",
    "character",
    "draw_identities",
    "neutral_head",
    "performer",
]
