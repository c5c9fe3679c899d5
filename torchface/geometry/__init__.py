"""What meshes, cameras and rotations compute of themselves; nothing here depends on faces, files or learning."""
