"""A performer made by code: head, identities, expressions, skin."""

from torchface.synthetic.head.identity import IDENTITY, IdentityParameter, draw_identities
from torchface.synthetic.head.performer import neutral_head, performer

__all__ = ["IDENTITY", "IdentityParameter", "draw_identities", "neutral_head", "performer"]
