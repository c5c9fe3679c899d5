"""Where a surface meets itself in a pose; see ``torchface.geometry.contact``."""

from torchface.geometry.contact import ContactFinder, ContactPairs

__all__ = ["ContactFinder", "ContactPairs"]
