"""What meshes, cameras and rotations compute of themselves; no room below knows of faces, files or learning."""
