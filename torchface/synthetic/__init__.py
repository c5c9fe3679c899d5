"""A performer made by code: head, identities, expressions, skin."""

from torchface.synthetic.head import head
from torchface.synthetic.identity import IDENTITY, IdentityParameter, draw_identities
from torchface.synthetic.performer import performer

__all__ = ["IDENTITY", "IdentityParameter", "draw_identities", "head", "performer"]
