"""Colour pictures of synthetic people with exact landmarks, for networks to learn from."""
