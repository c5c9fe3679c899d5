"""Mesh files: OBJ, PLY, STL, and many meshes of one topology."""
