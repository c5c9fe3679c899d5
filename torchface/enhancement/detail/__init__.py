"""Smooth parts and detail of frames: how they are split, encoded and compressed."""
