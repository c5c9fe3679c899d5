"""The same masks as for the registration of one scan."""

from scanned_masks import make_mask, mask, moved, rescanned, warp

__all__ = ["make_mask", "mask", "moved", "rescanned", "warp"]
