"""Cameras: projection, lens distortion, and where a camera stands (the perspective-n-point problem)."""
