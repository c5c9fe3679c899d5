"""Faces found on surfaces of any kind, by looking at them from around."""
