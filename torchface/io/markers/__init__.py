"""Marker takes as files: C3D, CSV, and tables of labels."""
