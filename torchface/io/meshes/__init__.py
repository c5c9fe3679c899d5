"""Mesh files: OBJ, PLY, STL, OFF, and many meshes of one topology."""
