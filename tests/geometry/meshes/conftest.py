"""The masks that rigid alignment finds again."""

from scanned_masks import make_mask, mask, moved

__all__ = ["make_mask", "mask", "moved"]
