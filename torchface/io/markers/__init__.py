"""Marker takes as files: C3D, TRC, CSV, and tables of labels."""
