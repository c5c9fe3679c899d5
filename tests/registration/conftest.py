"""The masks that every test of registration bends."""

from scanned_masks import make_mask, mask, moved, rescanned, warp

__all__ = ["make_mask", "mask", "moved", "rescanned", "warp"]
