"""Boxes of faces in images: detectors, and searches of turned faces."""
