"""Image files as tensors, with their 16-bit and transparent kinds."""
