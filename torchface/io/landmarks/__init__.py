"""Landmark files: points by hand, iBUG, OpenFace, dlib."""
