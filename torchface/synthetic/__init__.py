"""A performer made by code: head, identities, expressions, skin."""

from torchface.synthetic.head.identity import IDENTITY, IdentityParameter, draw_identities
from torchface.synthetic.head.neutral_head import neutral_head
from torchface.synthetic.head.performer import performer

__all__ = ["IDENTITY", "IdentityParameter", "draw_identities", "neutral_head", "performer"]
