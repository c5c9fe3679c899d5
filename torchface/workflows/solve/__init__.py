"""Markers in, weights out."""
