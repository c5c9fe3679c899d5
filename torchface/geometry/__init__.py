"""Geometry of meshes, cameras and rotations; nothing here depends on faces, files or learning."""
